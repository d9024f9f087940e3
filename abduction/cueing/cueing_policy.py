"""From statistic to advisory: the sustained rule and the policy that carries its numbers.

The threshold of a policy is set in `thresholds`, its map to risk in `risk_map`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import BoolArray, FloatArray, InvalidArgumentError, finite_array, in_range
from worldstate.ground.serialisation import Check
from worldstate.ground.values import SECONDS_PER_HOUR

from .risk_map import PlattMap, RiskMap

# Odds of half a billion to one: beyond them a shift of the threshold means nothing.
_EXTREME_LOGIT = 20.0
# eta, the shift that one false alarm brings, and the bounds of the shift; downward it keeps quiet nights from
# making every rustle an alarm.
STEP_NATS, MOST_UP_NATS, MOST_DOWN_NATS = 0.25, 2.0, 1.0
# Filtered P(none) from which on the street is believed empty, and P(visible) from which on something has
# come: the alarm was right.
_EMPTY, _CAME = 0.5, 0.5
# An alarm this old without anything having come counts as false, and again after as long.
_LONGEST_ALARM_S = 15.0


@dataclass(frozen=True, slots=True)
class AdaptiveBudget:
    r"""Target false-alarm rate and the range within which the threshold may move.

    The calibrated threshold is shifted in log-odds, :math:`\mathrm{logit}\,\gamma_t = \mathrm{logit}\,\gamma
    + x_t`, with

    .. math:: x \leftarrow \min(\max(x + \eta\,(N - \lambda\, \Delta t), -x_{down}), x_{up}),

    N false alarms and :math:`\Delta t` hours of street believed empty. Whatever the sounds are, the false
    alarms counted in T such hours are at most

    .. math:: \lambda T + (x_{down} + x_{up}) / \eta + 1,

    as long as the shift stays below its upper bound. That bound is there so that the threshold can never go
    deaf: the shift is at most `MOST_UP_NATS`, and the threshold never above `highest` unless it was
    calibrated there. A hazard whose odds are e^{x_up} times those at the calibrated threshold, or whose
    statistic is at `highest`, is announced however many alarms went before; the budget gives way first.

    Parameters
    ----------
    rate_per_hour : float
        lambda, false alarms per hour of empty street, > 0.
    highest : float
        Largest threshold that a shift may lead to, in (0, 1): one that most approaches reach.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> AdaptiveBudget(rate_per_hour=20.0).highest
    0.99
    """

    rate_per_hour: float
    highest: float = 0.99

    def __post_init__(self) -> None:
        in_range("rate_per_hour", self.rate_per_hour, 0.0, 1e5, open_low=True)
        in_range("highest", self.highest, 0.0, 1.0, open_low=True, open_high=True)

    def gamma(self, calibrated: float, shift_nats: float) -> float:
        r"""Return the threshold at a shift; never above `highest` unless it was calibrated there.

        .. math:: \mathrm{logit}\, \gamma_t = \mathrm{logit}\, \gamma + x_t, \qquad
                  \gamma_t \le \max(\gamma, highest)

        Parameters
        ----------
        calibrated : float
            Threshold of the policy.
        shift_nats : float
            How far it has moved, on the log-odds of the statistic.

        References
        ----------
        Derived here: on log-odds a shift means the same evidence wherever the threshold stands.

        Examples
        --------
        >>> budget = AdaptiveBudget(20.0)
        >>> [round(budget.gamma(0.9, shift), 3) for shift in (-1.0, 0.0, 1.0, 2.0)]
        [0.768, 0.9, 0.961, 0.985]
        """
        if shift_nats == 0.0 or not 0.0 < calibrated < 1.0:
            return calibrated
        logit = math.log(calibrated / (1.0 - calibrated)) + shift_nats
        shifted = 1.0 / (1.0 + math.exp(-max(min(logit, 2 * _EXTREME_LOGIT), -2 * _EXTREME_LOGIT)))
        return min(shifted, max(calibrated, self.highest))


@dataclass(frozen=True, slots=True)
class AdaptiveThreshold:
    """State of the adaptive threshold."""

    # x_t
    shift_nats: Annotated[float, Check("at most 100 nats", lambda x: abs(x) <= 100.0)] = 0.0
    # Age of an alarm of which it is not known yet whether anything comes; None where there is none.
    pending_s: Annotated[float, Check("an age", lambda age: 0.0 <= age <= 1e9)] | None = None
    alarm: bool = False  # Whether the rule was in alarm at the last hop

    def advance(
        self, budget: AdaptiveBudget, *, visible: float, none: float, alarm: bool, elapsed_s: float
    ) -> "AdaptiveThreshold":
        r"""Return the state after one more hop.

        .. math:: x \leftarrow \min(\max(x + \eta\, (N - \lambda\, \Delta t), -x_{down}), x_{up})

        with N one where an alarm has turned out false in this hop, and the time counted while the street is
        empty.

        References
        ----------
        I. Gibbs and E. Candès, "Adaptive conformal inference under distribution shift", 2021 (updates of this
        kind).
        """
        onset = alarm and not self.alarm
        pending_s = 0.0 if onset and self.pending_s is None else self.pending_s
        empty = not alarm and none >= _EMPTY
        # False alarms less those that the budget allows; None where an alarm was right or is not judged yet.
        events: float | None = None
        if pending_s is None:
            events = -budget.rate_per_hour * (elapsed_s / SECONDS_PER_HOUR if empty else 0.0)
        elif visible >= _CAME:
            pending_s = None
        elif empty:
            events, pending_s = 1.0, None
        elif pending_s + elapsed_s >= _LONGEST_ALARM_S:
            events, pending_s = 1.0, 0.0
        else:
            pending_s += elapsed_s
        shift = self.shift_nats
        if events is not None:
            shift = min(max(shift + STEP_NATS * events, -MOST_DOWN_NATS), MOST_UP_NATS)
        return AdaptiveThreshold(shift, pending_s, alarm)


@dataclass(frozen=True, slots=True)
class CueingPolicy:
    """Numbers of one false-alarm budget, fixed on calibration data and applied unchanged.

    Parameters
    ----------
    gamma : float
        Alarm when the statistic is at or above it.
    sustain_hops : int
        Consecutive hops that it has to hold.
    alpha : float
        Share of hazard-free windows in alarm that gamma was set for.
    reference_prior : tuple of float
        Probabilities of (hidden_1 .. hidden_K, visible, none) at which the statistic is formed.
    risk_map : RiskMap
        From statistic to calibrated risk.
    miss_rate : float
        The beta at which the statistic was formed on the calibration data: 0 with the visible explanation
        removed, 1 for the published statistic. The statistic falls as beta rises, so a gamma set at 0 keeps
        its budget at every beta.
    adaptive : AdaptiveBudget, optional
        A false-alarm rate that the filter keeps by moving the threshold about gamma; None leaves it there.

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
    adaptive: AdaptiveBudget | None = None

    def __post_init__(self) -> None:
        finite_array("gamma", self.gamma, ())
        _check_sustain_hops(self.sustain_hops)
        in_range("alpha", self.alpha, 0.0, 1.0, open_high=True)
        in_range("miss_rate", self.miss_rate, 0.0, 1.0)
        prior = finite_array("reference_prior", self.reference_prior, (None,))
        if prior.size < 3 or (prior <= 0).any() or not np.isclose(prior.sum(), 1.0, atol=1e-6):
            raise InvalidArgumentError("reference_prior: expected 3 or more positive numbers, sum one")

    def gamma_at(self, shift_nats: float) -> float:
        r"""Return the threshold once it has moved by so much; gamma itself where nothing moves it.

        .. math:: \mathrm{logit}\, \gamma_t = \mathrm{logit}\, \gamma + x_t

        Parameters
        ----------
        shift_nats : float
            On the log-odds of the statistic.

        References
        ----------
        Derived here: see `AdaptiveBudget.gamma`.
        """
        return self.gamma if self.adaptive is None else self.adaptive.gamma(self.gamma, shift_nats)


