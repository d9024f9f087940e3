"""Dropouts of the transport, faults of channels and the health of an array.

A dropout is a run of samples that are missing, constant or repeated. The channels of a recorder share its
buffers, so a fault of the transport affects all of them at the same sample. No sound does that.
"""

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from worldstate.frontend.array.microphone_array import ChannelMask
from worldstate.ground import BoolArray, FloatArray, NotUsable, mean
from worldstate.ground.typing import Float32Array

# Number of examined channels, evenly spaced: a dropout is at the same sample in all channels.
_PICKED = 8
# Shortest run of constant samples, and the probability of such a run in quantised sound.
_SHORTEST_STILL = 16
_STILL_CHANCE = 1e-12
# Splice: mean squared prediction error over the channels. Each channel is normalised by its mean and limited
# to 5^2, so that one click is no splice. Clean simulated streets are below 7.5, and most cuts are above 15.
_JUMP_CEILING = 5.0
_JUMP_LIMIT = 12.0
# Ratio to the other jumps of the hop: white sound from broadside also causes jumps in all channels.
_JUMP_CONTRAST = 3.0
# With fewer channels the mean varies too much for these limits.
_MIN_SPLICE_CHANNELS = 6
# Repeat: samples whose hash has five zero bits, one in 32, are compared with those of the last one or two
# seconds. Four matches with the same lag do not occur by chance.
_ANCHOR_BITS = np.uint64(31)
_MIN_ANCHORS = 4
_GENERATION_HOPS = 10
_TINY = np.finfo(np.float32).tiny


@dataclass(frozen=True, slots=True)
class Dropout:
    """An interruption of the stream.

    Examples
    --------
    >>> Dropout("still", 48_000, 512).kind
    'still'
    """

    # "still": no channel changes; "splice": samples are missing, so the sound jumps; "repeat": the samples
    # are a copy of earlier ones.
    kind: Literal["still", "splice", "repeat"]
    sample: int  # First sample, from the start of the stream
    # Length, for a repeat accurate to about ten samples; None for a splice, whose length is unknown.
    n_samples: int | None


