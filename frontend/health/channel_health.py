"""Dropouts of the transport, faults of channels and the health of an array.

A dropout is a run of samples that are missing, constant or repeated. All channels of a recorder share its
buffers, so that a fault of the transport appears in all of them at the same sample; no sound does that.
"""

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from worldstate.frontend.array.microphone_array import ChannelMask
from worldstate.ground import BoolArray, FloatArray, NotUsable, mean
from worldstate.ground.typing import Float32Array, IndexArray

DropoutKind = Literal["still", "splice", "repeat"]

# Channels examined, evenly picked: a dropout is at the same sample in all of them.
_PICKED = 8
# Shortest run of constant samples, and the chance at which quantised sound may produce a run by itself.
_SHORTEST_STILL = 16
_STILL_CHANCE = 1e-12
# Splice: mean squared prediction error over the channels, each relative to its own mean and at most 5^2, so
# that one click is no splice; clean simulated streets stay below 7.5 and most cuts are above 15.
_JUMP_CEILING = 5.0
_JUMP_LIMIT = 12.0
# The same relative to the other jumps of the hop: white sound from broadside jumps in all channels, too.
_JUMP_CONTRAST = 3.0
# The mean over fewer channels scatters too much for these limits.
_MIN_SPLICE_CHANNELS = 6
# Repeat: samples whose hash has five zero bits, one in 32, are compared with those of the last one or two
# seconds; four that agree in their lag are no chance.
_ANCHOR_BITS = np.uint64(31)
_MIN_ANCHORS = 4
_GENERATION_HOPS = 10
_TINY = np.finfo(np.float32).tiny


@dataclass(frozen=True, slots=True)
class Dropout:
    """A place where the stream is interrupted.

    Examples
    --------
    >>> Dropout("still", 48_000, 512).kind
    'still'
    """

    # "still": no channel changes; "splice": the sound jumps, samples are missing; "repeat": the samples
    # came before.
    kind: DropoutKind
    sample: int  # First sample, from the start of the stream
    # Length, that of a repeat to about ten samples; None for a splice, whose length is not known.
    n_samples: int | None


