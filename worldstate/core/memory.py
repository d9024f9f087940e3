"""The state that the filter carries from one call to the next."""

from dataclasses import dataclass, field
from typing import Annotated, TypeVar

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.road_users import DomainVerdict
from worldstate.belief.kinematics.cartesian import EgoBelief, corrected
from worldstate.belief.settings import FilterSettings
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.sound_tracks import SoundTrack
from worldstate.belief.track import Track, Tracks
from worldstate.ground.serialisation import ADDED, Count, Probability, Via
from worldstate.ground.values import SECONDS_PER_HOUR, NotUsable, nanoseconds
from worldstate.measurement import Odometry
from worldstate.measurement.measurement import Bearing, Heard
from worldstate.state import Context, Event, Relation

from .street_belief import StreetBelief

# An advisory lives in time: without news it ends, as that of a sequence does, after a second.
NEWS_HOLDS_NS = nanoseconds(1.0)
# Names come and go; without this, a checkpoint holds every one that was ever told.
FORGOTTEN_NS = nanoseconds(SECONDS_PER_HOUR)
# Of an image, and of the events of a step; a crowded street shows some forty, and at 600 a step took 0.3 s.
MOST_BOXES = 64
ValueT = TypeVar("ValueT")


@dataclass(frozen=True, slots=True)
class SourceState:
    """When a source last measured, what was wrong then, and how well it could hear, and since when."""

    stamp_ns: int
    fault: str | None = None
    heard: Heard = field(default=Heard())
    heard_ns: int = 0


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
    advised_ns: int | None = None  # Since when an advisory has been out
    announced_ns: int | None = None  # When messages last raised the alarm: time alone raises none


@dataclass(frozen=True, slots=True)
class Instant:
    """What one window says by itself, at the policy's reference prior; JSON knows no infinity."""

    statistic: Probability | None = None  # P(hidden), all directions together
    log_lambda: float | None = None  # None for a ratio without bound


@dataclass
class LastSaid:
    """What the last measurements said, as a snapshot states it."""

    # P(hidden), P(visible), P(none) before the last evidence; None before the first.
    predicted: tuple[Probability, Probability, Probability] | None = None
    instant: Instant = Instant()  # Of the last window
    bearing: Bearing | None = None
    domain: DomainVerdict | None = None
    named: tuple[str, ...] = ()  # Sides that its evidence distinguishes
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
    belief: StreetBelief
    history: tuple[SideHistory, ...]
    tracks: Annotated[Tracks, Via(tuple[Track, ...], Tracks.rows, Tracks.of)] = field(
        default_factory=lambda: Tracks.of(())
    )
    counts: Counts = field(default_factory=Counts)
    last: LastSaid = field(default_factory=LastSaid)
    sources: dict[str, SourceState] = field(default_factory=dict)  # By the source
    looks: dict[str, CountedLook] = field(default_factory=dict)  # Last one by the sensor
    relations: tuple[Relation, ...] = ()  # With the intervals in which they have held
    ego: EgoBelief | None = None  # By odometry; None without
    sounds: tuple[SoundTrack, ...] = field(default=(), metadata=ADDED)  # Where no model reads the sound

    @property
    def sides(self) -> SideBelief:
        """Marginals of the belief of the sides; messages not yet taken in."""
        return self.belief.sides

    def draft(self) -> "Memory":
        """Return a copy that a step may write into."""
        own = draft_of(self)
        own.history, own.tracks = tuple(map(draft_of, self.history)), self.tracks.draft()
        own.counts, own.last = draft_of(self.counts), draft_of(self.last)
        own.sources, own.looks = dict(self.sources), dict(self.looks)
        return own

    def forget(self) -> None:
        """Drop sources and sensors that have been unheard for an hour."""
        since_ns = self.stamp_ns - FORGOTTEN_NS
        self.sources = {name: one for name, one in self.sources.items() if one.stamp_ns >= since_ns}
        self.looks = {name: one for name, one in self.looks.items() if one.stamp_ns >= since_ns}
        self.belief = self.belief.since(since_ns)


def draft_of(value: ValueT) -> ValueT:
    """Return a copy to write into; what its fields hold is not copied, it is replaced as a whole."""
    # A copied dictionary takes a tenth of the time of `dataclasses.replace`: hence no slots.
    own = object.__new__(type(value))
    own.__dict__.update(value.__dict__)
    return own


def first_memory(context: Context, settings: FilterSettings, start_ns: int) -> Memory:
    """Return the memory of a filter that has measured nothing."""
    history = tuple(SideHistory() for _ in context.directions)
    # Without odometry the ego vehicle drives straight on, and corners that are known in metres come nearer.
    ego = corrected(None, Odometry("context", start_ns, speed)) if (speed := context.ego_speed_mps) else None
    return Memory(start_ns, StreetBelief.expected(context, settings.street), history, ego=ego)
