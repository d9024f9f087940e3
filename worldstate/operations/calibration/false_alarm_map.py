"""False alarms per hour that follow from a window-level budget alpha."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.cueing.cueing_policy import sustained_statistic
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.recordings.advisories import SECONDS_PER_HOUR, rising_edges


@dataclass(frozen=True, slots=True)
class FalseAlarmRate:
    """False alarms of one threshold on hazard-free recordings.

    Examples
    --------
    >>> rate = FalseAlarmRate(0.9, 0.02, 11, 0.103, 53.3, 191.1)
    >>> round(rate.per_hour), round(rate.quantum_per_hour, 1)
    (107, 9.7)
    """

    gamma: float  # The threshold
    window_rate: float  # Share of windows in sustained alarm
    onsets: int  # Rising edges
    hours: float  # Scored hazard-free time
    low_per_hour: float  # Exact 95 % interval of the rate, the onsets taken for a Poisson count
    high_per_hour: float

    @property
    def per_hour(self) -> float:
        """False alarms per hour."""
        return self.onsets / self.hours

    @property
    def quantum_per_hour(self) -> float:
        """What one onset more or less comes to: no rate finer than this can be told from these hours."""
        return 1.0 / self.hours


def false_alarm_rate(
    hazard_free: Sequence[ArrayLike], gamma: float, sustain_hops: int = 1, hop_s: float = 0.1
) -> FalseAlarmRate:
    r"""Count the false alarms of a threshold.

    .. math:: [\chi^2_{.025}(2n),\ \chi^2_{.975}(2n + 2)] / 2T.

    Shapes: hazard_free (windows,).

    Examples
    --------
    >>> rate = false_alarm_rate([[0.1, 0.9, 0.9, 0.1] * 900], gamma=0.5)
    >>> rate.onsets, rate.hours, rate.window_rate
    (900, 0.1, 0.5)
    """
    # With n onsets in T hours the interval is Garwood's,
    from scipy.stats import chi2

    period_s = in_range("hop_s", hop_s, 0.0, np.inf, open_low=True)
    held = [sustained_statistic(stream, sustain_hops) >= gamma for stream in hazard_free]
    windows = sum(alarm.size for alarm in held)
    if not windows:
        raise InvalidArgumentError("hazard_free: expected at least one window")
    onsets = sum(rising_edges(alarm).size for alarm in held)
    hours = windows * period_s / SECONDS_PER_HOUR
    low = chi2.ppf(0.025, 2 * onsets) / 2 if onsets else 0.0
    high = chi2.ppf(0.975, 2 * onsets + 2) / 2
    share = sum(int(alarm.sum()) for alarm in held) / windows
    return FalseAlarmRate(float(gamma), share, int(onsets), hours, float(low) / hours, float(high) / hours)


def threshold_for_rate(
    hazard_free: Sequence[ArrayLike], rate_per_hour: float, sustain_hops: int = 1, hop_s: float = 0.1
) -> FalseAlarmRate:
    """Return the smallest threshold from which on no larger one exceeds a rate: the map read backwards.

    Examples
    --------
    >>> streams = [np.random.default_rng(0).random(36_000)]
    >>> found = threshold_for_rate(streams, rate_per_hour=5.0)
    >>> found.onsets, round(found.gamma, 3)
    (5, 1.0)
    """
    # Onsets are no monotone function of the threshold, as two alarms merge where it falls; every threshold
    # above the returned one keeps the rate too.
    budget = in_range("rate_per_hour", rate_per_hour, 0.0, np.inf)
    held = [sustained_statistic(finite_array("hazard_free", s, (None,)), sustain_hops) for s in hazard_free]
    levels, count = _onset_levels(held)
    hours = sum(stream.size for stream in held) * hop_s / SECONDS_PER_HOUR
    over = np.flatnonzero(count > budget * hours + 1e-9)
    highest = levels[over[0]] if over.size else -np.inf
    gamma = float(max(np.nextafter(highest, np.inf), np.finfo(np.float64).min))
    return false_alarm_rate(hazard_free, gamma, sustain_hops, hop_s)


def _onset_levels(held: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Distinct levels, falling, and the number of onsets with the threshold at each."""
    # Window t is an onset for thresholds in (its predecessor, itself]: one more at its own level, one less at
    # its predecessor's.
    begin = np.concatenate([*held, np.empty(0)])
    before = np.concatenate([np.concatenate([[-np.inf], s])[: s.size] for s in held] + [np.empty(0)])
    rises = begin > before
    levels = np.concatenate([begin[rises], before[rises]])
    change = np.concatenate([np.ones(rises.sum()), -np.ones(rises.sum())])
    finite = np.isfinite(levels)
    distinct, where = np.unique(-levels[finite], return_inverse=True)
    return -distinct, np.cumsum(np.bincount(where, change[finite], distinct.size))
