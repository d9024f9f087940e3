"""A filter as JSON-able values, which Python writes and reads without losing a bit."""

import math
from collections.abc import Sequence, Sized
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar

from worldstate.abduction.cueing.adaptive_threshold import AdaptiveThreshold
from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.posterior import Posterior
from worldstate.abduction.signature.domain_guard import DomainVerdict
from worldstate.belief.belief_lag import BeliefLag, SourceEvidence
from worldstate.belief.ego_motion import EgoBelief
from worldstate.belief.explanation import ExplanationBelief
from worldstate.belief.settings import FilterSettings
from worldstate.belief.track import Track
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import ADDED, Count, Keys, Layout
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Bearing, Measurement
from worldstate.measurement.odometry import Odometry
from worldstate.measurement.position import PositionScan
from worldstate.state import Context, Delivery, Event, Priors, Relation

from .memory import CountedLook, Memory, SourceRule
from .sequence_memory import SequenceMemory

Logs = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Posterior:
    # JSON knows no infinity: null stands for an impossible explanation and for a ratio without bound.
    log_probabilities: tuple[Annotated[float | None, Keys("nats")], ...]
    log_lambda: float | None
    log_evidence: float


@dataclass(frozen=True, slots=True)
class _BeliefLag:
    beliefs: tuple[Annotated[tuple[int, Logs], Keys("stamp_ns", "log_explanations")], ...]
    heard: tuple[SourceEvidence, ...]


@dataclass(frozen=True, slots=True)
class _Memory:
    """The memory without what its context and policy say already."""

    stamp_ns: int
    log_explanations: Logs
    trail: _BeliefLag
    births: tuple[Count, ...]
    handover_ns: tuple[Annotated[int | None, Keys("stamp_ns")], ...]
    tracks: tuple[Track, ...]
    seq: Count
    sighted: Count
    last: tuple[Annotated[tuple[str, int], Keys("source", "stamp_ns")], ...]
    predicted: Priors | None
    instant: _Posterior | None
    threshold: AdaptiveThreshold = field(default_factory=AdaptiveThreshold, metadata=ADDED)
    rules: tuple[SourceRule, ...] = field(default=(), metadata=ADDED)
    looks: tuple[CountedLook, ...] = field(default=(), metadata=ADDED)
    bearing: Bearing | None = field(default=None, metadata=ADDED)
    domain: DomainVerdict | None = field(default=None, metadata=ADDED)
    sequence: SequenceMemory | None = field(default=None, metadata=ADDED)
    no_sequence: NotUsable | None = field(default=None, metadata=ADDED)
    heard_nats: float = field(default=0.0, metadata=ADDED)
    advised_ns: tuple[Annotated[int | None, Keys("stamp_ns")], ...] = field(default=(), metadata=ADDED)
    events: tuple[Event, ...] = field(default=(), metadata=ADDED)
    relations: tuple[Relation, ...] = field(default=(), metadata=ADDED)
    ego: EgoBelief | None = field(default=None, metadata=ADDED)


@dataclass(frozen=True, slots=True)
class LagRecord:
    """Measurements of the last two seconds, and the memory before the first of them."""

    stamp_ns: int  # Of the belief, predicted since the last measurement
    base: _Memory
    measurements: tuple[Measurement | PositionScan | Odometry, ...]
    delivery: Delivery
    late_since_ns: int | None


@dataclass(frozen=True, slots=True)
class FilterRecord:
    """All of a filter, as it is written."""

    LAYOUT: ClassVar = Layout("worldstate.Filter", "2.3.0")

    context: Context
    policy: CueingPolicy
    settings: FilterSettings
    start_ns: int
    memory: _Memory
    past: LagRecord | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        self._check(self.memory)
        if self.past is not None:
            self._check(self.past.base)

    def _check(self, memory: _Memory) -> None:
        k = len(self.context.directions)
        beliefs = [logs for _, logs in memory.trail.beliefs]
        lengths: dict[str, tuple[Sequence[Sized], int]] = {
            "log_explanations": ([memory.log_explanations, *beliefs], 2 * k + 2),
            "trail.heard": ([heard.log_likelihoods for heard in memory.trail.heard], k + 2),
            "births": ([memory.births], k),
            "handover_ns": ([memory.handover_ns], k),
            "advised_ns": ([memory.advised_ns] if memory.advised_ns else [], k),
            "instant": ([memory.instant.log_probabilities] if memory.instant else [], k + 2),
        }
        for name, (rows, length) in lengths.items():
            for row in rows:
                if len(row) != length:
                    raise InvalidArgumentError(f"memory.{name}: expected {length} numbers, got {len(row)}")
        if memory.sequence is not None:
            memory.sequence.check()
        if not beliefs:
            raise InvalidArgumentError("memory.trail.beliefs: expected at least one")
        if any(one.run > self.policy.sustain_hops for one in memory.rules):
            raise InvalidArgumentError("memory.rules: expected runs within the policy's rule")
        if any(side >= k for one in memory.rules for side in one.announced):
            raise InvalidArgumentError("memory.rules: expected known sides")
        if any(track.side >= k for track in memory.tracks):
            raise InvalidArgumentError("memory.tracks: expected known sides")


def memory_record(memory: Memory) -> _Memory:
    """Return what a checkpoint keeps of a memory."""
    lag, instant = memory.lag, memory.instant
    changed: dict[str, Any] = {
        "log_explanations": memory.explanation.log_probabilities,
        "trail": _BeliefLag(tuple((ns, b.log_probabilities) for ns, b in lag.beliefs), lag.heard),
        "last": memory.last_ns,
        "instant": None if instant is None else _posterior_record(instant),
    }
    return _Memory(**(_as_it_is(memory) | changed))


def memory_of(kept: _Memory, record: FilterRecord) -> Memory:
    """Return the memory that `memory_record` kept in a record."""
    directions = record.context.directions
    beliefs = tuple((ns, ExplanationBelief(directions, logs)) for ns, logs in kept.trail.beliefs)
    changed: dict[str, Any] = {
        "explanation": ExplanationBelief(directions, kept.log_explanations),
        "lag": BeliefLag(beliefs, kept.trail.heard),
        "last_ns": kept.last,
        "instant": None if kept.instant is None else _posterior_of(kept.instant, directions),
        "advised_ns": kept.advised_ns or (None,) * len(directions),
    }
    return Memory(**(_as_it_is(kept) | changed))


def _as_it_is(memory: Memory | _Memory) -> dict[str, Any]:
    """Return what a memory and its record have alike."""
    shared = {one.name for one in fields(Memory)} & {one.name for one in fields(_Memory)} - {"instant"}
    return {name: getattr(memory, name) for name in shared}


def _posterior_record(instant: Posterior) -> _Posterior:
    logs = tuple(nats if math.isfinite(nats) else None for nats in instant.log_probabilities)
    ratio = instant.log_lambda if math.isfinite(instant.log_lambda) else None
    return _Posterior(logs, ratio, instant.log_evidence)


def _posterior_of(kept: _Posterior, directions: tuple[str, ...]) -> Posterior:
    logs = tuple(-math.inf if nats is None else nats for nats in kept.log_probabilities)
    ratio = math.inf if kept.log_lambda is None else kept.log_lambda
    return Posterior(directions, logs, ratio, kept.log_evidence)
