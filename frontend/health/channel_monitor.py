"""Monitor of a stream's channels, hop by hop: levels, clipping, activity, dropouts, geometry."""

from collections import deque

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from worldstate.frontend.array.microphone_array import ChannelMask, MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, Float32Array, FloatArray
from worldstate.ground.values import mean, median

from .channel_health import (
    MASKED_FAULTS,
    ArrayHealth,
    ChannelFault,
    Dropout,
    DropoutFinder,
    Fault,
    faults_where,
)
from .geometry_check import GeometryCheck

# Width of the interval below an extreme, relative to half the span: unclipped sound has more samples there
# than at the extreme itself.
_SHELL = np.float32(0.1)
# Step to the next value, relative to half the span, above which quantisation would look like clipping.
_COARSE = np.float32(0.02)
# A smaller number of samples at the extreme occurs by chance.
_MIN_COUNT = 16


class ClippingCounter:
    """Counts samples at and just below the highest and the lowest value of every channel."""

    # Unclipped sound reaches its extreme once and the values just below it more often; clipped sound stays at
    # it. Only hops that reach the extreme again are counted, so a clean stream takes no time. A new extreme
    # restarts the count, because the old one was not a clipping level.

    def __init__(self, n_channels: int) -> None:
        self._n_samples = 0
        self._extreme = np.full((2, n_channels), -np.inf, np.float32)
        self._at = np.zeros((2, n_channels), np.int64)
        self._below = np.zeros((2, n_channels), np.int64)
        self.newest_share = 0.0  # Share of clipped samples in the latest hop, over all channels

    def push(self, samples: Float32Array, lowest: Float32Array, highest: Float32Array) -> None:
        r"""Process the samples (n, M) of a hop and their extremes (M,).

        .. math:: n_{at} = \#\{x = x_{max}\}, \qquad
                  n_{below} = \#\{x_{max} - \tfrac1{20} s \le x < x_{max}\}

        Shapes: samples (n, M), lowest, highest (M,).
        """
        # Counted for x and for -x; s is the span of the hop.
        self._n_samples += len(samples)
        self.newest_share = 0.0
        span = highest - lowest
        for side, (sign, top) in enumerate(((np.float32(1.0), highest), (np.float32(-1.0), -lowest))):
            extreme, at, below = self._extreme[side], self._at[side], self._below[side]
            reached = ((top == extreme) & (span > 0.0)).nonzero()[0]
            higher = top > extreme
            extreme[higher], at[higher], below[higher] = top[higher], 0, 0
            if not len(reached):
                continue
            values = sign * samples[:, reached]
            is_at = values == extreme[reached]
            n_at = is_at.sum(axis=0)
            half = np.float32(0.5) * span[reached]
            n_below = (values >= extreme[reached] - _SHELL * half).sum(axis=0) - n_at
            next_level = values.max(axis=0, where=~is_at, initial=-np.inf)
            fine = extreme[reached] - next_level < _COARSE * half
            at[reached] += n_at * fine
            below[reached] += n_below * fine
            n_clipped = int((n_at * fine * self._is_clipped[side, reached]).sum())
            self.newest_share += n_clipped / samples.size

    @property
    def _is_clipped(self) -> BoolArray:
        return np.asarray((self._at >= _MIN_COUNT) & (self._at > self._below))

    def clipped_share(self) -> FloatArray:
        r"""Return the share of all samples at a clipping level, shape (M,); 0 for channels without one.

        .. math:: q = \frac1n \sum_{sides} n_{at}\, [n_{at} \ge 16,\; n_{at} > n_{below}]
        """
        return np.asarray(np.where(self._is_clipped, self._at, 0).sum(axis=0) / max(self._n_samples, 1))


