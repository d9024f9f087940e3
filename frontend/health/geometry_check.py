"""Geometry, polarity, delays and clocks of the channels, once a second, by the waves that all hear."""

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, FloatArray
from worldstate.ground.values import NotUsable

from .channel_health import ChannelFault, Fault, repeated
from .delay_check import DelayCheck
from .order_check import MAX_CHANNELS, OrderCheck
from .plane_waves import PlaneWaves
from .position_fit import PositionFit

_EVERY_HOPS = 10
# Below, the waves are too long to compare channels by, and wind covers them.
_LOWEST_HZ = 250.0
# Bins used, for small and for large arrays: more bins or more pairs, the cost of a second stays some 5 ms.
_FEW_BINS, _MANY_BINS = 7, 14
_TINY = np.finfo(np.float32).tiny


class GeometryCheck:
    """Compare all channels with the positions that they are said to have; most faults need two verdicts."""

    # The position fit compares each channel with its neighbours: it finds noisy and inverted channels and, in
    # a large array, proposes exchanges. Plane waves over the whole array decide on them and find delays.

    def __init__(self, array: MicrophoneArray, frequencies_hz: FloatArray, speed_of_sound_m_s: float) -> None:
        n = array.n_microphones
        high = np.flatnonzero(frequencies_hz >= _LOWEST_HZ)
        most = _MANY_BINS if n <= MAX_CHANNELS else _FEW_BINS
        self._bins = high[:: max(-(-len(high) // most), 1)]
        chosen = frequencies_hz[self._bins]
        waves = PlaneWaves(array, chosen, speed_of_sound_m_s)
        self._fit = PositionFit(array, frequencies_hz, speed_of_sound_m_s)
        self._order, self._delay = OrderCheck(waves), DelayCheck(array, waves, chosen)
        self._sum = np.zeros((len(chosen), n, n), np.complex64)
        self._hops, self._n_frames = 0, 0
        self._late: list[ChannelFault] = []
        self._by_waves: list[ChannelFault] = []
        self.faults: list[ChannelFault] = []  # One a channel, the more specific one

    @property
    def coherence(self) -> float | NotUsable:
        """Median over the channels of the coherence with the prediction from the others."""
        return self._fit.coherence

    def push(self, matrices: Complex64Array, n_frames: int, active: BoolArray) -> None:
        r"""Take the cross-spectra (K, M, M) of one hop, summed over its frames, and the active channels (M,).

        .. math:: R_{ij} = \frac{1}{T} \sum_t Z_i \overline{Z_j}
        """
        self._fit.add(matrices, n_frames)
        self._sum += matrices[self._bins]
        self._n_frames += n_frames
        self._hops += 1
        if self._hops % _EVERY_HOPS == 0:
            self._fit.evaluate(active)
            self._compare_waves(active)
            self._sum[...] = 0.0
            self._n_frames = 0
            self.faults = self._most_specific()

    def _compare_waves(self, active: BoolArray) -> None:
        kept = active[:, None] & active
        np.fill_diagonal(kept, False)
        coherence = self._sum * (kept / np.float32(max(self._n_frames, 1)))
        if float(np.abs(coherence).max(initial=0.0)) < _TINY:
            return
        self._delay.push(coherence, active)
        proposed = [one for one in self._fit.faults if one.fault is Fault.SWAPPED]
        self._order.push(coherence, proposed, self._delay.log_sharpness)
        confirmed, self._late = repeated(self._delay.faults(), self._late)
        # Exchanged channels are late, too.
        self._by_waves = self._order.faults() or confirmed

    def _most_specific(self) -> list[ChannelFault]:
        # Microphones half a metre apart hardly predict each other: noisy is what no wave agrees with, either.
        incoherent = self._delay.incoherent
        inverted = [one for one in self._fit.faults if one.fault is Fault.INVERTED]
        noisy = [one for one in self._fit.faults if one.fault is Fault.NOISY and incoherent[one.channel]]
        crossed = {one.channel for one in inverted}
        found = [one for one in self._by_waves if one.channel not in crossed]
        elsewhere = {one.channel for one in found}
        return found + inverted + [one for one in noisy if one.channel not in elsewhere]
