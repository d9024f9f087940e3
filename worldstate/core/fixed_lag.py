"""Fixed-lag buffer: what came in during the last seconds, so that a late measurement is put in its place.

Order of arrival carries no meaning: a measurement that comes after later ones is taken in at its own time,
and those after it once more. One that was delivered before is dropped, one older than the lag is counted.
"""

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from worldstate.ground.values import nanoseconds
from worldstate.measurement import Measurement, Odometry, PositionScan
from worldstate.state import Delivery

from .memory import Memory

# Cameras and radios come up to half a second behind the sound; two seconds leave room for a bus that stalls.
LAG_NS = nanoseconds(2.0)
# Everything being too late for so long is no delay: the clock was set back, or a stamp from the future came
# before. The filter begins anew at the time that is told now.
REANCHOR_NS = nanoseconds(1.0)

Timed: TypeAlias = Measurement | PositionScan | Odometry
Step: TypeAlias = Callable[[Memory, Timed], Memory]


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A measurement, and the memory that it was added to."""

    measurement: Timed
    before: Memory

    @property
    def key(self) -> tuple[int, str]:
        """What arrivals are in order of; one source says one thing at a time."""
        return self.measurement.stamp_ns, self.measurement.source


@dataclass(frozen=True, slots=True, eq=False)
class FixedLag:
    """The arrivals of the lag, and the memory after the last of them."""

    latest: Memory
    arrivals: tuple[Arrival, ...] = ()
    delivery: Delivery = field(default_factory=Delivery)
    late_since_ns: int | None = None  # First stamp of a run of measurements that were all too late

    @property
    def base(self) -> Memory:
        """The memory before the first arrival, from which all others follow."""
        return self.arrivals[0].before if self.arrivals else self.latest

    def add(self, measurement: Timed, step: Step) -> "FixedLag | None":
        """Return the buffer with one more measurement; None where all have been too late for a second."""
        stamp_ns, keys = measurement.stamp_ns, [one.key for one in self.arrivals]
        at = bisect_left(keys, (stamp_ns, measurement.source))
        if at < len(keys) and keys[at] == (stamp_ns, measurement.source):
            delivery = replace(self.delivery, repeated=self.delivery.repeated + 1)
            return replace(self, delivery=delivery)
        if stamp_ns < max(self.latest.stamp_ns - LAG_NS, self.base.stamp_ns):
            return self._too_late(stamp_ns)
        memory = self.arrivals[at].before if at < len(keys) else self.latest
        moved = [one.measurement for one in self.arrivals[at:]]
        kept = list(self.arrivals[:at])
        for one in (measurement, *moved):
            kept.append(Arrival(one, memory))
            memory = step(memory, one)
        delivery = replace(self.delivery, replayed=self.delivery.replayed + bool(moved))
        oldest_ns = memory.stamp_ns - LAG_NS
        return FixedLag(memory, tuple(one for one in kept if one.measurement.stamp_ns >= oldest_ns), delivery)

    def _too_late(self, stamp_ns: int) -> "FixedLag | None":
        since_ns = stamp_ns if self.late_since_ns is None else self.late_since_ns
        if stamp_ns - since_ns >= REANCHOR_NS:
            return None
        delivery = replace(self.delivery, too_late=self.delivery.too_late + 1)
        return replace(self, delivery=delivery, late_since_ns=min(since_ns, stamp_ns))


@dataclass(frozen=True, slots=True)
class LagRecord:
    """Measurements of the last two seconds, and the memory before the first of them."""

    stamp_ns: int  # Of the belief, predicted since the last measurement
    base: Memory
    measurements: tuple[Timed, ...]
    delivery: Delivery
    late_since_ns: int | None


def restored(latest: Memory, past: LagRecord, step: Step) -> FixedLag:
    """Return the buffer of a checkpoint, with the memory before each of its measurements computed anew."""
    arrivals, memory = list[Arrival](), past.base
    for one in past.measurements:
        arrivals.append(Arrival(one, memory))
        memory = step(memory, one)
    return FixedLag(latest, tuple(arrivals), past.delivery, past.late_since_ns)
