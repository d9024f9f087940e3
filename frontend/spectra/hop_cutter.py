"""Cut a stream of samples into hops that do not drift."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import Float32Array


def hop_end(index: int, sample_rate_hz: float, hop_rate_hz: float) -> int:
    """Sample at which hop k, `index`, ends: ``n_k = floor(k fs / r + 1/2)`` with r hops a second.

    Examples
    --------
    >>> [hop_end(k, 47_998, 10) for k in (0, 1, 2, 10)]
    [0, 4800, 9600, 47998]
    """
    return math.floor(index * sample_rate_hz / hop_rate_hz + 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class Hop:
    """The samples of one hop."""

    index: int  # From 1
    end: int  # Number of samples from the start of the stream to the end of this hop
    samples: Float32Array  # shape (n, M): Valid until the next hop is read


class HopCutter:
    """Collect blocks of any length and return whole hops, in time proportional to the samples."""

    def __init__(self, n_channels: int, sample_rate_hz: float, hop_rate_hz: float) -> None:
        self._rates = sample_rate_hz, hop_rate_hz
        self._index = 1
        self._start, self._end = 0, hop_end(1, *self._rates)
        self._filled = 0
        self._buffer = np.empty((math.ceil(sample_rate_hz / hop_rate_hz) + 1, n_channels), np.float32)

    def cut(self, block: Float32Array) -> Iterator[Hop]:
        """Take a block (n, M) and yield the hops that it completes; the iterator must be read to its end."""
        while len(block):
            taken = min(len(block), self._length - self._filled)
            whole = taken == self._length
            if not whole:
                self._buffer[self._filled : self._filled + taken] = block[:taken]
            self._filled += taken
            if self._filled == self._length:
                samples = block[:taken] if whole else self._buffer[: self._length]
                hop = Hop(self._index, self._end, samples)
                self._advance()
                yield hop
            block = block[taken:]

    @property
    def _length(self) -> int:
        return self._end - self._start

    def _advance(self) -> None:
        self._index += 1
        self._start, self._end = self._end, hop_end(self._index, *self._rates)
        self._filled = 0