# Ten seconds; gusts last from half a second to three seconds, with equally long pauses.
_LEVEL_HOPS = 100
# Median of half a second: single hops vary by 2 dB between microphones, and a crackle lasts one hop.
_SMOOTHED = 5
# Six seconds: after two, the first gust would look like a wrong gain.
_FEWEST_HOPS = 60
# The quietest fifth of the hops: between gusts a channel has its usual level.
_QUIET = 0.2
# Simulated streets, 56 and 8 microphones, standing and moving ego: healthy levels are below 2.2 dB, and their
# rise within ten seconds below 0.9 dB (3.1 dB for a siren that interferes at one microphone). Gusts rise by 6
# to 19 dB.
_LEVEL_DB, _GUST_DB = 4.0, 4.5
# Number of smoothed hops, so that a single bang is not a gust.
_FEWEST_GUSTY = 3
_TINY = np.finfo(np.float64).tiny


class ChannelLevels:
    r"""Level of every channel relative to the median channel, averaged over bins in decibels.

    .. math:: L_m = \Big\langle 10 \lg \frac{E_{km}}{\mathrm{median}_j\, E_{kj}} \Big\rangle_k

    In a mean of logarithms, a tone that interferes at one microphone affects only one of many bins.
    """

    def __init__(self, n_channels: int) -> None:
        self._hops: deque[FloatArray] = deque(maxlen=_LEVEL_HOPS)
        self._latest: FloatArray = np.zeros(n_channels)
        self._count = np.zeros(n_channels, np.int64)

    def push(self, powers: FloatArray, good: BoolArray) -> None:
        """Process the mean power of a hop by bin and channel, (K, M); `good` are usable channels, (M,)."""
        if True in good:
            level = 10.0 * np.log10(np.maximum(powers, _TINY))
            level -= median(level[:, good])[:, None]
            # If a channel fails in a hop, the hop does not show its level.
            self._latest = np.where(good, mean(level, 0), self._latest)
        self._hops.append(self._latest)
        self._count += good

    def faults(self) -> list[ChannelFault]:
        r"""Return wrong gains in dB, and gusts with their share of the last ten seconds.

        .. math:: g_m = q_{20\%}(L) > 4 \;\text{or}\; q_{80\%}(L) < -4, \qquad
                  \#\{L - q_{20\%}(L) > 4.5\} \ge 3

        A channel with gusts has no gain fault.
        """
        if len(self._hops) < _FEWEST_HOPS:
            return []
        smooth = np.median(sliding_window_view(np.array(self._hops), _SMOOTHED, axis=0), axis=2)
        low, high = np.quantile(smooth, (_QUIET, 1.0 - _QUIET), axis=0)
        level = np.clip(0.0, low, high)
        usable = self._count >= _FEWEST_HOPS // 2
        gusty = (smooth - low > _GUST_DB).sum(axis=0)
        gusts = usable & (gusty >= _FEWEST_GUSTY)
        wrong = usable & ~gusts & (np.abs(level) > _LEVEL_DB)
        return faults_where(Fault.LEVEL, wrong, level) + faults_where(Fault.GUSTS, gusts, gusty / len(smooth))


# Five seconds: an intermittent contact fails again within this time, and a single bad hop is soon forgotten.
_ACTIVITY_HOPS = 50
# A hop without a change on any channel is a dropout of the transport; after a second the array is dead.
_SILENCE_HOPS = 10


