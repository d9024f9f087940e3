"""The state that the filter carries from one call to the next."""

from dataclasses import dataclass, field
from typing import Annotated, TypeVar

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.road_users import DomainVerdict
from worldstate.belief.kinematics.cartesian import EgoBelief, corrected
from worldstate.belief.sound_tracks import SoundTrack
from worldstate.belief.street_model import FilterSettings
from worldstate.belief.track import Track, Tracks
from worldstate.ground.serialisation import ADDED, Count, Probability, Via
from worldstate.ground.values import SECONDS_PER_HOUR, NotUsable, nanoseconds
from worldstate.measurement import Odometry
from worldstate.measurement.measurement import Bearing, Heard
from worldstate.state import Context, Event, Relation

from .street_belief import StreetBelief

# Without news an advisory ends after a second, like the alarm of a sequence model.
NEWS_HOLDS_NS = nanoseconds(1.0)
# Names come and go; without a limit a checkpoint would keep all of them.
FORGOTTEN_NS = nanoseconds(SECONDS_PER_HOUR)
# Limit per image, and for the events of a step. A crowded street has some forty; with 600 a step took 0.3 s.
MOST_BOXES = 64
ValueT = TypeVar("ValueT")


@dataclass(frozen=True, slots=True)
class SourceState:
    """Last stamp of a source, its fault, and its share of audible vehicles with the start of that state."""

    stamp_ns: int
    fault: str | None = None
    heard: Heard = field(default=Heard())
    heard_ns: int = 0


@dataclass(frozen=True, slots=True)
class CountedLook:
    """Last look of a sensor, its answer, and the source that delivered it first."""

    stamp_ns: int
    source: str
    answer: CoEvidence = field(default=Unqueried("messages search nothing"))
    sector_rad: tuple[float, float] | None = None  # The searched sector; None for the context's view
    fault: str | None = field(default=None, metadata=ADDED)


@dataclass
class SideHistory:
    """History of one approach side."""

    births: Count = 0  # Hidden entities born
    advised_ns: int | None = None  # Start of the present advisory
    announced_ns: int | None = None  # When messages last raised the alarm; time alone raises none


@dataclass(frozen=True, slots=True)
class Instant:
    """Result of one window alone, at the policy's reference prior."""

    statistic: Probability | None = None  # P(hidden), all directions together
    # Log of the likelihood ratio; None if infinite, which JSON cannot represent
    log_lambda: float | None = None


@dataclass
class LastSaid:
    """Results of the last measurements, for the snapshot."""

    # P(hidden), P(visible), P(none) before the last evidence; None before the first.
    predicted: tuple[Probability, Probability, Probability] | None = None
    instant: Instant = Instant()  # Result of the last window
    bearing: Bearing | None = None
    domain: DomainVerdict | None = None
    named: tuple[str, ...] = ()  # Sides that the evidence of this window distinguishes
    no_sequence: NotUsable | None = None  # Reason for missing times to visible
    events: tuple[Event, ...] = ()


@dataclass
class Counts:
    """Counters since the start."""

    measurements: Count = 0
    sighted: Count = 0  # Entities born in view
    left_out: Count = 0  # Entities left out, beyond the limit


@dataclass(eq=False)
class Memory:
    """State of a filter, as in a checkpoint; everything else in a filter is configuration.

    A step writes into its own draft; the memories of a filter and of its buffer do not change.
    """

    stamp_ns: int  # Time of the belief
    belief: StreetBelief
    history: tuple[SideHistory, ...]
    tracks: Annotated[Tracks, Via(tuple[Track, ...], Tracks.rows, Tracks.of)] = field(
        default_factory=lambda: Tracks.of(())
    )
    counts: Counts = field(default_factory=Counts)
    last: LastSaid = field(default_factory=LastSaid)
    sources: dict[str, SourceState] = field(default_factory=dict)
    looks: dict[str, CountedLook] = field(default_factory=dict)  # Last look by sensor
    relations: tuple[Relation, ...] = ()  # Relations with their intervals
    ego: EgoBelief | None = None  # Pose from odometry; None without odometry
    # Tracks of sound, used if no model reads the sound
    sounds: tuple[SoundTrack, ...] = field(default=(), metadata=ADDED)

    def draft(self) -> "Memory":
        """Return a copy that a step may write into."""
        own = draft_of(self)
        own.history, own.tracks = tuple(map(draft_of, self.history)), self.tracks.draft()
        own.counts, own.last = draft_of(self.counts), draft_of(self.last)
        own.sources, own.looks = dict(self.sources), dict(self.looks)
        return own

    def forget(self) -> None:
        """Remove sources and sensors without data for an hour."""
        since_ns = self.stamp_ns - FORGOTTEN_NS
        self.sources = {name: one for name, one in self.sources.items() if one.stamp_ns >= since_ns}
        self.looks = {name: one for name, one in self.looks.items() if one.stamp_ns >= since_ns}
        self.belief = self.belief.since(since_ns)


def draft_of(value: ValueT) -> ValueT:
    """Return a copy to write into; its fields share their values, which are only replaced as a whole."""
    # Copying the dictionary takes a tenth of the time of `dataclasses.replace`: hence no slots.
    own = object.__new__(type(value))
    own.__dict__.update(value.__dict__)
    return own


def first_memory(context: Context, settings: FilterSettings, start_ns: int) -> Memory:
    """Return the memory of a filter without measurements."""
    history = tuple(SideHistory() for _ in context.directions)
    # Without odometry the ego vehicle drives straight ahead; corners with known positions come nearer.
    ego = corrected(None, Odometry("context", start_ns, speed)) if (speed := context.ego_speed_mps) else None
    return Memory(start_ns, StreetBelief.expected(context, settings.street), history, ego=ego)
