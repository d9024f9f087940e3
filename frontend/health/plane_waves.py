"""Plane waves from all round: which directions a stream holds, and which order of channels they fit."""

from collections import deque
from collections.abc import Iterable
from itertools import combinations

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray, IndexArray

from .channel_health import ChannelFault, Fault

# Sound of the own vehicle comes from below and is no fault of a microphone: with level waves alone, swaps
# were reported in every second recording of a moving ego.
_ELEVATIONS_DEG = (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0)
# A third of the beam of 0.8 m at 1400 Hz.
_STEP_DEG = 7.5
# From here on the source is near, most often the own vehicle, and its wave is no plane one.
_STEEP = np.radians(30.0)
# Directions whose delays agree to this are one to the array: front and back, or a whole cone.
_SAME_S = 2e-6
# Sharpness of no agreement at all, far below that of one pair in one bin; keeps the logarithm finite.
SILENCE = 1e-12


class PlaneWaves:
    """Steering vectors of the directions that an array can tell apart."""

    def __init__(self, array: MicrophoneArray, frequencies_hz: FloatArray) -> None:
        azimuth, elevation = _directions()
        delays = MicrophoneArray(array.centred_m).delays_s(azimuth, elevation)
        kept = np.unique(np.round(delays / _SAME_S), axis=0, return_index=True)[1]
        self.is_steep = np.abs(elevation[kept]) > _STEEP
        phase = -2j * np.pi * frequencies_hz[:, None, None] * delays[kept].T
        self.beams: Complex64Array = np.exp(phase).astype(np.complex64)

    def agreement(self, coherence: Complex64Array) -> Complex64Array:
        r"""Agreement of every channel with all others for a wave from every direction, (K, M, D).

        .. math:: g_{kmd} = \overline{a_{kmd}} \sum_{j \ne m} R_{kmj}\, a_{kjd}

        Shapes: coherence (K, M, M), its diagonal zero.
        """
        return np.asarray(self.beams.conj() * (coherence @ self.beams))


def direction_weights(agreement: Complex64Array) -> Float32Array:
    r"""Share of every direction in the sound, (D,): the square of its beam power, which sharpens the beams.

    .. math:: w_d \propto \max\Big(\sum_{km} \mathrm{Re}\, g_{kmd},\; 0\Big)^2
    """
    power = np.square(np.maximum(agreement.real.sum(axis=(0, 1)), 0.0))
    return np.asarray(power / max(float(power.sum()), np.finfo(np.float32).tiny))


def log_sharpness(agreement: Complex64Array) -> float:
    r"""Return how much the sound is concentrated in few directions, nats.

    .. math:: \ln \sum_d \max\Big(\frac12 \sum_{km} \mathrm{Re}\, g_{kmd},\; 0\Big)^2
    """
    power = 0.5 * np.maximum(agreement.real.sum(axis=(0, 1)), 0.0)
    return float(np.log(max(float(np.square(power).sum(dtype=np.float64)), SILENCE)))


def _directions() -> tuple[FloatArray, FloatArray]:
    """Azimuths and elevations about one step apart, (D,) each, mirrored about the x and y axes alike."""
    rows = []
    for elevation in np.radians(_ELEVATIONS_DEG):
        quarter = np.linspace(0.0, np.pi / 2, round(90.0 / _STEP_DEG * np.cos(elevation)) + 1)
        half = np.concatenate([quarter, np.pi - quarter[:-1]])
        azimuth = np.concatenate([half, -half[(half > 0.0) & (half < np.pi)]])
        rows.append(np.stack([azimuth, np.full(len(azimuth), elevation)]))
    azimuths, elevations = np.concatenate(rows, axis=1)
    return azimuths, elevations


# Up to here every exchange of two channels is tried; a larger array predicts each position well enough from
# its neighbours (`position_fit`), which microphones half a metre apart do not, and proposes a few.
MAX_CHANNELS = 16
# Memory in seconds, and the fewest that count where all are tried: a street with one loud side needs several.
_MEMORY_S, _MIN_S = 20, 5
# Mean gain in nats of a small and of a large array. Simulated streets: 8 microphones in order below 0.04 in
# 10 s, with two of them exchanged .96 above 0.1; 56 in order below 0.027, though scattering at the roof
# makes a neighbour's position fit better, and 0.056 and more with two exchanged 8 cm or more apart.
_GAIN, _GAIN_OF_MANY = 0.1, 0.04
# An exchange in a small array must gain this share of what taking out the delays of all channels gains.
# Simulated streets, 8 microphones: of two exchanged mostly 0.84 and more, of a late card on a moving ego 0.55
# at most. In a large one the position fit has compared them before.
_SHARE_OF_DELAYS = 0.6

