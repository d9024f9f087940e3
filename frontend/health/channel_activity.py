"""Detect silent and intermittent channels from per-hop flags."""

import numpy as np

from worldstate.ground.typing import BoolArray

from .channel_health import ChannelFault, Fault, faults_where

# Five seconds: an intermittent contact comes back within that, and one bad hop is forgotten soon enough.
_MEMORY_HOPS = 50
# A hop without any change on any channel is a dropout of the transport; after a second the array is dead.
_SILENCE_HOPS = 10


class ChannelActivity:
    """Flags of unusable hops of every channel over the last five seconds."""

    # One stretch of bad hops that lasts until now is dead; several, or one that has ended, are intermittent.
    # A single bad hop is masked and not reported: a slammed door is no fault.

    def __init__(self, n_channels: int) -> None:
        self._bad = np.zeros((_MEMORY_HOPS, n_channels), bool)
        self._n_hops = 0
        self._n_silent = 0
        self._dead = self._intermittent = np.zeros(n_channels, bool)
        self._share = np.zeros(n_channels)

    def push(self, bad: BoolArray) -> BoolArray:
        """Take one flag per channel, shape (M,), and return it."""
        self._n_silent = 0
        return self._remember(bad)

    def all_silent(self) -> BoolArray:
        """Take a hop in which all channels are silent; return flags that are set after one second of this."""
        self._n_silent += 1
        silent = np.full(self._bad.shape[1], self._n_silent >= _SILENCE_HOPS)
        return self._remember(silent) if silent.any() else silent

    def _remember(self, bad: BoolArray) -> BoolArray:
        self._bad[self._n_hops % _MEMORY_HOPS] = bad
        self._n_hops += 1
        if bad.any() or self._share.any():
            self._classify(bad)
        return bad

    def _classify(self, bad: BoolArray) -> None:
        n = min(self._n_hops, _MEMORY_HOPS)
        newest = self._n_hops % _MEMORY_HOPS
        ordered = self._bad[:n] if n < _MEMORY_HOPS else np.roll(self._bad, -newest, axis=0)
        count = ordered.sum(axis=0)
        stretches = (ordered[1:] & ~ordered[:-1]).sum(axis=0) + ordered[0]
        repeated = count >= 2
        self._dead = repeated & bad & (stretches == 1)
        self._intermittent = repeated & ~self._dead
        self._share = count / n

    @property
    def suspects(self) -> BoolArray:
        """Dead and intermittent channels, (M,)."""
        return np.asarray(self._dead | self._intermittent)

    def faults(self) -> list[ChannelFault]:
        r"""Return the dead and the intermittent channels with their share of bad hops.

        .. math:: q_m = \frac1n \sum_{i=1}^{n} b_{i,m}, \qquad n \le 50
        """
        if not self._share.any():
            return []
        dead = faults_where(Fault.DEAD, self._dead, self._share)
        return dead + faults_where(Fault.INTERMITTENT, self._intermittent, self._share)
