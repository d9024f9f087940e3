"""Cues: the calibrated risk of a hidden road user, per direction."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal, SupportsIndex, TypeAlias, overload

from worldstate.abduction.sequence.sequence_model import AlarmPromise
from worldstate.ground import InvalidArgumentError, replaced
from worldstate.ground.checks import one_of
from worldstate.ground.serialisation import ADDED, Count, Layout, Probability

from .context import Priors
from .entity import AzimuthSource
from .sensor import SensorHealth


@dataclass(frozen=True, slots=True)
class Advisory:
    """An advisory for the side and the entity of its cue; never a control command.

    Parameters
    ----------
    since_ns : int
        Time of its onset, ns; it has lasted since then without a break.
    valid_until_ns : int
        Time at which it ends without a new measurement, ns: a reader must not use it after that.
    sensors : tuple of SensorHealth
        All sensors that can have contributed: those with a measurement in the second before.

    Examples
    --------
    >>> advisory = Advisory(since_ns=0, valid_until_ns=1_000_000_000)
    >>> advisory.valid_until_ns - advisory.since_ns
    1000000000
    """

    since_ns: int
    valid_until_ns: int
    sensors: tuple[SensorHealth, ...] = ()


@dataclass(frozen=True, slots=True)
class Held:
    """The reason for which an advisory continues although its log-odds are below the threshold.

    Parameters
    ----------
    entity_id : str or None
        The vehicle for which it continues.
    until_ns : int
        Time at which it ends at the latest, ns; the hand-over of that vehicle ends it earlier.

    Examples
    --------
    >>> Held(None, 1_000_000_000).until_ns
    1000000000
    """

    entity_id: str | None
    until_ns: int


@dataclass(frozen=True, slots=True)
class EvidenceTerms:
    r"""The contributions of all evidence to the log-odds that raise an alarm.

    .. math:: \log \frac{p}{1 - p} = \sum_j t_j

    Parameters
    ----------
    hypothesis : {"coming", "hidden", "announced"}
        The event of the log-odds: a vehicle comes into view from this side within 3 s (with a sequence
        model); a vehicle is hidden on any side (without one); or a vehicle that only messages announce.
    terms_nats : mapping of str to float
        Terms by their origin: the prior, the sequence or the window, the looks, a vehicle that has just come
        into view, messages. Each term is conditional on those before it, so that they add up.
    compared_nats : float
        The value that is compared with the threshold: the mean of the log-odds over 0.3 s. On the less likely
        side it is at most the log-odds that two vehicles come.
    threshold_nats : float
        The threshold. An advisory is active exactly if `compared_nats` is not below it, or if `held` of the
        cue is given. It is 1.2 higher for 5 s after a vehicle has come into view.

    Examples
    --------
    >>> EvidenceTerms("coming", {"prior": -3.0, "sequence": 4.5}, 1.2, 0.9).terms_nats["sequence"]
    4.5
    """

    hypothesis: Literal["coming", "hidden", "announced"]
    terms_nats: Mapping[str, float]
    compared_nats: float
    threshold_nats: float


@dataclass(frozen=True, slots=True)
class Tally:
    """Numbers of alarms and arrivals while a camera searched, at the threshold of the model.

    Parameters
    ----------
    quiet_ns : int
        Total time without a vehicle that came into view within 8 s before or after, ns.
    false_onsets : int
        Alarms that began in that time.
    arrivals : int
        Vehicles that came into view.
    warned : int
        Arrivals with an alarm of their side in the 8 s before.

    Examples
    --------
    >>> Tally().arrivals
    0
    """

    quiet_ns: Count = 0
    false_onsets: Count = 0
    arrivals: Count = 0
    warned: Count = 0


Verdict: TypeAlias = Literal["kept", "in doubt", "broken", "unwatched"]
# Reasons for which a cue must not be used, in the order in which a cue lists them.
WhyNot: TypeAlias = Literal[
    "uncalibrated", "unheard", "unknown sound", "too little sound", "budget broken", "expired", "masked"
]


@dataclass(frozen=True, slots=True)
class Budget:
    r"""A test of the budget of alarms and of the stated probabilities, by later detections of a camera.

    Parameters
    ----------
    verdict : {"kept", "in doubt", "broken", "unwatched"}
        In doubt from a tenth of the evidence that breaks the budget; unwatched if no camera searches now.
    why : str or None
        Which of both tests failed, or why nothing is tested; None otherwise.
    evidence_nats : mapping of str to float
        Log e-values against "no more onsets per hour than the budget" (``"onsets"``), and against "arrivals
        within 2 s are as frequent as stated" (``"within"``). Values above zero are evidence against it.
    onsets_per_hour : float
        The budget per hour in which no vehicle comes into view: the requested number, or the number on the
        curve of the model for a requested share.
    tally : Tally
        Numbers since the filter began.
    asked_alpha : float or None
        Requested share of hazard-free time in alarm, if it was requested instead of a number of onsets.
    promise : AlarmPromise or None
        Onsets per hour and share of time in alarm at this threshold on the hazard-free streams of the curve,
        with intervals for other junctions; None if the model file has no curve.

    Examples
    --------
    >>> Budget("kept", None, {"onsets": -2.0, "within": -0.5}, 25.0, Tally()).verdict
    'kept'
    """

    verdict: Verdict
    why: str | None
    evidence_nats: Mapping[str, float]
    onsets_per_hour: float
    tally: Tally
    asked_alpha: Probability | None = field(default=None, metadata=ADDED)
    promise: AlarmPromise | None = field(default=None, metadata=ADDED)


@dataclass(frozen=True, slots=True)
class RiskCue:
    r"""Risk that a road user is hidden in one direction: an advisory, never a control command.

    .. math:: r_k = P(T_k \le 8\,\mathrm{s} \mid y_{1:t})

    The probability that a vehicle comes into view from this direction within 8 s. It is a marginal of the
    belief, never above P(hidden); sides do not exclude each other. With a sequence model it is calibrated.
    Without one it is :math:`\min(P(hid), g(P(hid)))\, P(k \mid hid)` with the calibrated monotone map g of
    the policy: then the sides exclude each other, and the time is unknown.

    Parameters
    ----------
    direction : str or None
        Approach side; None if the sound gives no side, as with an array without a model. Then risk,
        confidence, statistic and hypotheses are None as well.
    azimuth_rad, azimuth_std_rad : float
        Coarse azimuth and its standard deviation, left positive.
    azimuth_source : {"measured", "context"} or None
        Origin of the azimuth, as in `Entity`.
    risk : float or None
        r_k in [0, 1]; None without a model.
    confidence : float or None
        P(k | hid): probability of this direction, given a hidden road user.
    statistic : float or None
        s of the last window, all directions together, in [0, 1]; None before the first window.
    log_lambda : float or None
        log Lambda of the last window, nats; None before the first window, and if it is infinite.
    hypotheses : Priors or None
        Probabilities of the explanations. *hidden*: at least one vehicle is not in line of sight and either
        comes into view within 8 s or is audible now, whether or not another one is in view; *visible*: one is
        in view and none is hidden; *none*: neither.
    advisory : Advisory or None
        Given while the alarm of this side is active. It ends with the hand-over of its vehicle, and is never
        given with a risk below 0.1.
    alpha : float or None
        Share of hazard-free time in alarm: the budget for which the rule was calibrated, or, for the alarm of
        a sequence model, the value on the curve of the model. None for an uncalibrated policy, for messages,
        and without a curve.
    entity_id : str or None
        Id of the hidden entity, if there is one. The cues of all possible sides have the id of a vehicle
        whose side is unknown.
    horizon_s : float or None
        Best time to visible if stated, otherwise the time to arrival of the entity; None if unknown.
    within : mapping of str to float, or None
        Probability that a vehicle comes into view from this side within 0.5, 1, 2 and 3 s (keys "0.5", "1",
        "2", "3"); None without a sequence model.
    time_to_visible_s : (float, float, float) or None
        Low, best and high estimate, a 90 % interval. None if this side has no advisory and more likely than
        not no vehicle comes within 5 s. For an announced road user it is derived from its position.
    sector_rad : (float, float) or None
        Right and left end of the 90 % interval of the azimuth.
    evidence : EvidenceTerms or None
        The log-odds of the alarm and their terms; None for a side that no source distinguishes.
    held : Held or None
        Given if the advisory continues below its threshold.
    not_advised : str or None
        Why there is no advisory although the risk is above 0.5, or that no source distinguishes this side.
    usable : bool
        Whether the cue and its advisory may be used: exactly if `why_not` is empty.
    why_not : tuple of str
        All reasons for which it must not be used: *uncalibrated*, no budget of false alarms was measured for
        the rule that raises alarms; *unheard*, no array could receive a hidden vehicle; *unknown sound*, the
        model was not made for the sound of this hop; *too little sound*, less than 1 s so far; *budget
        broken*, a camera finds more false alarms, or other probabilities, than stated; *expired*, no
        measurement for 1 s; *masked*, a vehicle in view, or one that has just left the view, covers the
        sound.

    Attributes
    ----------
    began : bool
        Whether the advisory begins in this state: its onset is the time of the state that holds the cue.

    Raises
    ------
    InvalidArgumentError
        If `usable` contradicts `why_not`.

    Examples
    --------
    >>> cue = RiskCue("left", 0.9, 0.3, 0.8, 0.95, 0.97, 3.1, Priors(0.9, 0.05, 0.05))
    >>> cue.advisory, cue.usable, cue.why_not
    (None, False, ('uncalibrated',))
    """

    LAYOUT: ClassVar = Layout(
        order="entity_id direction usable why_not azimuth_rad azimuth_std_rad azimuth_source sector_rad risk "
        "confidence statistic log_lambda hypotheses horizon_s"
    )

    direction: str | None
    azimuth_rad: float
    azimuth_std_rad: float
    risk: Probability | None
    confidence: Probability | None
    statistic: Probability | None
    log_lambda: float | None
    hypotheses: Priors | None
    advisory: Advisory | None = None
    # None, not 0: a threshold without calibration has no budget, while 0 would promise no false alarms.
    alpha: Probability | None = None
    entity_id: str | None = None
    horizon_s: float | None = None
    within: Mapping[str, Probability] | None = None
    time_to_visible_s: tuple[float, float, float] | None = None
    sector_rad: tuple[float, float] | None = None
    evidence: EvidenceTerms | None = None
    held: Held | None = None
    not_advised: str | None = None
    azimuth_source: AzimuthSource | None = None
    # A cue is not usable until `judged` has evaluated its snapshot.
    usable: bool = False
    why_not: tuple[WhyNot, ...] = ("uncalibrated",)
    # Not written: the state that holds the cue sets it from `advisory` and its own time.
    began: bool = field(default=False, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.usable is bool(self.why_not):
            raise InvalidArgumentError(f"usable: expected {not self.usable} with why_not {self.why_not}")

    @property
    def azimuth_deg(self) -> float:
        """Azimuth, degrees, left positive."""
        return math.degrees(self.azimuth_rad)

    def at(self, stamp_ns: int) -> "RiskCue":
        """Return the cue of a state of this time, with `began` set."""
        began = self.advisory is not None and self.advisory.since_ns == stamp_ns
        if began is self.began:
            return self
        cue = replaced(self)
        object.__setattr__(cue, "began", began)
        return cue


class Cues(tuple[RiskCue, ...]):
    """The cues of a state in order of direction; a direction is an index as well.

    Raises
    ------
    InvalidArgumentError
        If no cue has the direction: without a model, or before the first measurement, none has one.

    Examples
    --------
    >>> cues = Cues([RiskCue("left", 0.9, 0.3, 0.8, 0.95, 0.97, 3.1, Priors(0.9, 0.05, 0.05))])
    >>> cues["left"].risk, cues[0] is cues["left"], [cue.direction for cue in cues]
    (0.8, True, ['left'])
    """

    __slots__ = ()

    @overload
    def __getitem__(self, key: SupportsIndex | str, /) -> RiskCue: ...
    @overload
    def __getitem__(self, key: slice, /) -> tuple[RiskCue, ...]: ...
    def __getitem__(self, key: SupportsIndex | str | slice, /) -> RiskCue | tuple[RiskCue, ...]:
        if not isinstance(key, str):
            return super().__getitem__(key)
        by_direction = {cue.direction: cue for cue in self if cue.direction is not None}
        return by_direction[one_of("cues", key, by_direction or ["no direction"])]


# Readers and writers of snapshots, which follow the type hints, treat the cues as any other list.
if TYPE_CHECKING:
    CueList: TypeAlias = Cues
else:
    CueList = tuple[RiskCue, ...]
