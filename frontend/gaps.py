"""Places where a stream is not what the microphones heard: samples missing, silent or repeated.

All microphones of a recorder share its buffers, so that a fault of the transport shows in all channels at the
same sample, which no sound does.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

GapKind = Literal["still", "splice", "repeat"]

# Channels looked at, evenly picked: a few say what all would.
_PICKED = 8
# Samples without any change on any channel.
_SHORTEST_STILL = 16
# Splice: mean squared jump over the channels, in units of each channel's own, a single one counting 25 at
# most; clean simulated streets stay below 7.5 and nine in ten cuts are above 15.
_JUMP_CEILING = 5.0
_JUMP_LIMIT = 12.0
# ... and against the hop's own jumps: white sound from straight ahead jumps together, too.
_JUMP_CONTRAST = 3.0
_MIN_SPLICE_CHANNELS = 6
# Repeat: samples whose hash has five zeros in one place are compared with those of the last second or two.
_ANCHOR_BITS = np.uint64(31)
_MIN_ANCHORS = 4
_GENERATION_HOPS = 10


@dataclass(frozen=True, slots=True)
class Gap:
    """A place where the stream is broken.

    Parameters
    ----------
    kind : str
        "still": no channel changes; "splice": the sound jumps, samples are missing; "repeat": the samples
        have been there before.
    sample : int
        Where, from the start of the stream.
    n_samples : int or None
        Length, that of a repeat to some ten samples; None for a splice, whose length leaves no trace.

    Examples
    --------
    >>> Gap("still", 48_000, 512).kind
    'still'
    """

    kind: GapKind
    sample: int
    n_samples: int | None


class GapFinder:
    """Find gaps hop by hop.

    Parameters
    ----------
    n_channels : int
        Number of channels M.

    Examples
    --------
    >>> sound = np.random.default_rng(0).standard_normal((4800, 8)).astype(np.float32)
    >>> sound[1000:1100] = 0.0
    >>> GapFinder(8).push(sound, np.ones(8, bool))
    [Gap(kind='still', sample=1000, n_samples=100)]
    """

    def __init__(self, n_channels: int) -> None:
        self._n_seen = 0
        self._tail = np.zeros((0, n_channels), np.float32)
        self._still = StillRuns()
        self._repeats = RepeatFinder(n_channels)

    def push(self, samples: NDArray[np.float32], alive: NDArray[np.bool_]) -> list[Gap]:
        """Take the samples (n, M) of a hop and the channels that are not constant in it.

        Returns
        -------
        list of Gap
            Those that end or show within this hop.
        """
        picks = np.flatnonzero(alive)
        picks = picks[:: max(-(-len(picks) // _PICKED), 1)]
        start = self._n_seen - len(self._tail)
        sound = np.concatenate([self._tail[:, picks], samples[:, picks]])
        self._tail = samples[-2:].copy()
        self._n_seen += len(samples)
        change = sound[1:] - sound[:-1]
        still = ~change.any(axis=1) if len(picks) else np.ones(len(change), bool)
        gaps = self._still.push(still[-len(samples) :], self._n_seen)
        if len(picks) >= _MIN_SPLICE_CHANNELS:
            gaps += find_splices(sound, start, still)
        gaps += self._repeats.push(samples, picks, self._n_seen)
        return sorted(gaps, key=lambda gap: gap.sample)


class StillRuns:
    """Runs of samples in which nothing changes, across hops; one that opens the stream is no gap."""

    def __init__(self) -> None:
        self._length = 0
        self._heard = False

    def push(self, still: NDArray[np.bool_], end: int) -> list[Gap]:
        """Take one flag per sample, the last being sample `end` - 1; give the runs that end here."""
        moving = np.flatnonzero(~still)
        if not len(moving):
            self._length += len(still)
            return []
        first = end - len(still)
        edges = np.concatenate([[-1 - self._length], moving])
        lengths = np.diff(edges) - 1
        found = np.flatnonzero(lengths >= _SHORTEST_STILL)
        gaps = [Gap("still", int(first + edges[i]), int(lengths[i]) + 1) for i in found]
        if not self._heard:
            gaps = [gap for gap in gaps if gap.sample > 0 and gap.sample >= first + moving[0]]
        self._heard = True
        self._length = int(len(still) - 1 - moving[-1])
        return gaps


def find_splices(sound: NDArray[np.float32], start: int, still: NDArray[np.bool_]) -> list[Gap]:
    """Find samples at which all channels leave the line that their last two samples foretell.

    Parameters
    ----------
    sound : ndarray of float32, shape (n, channels)
        The first being sample `start`.
    start : int
        Of the stream.
    still : ndarray of bool, shape (n - 1,)
        Where no channel changes; the edges of such runs are no splices.
    """
    error = np.abs(_prediction_error(sound))
    error /= np.maximum(error.mean(axis=0) * np.float32(np.sqrt(np.pi / 2)), np.finfo(np.float32).tiny)
    np.minimum(error, _JUMP_CEILING, out=error)
    jump = np.square(np.maximum(error[1:], error[:-1])).mean(axis=1)
    limit = max(_JUMP_LIMIT, _JUMP_CONTRAST * float(np.partition(jump, -5)[-5]))
    found = np.flatnonzero(jump > limit)
    near_still = np.convolve(still, np.ones(9), "same")[2:] > 2
    found = found[~near_still[np.minimum(found, len(near_still) - 1)]]
    apart = found[np.diff(found, prepend=-100) > 50]
    return [Gap("splice", int(start + 2 + index), None) for index in apart]


def _prediction_error(sound: NDArray[np.float32]) -> NDArray[np.float32]:
    """Remainder of the best prediction of every sample from the two before it, one for all channels."""
    level: NDArray[np.float32] = sound - sound.mean(axis=0)
    level /= np.maximum(np.abs(level).max(axis=0), np.finfo(np.float32).tiny)
    r0, r1, r2 = (
        np.einsum("nm,nm->", level[: len(level) - lag], level[lag:], dtype=np.float64) for lag in range(3)
    )
    determinant = r0 * r0 - r1 * r1
    if determinant <= 0.0:
        return level[2:]
    first = np.float32(r1 * (r0 - r2) / determinant)
    second = np.float32((r0 * r2 - r1 * r1) / determinant)
    return np.asarray(level[2:] - first * level[1:-1] - second * level[:-2])


class RepeatFinder:
    """Samples that were there before, found by hashes of single samples over several channels.

    Sound never repeats to the last bit on eight channels. Only samples whose hash has five zeros in one place
    are kept, so that the same samples are kept when they come again. Memory does not grow: two generations of
    a second each.
    """

    def __init__(self, n_channels: int) -> None:
        odd = np.random.default_rng(0).integers(1, 2**62, n_channels, dtype=np.uint64)
        self._factors = 2 * odd + np.uint64(1)
        self._now: dict[int, int] = {}
        self._before: dict[int, int] = {}
        self._hops = 0
        self._lag = 0
        self._end = 0

    def push(self, samples: NDArray[np.float32], picks: NDArray[np.intp], end: int) -> list[Gap]:
        """Take a hop (n, M) and the channels to look at; `end` is the number of samples so far."""
        if len(picks) < 2:
            return []
        if self._hops % _GENERATION_HOPS == 0:
            self._before, self._now = self._now, {}
        self._hops += 1
        keys, places = self._anchors(samples, picks, end - len(samples))
        lags = [
            (place - before, place)
            for key, place in zip(keys, places, strict=True)
            if (before := self._now.get(key, self._before.get(key))) is not None
        ]
        self._now.update(zip(keys, places, strict=True))
        return self._repeat(lags)

    def _anchors(
        self, samples: NDArray[np.float32], picks: NDArray[np.intp], start: int
    ) -> tuple[list[int], list[int]]:
        bits = np.ascontiguousarray(samples[:, picks]).view(np.uint32)
        hashes: NDArray[np.uint64] = (bits * self._factors[: len(picks)]).sum(axis=1, dtype=np.uint64)
        # High bits are the well-mixed ones of a product.
        anchored = (hashes >> np.uint64(40)) & _ANCHOR_BITS == 0
        anchored[1:] &= hashes[1:] != hashes[:-1]
        anchored[0] = False
        where = np.flatnonzero(anchored)
        return hashes[where].tolist(), (where + start).tolist()

    def _repeat(self, lags: list[tuple[int, int]]) -> list[Gap]:
        if len(lags) < _MIN_ANCHORS:
            return []
        lag, count = Counter(lag for lag, _ in lags).most_common(1)[0]
        if count < _MIN_ANCHORS:
            return []
        places = [place for found, place in lags if found == lag]
        goes_on = lag == self._lag and places[0] - self._end < 1000
        self._lag, self._end = lag, places[-1]
        return [] if goes_on else [Gap("repeat", places[0], places[-1] - places[0])]
