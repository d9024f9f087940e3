r"""A threshold that keeps a false-alarm rate while sound and street drift, without hazard labels."""

import math
from dataclasses import dataclass, replace
from typing import Annotated

from worldstate.ground.checks import in_range
from worldstate.ground.serialisation import Check

SECONDS_PER_HOUR = 3600.0
# Odds of half a billion to one: beyond them a shift of the threshold means nothing.
_EXTREME_LOGIT = 20.0


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
    deaf: the shift is at most `most_up_nats`, and the threshold never above `highest` unless it was
    calibrated there. A hazard whose odds are e^{x_up} times those at the calibrated threshold, or whose
    statistic is at `highest`, is announced however many alarms went before; the budget gives way first.

    Parameters
    ----------
    rate_per_hour : float
        lambda, false alarms per hour of empty street, > 0.
    step_nats : float
        eta, the shift that one false alarm brings.
    most_up_nats, most_down_nats : float
        Bounds of the shift; downward it keeps quiet nights from making every rustle an alarm.
    highest : float
        Largest threshold that a shift may lead to, in (0, 1): one that most approaches reach.
    empty_probability : float
        Filtered P(none) from which on the street is believed empty.
    seen_probability : float
        Filtered P(visible) from which on an alarm is believed to have been right: something came.
    longest_alarm_s : float
        An alarm this old without anything having come counts as false, and again after as long.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> AdaptiveBudget(rate_per_hour=20.0).most_up_nats
    2.0
    """

    rate_per_hour: float
    step_nats: float = 0.25
    most_up_nats: float = 2.0
    most_down_nats: float = 1.0
    highest: float = 0.99
    empty_probability: float = 0.5
    seen_probability: float = 0.5
    longest_alarm_s: float = 15.0

    def __post_init__(self) -> None:
        in_range("rate_per_hour", self.rate_per_hour, 0.0, 1e5, open_low=True)
        in_range("step_nats", self.step_nats, 0.0, 10.0, open_low=True)
        in_range("most_up_nats", self.most_up_nats, 0.0, _EXTREME_LOGIT)
        in_range("most_down_nats", self.most_down_nats, 0.0, _EXTREME_LOGIT)
        in_range("highest", self.highest, 0.0, 1.0, open_low=True, open_high=True)
        in_range("empty_probability", self.empty_probability, 0.0, 1.0, open_low=True)
        in_range("seen_probability", self.seen_probability, 0.0, 1.0, open_low=True)
        in_range("longest_alarm_s", self.longest_alarm_s, 0.0, 1e6, open_low=True)

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
        empty = not alarm and none >= budget.empty_probability
        if pending_s is None:
            quiet_h = elapsed_s / SECONDS_PER_HOUR if empty else 0.0
            return replace(self._shifted(budget, -budget.rate_per_hour * quiet_h), alarm=alarm)
        if visible >= budget.seen_probability:
            return replace(self, pending_s=None, alarm=alarm)
        if empty:
            return replace(self._shifted(budget, 1.0), pending_s=None, alarm=alarm)
        age_s = pending_s + elapsed_s
        if age_s >= budget.longest_alarm_s:
            return replace(self._shifted(budget, 1.0), pending_s=0.0, alarm=alarm)
        return replace(self, pending_s=age_s, alarm=alarm)

    def _shifted(self, budget: AdaptiveBudget, events: float) -> "AdaptiveThreshold":
        shift = self.shift_nats + budget.step_nats * events
        return replace(self, shift_nats=min(max(shift, -budget.most_down_nats), budget.most_up_nats))