@dataclass(frozen=True, slots=True)
class CueingPolicies:
    """The policies of one model: one for each budget and miss rate that it was calibrated at.

    Parameters
    ----------
    policies : tuple of CueingPolicy
        At least one.

    Raises
    ------
    InvalidArgumentError
        If there is none.

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
        """Return the policy of a budget, calibrated at the given miss rate (0 or 1 in a trained model).

        Parameters
        ----------
        alpha : float
            Budget.
        miss_rate : float
            beta of the co-evidence that the statistic was made with.

        Raises
        ------
        InvalidArgumentError
            If the model was not calibrated for it; the message lists the budgets that it holds.
        """
        held: Sequence[CueingPolicy] = self.policies
        for name, wanted in (("alpha", alpha), ("miss_rate", miss_rate)):
            found = [one for one in held if np.isclose(getattr(one, name), wanted, rtol=1e-6)]
            if not found:
                known = ", ".join(sorted({f"{getattr(one, name):g}" for one in held}))
                raise InvalidArgumentError(f"{name}: expected a calibrated budget ({known}), got {wanted:g}")
            held = found
        return held[0]


def sustained_statistic(statistic: ArrayLike, sustain_hops: int) -> FloatArray:
    r"""Return the smallest statistic of the last k hops; -inf where there are fewer.

    .. math:: h_t = \min(s_{t-k+1}, \dots, s_t)

    Shapes: statistic (windows,).

    Examples
    --------
    >>> sustained_statistic([0.2, 0.9, 0.8, 0.1], sustain_hops=2)
    array([-inf,  0.2,  0.8,  0.1])
    """
    # The sustained rule is in alarm exactly where this is at or above the threshold.
    values = finite_array("statistic", statistic, (None,))
    hops = _check_sustain_hops(sustain_hops)
    held = np.full(values.shape, -np.inf)
    if values.size >= hops:
        held[hops - 1 :] = np.lib.stride_tricks.sliding_window_view(values, hops).min(axis=1)
    return held


def sustained_alarm(held: ArrayLike, sustain_hops: int) -> BoolArray:
    """Return where the last k hops all held, shape (windows,): the sustained rule over a whole recording.

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
    """Return a policy for trying things out: no false-alarm budget was ever measured for it (alpha 0).

    Parameters
    ----------
    directions : int
        Number of directions K.

    Returns
    -------
    CueingPolicy
        With alpha 0.

    Examples
    --------
    >>> uncalibrated_policy().gamma
    0.9
    """
    prior = (1.0 / (directions + 2),) * (directions + 2)
    # Three windows in a row above .9; slope -1 and offset 0 make the risk the statistic itself.
    return CueingPolicy(0.9, 3, 0.0, prior, PlattMap(-1.0, 0.0))
