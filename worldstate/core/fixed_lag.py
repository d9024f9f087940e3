"""Fixed-lag buffer: what came in during the last seconds, so that a late measurement is put in its place.

Order of arrival carries no meaning: a measurement that comes after later ones is taken in at its own time,
and those after it once more. One that was delivered before is dropped, one older than the lag is counted.
"""

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from worldstate.ground.values import nanoseconds
from worldstate.measurement.measurement import Measurement
from worldstate.measurement.odometry import Odometry
from worldstate.measurement.position import PositionScan
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
    """A measurement, and the memory that it was added to; None where that is still to be computed."""

    measurement: Timed
    before: Memory | None

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
        first = self.arrivals[0].before if self.arrivals else None
        return first or self.latest

    def add(self, measurement: Timed, step: Step) -> "FixedLag | None":
        """Return the buffer with one more measurement; None where all have been too late for a second."""
        stamp_ns, keys = measurement.stamp_ns, [one.key for one in self.arrivals]
        at = bisect_left(keys, (stamp_ns, measurement.source))
        if at < len(keys) and keys[at] == (stamp_ns, measurement.source):
            delivery = replace(self.delivery, repeated=self.delivery.repeated + 1)
            return replace(self, delivery=delivery)
        oldest_ns = self.latest.stamp_ns - LAG_NS
        if self.arrivals and self.arrivals[0].before is not None:
            oldest_ns = max(oldest_ns, self.arrivals[0].before.stamp_ns)
        if stamp_ns < oldest_ns or (not self.arrivals and stamp_ns < self.latest.stamp_ns):
            return self._too_late(stamp_ns)
        memory, known = self.latest, self.arrivals
        if at < len(keys):
            known = self._computed(step)
            memory = known[at].before or self.latest
        moved = [one.measurement for one in known[at:]]
        kept = list(known[:at])
        for one in (measurement, *moved):
            kept.append(Arrival(one, memory))
            memory = step(memory, one)
        delivery = replace(self.delivery, replayed=self.delivery.replayed + bool(moved))
        return FixedLag(memory, _recent(kept, memory.stamp_ns - LAG_NS), delivery)

    def _computed(self, step: Step) -> tuple[Arrival, ...]:
        """Return the arrivals with the memory before each: those of a checkpoint know only the first."""
        found: list[Arrival] = []
        for one in self.arrivals:
            before = one.before
            if before is None:
                last = found[-1]
                assert last.before is not None
                before = step(last.before, last.measurement)
            found.append(Arrival(one.measurement, before))
        return tuple(found)

    def _too_late(self, stamp_ns: int) -> "FixedLag | None":
        since_ns = stamp_ns if self.late_since_ns is None else self.late_since_ns
        if stamp_ns - since_ns >= REANCHOR_NS:
            return None
        delivery = replace(self.delivery, too_late=self.delivery.too_late + 1)
        return replace(self, delivery=delivery, late_since_ns=min(since_ns, stamp_ns))


def _recent(arrivals: list[Arrival], oldest_ns: int) -> tuple[Arrival, ...]:
    """Return the arrivals from a time on, and those before it that the memory must be computed from."""
    first = next(
        (i for i, one in enumerate(arrivals) if one.measurement.stamp_ns >= oldest_ns), len(arrivals)
    )
    while 0 < first < len(arrivals) and arrivals[first].before is None:
        first -= 1
    return tuple(arrivals[first:])


def restored(
    latest: Memory, base: Memory, measurements: tuple[Timed, ...], delivery: Delivery, since_ns: int | None
) -> FixedLag:
    """Return the buffer of a checkpoint: the memory before the first measurement, and after the last."""
    befores = (base, *[None] * max(len(measurements) - 1, 0))
    arrivals = tuple(Arrival(*pair) for pair in zip(measurements, befores, strict=False))
    return FixedLag(latest, arrivals, delivery, since_ns)