class DropoutFinder:
    """Finds dropouts hop by hop, and the samples of the latest hop that are lost in them.

    Attributes
    ----------
    lost : ndarray of bool, shape (n,)
        Samples of the latest hop that are constant in all channels or repeated. The samples lost in a splice
        are not part of the stream, so none are marked.
    """

    def __init__(self, n_channels: int) -> None:
        self.lost: BoolArray = np.zeros(0, bool)
        self._n_seen = 0
        self._tail = np.zeros((0, n_channels), np.float32)
        self._still = StillRuns()
        self._repeats = RepeatFinder()

    def push(self, samples: Float32Array, alive: BoolArray) -> list[Dropout]:
        """Process the samples (n, M) of a hop; `alive` are the channels (M,) that are not constant in it."""
        first, start = self._n_seen, self._n_seen - len(self._tail)
        # Some live channels, shape (channels, n), preceded by the end of the last hop.
        every = max(-(-int(np.add.reduce(alive)) // _PICKED), 1)
        picks = slice(None, None, every) if False not in alive else np.flatnonzero(alive)[::every]
        sound = np.ascontiguousarray(np.concatenate([self._tail[:, picks], samples[:, picks]]).T)
        self._tail, self._n_seen = samples[-2:].copy(), first + len(samples)
        change = sound[:, 1:] - sound[:, :-1]
        still = np.logical_and.reduce(change == 0.0)
        dropouts = self._still.push(still[-len(samples) :], self._n_seen)
        if len(sound) >= _MIN_SPLICE_CHANNELS:
            dropouts += find_splices(change, start + 1, still)
        dropouts += self._repeats.push(sound[:, -len(samples) :], self._n_seen)
        self.lost = np.zeros(len(samples), bool)
        for begin, end in (*self._still.runs, self._repeats.run):
            self.lost[max(begin - first, 0) : max(end - first, 0)] = True
        return sorted(dropouts, key=lambda dropout: dropout.sample)


class StillRuns:
    """Finds runs without a change on any channel, across hops; a run at the start is not a dropout.

    Attributes
    ----------
    runs : list of (int, int)
        First sample and end of the long runs in the latest hop, including an unfinished one.
    """

    def __init__(self) -> None:
        self.runs: list[tuple[int, int]] = []
        self._length = 0
        self._has_changed = False
        self._n_still, self._n_moving = 0, 0

    def push(self, still: BoolArray, end: int) -> list[Dropout]:
        r"""Process one flag per sample, the last for sample `end` - 1; return the runs that have ended.

        .. math:: L = \max\big(16,\; \ln 10^{-12} / \ln q\big)
        """
        # Constant samples, a share q of all, reach the length L by chance with a probability of 1e-12.
        first, moving = end - len(still), (~still).nonzero()[0]
        # The last run may continue in the next hop.
        edges = np.concatenate([[-1 - self._length], moving, [len(still)]])
        lengths = edges[1:] - edges[:-1] - 1
        # The shortest run that is unlikely for the share of constant samples so far.
        self._n_still += int(lengths[:-1][lengths[:-1] < _SHORTEST_STILL].sum())
        self._n_moving += len(moving)
        share = self._n_still / max(self._n_still + self._n_moving, 1)
        unlikely = np.log(_STILL_CHANCE) / np.log(share) if share else 0.0
        long = (lengths >= max(_SHORTEST_STILL, unlikely)).nonzero()[0]
        self.runs = [(int(first + edges[i]), int(first + edges[i] + lengths[i] + 1)) for i in long]
        self._length = int(lengths[-1])
        over = ((begin, stop) for begin, stop in self.runs if stop < end or not self._length)
        ended = [Dropout("still", begin, stop - begin) for begin, stop in over]
        if not self._has_changed:
            ended = [one for one in ended if one.sample > 0 and one.sample >= first + moving[0]]
        self._has_changed |= bool(len(moving))
        return ended


def find_splices(change: Float32Array, start: int, still: BoolArray) -> list[Dropout]:
    r"""Find samples at which the linear prediction fails in all channels at once.

    .. math:: e[n] = d[n] - \rho\, d[n-1], \quad \rho = \frac{\sum d[n]\, d[n-1]}{\sum d[n]^2}, \qquad
              J[n] = \Big\langle \min\Big(\frac{\max(e[n]^2, e[n+1]^2)}{\langle e^2 \rangle}, 25\Big)
              \Big\rangle_{channels},

    Shapes: change (channels, n), still (n,).
    """
    # With d the differences of successive samples, e their prediction errors and J the jump over two samples,
    # a splice has a J above 12 and above three times the fifth largest J of the hop.
    # The error of the best first-order prediction for all channels together, on the flat array: the few
    # products across channel boundaries are negligible.
    flat = change.ravel()
    power, product = float(flat @ flat), float(flat[1:] @ flat[:-1])
    error = change[:, 1:] - np.float32(product / power if power > 0.0 else 0.0) * change[:, :-1]
    np.square(error, out=error)
    error /= np.maximum(mean(error, 1), _TINY)[:, None]
    # An upper bound of J is sufficient for a clean hop.
    if 2.0 * float(mean(error, 0).max()) < _JUMP_LIMIT:
        return []
    np.minimum(error, _JUMP_CEILING**2, out=error)
    jump = np.maximum(error[:, 1:], error[:, :-1]).mean(axis=0)
    limit = max(_JUMP_LIMIT, _JUMP_CONTRAST * float(np.partition(jump, -5)[-5]))
    near_still = np.convolve(still, np.ones(9), "same")[1:-1] > 2
    found = np.flatnonzero((jump > limit) & ~near_still)
    apart = found[np.diff(found, prepend=-100) > 50]
    return [Dropout("splice", int(start + 2 + index), None) for index in apart]


class RepeatFinder:
    """Finds repeated samples by hashes of single samples over several channels."""

    # Sound never repeats bit for bit on eight channels. Only hashes with five zero bits are stored (Manber,
    # "Finding similar files in a large file system", 1994), so a repeated sample is stored or skipped like
    # its original. Memory is bounded: two generations of one second each. `run` is the repeated part of the
    # latest hop; a continued repeat begins at its end in the previous hop.

    def __init__(self) -> None:
        self.run = (0, 0)
        odd = np.random.default_rng(0).integers(1, 2**62, _PICKED, dtype=np.uint64)
        self._factors = 2 * odd + np.uint64(1)
        self._now: dict[int, int] = {}
        self._before: dict[int, int] = {}
        self._hops = 0
        self._lag = 0
        self._end = 0

    def push(self, sound: Float32Array, end: int) -> list[Dropout]:
        r"""Process a hop of some channels (channels, n); `end` is the number of samples so far.

        .. math:: h[n] = \sum_c a_c\, b_c[n] \bmod 2^{64}, \qquad
                  \hat\ell = \mathrm{mode}\{n - n' : h[n] = h[n']\}

        with the bits b of a sample, odd random factors a, and only those n at which five bits of h are zero.
        """
        self.run = (0, 0)
        if len(sound) < 2:
            return []
        if self._hops % _GENERATION_HOPS == 0:
            self._before, self._now = self._now, {}
        self._hops += 1
        keys, places = self._anchors(sound, end - sound.shape[1])
        now, before = self._now, self._before
        lags = [
            (place - (now[key] if key in now else before[key]), place)
            for key, place in zip(keys, places, strict=True)
            if key in now or key in before
        ]
        now.update(zip(keys, places, strict=True))
        return self._repeat(lags)

    def _anchors(self, sound: Float32Array, start: int) -> tuple[list[int], list[int]]:
        bits = np.ascontiguousarray(sound).view(np.uint32)
        hashes: NDArray[np.uint64] = (bits * self._factors[: len(bits), None]).sum(axis=0, dtype=np.uint64)
        # The high bits of a product are well mixed.
        anchored = (hashes >> np.uint64(40)) & _ANCHOR_BITS == 0
        anchored[1:] &= hashes[1:] != hashes[:-1]
        anchored[0] = False
        where = anchored.nonzero()[0]
        return hashes[where].tolist(), (where + start).tolist()

    def _repeat(self, lags: list[tuple[int, int]]) -> list[Dropout]:
        lag, count = next(iter(Counter(lag for lag, _ in lags).most_common(1)), (0, 0))
        if count < _MIN_ANCHORS:
            return []
        places = [place for found, place in lags if found == lag]
        goes_on = lag == self._lag and places[0] - self._end < 1000
        self.run = (self._end if goes_on else places[0], places[-1] + 1)
        self._lag, self._end = lag, places[-1]
        return [] if goes_on else [Dropout("repeat", places[0], places[-1] - places[0])]


class Fault(StrEnum):
    """Faults of a single channel.

    Examples
    --------
    >>> Fault("dead").name, len(Fault)
    ('DEAD', 11)
    """

    DEAD = "dead"
    """Constant, or 30 dB below the median channel."""
    INTERMITTENT = "intermittent"
    """Silent or crackling in several separate runs of hops."""
    NOISY = "noisy"
    """Incoherent with the prediction from the other channels."""
    INVERTED = "inverted"
    """Fits its position with the opposite sign: reversed polarity."""
    SWAPPED = "swapped"
    """Fits the position of another microphone better than its own."""
    CLIPPED = "clipped"
    """Many samples have the same extreme value."""
    OFFSET = "offset"
    """The mean is not small relative to the sound."""
    LEVEL = "level"
    """Louder or quieter than the median channel by more than the tolerance of microphones."""
    GUSTS = "gusts"
    """Repeatedly much louder than the others for half a second to seconds: wind at this microphone."""
    DELAY = "delayed"
    """Constantly later or earlier than sound from any direction."""
    DRIFT = "drifting"
    """Increasingly late or early: a sound card with its own clock."""


MASKED_FAULTS = frozenset(Fault) - {Fault.CLIPPED, Fault.OFFSET, Fault.LEVEL, Fault.GUSTS}
"""Faults for which a channel is excluded. The others leave its phase intact, and PHAT uses only phases."""


@dataclass(frozen=True, slots=True)
class ChannelFault:
    """One fault of one channel.

    Parameters
    ----------
    channel : int
        Number from 0, in the order of the array.
    fault : Fault
        Kind of the fault.
    value : float
        Size of the fault. Dead and intermittent: share of the last five seconds. Noisy and inverted:
        coherence with the prediction from the other channels, relative to the median channel. Swapped: gain
        in this coherence at the other position, -2 to 2. Clipped: share of samples. Offset: mean divided by
        the peak-to-peak value. Level: dB relative to the median channel. Gusts: share of the last ten
        seconds. Delayed: seconds. Drifting: seconds per second. Swapped, up to 16 channels: gain in
        sharpness, nats.
    looks_like : int or None
        Swapped: the channel whose position fits.
    std : float or None
        Delayed and drifting: standard deviation of `value`.

    Examples
    --------
    >>> ChannelFault(3, Fault.SWAPPED, 0.8, looks_like=7).fault.value
    'swapped'
    """

    channel: int
    fault: Fault
    value: float
    looks_like: int | None = None
    std: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ArrayHealth:
    """Health of an array at the end of a hop.

    Parameters
    ----------
    mask : ChannelMask
        Microphones that are used in this hop.
    faults : tuple of ChannelFault
        Current faults by channel; a channel may have several.
    dropouts : tuple of Dropout
        The last 16 dropouts.
    n_dropouts : int
        Number of dropouts since the start.
    coherence : float or NotUsable
        Median over the channels of the coherence with the prediction from the others. Not usable in the first
        second or without coherent sound; swapped, inverted and noisy channels are then not detected.
    clipped : float
        Share of clipped samples in the hop, over all channels.

    Examples
    --------
    >>> health = ArrayHealth.unknown(n_channels=4)
    >>> health.is_healthy, health.mask.n_kept
    (True, 4)
    """

    mask: ChannelMask
    faults: tuple[ChannelFault, ...]
    dropouts: tuple[Dropout, ...]
    n_dropouts: int
    coherence: float | NotUsable
    clipped: float = 0.0

    @classmethod
    def unknown(cls, n_channels: int, reason: str = "no hop so far") -> "ArrayHealth":
        """Return the health of an array without information: all channels are kept.

        Parameters
        ----------
        n_channels : int
            Number of microphones M.
        reason : str
            Reason for the missing estimate of the coherence.

        Returns
        -------
        ArrayHealth
            Health without faults.

        Examples
        --------
        >>> ArrayHealth.unknown(3).mask.keep
        array([ True,  True,  True])
        """
        return cls(ChannelMask.all_of(n_channels), (), (), 0, NotUsable(reason))

    @property
    def is_healthy(self) -> bool:
        """Whether there is no fault and no dropout."""
        return not (self.faults or self.n_dropouts)


def faults_where(fault: Fault, found: BoolArray, values: FloatArray) -> list[ChannelFault]:
    """Return one kind of fault for all affected channels; both arrays have shape (M,)."""
    return [ChannelFault(m, fault, float(values[m])) for m in found.nonzero()[0].tolist()]


def repeated(
    found: list[ChannelFault], before: list[ChannelFault]
) -> tuple[list[ChannelFault], list[ChannelFault]]:
    """Return the faults that were found twice in a row, and all faults for the next comparison."""
    known = {(one.channel, one.fault) for one in before}
    return [one for one in found if (one.channel, one.fault) in known], found
