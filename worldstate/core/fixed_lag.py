"""Fixed-lag buffer: the measurements of the last seconds, so that a late one takes effect at its own time.

The order of arrival has no effect: a late measurement is inserted at its own time, and later ones are applied
again. A repeated one, or one older than the lag, is dropped. One that is ahead of all others by more than the
lag waits until another one confirms its stamp.
"""

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import accumulate
from operator import attrgetter
from typing import TypeAlias

from worldstate.ground.serialisation import ADDED, encode
from worldstate.ground.values import nanoseconds, replaced
from worldstate.measurement import Measurement, Odometry, PositionScan
from worldstate.state import Delivery

from .memory import Memory

# Cameras and radios are up to half a second behind the sound; two seconds also cover a slow data bus.
LAG_NS = nanoseconds(2.0)
# If every measurement is too late for this long, the clock was set back. The filter restarts at the new time.
REANCHOR_NS = nanoseconds(1.0)

Timed: TypeAlias = Measurement | PositionScan | Odometry
Step: TypeAlias = Callable[[Memory, Timed], Memory]


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A measurement, and the memory before it."""

    measurement: Timed
    before: Memory


@dataclass(frozen=True, slots=True, eq=False)
class FixedLag:
    """Measurements within the lag, and the memory after the last of them."""

    latest: Memory
    arrivals: tuple[Arrival, ...] = ()
    delivery: Delivery = field(default_factory=Delivery)
    late_since_ns: int | None = None  # First stamp of a run of measurements that were all too late
    held: Timed | None = None  # Measurement ahead of all others, until another one confirms its stamp

    @property
    def base(self) -> Memory:
        """The memory before the first arrival, from which all others follow."""
        return self.arrivals[0].before if self.arrivals else self.latest

    def add(self, measurement: Timed, now_ns: int, step: Step) -> "FixedLag | None":
        """Return the buffer with one more measurement; None if all have been too late for a second.

        A measurement that is ahead of `now_ns`, the time of the predicted belief, by more than the lag is
        held. It is applied when another one is about as far ahead of all others.
        """
        stamp_ns, held = measurement.stamp_ns, self.held
        if any(_delivery(one) == _delivery(measurement) for one in (*self._at(stamp_ns), held) if one):
            return self.counted(repeated=1)
        if stamp_ns < max(self.latest.stamp_ns - LAG_NS, self.base.stamp_ns):
            since_ns = stamp_ns if self.late_since_ns is None else self.late_since_ns
            if stamp_ns - since_ns >= REANCHOR_NS:
                return None
            return replaced(self.counted(too_late=1), late_since_ns=min(since_ns, stamp_ns))
        if held is not None and self._agree(held.stamp_ns, stamp_ns):
            first, second = sorted((held, measurement), key=attrgetter("stamp_ns"))
            return replaced(self.counted(held_back=-1), held=None)._taken(first, step)._taken(second, step)
        if self._is_ahead(stamp_ns, now_ns):
            return replaced(self.counted(held_back=1), held=measurement)
        refuted = held is not None and held.source == measurement.source
        return replaced(self, held=None if refuted else held)._taken(measurement, step)

    def _agree(self, held_ns: int, stamp_ns: int) -> bool:
        """Return whether two stamps are ahead of all others and close to each other."""
        latest_ns = self.latest.stamp_ns
        near = -LAG_NS <= stamp_ns - held_ns <= max(LAG_NS, held_ns - latest_ns)
        return near and self._is_ahead(held_ns, latest_ns) and self._is_ahead(stamp_ns, latest_ns)

    def _is_ahead(self, stamp_ns: int, now_ns: int) -> bool:
        """Return whether a stamp is too far ahead of all others, and of the belief, to be a delay."""
        if not self.arrivals:
            return False  # There is nothing to compare with
        last = self.arrivals[-1]
        # A slow stream may continue at its own interval; before a second measurement there is no interval.
        pace_ns = last.measurement.stamp_ns - last.before.stamp_ns if last.before.counts.measurements else 0
        return stamp_ns - max(now_ns, self.latest.stamp_ns) > max(LAG_NS, 2 * pace_ns)

    def _taken(self, measurement: Timed, step: Step) -> "FixedLag":
        """Return the buffer with a measurement at its time, and all later ones applied again."""
        same = self._at(measurement.stamp_ns)
        at = bisect_left(self.arrivals, measurement.stamp_ns, key=_STAMP_NS)
        at += sum(_content(one) < _content(measurement) for one in same)
        memory = self.arrivals[at].before if at < len(self.arrivals) else self.latest
        again = (measurement, *(later.measurement for later in self.arrivals[at:]))
        *befores, memory = accumulate(again, step, initial=memory)
        kept = [*self.arrivals[:at], *map(Arrival, again, befores)]
        oldest = bisect_left(kept, memory.stamp_ns - LAG_NS, key=_STAMP_NS)
        counted = self.counted(replayed=1) if measurement.stamp_ns < self.latest.stamp_ns else self
        return replaced(counted, latest=memory, arrivals=tuple(kept[oldest:]), late_since_ns=None)

    def _at(self, stamp_ns: int) -> list[Timed]:
        return [one.measurement for one in self.arrivals if one.measurement.stamp_ns == stamp_ns]

    def counted(self, **more: int) -> "FixedLag":
        """Return the buffer with higher numbers in its delivery report."""
        counts = {name: getattr(self.delivery, name) + number for name, number in more.items()}
        return replaced(self, delivery=replaced(self.delivery, **counts))


_STAMP_NS = attrgetter("measurement.stamp_ns")
# The key of a delivery; a source has at most one measurement per stamp.
_delivery = attrgetter("stamp_ns", "source")


def _content(measurement: Timed) -> tuple[int, str]:
    """Return the sort key of measurements of one instant: their kind, then their content without names."""
    if not isinstance(measurement, Measurement):
        order = 0 if isinstance(measurement, Odometry) else 2 + (measurement.searched is None)
        return order, str(encode(replaced(measurement, source="-")))
    unnamed = [replaced(one, look=replaced(one.look, sensor="-")) for one in measurement.looks]
    looks = sorted(str(encode(one)) for one in unnamed)
    return 1, str((looks, encode(replaced(measurement, source="-", look=None, sightings=(), further=()))))


@dataclass(frozen=True, slots=True)
class LagRecord:
    """Measurements of the last two seconds, and the memory before the first of them."""

    stamp_ns: int  # Time of the belief, which may be later than the last measurement
    base: Memory
    measurements: tuple[Timed, ...]
    delivery: Delivery
    late_since_ns: int | None
    held: Timed | None = field(default=None, metadata=ADDED)


def restored(latest: Memory, past: LagRecord, step: Step) -> FixedLag:
    """Return the buffer of a checkpoint; the memory before each measurement is computed again."""
    befores = accumulate(past.measurements, step, initial=past.base)
    arrivals = tuple(map(Arrival, past.measurements, befores))
    return FixedLag(latest, arrivals, past.delivery, past.late_since_ns, past.held)
