"""Monitor the channels of a stream, hop by hop, against each other."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.array.channel_mask import ChannelMask
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, Float32Array, FloatArray

from .channel_activity import ChannelActivity
from .channel_health import MASKED_FAULTS, ArrayHealth, ChannelFault, Fault, faults_where
from .channel_levels import ChannelLevels
from .clipping import ClippingCounter
from .dropouts import Dropout, DropoutFinder
from .geometry_check import GeometryCheck
from .sample_clock import SampleClock

# Time constant, hops: three seconds.
_HOPS = 30


class RunningMean:
    """Exponential mean over hops, an ordinary mean until its time constant has passed."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.mean = np.zeros(shape)
        self.count = np.zeros(shape[1], np.int64)

    def add(self, values: ArrayLike, good: BoolArray) -> None:
        r"""Take the values of a hop, shape (statistics, M), and the usable channels, shape (M,).

        .. math:: \mu_{sm} \leftarrow \mu_{sm} + g_m \frac{x_{sm} - \mu_{sm}}{\min(n_m, 30)}
        """
        self.count += good
        weight = good / np.clip(self.count, 1, _HOPS)
        self.mean += weight * (np.asarray(values) - self.mean)


# Mean square of the band, relative to the median channel, below which a channel is silent: -30 dB, far below
# the few dB by which usable microphones differ.
_SILENT = 1e-3
# The same within one frame, -50 dB: destructive interference does not reach that over a whole band.
_DROPPED = 1e-5
# A channel whose peak-to-peak value grows by this factor more than that of the others crackles; a loud event
# raises all of them.
_CRACKLE = 4.0
# A mean above a tenth of the peak-to-peak sound (0.7 of its standard deviation), judged after two seconds.
_OFFSET = 0.1
_SETTLED_HOPS = 20
# One sample in ten thousand; a lone peak is less.
_CLIPPED_SHARE = 1e-4
# Enough for a report; the count goes on beyond them.
_KEPT_DROPOUTS = 16
# Samples taken as one row by `_extremes`: a minimum along long rows is several times faster.
_ROWS = 16
_TINY = np.finfo(np.float64).tiny
# Statistics with a memory of seconds are evaluated once a second.
_EVERY_HOPS = 10


