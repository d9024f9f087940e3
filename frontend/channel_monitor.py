"""Watching the microphones of a stream, hop by hop, against each other."""

import numpy as np
from numpy.typing import NDArray

from .array import MicrophoneArray
from .channel_health import MASKED_FAULTS, ArrayHealth, ChannelFault, Fault, faults_where
from .gaps import Gap, GapFinder
from .masking import ChannelMask
from .place_check import PlaceCheck
from .presence import Presence
from .rails import RailCounter
from .sample_clock import SampleClock
from .slow_mean import SlowMean

# Mean square of the band against the median channel's below which a channel counts as silent: -30 dB.
_SILENT = 1e-3
# A peak-to-peak that grows so much more than the other channels' is a crackle: seven times the usual noise.
_CRACKLE = 4.0
# A mean above a tenth of the peak-to-peak sound (0.7 of its standard deviation), judged after two seconds.
_OFFSET = 0.1
_OFFSET_AFTER_HOPS = 20
_LEVEL_DB = 10.0
_CLIPPED_SHARE = 1e-4
_KEPT_GAPS = 16


class ChannelMonitor:
    """Statistics of every channel and what they say; memory does not grow.

    Parameters
    ----------
    array : MicrophoneArray
        In the order of the channels.
    frequencies_hz : ndarray, shape (K,)
        Bins of the cross-spectra that `push` gets.
    sample_rate_hz, speed_of_sound_m_s : float
        Of the stream.

    Examples
    --------
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, 0, 0], [0, -0.1, 0]])
    >>> monitor = ChannelMonitor(array, np.array([500.0]), 48_000.0)
    >>> sound = np.random.default_rng(0).standard_normal((4800, 1)).astype(np.float32) * [1.0, 1.0, 0.0]
    >>> for _ in range(2):
    ...     health = monitor.push(sound.astype(np.float32), np.array([1.0, 1.0, 0.0]), np.ones((1, 3, 3)), 18)
    >>> health.mask.keep, [(fault.channel, fault.fault.value) for fault in health.faults]
    (array([ True,  True, False]), [(2, 'dead')])
    """

    def __init__(
        self,
        array: MicrophoneArray,
        frequencies_hz: NDArray[np.float64],
        sample_rate_hz: float,
        speed_of_sound_m_s: float = 343.0,
    ) -> None:
        n = array.n_microphones
        self.clock = SampleClock(sample_rate_hz)
        self._presence = Presence(n)
        self._level = SlowMean(n)
        self._offset = SlowMean(n)
        self._span = SlowMean(n)
        self._rails = RailCounter(n)
        self._gap_finder = GapFinder(n)
        self._gaps: tuple[Gap, ...] = ()
        self._n_gaps = 0
        self._places = PlaceCheck(array, frequencies_hz, speed_of_sound_m_s)

    def push(
        self,
        samples: NDArray[np.float32],
        energies: NDArray[np.float64],
        matrices: NDArray[np.complex64],
        n_frames: int,
    ) -> ArrayHealth:
        """Take one hop, say which channels count in it and why.

        Parameters
        ----------
        samples : ndarray of float32, shape (n, M)
        energies : ndarray, shape (M,)
            Mean square of each channel in the band that bearings are read from.
        matrices : ndarray of complex64, shape (K, M, M)
            Sums of Z_i conj(Z_j) over frames, Z being whitened spectra.
        n_frames : int
            Number of these frames.
        """
        lowest, highest = samples.min(axis=0), samples.max(axis=0)
        span = highest - lowest
        alive = span > 0.0
        self._rails.push(samples, lowest, highest)
        self._remember(self._gap_finder.push(samples, alive))
        bad = self._judge_hop(samples, energies, span)
        self._places.push(matrices, n_frames, ~self._presence.suspects)
        return self._report(bad)

    def _remember(self, gaps: list[Gap]) -> None:
        self._n_gaps += len(gaps)
        self._gaps = (*self._gaps, *gaps)[-_KEPT_GAPS:]

    def _judge_hop(
        self, samples: NDArray[np.float32], energies: NDArray[np.float64], span: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Which channels are silent or crackle in this hop."""
        alive = span > 0.0
        if not alive.any():
            return self._presence.all_silent()
        typical = max(float(np.median(energies[alive])), np.finfo(np.float64).tiny)
        bad = ~alive | (energies < _SILENT * typical)
        known = alive & (self._span.count > 0)
        if known.any():
            growth = np.divide(span, self._span.mean, out=np.zeros(len(span)), where=known)
            bad |= growth > _CRACKLE * np.median(growth[known])
        good = ~bad
        self._span.add(span, good)
        self._level.add(np.log(np.maximum(energies / typical, _SILENT)), good)
        share = np.full(len(samples), 1.0 / len(samples), np.float32)
        self._offset.add(share @ samples, alive)
        return self._presence.push(bad)

    def _report(self, bad: NDArray[np.bool_]) -> ArrayHealth:
        faults = [*self._presence.faults(), *self._places.faults(), *self._own_faults()]
        faults.sort(key=lambda fault: (fault.channel, fault.fault))
        keep = ~bad
        keep[[fault.channel for fault in faults if fault.fault in MASKED_FAULTS]] = False
        rate = self.clock.estimate()
        return ArrayHealth(
            ChannelMask(keep), tuple(faults), self._gaps, self._n_gaps, self._places.coherence, rate
        )

    def _own_faults(self) -> list[ChannelFault]:
        """Faults that a channel shows without the others, dead ones left out."""
        usable = ~self._presence.suspects
        clipped = self._rails.clipped_share()
        offset = np.abs(self._offset.mean) / np.maximum(self._span.mean, np.finfo(np.float32).tiny)
        heard = self._offset.count >= _OFFSET_AFTER_HOPS
        level_db = 10.0 / np.log(10.0) * self._level.mean
        return [
            *faults_where(Fault.CLIPPED, usable & (clipped > _CLIPPED_SHARE), clipped),
            *faults_where(Fault.OFFSET, usable & heard & (offset > _OFFSET), offset),
            *faults_where(Fault.LEVEL, usable & heard & (np.abs(level_db) > _LEVEL_DB), level_db),
        ]
