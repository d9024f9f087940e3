"""How long a state takes, and what it costs, in counts: a day takes no more memory than a minute."""

import os
import time
from dataclasses import dataclass

import numpy as np

# Width of a count, seconds, and the largest latency that is told apart.
_STEP_S, _LARGEST_S = 0.001, 60.0


class LatencyMeter:
    """Quantiles of the time from a hop's last sample to its state, to a millisecond.

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
        """Count a state."""
        self._counts[min(max(round(latency_s / _STEP_S), 0), len(self._counts) - 1)] += 1

    def quantile_s(self, share: float) -> float | None:
        """Return the smallest latency that so many of the states kept, None before the first."""
        total = int(self._counts.sum())
        if not total:
            return None
        return round(int(np.searchsorted(np.cumsum(self._counts), share * total)) * _STEP_S, 3)


@dataclass(frozen=True, slots=True)
class Cost:
    """What the process and the machine spent between two instants."""

    wall_s: float  # Time that passed
    cpu_s: float  # Time of the processor that this process took, all its threads
    load: float | None  # Processes that wanted to run, mean of the last minute; None where not known

    @property
    def cpu_share(self) -> float:
        """Share of one core."""
        return self.cpu_s / self.wall_s if self.wall_s > 0.0 else 0.0


class CostMeter:
    """Measure the cost of what happens from now on."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.monotonic(), time.process_time()

    def read(self) -> Cost:
        """Return the cost so far."""
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
        return Cost(time.monotonic() - self._wall_s, time.process_time() - self._cpu_s, load)
