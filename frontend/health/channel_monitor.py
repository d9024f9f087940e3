"""Watching the microphones of a stream, hop by hop, against each other."""

import numpy as np

from worldstate.frontend.array.channel_mask import ChannelMask
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, Float32Array, FloatArray

from .channel_activity import ChannelActivity
from .channel_health import MASKED_FAULTS, ArrayHealth, ChannelFault, Fault, faults_where
from .clipping import ClippingCounter
from .dropouts import Dropout, DropoutFinder
from .geometry_check import GeometryCheck
from .running_mean import RunningMean
from .sample_clock import SampleClock

# Mean square of the band against the median channel's below which a channel counts as silent: -30 dB.
_SILENT = 1e-3
# The same within one frame: no interference of sounds goes so deep.
_DROPPED = 1e-5
# A peak-to-peak that grows so much more than the other channels' is a crackle: seven times the usual noise.
_CRACKLE = 4.0
# A mean above a tenth of the peak-to-peak sound (0.7 of its standard deviation), judged after two seconds.
_OFFSET = 0.1
_SETTLED_HOPS = 20
_LEVEL_DB = 10.0
_CLIPPED_SHARE = 1e-4
_KEPT_GAPS = 16
_ROWS = 16
_TINY = np.finfo(np.float64).tiny
# Slow statistics are judged once in so many hops.
_EVERY_HOPS = 10


class ChannelMonitor:
    """Statistics of every channel and what they say; memory does not grow.

    Examples
    --------
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, 0, 0], [0, -0.1, 0]])
    >>> monitor = ChannelMonitor(array, np.array([500.0]), 48_000.0)
    >>> sound = np.random.default_rng(0).standard_normal((4800, 1)).astype(np.float32) * [1.0, 1.0, 0.0]
    >>> for _ in range(2):
    ...     health = monitor.push(sound.astype(np.float32), np.array([[1.0, 1.0, 0.0]]), np.ones((1, 3, 3)))
    >>> health.mask.keep, [(fault.channel, fault.fault.value) for fault in health.faults]
    (array([ True,  True, False]), [(2, 'dead')])
    """

    def __init__(
        self,
        array: MicrophoneArray,
        frequencies_hz: FloatArray,
        sample_rate_hz: float,
        speed_of_sound_m_s: float = 343.0,
    ) -> None:
        n = array.n_microphones
        self.clock = SampleClock(sample_rate_hz)
        self._presence = ChannelActivity(n)
        self._usual = RunningMean((3, n))
        self._own: list[ChannelFault] = []
        self._n_hops = 0
        self._rails = ClippingCounter(n)
        self._gap_finder = DropoutFinder(n)
        self._gaps: tuple[Dropout, ...] = ()
        self._n_gaps = 0
        self._places = GeometryCheck(array, frequencies_hz, speed_of_sound_m_s)

    def push(
        self,
        samples: Float32Array,
        energies: FloatArray,
        matrices: Complex64Array,
    ) -> ArrayHealth:
        r"""Take one hop, say which channels count in it and why.

        .. math:: \langle E_{tm} / \tilde E_t \rangle_t < 10^{-3}, \qquad
                  \min_t E_{tm} / \tilde E_t < 10^{-5}, \qquad
                  s_m / \bar s_m > 4\, \mathrm{median}_j\, (s_j / \bar s_j).

        Shapes: samples (n, M), energies (frames, M), matrices (K, M, M).
        """
        # A channel counts unless it has one of `MASKED_FAULTS` or is silent, breaks off or crackles in this
        # hop: with its mean squares E over those of the median living channel and its peak-to-peak s over the
        # usual one,
        lowest, highest = _extremes(samples)
        span = highest - lowest
        alive = span > 0.0
        self._rails.push(samples, lowest, highest)
        self._remember(self._gap_finder.push(samples, alive))
        bad = self._judge_hop(samples, energies, span)
        self._places.push(matrices, len(energies), ~self._presence.suspects)
        return self._report(bad)

    def _remember(self, gaps: list[Dropout]) -> None:
        self._n_gaps += len(gaps)
        self._gaps = (*self._gaps, *gaps)[-_KEPT_GAPS:]

    def _judge_hop(self, samples: Float32Array, energies: FloatArray, span: Float32Array) -> BoolArray:
        """Which channels are silent or crackle in this hop."""
        alive = span > 0.0
        if not alive.any():
            return self._presence.all_silent()
        typical = np.maximum(np.median(energies[:, alive], axis=1, keepdims=True), _TINY)
        level = (energies / typical).mean(axis=0)
        bad = ~alive | (level < _SILENT) | (energies < _DROPPED * typical).any(axis=0)
        usual_span = self._usual.mean[0]
        known = alive & (usual_span > 0.0)
        if known.any():
            growth = np.divide(span, usual_span, out=np.zeros(len(span)), where=known)
            bad |= growth > _CRACKLE * np.median(growth[known])
        share = np.full(len(samples), 1.0 / len(samples), np.float32)
        self._usual.add(np.stack([span, np.log(np.maximum(level, _SILENT)), share @ samples]), ~bad)
        return self._presence.push(bad)

    def _report(self, bad: BoolArray) -> ArrayHealth:
        if self._n_hops % _EVERY_HOPS == 0:
            self._own = self._own_faults()
        self._n_hops += 1
        faults = [*self._presence.faults(), *self._places.faults(), *self._own]
        faults.sort(key=lambda fault: (fault.channel, fault.fault))
        keep = ~bad
        for fault in faults:
            keep[fault.channel] &= fault.fault not in MASKED_FAULTS
        rate = self.clock.estimate()
        return ArrayHealth(
            ChannelMask(keep), tuple(faults), self._gaps, self._n_gaps, self._places.coherence, rate
        )

    def _own_faults(self) -> list[ChannelFault]:
        """Faults that a channel shows without the others, dead ones left out."""
        usable = ~self._presence.suspects
        clipped = self._rails.clipped_share()
        span, level, mean = self._usual.mean
        offset = np.abs(mean) / np.maximum(span, np.finfo(np.float32).tiny)
        heard = self._usual.count >= _SETTLED_HOPS
        level_db = 10.0 / np.log(10.0) * level
        return [
            *faults_where(Fault.CLIPPED, clipped > _CLIPPED_SHARE, clipped),
            *faults_where(Fault.OFFSET, usable & heard & (offset > _OFFSET), offset),
            *faults_where(Fault.LEVEL, usable & heard & (np.abs(level_db) > _LEVEL_DB), level_db),
        ]


def _extremes(samples: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Lowest and highest sample of every channel, (M,) each; long rows are faster than short ones."""
    rows, n_channels = len(samples) // _ROWS * _ROWS, samples.shape[1]
    wide, rest = samples[:rows].reshape(-1, _ROWS * n_channels), samples[rows:]
    lowest = np.concatenate([wide.min(axis=0, initial=np.inf).reshape(-1, n_channels), rest]).min(axis=0)
    highest = np.concatenate([wide.max(axis=0, initial=-np.inf).reshape(-1, n_channels), rest]).max(axis=0)
    return lowest, highest