class ChannelActivity:
    """Flags of unusable hops of every channel over the last five seconds."""

    # One run of bad hops that lasts until now means dead; several, or one that has ended, mean intermittent.
    # A single bad hop is masked but not reported, because a slammed door is no fault.

    def __init__(self, n_channels: int) -> None:
        self._bad: deque[BoolArray] = deque(maxlen=_ACTIVITY_HOPS)
        self._n_silent = 0
        self._dead = self._intermittent = np.zeros(n_channels, bool)
        self._share = np.zeros(n_channels)

    def push(self, bad: BoolArray) -> BoolArray:
        """Add one flag per channel, shape (M,), and return the flags."""
        if self._n_silent >= _SILENCE_HOPS:
            # If all channels failed together, no single channel is faulty.
            self._bad.extend([np.zeros_like(bad)] * len(self._bad))
        self._n_silent = 0
        return self._remember(bad)

    def all_silent(self) -> BoolArray:
        """Add a hop in which all channels are silent; return flags, set after one second of silence."""
        self._n_silent += 1
        silent = np.full(len(self._share), self._n_silent >= _SILENCE_HOPS)
        return self._remember(silent) if silent.any() else silent

    def _remember(self, bad: BoolArray) -> BoolArray:
        self._bad.append(bad)
        if True in bad or self._share.any():
            ordered = np.array(self._bad)
            count = ordered.sum(axis=0)
            stretches = (ordered[1:] & ~ordered[:-1]).sum(axis=0) + ordered[0]
            self._dead = (count >= 2) & bad & (stretches == 1)
            self._intermittent = (count >= 2) & ~self._dead
            self._share = count / len(ordered)
        return bad

    @property
    def suspects(self) -> BoolArray:
        """Dead and intermittent channels, (M,)."""
        return np.asarray(self._dead | self._intermittent)

    def faults(self) -> list[ChannelFault]:
        r"""Return the dead and the intermittent channels with their share of bad hops.

        .. math:: q_m = \frac1n \sum_{i=1}^{n} b_{i,m}, \qquad n \le 50
        """
        dead = faults_where(Fault.DEAD, self._dead, self._share)
        return dead + faults_where(Fault.INTERMITTENT, self._intermittent, self._share)


# Time constant of the means of span and sample, hops: three seconds.
_HOPS = 30
# Mean square of the band, relative to the median channel, below which a channel is silent: -30 dB. Usable
# microphones differ only by a few dB.
_SILENT = 1e-3
# The same within one frame, -50 dB: destructive interference does not reach this over a whole band.
_DROPPED = 1e-5
# A channel crackles if its peak-to-peak value grows by this factor more than those of the others; a loud
# event raises all channels.
_CRACKLE = 4.0
# Smallest offset: a tenth of the peak-to-peak value (0.7 standard deviations), evaluated after two seconds.
_OFFSET = 0.1
_SETTLED_HOPS = 20
# Smallest share of clipped samples; a single peak has less.
_CLIPPED_SHARE = 1e-4
# Enough for a report; the number of dropouts includes older ones.
_KEPT_DROPOUTS = 16
# Samples that `_extremes` combines into one row: a minimum along long rows is several times faster.
_ROWS = 16
# Statistics over seconds are evaluated once per second.
_EVERY_HOPS = 10


