"""The state that the filter carries from one call to the next."""

from dataclasses import dataclass, field, replace
from typing import Annotated, TypeAlias, TypeVar

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.cueing.cueing_policy import AdaptiveThreshold
from worldstate.abduction.road_users import DomainVerdict
from worldstate.belief.kinematics.cartesian import EgoBelief, corrected
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.track import Track, Tracks
from worldstate.belief.window_belief import ExplanationBelief, WindowBelief
from worldstate.ground.serialisation import ADDED, Count, Probability, Via
from worldstate.ground.values import NotUsable, nanoseconds
from worldstate.measurement import Odometry
from worldstate.measurement.measurement import Bearing, Heard
from worldstate.state import Context, Event, Relation

from .sequence_memory import HOP_NS, SLACK_NS, SequenceMemory

# An advisory lives in time: without news it ends, as that of a sequence does, after a second.
NEWS_HOLDS_NS = nanoseconds(1.0)
# Names come and go; without this, a checkpoint holds every one that was ever told.
FORGOTTEN_NS = nanoseconds(3600.0)
Belief: TypeAlias = WindowBelief | SequenceMemory
ValueT = TypeVar("ValueT")


@dataclass(frozen=True, slots=True)
class SourceRule:
    """What a source said last: its statistic over the hops of the sustained rule, and how it is.

    What another one measures does not end its alarm.
    """

    stamp_ns: int  # Of its last measurement
    # Of as many hops of .1 s as the rule asks for, the last one last, which began then.
    statistic: tuple[Probability, ...] = ()
    hop_ns: int = 0
    fault: str | None = None  # What was wrong with it then
    announced: tuple[Count, ...] = ()  # Sides on which its messages announce vehicles; empty of what hears
    heard: Heard = field(default=Heard())  # How well it could hear, and since when so
    heard_ns: int = 0

    def after(self, last: "SourceRule | None", statistic: float, hops: int) -> "SourceRule":
        """Return the rule with a statistic more, after that of the source's last measurement.

        Time counts, not measurements: in one hop the least, and in a hop without one the less of its
        neighbours. Of silence that ends an alarm nothing is known.
        """
        if last is None or not last.statistic:
            return replace(self, statistic=(statistic,), hop_ns=self.stamp_ns)
        since_ns = self.stamp_ns - last.hop_ns
        steps = (since_ns + SLACK_NS) // HOP_NS if since_ns <= NEWS_HOLDS_NS else 1
        less = min(last.statistic[-1], statistic)
        if steps < 1:
            return replace(self, statistic=(*last.statistic[:-1], less), hop_ns=last.hop_ns)
        every = (*last.statistic, *[less] * (min(steps, hops) - 1), statistic)
        return replace(self, statistic=every[-hops:], hop_ns=self.stamp_ns)

    def sustained(self, hops: int) -> float:
        """Return the least statistic of so many hops, 0 where there are fewer."""
        return min(self.statistic[-hops:]) if len(self.statistic) >= hops else 0.0


@dataclass(frozen=True, slots=True)
class CountedLook:
    """The last look of a sensor, what it said, and the source whose measurement carried it first."""

    stamp_ns: int
    source: str
    answer: CoEvidence = field(default=Unqueried("messages search nothing"))
    sector_rad: tuple[float, float] | None = None  # Where it searched; None for the view of the context
    fault: str | None = field(default=None, metadata=ADDED)


@dataclass
class SideHistory:
    """What happened on one approach side so far."""

    births: Count = 0  # Hidden entities born
    handover_ns: int | None = None  # Last hand-over
    advised_ns: int | None = None  # Since when an advisory has been out


@dataclass(frozen=True, slots=True)
class Instant:
    """What one window says by itself, at the policy's reference prior; JSON knows no infinity."""

    statistic: Probability  # P(hidden), all directions together
    log_lambda: float | None  # None for a ratio without bound
    heard_nats: float  # Log-odds of hidden by sound alone


