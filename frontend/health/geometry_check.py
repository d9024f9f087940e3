"""Noisy, inverted and swapped channels, by the position that their sound fits: see `position_fit`."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, FloatArray
from worldstate.ground.values import NotUsable

from .channel_health import ChannelFault, Fault, faults_where
from .position_fit import position_scores, position_weights

# Evaluated once a second, on a mean over the last two.
_EVERY_HOPS = 10
_FORGET = 1.0 - 1.0 / 20.0
# Median coherence below which there is no verdict: chance alone gives 0.02 in two seconds.
_MIN_COHERENCE = 0.15
# Shares of the median coherence at which a channel becomes suspect, and well again. Simulated streets:
# healthy ones above 0.59, incoherent ones below 0.07.
_SUSPECT, _WELL = 0.3, 0.45
# Least gain at another position. Simulated streets: a correct position loses by 0.18 at most, swapped
# channels 9 cm or more apart across the road gain 0.25 to 0.75.
_MARGIN = 0.3
# Channels that may be reassigned gain at least the first somewhere; a swap is reported only if the channel
# whose position is taken gains at least the second by leaving it.
_CANDIDATE_GAIN = 0.2
_PARTNER_MARGIN = 0.1


class GeometryCheck:
    """Check the positions of all channels once a second; a fault needs two verdicts in a row."""

    def __init__(
        self, array: MicrophoneArray, frequencies_hz: FloatArray, speed_of_sound_m_s: float = 343.0
    ) -> None:
        n = array.n_microphones
        self.coherence: float | NotUsable = NotUsable("the first second is not over")
        self._geometry = array, frequencies_hz, speed_of_sound_m_s
        self._sum = np.zeros((len(frequencies_hz), n, n), np.float32)
        self._n_frames = 0.0
        self._hops = 0
        self._usable = np.ones(n, bool)
        self._weights = position_weights(array, frequencies_hz, self._usable, speed_of_sound_m_s)
        self._suspects = np.zeros(n, bool)
        self._candidates: set[ChannelFault] = set()
        self._faults: list[ChannelFault] = []

    def push(self, matrices: Complex64Array, n_frames: int, active: BoolArray) -> None:
        r"""Take the cross-spectra (K, M, M) of one hop, summed over its frames, and the active channels (M,).

        .. math:: S_{ij} \leftarrow 0.95\, S_{ij} + \mathrm{Re} \sum_t Z_i \overline{Z_j}, \qquad
                  n \leftarrow 0.95\, n + T
        """
        self._sum *= np.float32(_FORGET)
        self._sum += matrices.real
        self._n_frames = _FORGET * self._n_frames + n_frames
        self._hops += 1
        if self._hops % _EVERY_HOPS == 0:
            self._evaluate(active)

    def faults(self) -> list[ChannelFault]:
        """Return the noisy, inverted and swapped channels."""
        return self._faults

    def _evaluate(self, active: BoolArray) -> None:
        self._use(active & ~self._suspects)
        scores = position_scores(self._sum / np.float32(self._n_frames), self._weights)
        own = scores.diagonal()
        typical = float(np.median(own[self._usable])) if self._usable.any() else 0.0
        found: list[ChannelFault] = []
        if typical < _MIN_COHERENCE:
            self.coherence = NotUsable(f"no coherent sound ({typical:.2f})")
        else:
            self.coherence = typical
            found = self._find(scores, typical, active)
        self._confirm(found)

    def _use(self, usable: BoolArray) -> None:
        """Predict from these channels only; new weights take a few milliseconds, so they are kept."""
        if not np.array_equal(usable, self._usable):
            array, frequencies_hz, speed = self._geometry
            self._usable = usable
            self._weights = position_weights(array, frequencies_hz, usable, speed)

    def _find(self, scores: FloatArray, typical: float, active: BoolArray) -> list[ChannelFault]:
        limit = typical * np.where(self._suspects, _WELL, _SUSPECT)
        own = scores.diagonal()
        inverted = active & (own < -limit)
        swapped = displaced(scores, active & ~inverted & (scores.max(axis=1) > 0.5 * limit))
        noisy = active & ~inverted & (own < limit)
        noisy[[fault.channel for fault in swapped]] = False
        self._suspects = noisy | inverted
        self._suspects[[fault.channel for fault in swapped]] = True
        share = own / typical
        return (
            swapped + faults_where(Fault.NOISY, noisy, share) + faults_where(Fault.INVERTED, inverted, share)
        )

    def _confirm(self, found: list[ChannelFault]) -> None:
        before = {(fault.channel, fault.fault) for fault in self._candidates}
        self._faults = [fault for fault in found if (fault.channel, fault.fault) in before]
        self._candidates = set(found)


def displaced(scores: FloatArray, candidates: BoolArray) -> list[ChannelFault]:
    r"""Assign channels to positions so that the total score is largest; list those that gain by it.

    .. math:: \hat\pi = \arg\max_\pi \sum_m S_{m, \pi(m)}, \qquad g_m = S_{m, \hat\pi(m)} - S_{mm}

    Shapes: scores (M, M), candidates (M,).
    """
    # The Hungarian method over the channels that fit elsewhere better. The others stay, so that a swap does
    # not displace a third channel to its second-best position.
    movable_mask = scores.max(axis=1) - scores.diagonal() > _CANDIDATE_GAIN
    movable = np.flatnonzero(candidates & movable_mask)
    table = scores[np.ix_(movable, movable)]
    best = linear_sum_assignment(table, maximize=True)[1]
    gain = table[np.arange(len(movable)), best] - table.diagonal()
    leaves = gain > _PARTNER_MARGIN
    found = (gain > _MARGIN) & leaves[best]
    # In a swap of two, one certain channel implies the other.
    found |= (best[best] == np.arange(len(movable))) & found[best] & leaves
    return [
        ChannelFault(int(movable[i]), Fault.SWAPPED, float(gain[i]), looks_like=int(movable[best[i]]))
        for i in np.flatnonzero(found)
    ]
