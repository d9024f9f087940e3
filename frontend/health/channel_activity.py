"""Who is there: channels that are silent or crackle now, always, or now and then."""

import numpy as np

from worldstate.ground.typing import BoolArray

from .channel_health import ChannelFault, Fault, faults_where

_MEMORY_HOPS = 50
# A hop without any change on any channel is a gap of the transport; after a second the array is dead.
_SILENCE_HOPS = 10


class ChannelActivity:
    """Hops in which a channel was of no use, over the last five seconds.

    Examples
    --------
    >>> presence = ChannelActivity(3)
    >>> for hop in range(4):
    ...     bad = presence.push(np.array([False, True, hop % 2 == 0]))
    >>> [(fault.channel, fault.fault.value, fault.value) for fault in presence.faults()]
    [(1, 'dead', 1.0), (2, 'intermittent', 0.5)]
    """

    # Bad until now since one moment means dead; bad in several stretches, or once and well again,
    # intermittent. A single bad hop is masked and forgotten.

    def __init__(self, n_channels: int) -> None:
        self._bad = np.zeros((_MEMORY_HOPS, n_channels), bool)
        self._n_hops = 0
        self._n_silent = 0
        self._dead = self._intermittent = np.zeros(n_channels, bool)
        self._share = np.zeros(n_channels)

    def push(self, bad: BoolArray) -> BoolArray:
        """Take one flag per channel (M,); give it back.

        Shapes: bad (M,).
        """
        self._n_silent = 0
        return self._remember(bad)

    def all_silent(self) -> BoolArray:
        """Take a hop in which all are silent, which for a second is held against nobody."""
        # ``bad = (n >= 10)`` for all channels, n being the hops of silence in a row.
        self._n_silent += 1
        silent = np.full(self._bad.shape[1], self._n_silent >= _SILENCE_HOPS)
        return self._remember(silent) if silent.any() else silent

    def _remember(self, bad: BoolArray) -> BoolArray:
        self._bad[self._n_hops % _MEMORY_HOPS] = bad
        self._n_hops += 1
        if bad.any() or self._share.any():
            self._judge(bad)
        return bad

    def _judge(self, bad: BoolArray) -> None:
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
        r"""Say which channels are dead or intermittent.

        .. math:: q_m = \frac1n \sum_{i=1}^{n} b_{i,m}, \qquad n \le 50

        with b the bad hops: dead where they are one stretch that lasts until now, else intermittent.
        """
        if not self._share.any():
            return []
        dead = faults_where(Fault.DEAD, self._dead, self._share)
        return dead + faults_where(Fault.INTERMITTENT, self._intermittent, self._share)
