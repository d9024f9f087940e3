"""From the statistic to an advisory: the sustained rule, the policy and its Neyman-Pearson threshold.

`risk_map` contains its map to risk.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import TINY, BoolArray, FloatArray, InvalidArgumentError, finite_array, in_range

from .risk_map import PlattMap, RiskMap


@dataclass(frozen=True, slots=True)
class CueingPolicy:
    """Parameters of one false-alarm budget, fixed on calibration data and then applied unchanged.

    Parameters
    ----------
    gamma : float
        An alarm requires a statistic of at least this value.
    sustain_hops : int
        Number of consecutive hops that have to reach gamma.
    alpha : float
        Share of hazard-free windows in alarm for which gamma was set.
    reference_prior : tuple of float
        Probabilities of (hidden_1 .. hidden_K, visible, none) at which the statistic is computed.
    risk_map : RiskMap
        Map from the statistic to calibrated risk.
    miss_rate : float
        The beta of the statistic on the calibration data: 0 without the visible explanation, 1 for the
        published statistic. The statistic falls as beta rises, so a gamma set at 0 keeps its budget at every
        beta.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or the prior does not sum to one.

    Examples
    --------
    >>> from worldstate.abduction.cueing.risk_map import PlattMap
    >>> policy = CueingPolicy(0.8, 3, 0.02, (0.25, 0.25, 0.25, 0.25), PlattMap(-1.0, 0.0))
    >>> policy.gamma, round(policy.risk_map(0.9), 2)
    (0.8, 0.9)
    """

    gamma: float
    sustain_hops: int
    alpha: float
    reference_prior: tuple[float, ...]
    risk_map: RiskMap
    miss_rate: float = 0.0

    def __post_init__(self) -> None:
        finite_array("gamma", self.gamma, ())
        _check_sustain_hops(self.sustain_hops)
        in_range("alpha", self.alpha, 0.0, 1.0, open_high=True)
        in_range("miss_rate", self.miss_rate, 0.0, 1.0)
        prior = finite_array("reference_prior", self.reference_prior, (None,))
        if prior.size <= 2 or (prior <= 0).any() or not np.isclose(prior.sum(), 1.0):
            raise InvalidArgumentError("reference_prior: expected 3 or more positive numbers, sum one")


@dataclass(frozen=True, slots=True)
class CueingPolicies:
    """The policies of one model: one per budget and miss rate of its calibration.

    Parameters
    ----------
    policies : tuple of CueingPolicy
        At least one policy.

    Raises
    ------
    InvalidArgumentError
        If there is no policy.

    Examples
    --------
    >>> from worldstate.abduction.cueing.risk_map import PlattMap
    >>> policy = CueingPolicy(0.8, 3, 0.02, (0.25, 0.25, 0.25, 0.25), PlattMap(-1.0, 0.0))
    >>> CueingPolicies((policy,)).for_alpha(0.02).gamma
    0.8
    """

    policies: tuple[CueingPolicy, ...]

    def __post_init__(self) -> None:
        if not self.policies:
            raise InvalidArgumentError("policies: expected at least one")

    def for_alpha(self, alpha: float, miss_rate: float = 0.0) -> CueingPolicy:
        """Return the policy of a budget at the given miss rate (0 or 1 in a trained model).

        Parameters
        ----------
        alpha : float
            Budget: share of hazard-free windows in alarm.
        miss_rate : float
            The beta of the statistic.

        Raises
        ------
        InvalidArgumentError
            If the model was not calibrated for this budget; the message lists the available ones.
        """
        held: Sequence[CueingPolicy] = self.policies
        for name, wanted in (("alpha", alpha), ("miss_rate", miss_rate)):
            found = [one for one in held if np.isclose(getattr(one, name), wanted)]
            if not found:
                known = ", ".join(sorted({f"{getattr(one, name):g}" for one in held}))
                raise InvalidArgumentError(f"{name}: expected a calibrated budget ({known}), got {wanted:g}")
            held = found
        return held[0]


def sustained_statistic(statistic: ArrayLike, sustain_hops: int) -> FloatArray:
    r"""Return the smallest statistic of the last k hops; -inf if there are fewer.

    .. math:: h_t = \min(s_{t-k+1}, \dots, s_t)

    Shapes: statistic (windows,).

    Examples
    --------
    >>> sustained_statistic([0.2, 0.9, 0.8, 0.1], sustain_hops=2)
    array([-inf,  0.2,  0.8,  0.1])
    """
    # The sustained rule raises an alarm exactly if this value is at or above the threshold.
    values = finite_array("statistic", statistic, (None,))
    hops = _check_sustain_hops(sustain_hops)
    held = np.full(values.shape, -np.inf)
    if values.size >= hops:
        held[hops - 1 :] = np.lib.stride_tricks.sliding_window_view(values, hops).min(axis=1)
    return held


def sustained_alarm(held: ArrayLike, sustain_hops: int) -> BoolArray:
    """Return whether `held` is true in each of the last k hops, shape (windows,): the sustained rule.

    Shapes: held (windows,).

    Examples
    --------
    >>> sustained_alarm([True, True, False, True], sustain_hops=2)
    array([False,  True, False, False])
    """
    # `alarm_t = held_(t-k+1) and .. and held_t`
    return sustained_statistic(np.asarray(held, dtype=bool), sustain_hops) >= 0.5


def _check_sustain_hops(sustain_hops: object) -> int:
    if not isinstance(sustain_hops, int | np.integer) or isinstance(sustain_hops, bool) or sustain_hops < 1:
        raise InvalidArgumentError(f"sustain_hops: expected a whole number >= 1, got {sustain_hops!r:.40}")
    return int(sustain_hops)


def uncalibrated_policy(directions: int = 2) -> CueingPolicy:
    """Return a policy for experiments, for which no false-alarm budget was measured (alpha 0).

    Parameters
    ----------
    directions : int
        Number of directions K.

    Returns
    -------
    CueingPolicy
        Policy with alpha 0.

    Examples
    --------
    >>> uncalibrated_policy().gamma
    0.9
    """
    prior = (1.0 / (directions + 2),) * (directions + 2)
    # Three windows in a row above 0.9; with slope -1 and offset 0 the risk is the statistic.
    return CueingPolicy(0.9, 3, 0.0, prior, PlattMap(-1.0, 0.0))


def neyman_pearson_threshold(hazard_free: Sequence[ArrayLike], alpha: float, sustain_hops: int = 1) -> float:
    r"""Return the smallest threshold whose sustained alarm stays within its budget on hazard-free recordings.

    .. math::
        \gamma(\alpha) = \min \Big\{ \gamma : \frac{1}{N} \sum_t
        1\big[\min(s_{t-k+1}, \dots, s_t) \ge \gamma\big] \le \alpha \Big\}

    over all N windows of all recordings; consecutive hops never span two recordings. The rate on these
    windows never exceeds `alpha`, even if statistics are equal.

    Parameters
    ----------
    hazard_free : sequence of array_like, each of shape (windows,)
        Statistics of each hazard-free calibration recording, in temporal order.
    alpha : float
        Budget: share of windows in alarm, in [0, 1).
    sustain_hops : int
        k, the number of consecutive hops for which the statistic has to hold.

    Returns
    -------
    float
        Threshold on the scale of the statistic.

    Raises
    ------
    InvalidArgumentError
        If there are no windows, one is not finite, or alpha or k is out of range.

    References
    ----------
    "Evidence of Absence", section VII; DESIGN.md, Definitions, gamma(alpha).

    Examples
    --------
    >>> gamma = neyman_pearson_threshold([[0.1, 0.9, 0.2], [0.3, 0.4]], alpha=0.2)
    >>> 0.4 < gamma < 0.4000001
    True
    """
    budget = in_range("alpha", alpha, 0.0, 1.0, open_high=True)
    streams = [finite_array("hazard_free", stream, (None,)) for stream in hazard_free]
    held = np.concatenate([np.zeros(0), *(sustained_statistic(one, sustain_hops) for one in streams)])
    if not held.size:
        raise InvalidArgumentError("hazard_free: expected at least one window")
    # The threshold is the next float above the statistic of the first window that exceeds the budget.
    paid, least = int(budget * held.size * (1.0 + TINY)), float(np.finfo(np.float64).min)
    return least if paid >= held.size else max(float(np.nextafter(np.sort(held)[-1 - paid], np.inf)), least)
