"""Positions, polarity, delays and clocks of the channels, once a second, by the waves that all hear."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from worldstate.frontend.array.geometry import SPEED_OF_SOUND_M_S
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, Float32Array, FloatArray
from worldstate.ground.values import NotUsable

from .channel_health import ChannelFault, Fault, faults_where, repeated
from .delay_check import DelayCheck
from .plane_waves import MAX_CHANNELS, OrderCheck, PlaneWaves

# Incoherent power of a usable channel against the field's: delay mismatch and self-noise of real arrays.
_NOISE = 0.2
# The same for a channel that is not used to predict others: its weight becomes negligible.
_UNUSABLE = 1e3


def position_weights(
    array: MicrophoneArray,
    frequencies_hz: FloatArray,
    usable: BoolArray,
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
) -> Float32Array:
    r"""Weights of all other microphones in the prediction at every position.

    .. math:: w_{pj} = -\frac{(\Gamma + \Lambda)^{-1}_{pj}}{(\Gamma + \Lambda)^{-1}_{pp}}, \qquad
              \Gamma_{ij} = \frac{\sin(k d_{ij})}{k d_{ij}}

    Shapes: frequencies_hz (K,), usable (M,).
    """
    positions = array.positions_m
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    field = np.sinc(2.0 * frequencies_hz[:, None, None] * distance / speed_of_sound_m_s)
    inverse = np.linalg.inv(field + np.diag(np.where(usable, _NOISE, _UNUSABLE)))
    own = np.einsum("kmm->km", inverse)
    weights = -inverse / own[:, :, None]
    np.einsum("kmm->km", weights)[...] = 0.0
    return np.asarray(weights, np.float32)


def position_scores(coherence: Float32Array, weights: Float32Array) -> FloatArray:
    r"""Score every channel at every position, between -1 and 1.

    .. math:: S_{mp} = \frac{\sum_k \sum_{j \ne m} w_{k,pj} R_{k,jm}}
              {\sqrt{K \sum_k w_{k,p}^T R_k\, w_{k,p}}}

    Shapes: coherence (K, M, M), weights (K, M, M).
    """
    predicted = weights @ coherence
    power = (predicted * weights).sum(axis=(0, 2), dtype=np.float64)
    # A channel that took part in the prediction would agree with itself.
    predicted -= np.einsum("kmm->km", coherence)[:, None, :] * weights
    agreement = predicted.sum(axis=0, dtype=np.float64).T
    floor = np.finfo(np.float32).tiny
    return np.asarray(agreement / np.sqrt(np.maximum(power, floor) * len(coherence)))


# A mean over the last two seconds.
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


class PositionFit:
    r"""Compare every channel with every position; a fault needs two verdicts in a row.

    In any field of plane waves the sound at one position follows from that at the positions around it. The
    best linear prediction in a diffuse field, whose coherence over a distance d is sin(kd) / (kd), from all
    other microphones is

    .. math:: \hat x_p = -\sum_{j \ne p} \frac{(\Gamma + \Lambda)^{-1}_{pj}}{(\Gamma + \Lambda)^{-1}_{pp}}\,
              x_j

    and the score of channel m at position p is the coherence of x_m with that prediction, m itself left out,

    .. math:: S_{mp} = \frac{\sum_k \mathrm{Re}\, E[x_{k,m} \overline{\hat x_{k,p}}]}
                            {\sqrt{K \sum_k E|\hat x_{k,p}|^2}}

    over K bins of whitened spectra. A usable channel fits its own position best, an incoherent one fits none,
    one with crossed leads fits with the opposite sign, one in the wrong socket fits another position.
    Microphones that differ only in a direction in which no wave travels cannot be distinguished, and need not
    be.

    References
    ----------
    The prediction is kriging, or Gaussian process regression, with leave-one-out weights: C. Rasmussen and C.
    Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2. Coherence: R. Cook et al.,
    J. Acoust. Soc. Am., 1955.
    """

    def __init__(self, array: MicrophoneArray, frequencies_hz: FloatArray, speed_of_sound_m_s: float) -> None:
        n = array.n_microphones
        self.coherence: float | NotUsable = NotUsable("the first second is not over")
        self._geometry = array, frequencies_hz, speed_of_sound_m_s
        self._sum = np.zeros((len(frequencies_hz), n, n), np.float32)
        self._n_frames = 0.0
        self._usable = np.ones(n, bool)
        self._weights = position_weights(array, frequencies_hz, self._usable, speed_of_sound_m_s)
        self._suspects = np.zeros(n, bool)
        self._found: list[ChannelFault] = []
        self.faults: list[ChannelFault] = []  # Noisy, inverted and swapped channels

    def add(self, matrices: Complex64Array, n_frames: int) -> None:
        r"""Take the cross-spectra (K, M, M) of one hop, summed over its frames.

        .. math:: S_{ij} \leftarrow 0.95\, S_{ij} + \mathrm{Re} \sum_t Z_i \overline{Z_j}, \qquad
                  n \leftarrow 0.95\, n + T
        """
        self._sum *= np.float32(_FORGET)
        self._sum += matrices.real
        self._n_frames = _FORGET * self._n_frames + n_frames

    def evaluate(self, active: BoolArray) -> None:
        """Look for faults among the active channels, (M,)."""
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
        self.faults, self._found = repeated(found, self._found)

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
