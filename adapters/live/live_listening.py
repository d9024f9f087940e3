"""The whole processing chain on live sensors: one state per hop, its latency and its cost.

Latencies are stored as a histogram, whose memory does not grow with time.
"""

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from worldstate.adapters.listener import Listener, Step, listened
from worldstate.adapters.source import Source
from worldstate.ground.errors import InvalidArgumentError, OwnPartError

from .live_sound import LiveSound

# Bin width of the histogram and largest latency, seconds.
_STEP_S, _LARGEST_S = 0.001, 60.0


@dataclass(frozen=True, slots=True)
class LiveStep:
    """One hop as a `Step`, with its latency."""

    step: Step
    latency_s: float  # From the capture of the hop's last sample to the state
    overruns: int  # Number of losses of sound so far
    lost_s: float  # Seconds of sound lost so far


def live_steps(source: Source, *hand_in: Callable[[Listener], int]) -> Iterator[LiveStep]:
    """Yield every hop of a source whose sound is a `LiveSound`, as soon as it is available.

    Each `hand_in` is called before every block of sound to deliver data of other sensors. It returns the
    number of refused items; a call that fails, or returns something else, counts as one.
    """
    sound = source.sound
    if not isinstance(sound, LiveSound):
        got = source.audio_path
        raise InvalidArgumentError(f"source: expected one whose sound is a LiveSound, got {got}")
    told, start_ns = 0, sound.start_ns
    for listener, block in listened(source):
        if sound.start_ns > start_ns:
            listener.skip(sound.start_ns - start_ns)
            start_ns = sound.start_ns
        for one in hand_in:
            try:
                listener.refuse(one(listener))
            except OwnPartError:
                raise
            except Exception as error:  # the caller's function may raise anything
                listener.refuse(1, "hand_in", f"fails is refused: {error!r}")
        listener.refuse(sound.refused - told)
        told = sound.refused
        for step in listener.steps(block):
            yield LiveStep(step, sound.age_s(step.frame.sample_index), sound.overruns, sound.lost_s)


class LatencyMeter:
    """Quantiles of the time from a hop's last sample to its state, to 1 ms.

    Examples
    --------
    >>> meter = LatencyMeter()
    >>> for latency_s in (0.010, 0.012, 0.300):
    ...     meter.add(latency_s)
    >>> meter.quantile_s(0.5), meter.quantile_s(0.99)
    (0.012, 0.3)
    """

    def __init__(self) -> None:
        self._counts = np.zeros(round(_LARGEST_S / _STEP_S) + 1, dtype=np.int64)

    def add(self, latency_s: float) -> None:
        """Add the latency of a state."""
        self._counts[min(max(round(latency_s / _STEP_S), 0), len(self._counts) - 1)] += 1

    def quantile_s(self, share: float) -> float | None:
        """Return the latency that this share of the states did not exceed; None before the first state."""
        total = int(self._counts.sum())
        if not total:
            return None
        return round(int(np.searchsorted(np.cumsum(self._counts), share * total)) * _STEP_S, 3)


class CostMeter:
    """Measure the resources that the process uses from now on."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.monotonic(), time.process_time()

    def read(self) -> dict[str, float | None]:
        """Return elapsed time, CPU time of all threads, its share of one core, and the load.

        The load is the number of runnable processes, averaged over the last minute; None if it is not
        available.
        """
        wall_s, cpu_s = time.monotonic() - self._wall_s, time.process_time() - self._cpu_s
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
        share = cpu_s / wall_s if wall_s else 0.0
        return {"wall_s": wall_s, "cpu_s": cpu_s, "cpu_share": share, "load": load}
