"""A filter as JSON-able values, which Python writes and reads without losing a bit."""

from collections.abc import Sequence, Sized
from dataclasses import dataclass, field
from typing import ClassVar

from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.belief.settings import FilterSettings
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import ADDED, Layout
from worldstate.state import Context, Delivery

from .fixed_lag import Timed
from .memory import Memory


@dataclass(frozen=True, slots=True)
class LagRecord:
    """Measurements of the last two seconds, and the memory before the first of them."""

    stamp_ns: int  # Of the belief, predicted since the last measurement
    base: Memory
    measurements: tuple[Timed, ...]
    delivery: Delivery
    late_since_ns: int | None


@dataclass(frozen=True, slots=True)
class FilterRecord:
    """All of a filter, as it is written."""

    LAYOUT: ClassVar = Layout("worldstate.Filter", "2.4.0")

    context: Context
    policy: CueingPolicy
    settings: FilterSettings
    start_ns: int
    memory: Memory
    past: LagRecord | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        self._check(self.memory)
        if self.past is not None:
            self._check(self.past.base)

    def _check(self, memory: Memory) -> None:
        k = len(self.context.directions)
        beliefs = [belief.log_probabilities for _, belief in memory.lag.beliefs]
        lengths: dict[str, tuple[Sequence[Sized], int]] = {
            "log_explanations": ([memory.explanation.log_probabilities, *beliefs], 2 * k + 2),
            "trail.heard": ([heard.log_likelihoods for heard in memory.lag.heard], k + 2),
            "births": ([memory.births], k),
            "handover_ns": ([memory.handover_ns], k),
            "advised_ns": ([memory.advised_ns], k),
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
