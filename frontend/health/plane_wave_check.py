"""Order, delays and clocks of the channels, once a second, against plane waves from all round."""

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, FloatArray

from .channel_health import ChannelFault
from .delay_check import DelayCheck
from .order_check import MAX_CHANNELS, OrderCheck
from .plane_waves import PlaneWaves

_EVERY_HOPS = 10
# Below, the waves are too long to tell anything by, and wind covers them.
_LOWEST_HZ = 250.0
# Bins used, for small and for large arrays: more bins or more pairs, the cost of a second stays some 5 ms.
_FEW_BINS, _MANY_BINS = 7, 14
_TINY = np.finfo(np.float32).tiny


class PlaneWaveCheck:
    """Collect the coherence of one second and hand it to the checks; a delay needs two seconds in a row."""

    def __init__(
        self, array: MicrophoneArray, frequencies_hz: FloatArray, speed_of_sound_m_s: float = 343.0
    ) -> None:
        n = array.n_microphones
        high = np.flatnonzero(frequencies_hz >= _LOWEST_HZ)
        most = _MANY_BINS if n <= MAX_CHANNELS else _FEW_BINS
        self._bins = high[:: max(-(-len(high) // most), 1)]
        chosen = frequencies_hz[self._bins]
        waves = PlaneWaves(array, chosen, speed_of_sound_m_s)
        self._order = OrderCheck(waves)
        self._delay = DelayCheck(array, waves, chosen)
        self._sum = np.zeros((len(chosen), n, n), np.complex64)
        self._hops, self._n_frames = 0, 0
        self._before: set[tuple[int, str]] = set()
        self._faults: list[ChannelFault] = []

    def push(
        self, matrices: Complex64Array, n_frames: int, active: BoolArray, proposed: list[ChannelFault]
    ) -> None:
        r"""Take one hop: cross-spectra (K, M, M) summed over its frames, active channels, proposed exchanges.

        .. math:: R_{ij} = \frac{1}{T} \sum_t Z_i \overline{Z_j}
        """
        if not len(self._bins):
            return
        self._sum += matrices[self._bins]
        self._n_frames += n_frames
        self._hops += 1
        if self._hops % _EVERY_HOPS == 0:
            self._evaluate(active, proposed)
            self._sum[...] = 0.0
            self._n_frames = 0

    def faults(self) -> list[ChannelFault]:
        """Return the exchanged, late and drifting channels."""
        return self._faults

    @property
    def incoherent(self) -> BoolArray:
        """Channels that agreed with no wave in the last two seconds, (M,)."""
        return self._delay.incoherent

    def _evaluate(self, active: BoolArray, proposed: list[ChannelFault]) -> None:
        kept = active[:, None] & active
        np.fill_diagonal(kept, False)
        coherence = self._sum * (kept / np.float32(max(self._n_frames, 1)))
        if float(np.abs(coherence).max(initial=0.0)) < _TINY:
            return
        self._delay.push(coherence, active)
        self._order.push(coherence, proposed, self._delay.log_sharpness)
        late = self._delay.faults()
        confirmed = [fault for fault in late if (fault.channel, fault.fault) in self._before]
        self._before = {(fault.channel, fault.fault) for fault in late}
        # Exchanged channels are late, too.
        self._faults = self._order.faults() or confirmed
