"""Predictive cues: the calibrated, direction-resolved risk of a hidden road user."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from worldstate.ground.serialisation import ADDED, Layout, Probability

from .context import Priors


@dataclass(frozen=True, slots=True)
class RiskCue:
    r"""Risk that a road user is hidden in one direction: an advisory, never a control command.

    .. math:: r_k = g(P(hid \mid y_{1:t}))\, P(k \mid hid, y_{1:t})

    with g the calibrated monotone map of the policy, so that the risks of all directions add up to the risk
    of a hidden road user at all.

    Parameters
    ----------
    direction : str
        Approach side.
    azimuth_rad, azimuth_std_rad : float
        Where to look, coarsely; left positive.
    risk : float
        r_k in [0, 1].
    confidence : float
        P(k | hid): how sure the direction is, given a hidden road user.
    statistic : float
        s of the last window, all directions together, in [0, 1]; what the threshold is compared with.
    log_lambda : float or None
        log Lambda of the last window, nats; None where it is infinite.
    hypotheses : Priors
        Filtered P(hidden), P(visible), P(none).
    advisory : bool
        Whether the sustained rule is in alarm and names this direction; with the alarm of a sequence model,
        whether it is raised for it.
    alpha : float or None
        False-positive budget that the rule was calibrated for; None for an uncalibrated policy, and where the
        alarm of a sequence model stands in for the rule, which has a budget of onsets an hour.
    entity_id : str or None
        The hidden entity that it speaks of, if one was born.
    horizon_s : float or None
        Best time to visible where one is stated, else time to arrival of that entity; None where unknown.
    within : mapping of str to float, or None
        Probability that somebody comes into view from there within so many seconds ("0.5", "1", "2", "3");
        None without a sequence model.
    time_to_visible_s : (float, float, float) or None
        Low, best and high; the interval holds nine of ten. None where no advisory names the direction and it
        is likelier than not that nobody comes within five seconds.

    Examples
    --------
    >>> RiskCue("left", 0.9, 0.3, 0.8, 0.95, 0.97, 3.1, Priors(0.9, 0.05, 0.05), True).advisory
    True
    """

    LAYOUT: ClassVar = Layout(
        order="entity_id direction azimuth_rad azimuth_std_rad risk confidence statistic log_lambda "
        "hypotheses horizon_s"
    )

    direction: str
    azimuth_rad: float
    azimuth_std_rad: float
    risk: Probability
    confidence: Probability
    statistic: Probability
    log_lambda: float | None
    hypotheses: Priors
    advisory: bool
    # None, not 0: a threshold without calibration has no budget, while 0 would promise no false alarms.
    alpha: Probability | None = None
    entity_id: str | None = None
    horizon_s: float | None = None
    within: Mapping[str, Probability] | None = field(default=None, metadata=ADDED)
    time_to_visible_s: tuple[float, float, float] | None = field(default=None, metadata=ADDED)
