"""Predictive cues: the calibrated, direction-resolved risk of a hidden road user."""

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
        Since when it has been out without a break, ns.
    valid_until_ns : int
        When it ends without news, ns: a reader must not use it after that.
    sensors : tuple of SensorHealth
        Those that it rests on: all that spoke while it can have been raised.

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
    """An advisory that stands although what decides it has fallen below its threshold.

    Parameters
    ----------
    entity_id : str or None
        The vehicle for which it is held.
    until_ns : int
        When it ends without news, ns; the hand-over of that vehicle ends it before.

    Examples
    --------
    >>> Held(None, 1_000_000_000).until_ns
    1000000000
    """

    entity_id: str | None
    until_ns: int


@dataclass(frozen=True, slots=True)
class EvidenceTerms:
    r"""What every piece of evidence adds to the log-odds that an alarm goes by.

    .. math:: \log \frac{p}{1 - p} = \sum_j t_j

    Parameters
    ----------
    hypothesis : {"coming", "hidden", "announced"}
        A vehicle comes into view from this side within three seconds, by a sequence model; one is hidden on
        any side, without such a model; or messages alone announce one.
    terms_nats : mapping of str to float
        By what was said: the prior, the sequence or the window, each sensor's look, what has just come into
        view, messages; each given those before it, so that they add up.
    compared_nats : float
        What decides: the mean of the log-odds over .3 s, of the less likely side no more than that two come.
    threshold_nats : float
        An advisory stands exactly where `compared_nats` is not below it, or where the cue says that it is
        held. It is 1.2 higher for five seconds after a vehicle has come into view.

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
    """What was counted of an alarm while a camera watched, at the model's own threshold.

    Parameters
    ----------
    quiet_ns : int
        Time in which no vehicle came into view within eight seconds before or after, ns.
    false_onsets : int
        Alarms that began in that time.
    arrivals : int
        Vehicles that came into view.
    warned : int
        Those of them for whose side the alarm stood in the eight seconds before.

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
# Why a cue may not be acted on, in the order in which a cue gives its reasons.
WhyNot: TypeAlias = Literal[
    "uncalibrated", "unheard", "unknown sound", "too little sound", "budget broken", "expired", "masked"
]


@dataclass(frozen=True, slots=True)
class Budget:
    r"""Whether a sequence's alarm keeps to its budget, and its chances are true, by what a camera sees later.

    Parameters
    ----------
    verdict : {"kept", "in doubt", "broken", "unwatched"}
        In doubt from a tenth of what breaks it on; unwatched where no camera looks now.
    why : str or None
        What is broken, or that nothing watches; None otherwise.
    evidence_nats : mapping of str to float
        Log e-values against "no more onsets an hour than the budget" (``"onsets"``), and against "what comes
        within two seconds is as frequent as stated" (``"within"``). Above zero they speak against it.
    onsets_per_hour : float
        The budget, of time in which no vehicle comes into view: what was asked, or what the curve of the
        model promises at a share that was asked.
    tally : Tally
        What was counted since the filter began.
    asked_alpha : float or None
        Share of hazard-free time in alarm that was asked in place of onsets.
    promise : AlarmPromise or None
        Onsets an hour and share of time in alarm of the hazard-free streams on which the curve was measured,
        at this threshold, and the intervals for other junctions; None of a model file without a curve.

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

    The probability that a vehicle comes into view from there within eight seconds: a marginal of the one
    belief, never above P(hidden); sides do not exclude each other. With a sequence model it is calibrated.
    Without one it is :math:`\min(P(hid), g(P(hid)))\, P(k \mid hid)` with the calibrated monotone map g of
    the policy: the sides exclude each other, and when one comes is not known.

    Parameters
    ----------
    direction : str or None
        Approach side; None if the sound gives no side, as with an array without a model. What rests on a
        side or on a model (risk, confidence, statistic, hypotheses) is None then, too.
    azimuth_rad, azimuth_std_rad : float
        Where to look, coarsely; left positive.
    azimuth_source : {"measured", "context"} or None
        What the azimuth rests on, as that of an `Entity`.
    risk : float or None
        r_k in [0, 1]; None if no model states it.
    confidence : float or None
        P(k | hid): how sure the direction is, given a hidden road user.
    statistic : float or None
        s of the last window, all directions together, in [0, 1]; None before the first one.
    log_lambda : float or None
        log Lambda of the last window, nats; None before the first one, and if it is infinite.
    hypotheses : Priors or None
        Probabilities of the explanations. *hidden*: at least one vehicle that is not in line of sight and
        comes into view within eight seconds or is audible now, whether or not another is in view; *visible*:
        one in view and none hidden; *none*: neither.
    advisory : Advisory or None
        Given while the alarm of this side is raised or held. It ends with the hand-over of its vehicle, and
        none stands beside a risk below .1.
    alpha : float or None
        Share of hazard-free time in alarm: of the budget that the rule was calibrated for, or of a sequence's
        alarm what the curve of its model promises. None of an uncalibrated policy, of messages, and without a
        curve.
    entity_id : str or None
        The hidden entity that it speaks of, if one was born; of one vehicle whose side is not known the cues
        of all its sides speak.
    horizon_s : float or None
        Best time to visible where one is stated, else time to arrival of that entity; None where unknown.
    within : mapping of str to float, or None
        Probability that a vehicle comes into view from there within so many seconds ("0.5", "1", "2", "3");
        None without a sequence model.
    time_to_visible_s : (float, float, float) or None
        Low, best and high; the interval holds nine of ten. None where no advisory names the direction and it
        is likelier than not that none comes within five seconds. Of an announced road user that of its place.
    sector_rad : (float, float) or None
        Where it is in nine of ten cases: from this azimuth to the left until that one.
    evidence : EvidenceTerms or None
        What an advisory is raised by, piece by piece; None of a side that no source distinguishes.
    held : Held or None
        Given where the advisory stands below its threshold, with what for and until when.
    not_advised : str or None
        If the risk is above 0.5 and no advisory is out, why; or that no source distinguishes this side.
    usable : bool
        Whether the cue, its advisory included, may be acted on: exactly if `why_not` is empty.
    why_not : tuple of str
        Every reason for which it may not, from a closed list: *uncalibrated*, no budget of false alarms was
        measured for what decides; *unheard*, no source that listens can hear; *unknown sound*, the model was
        not made for the sound of this hop; *too little sound*, less than a second so far; *budget broken*, a
        camera finds more false alarms, or other chances, than stated; *expired*, nothing was measured for a
        second; *masked*, a vehicle in view, or one that has just left the view, covers the sound.

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
    # Nothing vouches for a cue until `judged` has looked at the snapshot that it stands in.
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