class ChannelMonitor:
    """Collects the statistics of all channels and reports their faults; memory is bounded."""

    def __init__(self, array: MicrophoneArray, frequencies_hz: FloatArray) -> None:
        n = array.n_microphones
        self._activity = ChannelActivity(n)
        self._means, self._n_good = np.zeros((2, n)), np.zeros(n, np.int64)
        self._levels = ChannelLevels(n)
        self._single_channel: list[ChannelFault] = []
        self._n_hops = 0
        self._clipping = ClippingCounter(n)
        self._dropout_finder = DropoutFinder(n)
        self._dropouts: tuple[Dropout, ...] = ()
        self._n_dropouts = 0
        self._geometry_check = GeometryCheck(array, frequencies_hz)
        self._span = np.zeros(n, np.float32)

    def find_lost(self, samples: Float32Array) -> BoolArray:
        """Process the samples (n, M) of a hop; return which of them are lost in all channels, (n,)."""
        lowest, highest = _extremes(samples)
        self._span = highest - lowest
        self._clipping.push(samples, lowest, highest)
        dropouts = self._dropout_finder.push(samples, self._span > 0.0)
        self._n_dropouts += len(dropouts)
        self._dropouts = (*self._dropouts, *dropouts)[-_KEPT_DROPOUTS:]
        return self._dropout_finder.lost

    def push(
        self, samples: Float32Array, energies: FloatArray, powers: Float32Array, matrices: Complex64Array
    ) -> ArrayHealth:
        r"""Process the hop of `find_lost` without its lost frames; return the kept channels and the faults.

        .. math:: \langle E_{tm} / \tilde E_t \rangle_t < 10^{-3}, \qquad
                  \min_t E_{tm} / \tilde E_t < 10^{-5}, \qquad
                  s_m / \bar s_m > 4\, \mathrm{median}_j\, (s_j / \bar s_j).

        Shapes: samples (n, M), energies (frames, M), powers (frames, bins, M), matrices (K, M, M).
        """
        # E is the mean square of a frame and channel, E~ that of the median channel, s the peak-to-peak value
        # and s-bar its running mean. A channel is excluded from the hop if it is silent, fails or crackles in
        # it, or if it has one of `MASKED_FAULTS`.
        alive = self._span > 0.0
        if not len(energies):
            return self._report(np.zeros(len(alive), bool) if alive.any() else self._activity.all_silent())
        silent, some = ~alive, True in alive
        if some:
            typical = np.maximum(median(energies[:, alive]), _TINY)[:, None]
            failed = np.logical_or.reduce(energies < _DROPPED * typical)
            silent = silent | (mean(energies / typical, 0) < _SILENT) | failed
        self._levels.push(mean(powers, 0, np.float64), ~silent)
        bad = self._judge_hop(samples, alive, silent) if some else self._activity.all_silent()
        self._geometry_check.push(matrices, len(energies), ~self._activity.suspects)
        return self._report(bad)

    def _judge_hop(self, samples: Float32Array, alive: BoolArray, silent: BoolArray) -> BoolArray:
        """Return the channels that are silent, fail or crackle in this hop."""
        bad, span, mean_span = silent.copy(), self._span, self._means[0]
        known = alive & (mean_span > 0.0)
        if True in known:
            growth = np.divide(span, mean_span, out=np.zeros(len(span)), where=known)
            bad |= growth > _CRACKLE * median(growth[known])
        share = np.full(len(samples), 1.0 / len(samples), np.float32)
        # Exponential means over the good hops; arithmetic ones until the time constant has passed:
        # mu <- mu + (x - mu) / min(n, 30).
        self._n_good += ~bad
        weight = ~bad / np.minimum(np.maximum(self._n_good, 1), _HOPS)
        self._means += weight * (np.array([span, share @ samples]) - self._means)
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
        found = tuple(faults), self._dropouts, self._n_dropouts
        coherence, clipped = self._geometry_check.fit.coherence, self._clipping.newest_share
        return ArrayHealth(ChannelMask(keep), *found, coherence, clipped)

    def _single_channel_faults(self) -> list[ChannelFault]:
        """Return faults that are visible on a single channel: clipping, offset, level, gusts."""
        usable = ~self._activity.suspects
        clipped = self._clipping.clipped_share()
        span, mean = self._means
        offset = np.abs(mean) / np.maximum(span, np.finfo(np.float32).tiny)
        settled = self._n_good >= _SETTLED_HOPS
        return [
            *faults_where(Fault.CLIPPED, clipped > _CLIPPED_SHARE, clipped),
            *faults_where(Fault.OFFSET, usable & settled & (offset > _OFFSET), offset),
            *self._levels.faults(),
        ]


def _extremes(samples: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return the lowest and the highest sample of every channel, (M,) each."""
    rows, n_channels = len(samples) // _ROWS * _ROWS, samples.shape[1]
    wide, rest = samples[:rows].reshape(-1, _ROWS * n_channels), samples[rows:]
    lowest = np.concatenate([wide.min(axis=0, initial=np.inf).reshape(-1, n_channels), rest]).min(axis=0)
    highest = np.concatenate([wide.max(axis=0, initial=-np.inf).reshape(-1, n_channels), rest]).max(axis=0)
    return lowest, highest