@dataclass
class LastSaid:
    """What the last measurements said, as a snapshot states it."""

    # P(hidden), P(visible), P(none) before the last evidence; None before the first.
    predicted: tuple[Probability, Probability, Probability] | None = None
    instant: Instant | None = None  # Of the last window; None before the first
    bearing: Bearing | None = None
    domain: DomainVerdict | None = None
    no_sequence: NotUsable | None = None  # Why it did not say when vehicles come into view
    events: tuple[Event, ...] = ()


@dataclass
class Counts:
    """How many there were so far."""

    measurements: Count = 0
    sighted: Count = 0  # Entities born in view
    left_out: Count = 0  # Entities beyond the most that are kept


@dataclass(eq=False)
class Memory:
    """State of a filter, as checkpoints hold it; everything else in a filter is configuration.

    A step writes into a draft of its own; what a filter or its buffer holds is not changed.
    """

    stamp_ns: int  # Time of the belief
    # By single windows, until a sequence is read, which then is the only belief.
    belief: Belief
    history: tuple[SideHistory, ...]
    tracks: Annotated[Tracks, Via(tuple[Track, ...], Tracks.rows, Tracks.of)] = field(
        default_factory=lambda: Tracks.of(())
    )
    counts: Counts = field(default_factory=Counts)
    last: LastSaid = field(default_factory=LastSaid)
    # How far the threshold has moved, where the policy lets it.
    threshold: AdaptiveThreshold = field(default_factory=AdaptiveThreshold)
    rules: dict[str, SourceRule] = field(default_factory=dict)  # By the source
    looks: dict[str, CountedLook] = field(default_factory=dict)  # Last one by the sensor
    relations: tuple[Relation, ...] = ()  # With the intervals in which they have held
    ego: EgoBelief | None = None  # By odometry; None without

    @property
    def sides(self) -> SideBelief:
        """What is believed of the sides, by whichever evidence there is; messages not yet taken in."""
        return self.belief.sides

    @property
    def sequence(self) -> SequenceMemory | None:
        """The belief by a sequence; None before the first one."""
        return self.belief if isinstance(self.belief, SequenceMemory) else None

    def draft(self) -> "Memory":
        """Return a copy that a step may write into."""
        own = draft_of(self)
        own.history, own.tracks = tuple(map(draft_of, self.history)), self.tracks.draft()
        own.counts, own.last = draft_of(self.counts), draft_of(self.last)
        own.rules, own.looks = dict(self.rules), dict(self.looks)
        return own

    def forget(self) -> None:
        """Drop sources and sensors that have been unheard for an hour."""
        since_ns = self.stamp_ns - FORGOTTEN_NS
        self.rules = {name: one for name, one in self.rules.items() if one.stamp_ns >= since_ns}
        self.looks = {name: one for name, one in self.looks.items() if one.stamp_ns >= since_ns}
        if isinstance(self.belief, WindowBelief):
            self.belief = self.belief.since(since_ns)


def draft_of(value: ValueT) -> ValueT:
    """Return a copy to write into; what its fields hold is not copied, it is replaced as a whole."""
    # A copied dictionary takes a tenth of the time of `dataclasses.replace`: hence no slots.
    own = object.__new__(type(value))
    own.__dict__.update(value.__dict__)
    return own


def first_memory(context: Context, start_ns: int) -> Memory:
    """Return the memory of a filter that has measured nothing."""
    k, priors = len(context.directions), context.priors
    # Without priors the filter starts as if it had waited for ever: neither alarmed nor sure of an empty
    # street.
    if priors is None:
        belief = ExplanationBelief.settled(k, context.rates.values_hz)
    else:
        belief = ExplanationBelief.from_priors(k, priors.hidden, priors.visible, priors.none)
    history = tuple(SideHistory() for _ in range(k))
    # Without odometry the ego vehicle drives straight on, and corners that are known in metres come nearer.
    ego = corrected(None, Odometry("context", start_ns, speed)) if (speed := context.ego_speed_mps) else None
    return Memory(start_ns, WindowBelief(belief, ((start_ns, belief),)), history, ego=ego)
