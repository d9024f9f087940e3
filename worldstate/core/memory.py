"""The state that the filter carries from one call to the next."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Annotated, TypeAlias

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.cueing.cueing_policy import AdaptiveThreshold
from worldstate.abduction.signature.domain_guard import DomainVerdict
from worldstate.belief.kinematics.cartesian import EgoBelief
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.track import Track
from worldstate.belief.window_belief import ExplanationBelief, WindowBelief
from worldstate.ground.serialisation import Count, Keys, Probability
from worldstate.ground.values import NotUsable, nanoseconds
from worldstate.measurement.measurement import Bearing, Heard
from worldstate.state import Context, Event, Relation

from .sequence_memory import SequenceMemory

# An advisory lives in time: without news it ends, as that of a sequence does, after a second.
NEWS_HOLDS_NS = nanoseconds(1.0)
# Names come and go; without this, a checkpoint holds every one that was ever told.
FORGOTTEN_NS = nanoseconds(3600.0)
StampNs: TypeAlias = Annotated[int | None, Keys("stamp_ns")]


@dataclass(frozen=True, slots=True)
class SourceRule:
    """What a source said last: its statistic over the hops of the sustained rule, and how it is.

    What another one measures does not end its alarm.
    """

    source: str
    stamp_ns: int  # Of its last measurement
    # Of as many measurements as the rule asks for, the last one last.
    statistic: tuple[Probability, ...] = ()
    fault: str | None = None  # What was wrong with it then
    announced: tuple[Count, ...] = ()  # Sides on which its messages announce vehicles; empty of what hears
    heard: Heard = field(default=Heard())  # How well it could hear, and since when so
    heard_ns: int = 0

    def sustained(self, hops: int) -> float:
        """Return the least statistic of so many hops, 0 where there are fewer."""
        return min(self.statistic[-hops:]) if len(self.statistic) >= hops else 0.0


@dataclass(frozen=True, slots=True)
class CountedLook:
    """The last look of a sensor, what it said, and the source whose measurement carried it first."""

    sensor: str
    stamp_ns: int
    source: str
    answer: CoEvidence = field(default=Unqueried("messages search nothing"))
    sector_rad: tuple[float, float] | None = None  # Where it searched; None for the view of the context


@dataclass(frozen=True, slots=True)
class Instant:
    """What one window says by itself, at the policy's reference prior; JSON knows no infinity."""

    statistic: Probability  # P(hidden), all directions together
    log_lambda: float | None  # None for a ratio without bound
    heard_nats: float  # Log-odds of hidden by sound alone


# No slots: the belief of the sides is computed once.
@dataclass(frozen=True, eq=False)
class Memory:
    """State of a filter, as checkpoints hold it; everything else in a filter is configuration."""

    stamp_ns: int  # Time of the belief
    # By single windows, until a sequence is read, which then is the only belief.
    windows: WindowBelief | None
    births: tuple[Count, ...]  # Hidden entities born so far on each side
    handover_ns: tuple[StampNs, ...]  # Last hand-over on each side
    tracks: tuple[Track, ...] = ()  # Entities
    seq: Count = 0  # Measurements so far
    sighted: Count = 0  # Entities born in view so far
    # P(hidden), P(visible), P(none) before the last evidence; None before the first.
    predicted: tuple[Probability, Probability, Probability] | None = None
    instant: Instant | None = None  # Of the last window; None before the first
    # How far the threshold has moved, where the policy lets it.
    threshold: AdaptiveThreshold = field(default_factory=AdaptiveThreshold)
    rules: tuple[SourceRule, ...] = ()  # One of every source, sorted by its name
    looks: tuple[CountedLook, ...] = ()  # Last one of every sensor, sorted by its name
    bearing: Bearing | None = None  # Of the last measurement
    domain: DomainVerdict | None = None  # Of the last measurement
    # Vehicles that come into view, and when; None without such a model, and why the last one did not say it.
    sequence: SequenceMemory | None = None
    no_sequence: NotUsable | None = None
    advised_ns: tuple[StampNs, ...] = ()  # Since when an advisory has been out on each side
    events: tuple[Event, ...] = ()  # Of the last measurement
    relations: tuple[Relation, ...] = ()  # Then, with the intervals in which they have held
    tracks_left_out: Count = 0  # So far, each beyond the most that are kept
    ego: EgoBelief | None = None  # By odometry; None without

    def __post_init__(self) -> None:
        if not self.advised_ns:
            object.__setattr__(self, "advised_ns", (None,) * len(self.births))

    def rule_of(self, source: str, start_ns: int = 0) -> SourceRule:
        """Return what a source said last; of one that has said nothing, nothing since a start."""
        first = SourceRule(source, start_ns, heard_ns=start_ns)
        return next((one for one in self.rules if one.source == source), first)

    def with_rule(self, rule: SourceRule) -> "Memory":
        """Return the memory with what a source said last."""
        others = (one for one in self.rules if one.source != rule.source)
        return replace(self, rules=tuple(sorted((*others, rule), key=attrgetter("source"))))

    def last_look(self, sensor: str) -> CountedLook | None:
        """Return the last look of a sensor; None where it has made none."""
        return next((one for one in self.looks if one.sensor == sensor), None)

    def with_look(self, look: CountedLook) -> "Memory":
        """Return the memory with the last look of a sensor."""
        others = (one for one in self.looks if one.sensor != look.sensor)
        return replace(self, looks=tuple(sorted((*others, look), key=attrgetter("sensor"))))

    @cached_property
    def sides(self) -> SideBelief:
        """What is believed of the sides, by whichever evidence there is; messages not yet taken in."""
        if self.sequence is not None:
            return self.sequence.sides
        assert self.windows is not None
        return self.windows.now.sides


def first_memory(context: Context, start_ns: int) -> Memory:
    """Return the memory of a filter that has measured nothing."""
    k, priors = len(context.directions), context.priors
    # Without priors the filter starts as if it had waited for ever: neither alarmed nor sure of an empty
    # street.
    if priors is None:
        belief = ExplanationBelief.settled(k, context.rates.values_hz)
    else:
        belief = ExplanationBelief.from_priors(k, priors.hidden, priors.visible, priors.none)
    return Memory(
        stamp_ns=start_ns,
        windows=WindowBelief(belief, ((start_ns, belief),)),
        births=(0,) * k,
        handover_ns=(None,) * k,
    )


def without_forgotten(memory: Memory, stamp_ns: int) -> Memory:
    """Return the memory without sources and sensors that have then been unheard for an hour."""
    since_ns = stamp_ns - FORGOTTEN_NS
    stamps_ns = [one.stamp_ns for one in memory.rules] + [one.stamp_ns for one in memory.looks]
    if min(stamps_ns, default=since_ns) >= since_ns:  # Nearly always: what else is kept has their names
        return memory
    windows = memory.windows
    return replace(
        memory,
        rules=tuple(one for one in memory.rules if one.stamp_ns >= since_ns),
        looks=tuple(one for one in memory.looks if one.stamp_ns >= since_ns),
        windows=windows
        and replace(windows, heard=tuple(one for one in windows.heard if one.stamp_ns >= since_ns)),
    )