class DropoutFinder:
    """Find dropouts hop by hop, and the samples of the newest hop that are lost in them.

    Attributes
    ----------
    lost : ndarray of bool, shape (n,)
        Samples of the newest hop that are constant in all channels, or repeated. A splice loses samples
        outside the stream and marks none.
    """

    def __init__(self, n_channels: int) -> None:
        self.lost: BoolArray = np.zeros(0, bool)
        self._n_seen = 0
        self._tail = np.zeros((0, n_channels), np.float32)
        self._still = StillRuns()
        self._repeats = RepeatFinder()

    def push(self, samples: Float32Array, alive: BoolArray) -> list[Dropout]:
        """Take the samples (n, M) of a hop and the channels (M,) that are not constant in it."""
        start = self._n_seen - len(self._tail)
        sound = self._picked(samples, alive)
        self._tail = samples[-2:].copy()
        first = self._n_seen
        self._n_seen += len(samples)
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

    def _picked(self, samples: Float32Array, alive: BoolArray) -> Float32Array:
        """Return a few live channels, shape (channels, n), the end of the last hop in front."""
        every = max(-(-int(np.add.reduce(alive)) // _PICKED), 1)
        picks = slice(None, None, every) if False not in alive else np.flatnonzero(alive)[::every]
        return np.ascontiguousarray(np.concatenate([self._tail[:, picks], samples[:, picks]]).T)


class StillRuns:
    """Find runs of samples in which no channel changes, across hops; a run at the start is no dropout.

    Attributes
    ----------
    runs : list of (int, int)
        First sample and end of the long runs of the newest hop, that at its end included.
    """

    def __init__(self) -> None:
        self.runs: list[tuple[int, int]] = []
        self._length = 0
        self._has_changed = False
        self._n_still, self._n_moving = 0, 0

    def push(self, still: BoolArray, end: int) -> list[Dropout]:
        r"""Take one flag per sample, the last being sample `end` - 1; return the runs that end here.

        .. math:: L = \max\big(16,\; \ln 10^{-12} / \ln q\big)
        """
        # L is the length that constant samples by chance, a share q of all, reach once in 1e12.
        first, moving = end - len(still), (~still).nonzero()[0]
        # The last run goes on.
        edges = np.concatenate([[-1 - self._length], moving, [len(still)]])
        lengths = edges[1:] - edges[:-1] - 1
        long = (lengths >= self._shortest(lengths[:-1])).nonzero()[0]
        self.runs = [(int(first + edges[i]), int(first + edges[i] + lengths[i] + 1)) for i in long]
        self._length = int(lengths[-1])
        over = ((begin, stop) for begin, stop in self.runs if stop < end or not self._length)
        ended = [Dropout("still", begin, stop - begin) for begin, stop in over]
        if not self._has_changed:
            ended = [one for one in ended if one.sample > 0 and one.sample >= first + moving[0]]
        self._has_changed |= bool(len(moving))
        return ended

    def _shortest(self, lengths: IndexArray) -> float:
        """Shortest run that is not explained by the share of constant samples met so far."""
        self._n_still += int(lengths[lengths < _SHORTEST_STILL].sum())
        self._n_moving += len(lengths)
        share = self._n_still / max(self._n_still + self._n_moving, 1)
        return max(_SHORTEST_STILL, np.log(_STILL_CHANCE) / np.log(share)) if share else _SHORTEST_STILL


def find_splices(change: Float32Array, start: int, still: BoolArray) -> list[Dropout]:
    r"""Find samples at which the linear prediction fails in all channels at once.

    .. math:: e[n] = d[n] - \rho\, d[n-1], \quad \rho = \frac{\sum d[n]\, d[n-1]}{\sum d[n]^2}, \qquad
              J[n] = \Big\langle \min\Big(\frac{\max(e[n]^2, e[n+1]^2)}{\langle e^2 \rangle}, 25\Big)
              \Big\rangle_{channels},

    Shapes: change (channels, n), still (n,).
    """
    # d are the differences of successive samples, e their prediction errors and J the jump over two samples:
    # a splice has J above 12 and above three times the fifth largest of the hop.
    error = _prediction_error(change)
    np.square(error, out=error)
    error /= np.maximum(mean(error, 1), _TINY)[:, None]
    # An upper limit of J, without the ceiling: a clean hop ends here.
    if 2.0 * float(mean(error, 0).max()) < _JUMP_LIMIT:
        return []
    np.minimum(error, _JUMP_CEILING**2, out=error)
    jump = np.maximum(error[:, 1:], error[:, :-1]).mean(axis=0)
    limit = max(_JUMP_LIMIT, _JUMP_CONTRAST * float(np.partition(jump, -5)[-5]))
    near_still = np.convolve(still, np.ones(9), "same")[1:-1] > 2
    found = np.flatnonzero((jump > limit) & ~near_still)
    apart = found[np.diff(found, prepend=-100) > 50]
    return [Dropout("splice", int(start + 2 + index), None) for index in apart]


def _prediction_error(change: Float32Array) -> Float32Array:
    """Error of the best first-order prediction of the differences, one coefficient for all channels."""
    # Taken over the flat array: the few products that cross from one channel to the next do not matter.
    flat = change.ravel()
    power, product = float(flat @ flat), float(flat[1:] @ flat[:-1])
    rule = np.float32(product / power if power > 0.0 else 0.0)
    return np.asarray(change[:, 1:] - rule * change[:, :-1])


class RepeatFinder:
    """Find samples that are repeated, by hashes of single samples over several channels."""

    # Sound never repeats to the last bit on eight channels. Only hashes with five zero bits are kept (Manber,
    # "Finding similar files in a large file system", 1994), so that the same samples are kept when they
    # return. Memory does not grow: two generations of one second each. `run` is what the newest hop repeats,
    # from its first sample to its end; a repeat that goes on begins where it ended in the hop before.

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
        r"""Take a hop of a few channels (channels, n); `end` is the number of samples so far.

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
        # High bits are the well-mixed ones of a product.
        anchored = (hashes >> np.uint64(40)) & _ANCHOR_BITS == 0
        anchored[1:] &= hashes[1:] != hashes[:-1]
        anchored[0] = False
        where = anchored.nonzero()[0]
        return hashes[where].tolist(), (where + start).tolist()

    def _repeat(self, lags: list[tuple[int, int]]) -> list[Dropout]:
        if len(lags) < _MIN_ANCHORS:
            return []
        lag, count = Counter(lag for lag, _ in lags).most_common(1)[0]
        if count < _MIN_ANCHORS:
            return []
        places = [place for found, place in lags if found == lag]
        goes_on = lag == self._lag and places[0] - self._end < 1000
        self.run = (self._end if goes_on else places[0], places[-1] + 1)
        self._lag, self._end = lag, places[-1]
        return [] if goes_on else [Dropout("repeat", places[0], places[-1] - places[0])]


class Fault(StrEnum):
    """Kinds of faults of one channel.

    Examples
    --------
    >>> Fault("dead").name, len(Fault)
    ('DEAD', 11)
    """

    DEAD = "dead"
    """Constant, or 30 dB below the median channel."""
    INTERMITTENT = "intermittent"
    """Silent or crackling in several stretches of hops."""
    NOISY = "noisy"
    """Incoherent with the prediction from the other channels."""
    INVERTED = "inverted"
    """Fits its position with the opposite sign: crossed leads."""
    SWAPPED = "swapped"
    """Fits the position of another microphone better than its own."""
    CLIPPED = "clipped"
    """Samples pile up at one extreme value."""
    OFFSET = "offset"
    """A mean that is not small against the sound."""
    LEVEL = "level"
    """Louder or quieter than the median channel by more than microphones differ."""
    GUSTS = "gusts"
    """Much louder than the others for half a second to seconds, now and then: wind at this microphone."""
    DELAY = "delayed"
    """Later or earlier than sound from any direction, by an amount that stays the same."""
    DRIFT = "drifting"
    """Later and later, or earlier and earlier: a card with a clock of its own."""


MASKED_FAULTS = frozenset(Fault) - {Fault.CLIPPED, Fault.OFFSET, Fault.LEVEL, Fault.GUSTS}
"""Faults for which a channel is left out. The others leave its phase intact, which is all that PHAT uses."""


@dataclass(frozen=True, slots=True)
class ChannelFault:
    """One fault of one channel.

    Parameters
    ----------
    channel : int
        From 0, in the order of the array.
    fault : Fault
        What is wrong.
    value : float
        Size of the fault. Dead and intermittent: share of the last five seconds. Noisy and inverted:
        coherence with the prediction from the other channels, over the median channel's. Swapped: gain in
        that coherence at the other position, -2 to 2. Clipped: share of samples. Offset: mean over the
        peak-to-peak value. Level: dB relative to the median channel. Gusts: share of the last ten seconds.
        Delayed: seconds. Drifting: seconds a second. Swapped, up to 16 channels: gain in sharpness, nats.
    looks_like : int or None
        Swapped: the channel whose position it fits.
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
        Microphones that count in this hop.
    faults : tuple of ChannelFault
        Present faults by channel; a channel may have several.
    dropouts : tuple of Dropout
        The last 16 places in the stream where samples are missing, constant or repeated.
    n_dropouts : int
        Number of such places since the start.
    coherence : float or NotUsable
        Median over the channels of the coherence with the prediction from the others. Not usable in the
        first second and without a coherent sound; swapped, inverted and noisy channels are then not found.
    clipped : float
        Share of the samples of the hop that are clipped, over all channels.

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
        """Return the health of an array of which nothing is known: all channels kept.

        Parameters
        ----------
        n_channels : int
            Number of microphones M.
        reason : str
            Why there is no estimate of the coherence.

        Returns
        -------
        ArrayHealth
            Without faults.

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
    """List one kind of fault for all channels in which it was found; both arrays have shape (M,)."""
    return [ChannelFault(m, fault, float(values[m])) for m in found.nonzero()[0].tolist()]


def repeated(
    found: list[ChannelFault], before: list[ChannelFault]
) -> tuple[list[ChannelFault], list[ChannelFault]]:
    """Return the faults that were found the last time, too, and all of them for the next time."""
    known = {(one.channel, one.fault) for one in before}
    return [one for one in found if (one.channel, one.fault) in known], found