Pair = tuple[int, int]


class OrderCheck:
    """Compare the order of the channels with those in which two of them are exchanged, second by second."""

    def __init__(self, waves: PlaneWaves) -> None:
        self._waves = waves
        n = waves.beams.shape[1]
        self._all: tuple[Pair, ...] = tuple(combinations(range(n), 2)) if n <= MAX_CHANNELS else ()
        self._gains: dict[Pair, deque[tuple[float, float]]] = {}

    def push(
        self, coherence: Complex64Array, proposed: Iterable[ChannelFault], log_sharpness_undelayed: float
    ) -> None:
        r"""Take the coherence (K, M, M) of one second, its diagonal zero, and the exchanges to be tried.

        .. math:: G_{ab} = \ln \frac{\sum_d \max(P_d^{(ab)}, 0)^2}{\sum_d \max(P_d, 0)^2}
        """
        pairs = self._all or tuple({_pair(one) for one in proposed})
        usual = log_sharpness(self._waves.agreement(coherence))
        gains = sharpness_gains(coherence, self._waves.beams, np.array(pairs, int).reshape(-1, 2))
        rival = log_sharpness_undelayed - usual
        # An exchange that is no longer proposed is forgotten.
        before, self._gains = self._gains, {}
        for pair, gain in zip(pairs, gains.tolist(), strict=True):
            self._gains[pair] = before.get(pair, deque(maxlen=_MEMORY_S))
            self._gains[pair].append((gain, rival))

    def faults(self) -> list[ChannelFault]:
        """Return the channels whose exchange makes the waves sharper, of a small array the sharpest pair."""
        least_s, least, share = (_MIN_S, _GAIN, _SHARE_OF_DELAYS) if self._all else (1, _GAIN_OF_MANY, 0.0)
        means = {pair: np.mean(one, axis=0) for pair, one in self._gains.items() if len(one) >= least_s}
        found = sorted(
            (float(gain), pair) for pair, (gain, rival) in means.items() if gain > max(least, share * rival)
        )
        return [
            ChannelFault(one, Fault.SWAPPED, gain, looks_like=other)
            for gain, (a, b) in (found[-1:] if self._all else found)
            for one, other in ((a, b), (b, a))
        ]


def _pair(fault: ChannelFault) -> Pair:
    other = fault.channel if fault.looks_like is None else fault.looks_like
    return min(fault.channel, other), max(fault.channel, other)


def sharpness_gains(coherence: Complex64Array, beams: Complex64Array, pairs: IndexArray) -> FloatArray:
    r"""Gain in the sharpness of the beams by exchanging two channels, nats, (P,).

    .. math:: P_d = \sum_{k,\, m < j} \mathrm{Re}\, \overline{a_{kmd}} R_{kmj} a_{kjd}

    Shapes: coherence (K, M, M), its diagonal zero, beams (K, M, D), pairs (P, 2).
    """
    a, b = pairs.T
    heard = coherence @ beams
    own = (beams.conj() * heard).real.sum(axis=0)
    power = 0.5 * own.sum(axis=0)
    at_a, at_b, between = beams[:, a], beams[:, b], coherence[:, a, b, None]
    usual = (at_a.conj() * between * at_b).real.sum(axis=0)
    crossed = (at_b.conj() * between * at_a).real.sum(axis=0)
    # Each in the other's position, all others in their own; the pair itself is in both sums.
    placed = (at_b.conj() * heard[:, a] + at_a.conj() * heard[:, b]).real.sum(axis=0)
    exchanged = power - own[a] - own[b] + usual + placed - 2.0 * between.real.sum(axis=0) + crossed
    sharp = np.square(np.maximum(exchanged, 0.0)).sum(axis=1, dtype=np.float64)
    before = np.square(np.maximum(power, 0.0)).sum(dtype=np.float64)
    return np.asarray(np.log(np.maximum(sharp, SILENCE)) - np.log(max(float(before), SILENCE)))
