"""The filter of the whole world-state, with a bit-exact checkpoint."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

from worldstate.abduction.cueing.cueing_policy import CueingPolicy, uncalibrated_policy
from worldstate.belief.detection import BY_ALL
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.street_model import FilterSettings
from worldstate.ground import InvalidArgumentError, NotUsable, in_range, integer_ns, nanoseconds, replaced
from worldstate.ground.serialisation import ADDED, Layout, decode, encode
from worldstate.measurement import CameraLook, Measurement, Odometry, PositionScan
from worldstate.state import Context, Cues, Event, Priors, WorldState
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
    """Filter of the world-state S_t: `predict` and `update` return a new filter, `state` is the snapshot.

    Parameters
    ----------
    context : Context
        Rates, occluders, ego motion.
    policy : CueingPolicy
        Threshold and risk map; a model file contains one.
    settings : FilterSettings
        Settings of the belief.
    start_ns : int
        Time of the first belief, ns, on the clock of the measurements.
    memory : Memory, optional
        Memory of another filter; by default the belief before any measurement.
    lag : FixedLag, optional
        Measurements of the last two seconds, for the insertion of late ones; by default none.
    no_model : NotUsable, optional
        Why no model interprets the sound, if none does. Snapshots then contain tracks of sound instead of
        hidden entities, and cues without side, risk and advisory.

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
        """Belief over the sides; the snapshot contains its marginals."""
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
        # The last step's relations stay valid until time passes or odometry moves the ego vehicle.
        is_fresh = memory is self._lag.latest and memory.ego is None
        sounds = sound_entities(memory.sounds, settings)
        before = last.predicted or memory.belief.sides.hypotheses
        cues = SideAlarms(memory, model).cues(sensors) if self.no_model is None else sound_cues(sounds)
        state = WorldState(
            stamp_ns=memory.stamp_ns,
            seq=memory.counts.measurements,
            entities=(*entities_of(tracks, memory, model.site), *sounds),
            relations=memory.relations if is_fresh else relations_at(memory, tracks, model),
            context=context if self.no_model else replaced(context, priors=Priors(*before)),
            cues=Cues(cues),
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
            If the time is not an integer or is before the belief.
        """
        stamp_ns = integer_ns("stamp_ns", stamp_ns)
        if stamp_ns < self.stamp_ns - SLACK_NS:
            problem = f"expected a time not before {self.stamp_ns} ns, got {stamp_ns} ns"
            raise InvalidArgumentError(f"stamp_ns: {problem}")
        if stamp_ns <= self.stamp_ns:  # Within the slack: the belief does not go back
            return self
        # Predicted from the last measurement, so that many small steps equal one step to the bit.
        return self._with(advanced(self._lag.latest, stamp_ns, self._model), self._lag)

    def update(self, measurement: Timed) -> "WorldFilter":
        """Return the filter after a measurement or a scan, at its stamp or the belief's, whichever is later.

        A measurement that is up to two seconds late takes effect at its own time. Repeated measurements, and
        those that are even later, are dropped and counted in `WorldState.delivery`. If everything is too late
        for a second, a clock was changed, and the belief restarts. A measurement more than two seconds ahead
        of the belief and of all others is held until a second one confirms its stamp. Only 64 boxes of an
        image are used.

        Raises
        ------
        InvalidArgumentError
            If the measurement has no direction of the context. Its values are checked when it is built.
        """
        # Checked first, so that a refused measurement leaves the filter unchanged.
        measurement, left_out = _fitting(measurement, self.context)
        lag = self._lag.add(measurement, self.stamp_ns, self._step)
        if lag is None:
            return self._begun_anew(measurement)
        if lag.latest is not self._lag.latest:
            # Compared with the last published tracks, because a late measurement changes all steps after it.
            steps = (*[one.before for one in lag.arrivals], lag.latest)
            known, now = (published(one.latest.tracks, self.settings.street) for one in (self._lag, lag))
            lag.latest.last.events = (*events_between(known, now, steps), *self._sound_events(lag.latest))
            lag = lag.counted(boxes_left_out=left_out) if left_out else lag
        world = self._with(lag.latest, lag)
        return world if self.stamp_ns <= world.stamp_ns + SLACK_NS else world.predict_to(self.stamp_ns)

    def _sound_events(self, latest: Memory) -> Iterator[Event]:
        """Yield the tracks of sound that have ended or begun since the last measurement."""
        both = (sound_entities(one.sounds, self.settings) for one in (self._lag.latest, latest))
        known, now = ([one.id for one in sounds] for sounds in both)
        yield from (Event(latest.stamp_ns, "died", name) for name in known if name not in now)
        yield from (Event(latest.stamp_ns, "born", name) for name in now if name not in known)

    def refused(self, inputs: int) -> "WorldFilter":
        """Return the filter with more refused inputs counted in `WorldState.delivery`."""
        return self._with(self._memory, self._lag.counted(refused=inputs)) if inputs else self

    def _step(self, memory: Memory, measurement: Timed) -> Memory:
        """Return the memory after one more measurement, which is not earlier than the last one."""
        is_predicted = memory is self._lag.latest and measurement.stamp_ns == self.stamp_ns
        latest = self._memory if is_predicted else memory
        # Within the slack the belief does not go back.
        is_later = measurement.stamp_ns > latest.stamp_ns
        draft = advanced(latest, measurement.stamp_ns, self._model) if is_later else latest.draft()
        take_in(memory, draft, measurement, self.start_ns, self._model)
        return draft

    def _with(self, memory: Memory, lag: FixedLag) -> "WorldFilter":
        """Return the filter with another memory and the same configuration."""
        world = replaced(self, memory=memory, lag=lag)
        vars(world)["_model"] = self._model
        return world

    def _begun_anew(self, measurement: Timed) -> "WorldFilter":
        fresh = first_memory(self.context, self.settings, measurement.stamp_ns)
        fresh.counts.left_out = self._memory.counts.left_out
        lag = FixedLag(fresh, (), self._lag.counted(reanchored=1).delivery)
        return replaced(self, start_ns=measurement.stamp_ns, memory=fresh, lag=lag).update(measurement)

    def to_dict(self) -> dict[str, Any]:
        """Return a checkpoint of JSON-compatible values; a filter read from it continues bit for bit.

        Examples
        --------
        >>> world = WorldFilter().predict(0.3)
        >>> WorldFilter.from_dict(world.to_dict()).state == world.state
        True
        """
        lag, measurements = self._lag, tuple(one.measurement for one in self._lag.arrivals)
        past = LagRecord(self.stamp_ns, lag.base, measurements, lag.delivery, lag.late_since_ns, lag.held)
        # Predictions since the last measurement are computed again when the checkpoint is read.
        given = self.context, self.policy, self.settings, self.start_ns
        return encode(FilterRecord(*given, lag.latest, past, self.no_model))

    @classmethod
    def from_dict(cls, value: object) -> "WorldFilter":
        """Return the filter of a checkpoint that `to_dict` wrote.

        Raises
        ------
        SchemaVersionError
            On another schema or another major version.
        InvalidArgumentError
            If a value is missing, has the wrong type or is out of range; the message gives its place.
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
    """A filter as it is written to a checkpoint."""

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
    """Return a measurement at the time it was taken, with at most `MOST_BOXES` boxes, and how many were cut.

    A measurement that does not fit the context raises an error.
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
        # Moving ones and high scores first, independent of their order.
        ranked = (sorted(boxes, key=lambda one: (not one.moving, -one.score, BY_ALL(one))) for boxes in every)
        first, *others = (tuple(boxes[:MOST_BOXES]) for boxes in ranked)
        further = map(CameraLook, (one.look for one in measurement.further), others)
        measurement = replaced(measurement, sightings=first, further=tuple(further))
    return measurement, left_out
