"""The filter: predict and update of the whole world-state, and its checkpoint, which loses no bit."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

from worldstate.abduction.cueing.cueing_policy import CueingPolicy, uncalibrated_policy
from worldstate.belief.detection import BY_ALL
from worldstate.belief.settings import FilterSettings
from worldstate.belief.side_belief import SideBelief
from worldstate.ground import InvalidArgumentError, NotUsable, in_range, integer_ns, nanoseconds, replaced
from worldstate.ground.serialisation import ADDED, Layout, decode, encode
from worldstate.measurement import CameraLook, Measurement, Odometry, PositionScan, Sighting
from worldstate.state import Context, Event, Priors, WorldState
from worldstate.state.world_state import judged

from .birth_death import events_between, published
from .budget_watch import SLACK_NS
from .cues import SideAlarms, sound_cues
from .fixed_lag import FixedLag, LagRecord, Timed, restored
from .memory import MOST_BOXES, NEWS_HOLDS_NS, Memory, first_memory
from .relations import relations_at
from .site_model import FilterModel, from_here, site_geometry_of
from .snapshot_builder import ego_of, entities_of, hearings, searched_views, sensors_of, sound_entities
from .step import advanced, take_in

MOST_SIDES = 3


@dataclass(frozen=True, eq=False)
class WorldFilter:
    """Keeps S_t: `predict` and `update` return a new filter, `state` is the snapshot.

    Parameters
    ----------
    context : Context
        Rates, occluders, ego motion.
    policy : CueingPolicy
        Threshold and risk map; a model file brings one.
    settings : FilterSettings
        Windows, births and deaths.
    start_ns : int
        Time of the first belief, ns on the clock of the measurements.
    memory : Memory, optional
        What another filter carried; the first belief where not given.
    lag : FixedLag, optional
        Measurements of the last two seconds, among which a late one is put; none where not given.
    no_model : NotUsable, optional
        Why no model reads the sound, if none does. The snapshots then hold tracks of sound in place of what
        is hidden, and cues without a side, a risk and an advisory.

    Raises
    ------
    InvalidArgumentError
        If the context has more than three approach sides.

    Examples
    --------
    >>> from worldstate.abduction.co_evidence import Absent
    >>> from worldstate.abduction.evidence import SignatureEvidence
    >>> from worldstate.ground import NotUsable
    >>> world, heard = WorldFilter(), SignatureEvidence(("left", "right"), (4.0, 0.0), 2.0, 0.0)
    >>> for hop in range(1, 11):
    ...     look = Measurement(hop * 10**8, heard, Absent(0.04), NotUsable("-"), NotUsable("-"))
    ...     world = world.predict(0.1).update(look)
    >>> [(entity.status, entity.direction) for entity in world.state.entities]
    [('hidden', 'left')]
    >>> world.state.risk > 0.5
    True
    """

    context: Context = field(default_factory=Context)
    policy: CueingPolicy = field(default_factory=uncalibrated_policy)
    settings: FilterSettings = field(default_factory=FilterSettings)
    start_ns: int = 0
    memory: Memory | None = field(default=None, repr=False)
    lag: FixedLag | None = field(default=None, repr=False)
    no_model: NotUsable | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "start_ns", integer_ns("start_ns", self.start_ns))
        if (sides := len(self.context.directions)) > MOST_SIDES:
            # The joint of four sides has half a million states.
            raise InvalidArgumentError(f"context: expected at most {MOST_SIDES} approach sides, got {sides}")

    @property
    def stamp_ns(self) -> int:
        """Time of the belief, ns."""
        return self._memory.stamp_ns

    @property
    def belief(self) -> SideBelief:
        """What is believed of the sides, of which the snapshot states marginals."""
        return SideAlarms(self._memory, from_here(self._model, self._memory.ego)).sides

    @property
    def risk(self) -> float:
        """Calibrated risk of a road user hidden in any direction."""
        return self.belief.risk

    @cached_property
    def state(self) -> WorldState:
        """The snapshot S_t."""
        memory, last, settings = self._memory, self._memory.last, self.settings
        model = from_here(self._model, memory.ego)
        context = model.context
        sensors, tracks = sensors_of(memory), published(memory.tracks, settings.street)
        # Those of the last step hold until time passes, or odometry moves the place.
        is_fresh = memory is self._lag.latest and memory.ego is None
        sounds, before = sound_entities(memory.sounds, settings), last.predicted or memory.sides.hypotheses
        state = WorldState(
            stamp_ns=memory.stamp_ns,
            seq=memory.counts.measurements,
            entities=(*entities_of(tracks, memory, model.site), *sounds),
            relations=memory.relations if is_fresh else relations_at(memory, tracks, model),
            context=context if self.no_model else replaced(context, priors=Priors(*before)),
            cues=SideAlarms(memory, model).cues(sensors) if self.no_model is None else sound_cues(sounds),
            calibrated=self.policy.alpha > 0.0,
            bearing=last.bearing,
            domain=last.domain,
            no_sequence=last.no_sequence,
            delivery=replaced(self._lag.delivery, tracks_left_out=memory.counts.left_out),
            valid_until_ns=max((one.stamp_ns + NEWS_HOLDS_NS for one in sensors), default=None),
            sensors=sensors,
            searched=searched_views(memory, context),
            events=last.events,
            heard=hearings(memory),
            ego=None if memory.ego is None else ego_of(memory.ego),
            budget=memory.belief.budget(memory.stamp_ns),
            no_model=self.no_model,
        )
        return judged(state)

    def predict(self, dt_s: float) -> "WorldFilter":
        """Return the filter `dt_s` seconds later, without a measurement.

        Raises
        ------
        InvalidArgumentError
            If the step is negative or not finite.
        """
        step_s = in_range("dt_s", dt_s, 0.0, math.inf, open_high=True)
        return self.predict_to(self.stamp_ns + nanoseconds(step_s))

    def predict_to(self, stamp_ns: int) -> "WorldFilter":
        """Return the filter at a later time, ns.

        Raises
        ------
        InvalidArgumentError
            If that time is no integer or is earlier than the belief's.
        """
        stamp_ns = integer_ns("stamp_ns", stamp_ns)
        if stamp_ns < self.stamp_ns - SLACK_NS:
            problem = f"expected a time not before {self.stamp_ns} ns, got {stamp_ns} ns"
            raise InvalidArgumentError(f"stamp_ns: {problem}")
        if stamp_ns <= self.stamp_ns:  # Within the slack: the belief is not moved back
            return self
        # From the last measurement on, so that many small steps are one step to the bit.
        return self._with(advanced(self._lag.latest, stamp_ns, self._model), self._lag)

    def update(self, measurement: Timed) -> "WorldFilter":
        """Return the filter after a measurement or a scan, at its stamp or, if that has passed, the belief's.

        A measurement that is up to two seconds late is put where it belongs, as if it had come in time. One
        that was delivered before is dropped, and one that is later still; `WorldState.delivery` counts them.
        Where everything comes too late for a second, clocks were changed: the belief begins anew. One that is
        ahead of all others, and of the belief, by more than two seconds waits until a second one is, too. Of
        an image 64 boxes count.

        Raises
        ------
        InvalidArgumentError
            If none of its directions is one of the context; what a measurement consists of is checked when it
            is built.
        """
        # Before anything is computed: a measurement that is refused leaves the filter as it was.
        measurement, left_out = _fitting(measurement, self.context)
        lag = self._lag.add(measurement, self.stamp_ns, self._step)
        if lag is None:
            return self._begun_anew(measurement)
        if lag.latest is not self._lag.latest:
            # From what was published last on: a late measurement changes what has become of it since.
            steps = (*[one.before for one in lag.arrivals], lag.latest)
            known, now = (published(one.latest.tracks, self.settings.street) for one in (self._lag, lag))
            lag.latest.last.events = (*events_between(known, now, steps), *self._sound_events(lag.latest))
            lag = lag.counted(boxes_left_out=left_out) if left_out else lag
        world = self._with(lag.latest, lag)
        return world if self.stamp_ns <= world.stamp_ns + SLACK_NS else world.predict_to(self.stamp_ns)

    def _sound_events(self, latest: Memory) -> Iterator[Event]:
        """Yield which tracks of sound have ended or begun since the last measurement."""
        both = (sound_entities(one.sounds, self.settings) for one in (self._lag.latest, latest))
        known, now = ([one.id for one in sounds] for sounds in both)
        yield from (Event(latest.stamp_ns, "died", name) for name in known if name not in now)
        yield from (Event(latest.stamp_ns, "born", name) for name in now if name not in known)

    def refused(self, inputs: int) -> "WorldFilter":
        """Return the filter, whose `WorldState.delivery` counts so many more inputs refused before it."""
        return self._with(self._memory, self._lag.counted(refused=inputs)) if inputs else self

    def _step(self, memory: Memory, measurement: Timed) -> Memory:
        """Return the memory after one more measurement, not earlier than the last one."""
        is_predicted = memory is self._lag.latest and measurement.stamp_ns == self.stamp_ns
        latest = self._memory if is_predicted else memory
        # Within the slack the belief is not moved back.
        is_later = measurement.stamp_ns > latest.stamp_ns
        draft = advanced(latest, measurement.stamp_ns, self._model) if is_later else latest.draft()
        take_in(memory, draft, measurement, self.start_ns, self._model)
        return draft

    def _with(self, memory: Memory, lag: FixedLag) -> "WorldFilter":
        """Return the filter with another memory; what follows from its configuration is the same."""
        world = replaced(self, memory=memory, lag=lag)
        vars(world)["_model"] = self._model
        return world

    def _begun_anew(self, measurement: Timed) -> "WorldFilter":
        fresh = first_memory(self.context, self.settings, measurement.stamp_ns)
        fresh.counts.left_out = self._memory.counts.left_out
        lag = FixedLag(fresh, (), self._lag.counted(reanchored=1).delivery)
        return replaced(self, start_ns=measurement.stamp_ns, memory=fresh, lag=lag).update(measurement)

    def to_dict(self) -> dict[str, Any]:
        """Return a checkpoint as JSON-able values: what is read back continues bit for bit.

        Examples
        --------
        >>> world = WorldFilter().predict(0.3)
        >>> WorldFilter.from_dict(world.to_dict()).state == world.state
        True
        """
        lag, measurements = self._lag, tuple(one.measurement for one in self._lag.arrivals)
        past = LagRecord(self.stamp_ns, lag.base, measurements, lag.delivery, lag.late_since_ns, lag.held)
        # What was predicted since the last measurement is predicted again.
        given = self.context, self.policy, self.settings, self.start_ns
        return encode(FilterRecord(*given, lag.latest, past, self.no_model))

    @classmethod
    def from_dict(cls, value: object) -> "WorldFilter":
        """Return the filter that `to_dict` wrote.

        Raises
        ------
        SchemaVersionError
            On another schema or another major version.
        InvalidArgumentError
            If a value is missing, of the wrong type or out of range; the message says where.
        """
        kept = decode(FilterRecord, value, "checkpoint")
        past, latest = kept.past, kept.memory
        given = kept.context, kept.policy, kept.settings, kept.start_ns
        world = cls(*given, latest, no_model=kept.no_model)
        world = replaced(world, lag=restored(latest, past, world._step))
        return world if past.stamp_ns <= latest.stamp_ns else world.predict_to(past.stamp_ns)

    @cached_property
    def _memory(self) -> Memory:
        return self.memory or first_memory(self.context, self.settings, self.start_ns)

    @cached_property
    def _lag(self) -> FixedLag:
        return self.lag or FixedLag(self._memory)

    @cached_property
    def _model(self) -> FilterModel:
        site = site_geometry_of(self.context, self.settings)
        return FilterModel(self.context, self.policy, site, self.no_model is None)


@dataclass(frozen=True, slots=True)
class FilterRecord:
    """All of a filter, as it is written."""

    LAYOUT: ClassVar = Layout("worldstate.Filter", "4.0.0")

    context: Context
    policy: CueingPolicy
    settings: FilterSettings
    start_ns: int
    memory: Memory
    past: LagRecord
    no_model: NotUsable | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        k = len(self.context.directions)
        for memory in (self.memory, self.past.base):
            memory.belief.check(k)
            if len(memory.history) != k or max(memory.tracks.side.tolist(), default=0) >= k:
                raise InvalidArgumentError("memory: expected known sides")


def _fitting(measurement: object, context: Context) -> tuple[Timed, int]:
    """Return a measurement at the time it was taken, with the boxes that count, and how many do not.

    One that does not fit the context is refused.
    """
    if isinstance(measurement, PositionScan):
        return replaced(measurement, stamp_ns=measurement.observed_ns, latency_s=0.0), 0
    if isinstance(measurement, Odometry):
        return measurement, 0
    if not isinstance(measurement, Measurement):
        raise InvalidArgumentError(f"measurement: expected a Measurement, got {type(measurement).__name__}")
    expected, got = context.directions, measurement.signature.directions
    if not set(got) & set(expected):
        raise InvalidArgumentError(f"signature: expected one of the directions {expected}, got {got}")
    every = (measurement.sightings, *(one.sightings for one in measurement.further))
    left_out = sum(max(len(boxes) - MOST_BOXES, 0) for boxes in every)
    if left_out:
        first, *others = (tuple(sorted(boxes, key=_first_counting)[:MOST_BOXES]) for boxes in every)
        further = map(CameraLook, (one.look for one in measurement.further), others)
        measurement = replaced(measurement, sightings=first, further=tuple(further))
    return measurement, left_out


def _first_counting(one: Sighting) -> tuple[object, ...]:
    """Return what boxes count by: moving ones and high scores first, however a detector lists them."""
    return not one.moving, -one.score, BY_ALL(one)
