"""False alarms per hour that follow from a window-level budget alpha."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.cueing.cueing_policy import sustained_statistic
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.metrics.approach_table import SECONDS_PER_HOUR, poisson_interval, rising_edges


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
        """One onset as a rate: the resolution of these hours."""
        return 1.0 / self.hours


def false_alarm_rate(
    hazard_free: Sequence[ArrayLike], gamma: float, sustain_hops: int = 1, hop_s: float = 0.1
) -> FalseAlarmRate:
    """Count the false alarms of a threshold on hazard-free streams, each of shape (windows,)."""
    period_s = in_range("hop_s", hop_s, 0.0, np.inf, open_low=True)
    held = [sustained_statistic(stream, sustain_hops) >= gamma for stream in hazard_free]
    windows = sum(alarm.size for alarm in held)
    if not windows:
        raise InvalidArgumentError("hazard_free: expected at least one window")
    onsets = sum(rising_edges(alarm).size for alarm in held)
    hours = windows * period_s / SECONDS_PER_HOUR
    share = sum(int(alarm.sum()) for alarm in held) / windows
    return FalseAlarmRate(float(gamma), share, onsets, hours, *poisson_interval(onsets, hours))
