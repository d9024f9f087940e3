"""Levels of channels against each other over ten seconds: wrong gains, and gusts at single microphones."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from worldstate.ground.typing import BoolArray, FloatArray

from .channel_health import ChannelFault, Fault, faults_where

# Ten seconds; gusts last half a second to three, with lulls of as much between them.
_MEMORY_HOPS = 100
# Median of half a second: single hops of sound scatter by 2 dB between microphones, and a crackle is one hop.
_SMOOTHED = 5
# Six seconds: after two, the first gust is taken for a gain.
_FEWEST_HOPS = 60
# The fifth of the hops that is nearest to the others': in the lulls of gusts a channel has its own level.
_QUIET = 0.2
# Simulated streets, 56 and 8 microphones, standing and moving ego: healthy levels below 2.2 dB, their rise
# within ten seconds below 0.9 dB, of a siren that interferes at one microphone 3.1 dB; gusts rise by 6 to 19.
_LEVEL_DB, _GUST_DB = 4.0, 4.5
# Hops of half a second's mean: one bang is no gust.
_FEWEST_GUSTY = 3
_TINY = np.finfo(np.float64).tiny


class ChannelLevels:
    r"""Level of every channel against the median channel, a mean over bins in decibels.

    .. math:: L_m = \Big\langle 10 \lg \frac{E_{km}}{\mathrm{median}_j\, E_{kj}} \Big\rangle_k

    The mean of logarithms: a tone that interferes at one microphone is one bin of many.
    """

    def __init__(self, n_channels: int) -> None:
        self._hops = np.zeros((_MEMORY_HOPS, n_channels))
        self._latest = np.zeros(n_channels)
        self._count = np.zeros(n_channels, np.int64)
        self._n_hops = 0

    def push(self, powers: FloatArray, good: BoolArray) -> None:
        """Take the mean power of one hop per bin and channel, (K, M), and the channels that sound, (M,)."""
        if good.any():
            level = 10.0 * np.log10(np.maximum(powers, _TINY))
            level -= np.median(level[:, good], axis=1, keepdims=True)
            # A hop in which a channel breaks off says nothing of its level.
            self._latest = np.where(good, level.mean(axis=0), self._latest)
        self._hops[self._n_hops % _MEMORY_HOPS] = self._latest
        self._n_hops += 1
        self._count += good

    def faults(self) -> list[ChannelFault]:
        r"""Return wrong gains in dB, and gusts with their share of the last ten seconds.

        .. math:: g_m = q_{20\%}(L) > 4 \;\text{or}\; q_{80\%}(L) < -4, \qquad
                  \#\{L - q_{20\%}(L) > 4.5\} \ge 3

        A channel with gusts has no gain.
        """
        n = min(self._n_hops, _MEMORY_HOPS)
        if n < _FEWEST_HOPS:
            return []
        newest = self._n_hops % _MEMORY_HOPS if self._n_hops >= _MEMORY_HOPS else 0
        ordered = np.roll(self._hops, -newest, axis=0)[:n]
        smooth = np.median(sliding_window_view(ordered, _SMOOTHED, axis=0), axis=2)
        low, high = np.quantile(smooth, (_QUIET, 1.0 - _QUIET), axis=0)
        level = np.clip(0.0, low, high)
        usable = self._count >= _FEWEST_HOPS // 2
        gusty = (smooth - low > _GUST_DB).sum(axis=0)
        gusts = usable & (gusty >= _FEWEST_GUSTY)
        wrong = usable & ~gusts & (np.abs(level) > _LEVEL_DB)
        return faults_where(Fault.LEVEL, wrong, level) + faults_where(Fault.GUSTS, gusts, gusty / len(smooth))