class ChannelMonitor:
    """Collect the statistics of all channels and report their faults; memory does not grow."""

    def __init__(
        self,
        array: MicrophoneArray,
        frequencies_hz: FloatArray,
        sample_rate_hz: float,
        speed_of_sound_m_s: float = 343.0,
    ) -> None:
        n = array.n_microphones
        self.clock = SampleClock(sample_rate_hz)
        self._activity = ChannelActivity(n)
        self._means = RunningMean((2, n))
        self._levels = ChannelLevels(n)
        self._single_channel: list[ChannelFault] = []
        self._n_hops = 0
        self._clipping = ClippingCounter(n)
        self._dropout_finder = DropoutFinder(n)
        self._dropouts: tuple[Dropout, ...] = ()
        self._n_dropouts = 0
        self._geometry_check = GeometryCheck(array, frequencies_hz, speed_of_sound_m_s)

    def push(
        self,
        samples: Float32Array,
        energies: FloatArray,
        powers: Float32Array,
        matrices: Complex64Array,
    ) -> ArrayHealth:
        r"""Take one hop; return the channels to keep and the faults.

        .. math:: \langle E_{tm} / \tilde E_t \rangle_t < 10^{-3}, \qquad
                  \min_t E_{tm} / \tilde E_t < 10^{-5}, \qquad
                  s_m / \bar s_m > 4\, \mathrm{median}_j\, (s_j / \bar s_j).

        Shapes: samples (n, M), energies (frames, M), powers (frames, bins, M), matrices (K, M, M).
        """
        # E is the mean square of a frame and channel, E~ that of the median channel, s the peak-to-peak value
        # and s-bar its running mean: a channel is left out of the hop if it is silent, breaks off or crackles
        # in it, or if it has one of `MASKED_FAULTS`.
        lowest, highest = _extremes(samples)
        span = highest - lowest
        alive = span > 0.0
        self._clipping.push(samples, lowest, highest)
        dropouts = self._dropout_finder.push(samples, alive)
        self._n_dropouts += len(dropouts)
        self._dropouts = (*self._dropouts, *dropouts)[-_KEPT_DROPOUTS:]
        silent = self._silent(energies, alive)
        self._levels.push(powers.mean(axis=0, dtype=np.float64), ~silent)
        bad = self._judge_hop(samples, span, silent)
        self._geometry_check.push(matrices, len(energies), ~self._activity.suspects)
        return self._report(bad)

    def _silent(self, energies: FloatArray, alive: BoolArray) -> BoolArray:
        """Flag the channels that are silent in this hop or break off in it."""
        if not alive.any():
            return ~alive
        typical = np.maximum(np.median(energies[:, alive], axis=1, keepdims=True), _TINY)
        level = (energies / typical).mean(axis=0)
        return np.asarray(~alive | (level < _SILENT) | (energies < _DROPPED * typical).any(axis=0))

    def _judge_hop(self, samples: Float32Array, span: Float32Array, silent: BoolArray) -> BoolArray:
        """Flag the channels that are silent or crackle in this hop."""
        alive = span > 0.0
        if not alive.any():
            return self._activity.all_silent()
        bad = silent.copy()
        mean_span = self._means.mean[0]
        known = alive & (mean_span > 0.0)
        if known.any():
            growth = np.divide(span, mean_span, out=np.zeros(len(span)), where=known)
            bad |= growth > _CRACKLE * np.median(growth[known])
        share = np.full(len(samples), 1.0 / len(samples), np.float32)
        self._means.add(np.stack([span, share @ samples]), ~bad)
        return self._activity.push(bad)

    def _report(self, bad: BoolArray) -> ArrayHealth:
        if self._n_hops % _EVERY_HOPS == 0:
            self._single_channel = self._single_channel_faults()
        self._n_hops += 1
        faults = [*self._activity.faults(), *self._geometry_check.faults, *self._single_channel]
        faults.sort(key=lambda fault: (fault.channel, fault.fault))
        keep = ~bad
        for fault in faults:
            keep[fault.channel] &= fault.fault not in MASKED_FAULTS
        rate = self.clock.estimate()
        return ArrayHealth(
            ChannelMask(keep),
            tuple(faults),
            self._dropouts,
            self._n_dropouts,
            self._geometry_check.coherence,
            rate,
        )

    def _single_channel_faults(self) -> list[ChannelFault]:
        """Faults seen on a channel by itself: clipping, offset, level, gusts."""
        usable = ~self._activity.suspects
        clipped = self._clipping.clipped_share()
        span, mean = self._means.mean
        offset = np.abs(mean) / np.maximum(span, np.finfo(np.float32).tiny)
        settled = self._means.count >= _SETTLED_HOPS
        return [
            *faults_where(Fault.CLIPPED, clipped > _CLIPPED_SHARE, clipped),
            *faults_where(Fault.OFFSET, usable & settled & (offset > _OFFSET), offset),
            *self._levels.faults(),
        ]


def _extremes(samples: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Lowest and highest sample of every channel, (M,) each."""
    rows, n_channels = len(samples) // _ROWS * _ROWS, samples.shape[1]
    wide, rest = samples[:rows].reshape(-1, _ROWS * n_channels), samples[rows:]
    lowest = np.concatenate([wide.min(axis=0, initial=np.inf).reshape(-1, n_channels), rest]).min(axis=0)
    highest = np.concatenate([wide.max(axis=0, initial=-np.inf).reshape(-1, n_channels), rest]).max(axis=0)
    return lowest, highest
