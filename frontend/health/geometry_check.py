"""Positions, polarity, delays and clocks of the channels, checked once per second by common waves.

Plane waves give the directions of the sound and, for many channels, the order that fits.
"""

from collections import deque
from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S, MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, Float32Array, FloatArray, IndexArray
from worldstate.ground.values import NotUsable

from .channel_health import ChannelFault, Fault, faults_where, repeated

# Sound of the own vehicle comes from below and is no fault of a microphone: with horizontal waves alone,
# swaps were reported in half of the recordings of a moving ego.
_ELEVATIONS_DEG = (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0)
# A third of the beam width of a 0.8 m array at 1400 Hz.
_STEP_DEG = 7.5
# Steeper sources are near, mostly on the own vehicle, so their waves are not plane.
_STEEP = np.radians(30.0)
# Directions whose delays differ by less are equivalent: front and back, or a whole cone.
_SAME_S = 2e-6
# Sharpness without any agreement, far below that of one pair in one bin; keeps the logarithm finite.
SILENCE = 1e-12


class PlaneWaves:
    """Steering vectors of the directions that microphones (M, 3) can distinguish.

    Shapes: waves_rad (2, D), azimuths and elevations of candidate directions.
    """

    def __init__(self, positions_m: FloatArray, frequencies_hz: FloatArray, waves_rad: FloatArray) -> None:
        delays = MicrophoneArray(positions_m).delays_s(*waves_rad)
        kept = np.unique(np.round(delays / _SAME_S), axis=0, return_index=True)[1]
        (self.azimuths_rad, self.elevations_rad), self.delays_s = waves_rad[:, kept], delays[kept]
        phase = -2j * np.pi * frequencies_hz[:, None, None] * self.delays_s.T
        self.beams: Complex64Array = np.exp(phase).astype(np.complex64)

    def agreement(self, coherence: Complex64Array) -> Complex64Array:
        r"""Return the agreement of every channel with all others for every direction, (..., K, M, D).

        .. math:: g_{kmd} = \overline{a_{kmd}} \sum_{j \ne m} R_{kmj}\, a_{kjd}

        Shapes: coherence (..., K, M, M), its diagonal zero.
        """
        return np.asarray(self.beams.conj() * (coherence @ self.beams))


def diffuse_coherence(positions_m: FloatArray, frequencies_hz: FloatArray) -> FloatArray:
    r"""Return the coherence of a diffuse field between microphones (M, 3), (K, M, M).

    .. math:: \Gamma_{kij} = \frac{\sin(2 \pi f_k d_{ij} / c)}{2 \pi f_k d_{ij} / c}
    """
    distance = np.linalg.norm(positions_m[:, None] - positions_m, axis=-1)
    return np.asarray(np.sinc(2.0 * frequencies_hz[:, None, None] * distance / SPEED_OF_SOUND_M_S))


def direction_weights(agreement: Complex64Array) -> Float32Array:
    r"""Return the share of every direction in the sound, (D,): the square of its beam power.

    .. math:: w_d \propto \max\Big(\sum_{km} \mathrm{Re}\, g_{kmd},\; 0\Big)^2
    """
    power = np.square(np.maximum(agreement.real.sum(axis=(0, 1)), 0.0))
    return np.asarray(power / max(float(power.sum()), np.finfo(np.float32).tiny))


def _directions() -> FloatArray:
    """Return azimuths and elevations about one step apart, (2, D), symmetric about the x and y axes."""
    rows = []
    for elevation in np.radians(_ELEVATIONS_DEG):
        quarter = np.linspace(0.0, np.pi / 2, round(90.0 / _STEP_DEG * np.cos(elevation)) + 1)
        half = np.concatenate([quarter, np.pi - quarter[:-1]])
        azimuth = np.concatenate([half, -half[(half > 0.0) & (half < np.pi)]])
        rows.append(np.stack([azimuth, np.full(len(azimuth), elevation)]))
    return np.concatenate(rows, axis=1)


# With fewer channels, exchanges are not checked here: the neighbours of a microphone predict it too poorly,
# and `position_check` tests every exchange in a recording.
MAX_CHANNELS = 16
_ORDER_MEMORY_S = 20
# Mean gain, nats. With 56 microphones in simulated streets, the gain is below 0.027 in the right order,
# although scattering at the roof makes a neighbour's position fit better, and 0.056 or more if two
# microphones 8 cm or more apart are exchanged.
_GAIN_OF_MANY = 0.04


class OrderCheck:
    """Compares the order of the channels with orders in which two are exchanged, once per second."""

    def __init__(self, beams: Complex64Array) -> None:
        self._beams = beams
        self._gains: dict[tuple[int, int], deque[float]] = {}

    def push(self, coherence: Complex64Array, proposed: Iterable[ChannelFault]) -> list[ChannelFault]:
        r"""Process the coherence (K, M, M) of one second, with zero diagonal, and the exchanges to test.

        .. math:: G_{ab} = \ln \frac{\sum_d \max(P_d^{(ab)}, 0)^2}{\sum_d \max(P_d, 0)^2}

        Return the channels whose exchange makes the beams sharper.
        """
        exchanges = ((one.channel, one.looks_like) for one in proposed if one.looks_like is not None)
        pairs = tuple({(min(pair), max(pair)) for pair in exchanges})
        gains = sharpness_gains(coherence, self._beams, np.array(pairs, int)) if pairs else np.zeros(0)
        # Exchanges that are no longer proposed are deleted.
        before, self._gains = self._gains, {}
        for pair, gain in zip(pairs, gains.tolist(), strict=True):
            self._gains[pair] = before.get(pair, deque(maxlen=_ORDER_MEMORY_S))
            self._gains[pair].append(gain)
        means = sorted((float(np.mean(gains)), pair) for pair, gains in self._gains.items())
        return [
            ChannelFault(one, Fault.SWAPPED, gain, looks_like=other)
            for gain, (a, b) in means
            if gain > _GAIN_OF_MANY
            for one, other in ((a, b), (b, a))
        ]


def sharpness_gains(coherence: Complex64Array, beams: Complex64Array, pairs: IndexArray) -> FloatArray:
    r"""Return the gain in the sharpness of the beams from the exchange of two channels, nats, (P,).

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
    # The two channels exchange positions, all others keep theirs; the pair itself is in both sums.
    placed = (at_b.conj() * heard[:, a] + at_a.conj() * heard[:, b]).real.sum(axis=0)
    exchanged = power - own[a] - own[b] + usual + placed - 2.0 * between.real.sum(axis=0) + crossed
    sharp = np.square(np.maximum(exchanged, 0.0)).sum(axis=1, dtype=np.float64)
    before = np.square(np.maximum(power, 0.0)).sum(dtype=np.float64)
    return np.asarray(np.log(np.maximum(sharp, SILENCE)) - np.log(max(float(before), SILENCE)))


_FLAT = 1e-9


def untilted(positions_m: FloatArray, known: BoolArray) -> FloatArray:
    r"""Return the projection that removes the effect of another sound direction from channel values.

    .. math:: Q = I - X (X^T X)^+ X^T, \qquad X = [1, p]

    over the known channels, zero elsewhere. Shapes: positions_m (M, 3), known (M,), returns (M, M).
    """
    if not known.any():
        return np.zeros((len(known), len(known)))
    centred = (positions_m - positions_m[known].mean(axis=0)) * known[:, None]
    design = np.column_stack([known.astype(float), centred])
    basis, size, _ = np.linalg.svd(design, full_matrices=False)
    basis = basis[:, size > 1e-6 * max(float(size[0]), _FLAT)]
    return np.asarray(np.diag(known.astype(float)) - basis @ basis.T)


def runs(n_channels: int) -> FloatArray:
    """Return all runs of consecutive channels up to half of them, (R, M), as ones and zeros.

    Examples
    --------
    >>> runs(3)
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    index = np.arange(n_channels)
    found = [
        (index >= first) & (index < first + length)
        for length in range(1, n_channels // 2 + 1)
        # Of two halves only the second, because a difference of the first is equivalent.
        for first in range(n_channels // 2 if 2 * length == n_channels else 0, n_channels - length + 1)
    ]
    return np.asarray(found, np.float64)


@lru_cache(maxsize=8)
def _untilted_runs(positions_m: bytes, known: bytes) -> tuple[FloatArray, FloatArray]:
    """Return the matrix of `untilted` and the power of every run after it; 0.5 ms for 56 channels."""
    free = untilted(np.frombuffer(positions_m).reshape(-1, 3), np.frombuffer(known, bool))
    candidates = runs(len(free))
    return free, np.add.reduce(candidates @ free * candidates, 1)


def best_card(
    values: FloatArray, power: FloatArray, candidates: FloatArray
) -> tuple[BoolArray, float, float]:
    r"""Return the consecutive channels, such as those of one sound card, that explain most of the values.

    .. math:: \hat c = \arg\max_c \frac{(c^T v)^2}{c^T Q c}, \qquad \hat a = \frac{c^T v}{c^T Q c}

    Return the channels (M,), the amount by which they differ, and the length of the part of their pattern
    that no other sound direction explains.

    Shapes: values (M,), projected, power (R,), c^T Q c of the candidates (R, M).
    """
    # If a sound direction explains all but a twentieth of a pattern, noise would give a large value.
    power = np.where(power > 0.05 * candidates.sum(axis=1), power, np.inf)
    found = candidates @ values
    best = int((found**2 / power).argmax())
    return candidates[best] > 0.0, float(found[best] / power[best]), float(np.sqrt(power[best]))


# Delays tested in one second, added to those of the seconds before: half a period of 700 Hz.
_SEARCH_S = np.arange(-8e-4, 8.01e-4, 2e-5)
# Duration of the memory, and the smallest durations for a result on delays and on drifts.
_MEMORY_S, _MIN_DELAY_S, _MIN_DRIFT_S = 30, 6, 8
# Agreement relative to the median channel below which the delay of a channel is meaningless.
_GOOD = 0.3
# Share of the seconds in which a channel must be usable for a result.
_MOSTLY = 0.7
# Largest share of sound from steep directions, i.e. from the own vehicle. Its near sources cause delays of up
# to 0.15 ms that no plane wave has. These are constant, so drifts can still be checked. With many channels,
# the pattern of a late card is three times as long.
_NEAR = 0.5
# With fewer free delays, any variation looks like a card.
_MIN_FREEDOM = 3.0
# Smallest delay of a card and of a single channel, and smallest length of its pattern divided by the root of
# the number of channels. Scattering at the roof delays a vehicle's sound by 0.1 ms at random. In simulated
# streets (8 microphones, 10 s), the length is 0.135 ms or more with a card 0.3 ms late; without one it is
# mostly below 0.09 ms and at most 0.14 ms.
_DELAY_S, _LONE_DELAY_S, _DELAY_RMS_S = 1.5e-4, 4e-4, 4.6e-5
# Smallest drift, 20 parts per million, and smallest length of its pattern over twenty seconds. The sound of a
# passing vehicle, scattered at the roof, looks like a drift for some seconds; the error falls with time to
# the power 3/2.
_DRIFT, _DRIFT_LENGTH, _DRIFT_SPAN_S = 2e-5, 2e-5, 20.0
# Streams of 8 microphones: 11 if a siren passes a healthy array, 17 or more within 30 s at 50 parts per
# million.
_SIGMAS = 12.0
# Small arrays have several rounds per second; in large ones a single card hardly changes the beams.
_ROUNDS = 3


class DelayCheck:
    r"""Estimates the delay of every channel, once per second.

    Sharp beams give the direction of the sound. Each channel is then shifted until it agrees best with all
    others in these beams,

    .. math:: \hat\tau_m = \arg\max_\tau \sum_k \mathrm{Re}\, e^{j \omega_k \tau} \sum_d w_d\, g_{kmd}

    and the part that another direction of the sound explains is removed. The repetition with shifted channels
    is the self-calibration of radio astronomy.

    References
    ----------
    T. Pearson and A. Readhead, "Image formation by self-calibration in radio astronomy", Annu. Rev. Astron.
    Astrophys. 22, 1984.
    """

    def __init__(self, array: MicrophoneArray, waves: PlaneWaves, frequencies_hz: FloatArray) -> None:
        n = array.n_microphones
        self._positions = array.positions_m
        self._waves = waves
        self._omega = 2.0 * np.pi * frequencies_hz
        self._search = np.exp(1j * self._omega[:, None] * _SEARCH_S)
        self._delays = np.zeros(n)
        self._runs = runs(n)
        # A clock drives at least two channels; a single channel with a drift has another position.
        self._is_card = self._runs.sum(axis=1) > 1.0
        self._rounds = _ROUNDS if n <= MAX_CHANNELS else 1
        self._values: deque[FloatArray] = deque(maxlen=_MEMORY_S)
        self._far: deque[bool] = deque(maxlen=_MEMORY_S)

    def push(self, coherence: Complex64Array, active: BoolArray) -> None:
        r"""Process the coherence (K, M, M) of one second, with zero diagonal, and the active channels (M,).

        .. math:: \hat\tau \leftarrow Q (\hat\tau + \Delta\tau)
        """
        for _ in range(self._rounds):
            turn = np.exp(1j * self._omega[:, None] * self._delays).astype(np.complex64)
            agreement = self._waves.agreement(coherence * turn[:, :, None] * turn.conj()[:, None, :])
            weights = direction_weights(agreement)
            moved, good = self._peaks(agreement @ weights, active)
            found = untilted(self._positions, good) @ (self._delays + moved)
            self._delays = np.where(good, found, self._delays)
        self._values.append(np.where(good, self._delays, np.nan))
        near = float(weights @ (np.abs(self._waves.elevations_rad) > _STEEP)) > _NEAR
        self._far.append(not near or len(good) > MAX_CHANNELS)

    @property
    def incoherent(self) -> BoolArray:
        """Channels that agreed with no wave in the last two seconds, (M,)."""
        latest = list(self._values)[-2:]
        return np.asarray(np.isnan(latest).all(axis=0)) if latest else np.ones(len(self._delays), bool)

    def _peaks(self, agreement: Complex64Array, active: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Return the delay of best agreement for every channel, (M,), and the channels that agree at all."""
        table = (agreement.T @ self._search).real
        at = np.clip(table.argmax(axis=1), 1, len(_SEARCH_S) - 2)
        rows = np.arange(len(at))
        before, peak, after = (table[rows, at + step] for step in (-1, 0, 1))
        # A channel without agreement has no curvature.
        bend = np.minimum(before - 2.0 * peak + after, -1e-12)
        step = _SEARCH_S[1] - _SEARCH_S[0]
        moved = _SEARCH_S[at] + step * np.clip(0.5 * (before - after) / bend, -1.0, 1.0)
        good = active & (peak > _GOOD * np.median(peak[active])) if active.any() else active
        return np.where(good, moved, 0.0), good

    def faults(self) -> list[ChannelFault]:
        """Return the channels of a card that drifts; if none drifts, those of a card that is late."""
        if not self._values:
            return []
        values = np.array(self._values)
        known = np.isfinite(values).mean(axis=0) > _MOSTLY
        free, power = _untilted_runs(self._positions.tobytes(), known.tobytes())
        if np.trace(free) < _MIN_FREEDOM or not self._is_card.any():
            return []
        whole = np.isfinite(values[:, known]).all(axis=1)
        values = np.where(known, values, 0.0)
        drifting = self._drift(values[whole], np.flatnonzero(whole), free, power[self._is_card])
        return drifting or self._late(values[whole & np.array(self._far)], free, power)

    def _drift(
        self, values: FloatArray, seconds: IndexArray, free: FloatArray, power: FloatArray
    ) -> list[ChannelFault]:
        if len(seconds) < _MIN_DRIFT_S:
            return []
        time = seconds - seconds.mean()
        some = self._runs[self._is_card]
        card, amount, sensitivity = best_card(free @ (time @ values) / (time @ time), power, some)
        # Standard deviation of the slope of a line: sigma^2 = sum e^2 / ((n - 2) sum (t - mean t)^2).
        path = values @ card / sensitivity**2
        rest = path - path.mean() - (time @ path) / (time @ time) * time
        error = float(np.sqrt((rest @ rest) / (len(time) - 2) / (time @ time)))
        length = abs(amount) * sensitivity * (np.ptp(seconds) / _DRIFT_SPAN_S) ** 1.5
        if abs(amount) < max(_DRIFT, _SIGMAS * error) or length < _DRIFT_LENGTH:
            return []
        return _named(card, Fault.DRIFT, amount, error)

    def _late(self, values: FloatArray, free: FloatArray, power: FloatArray) -> list[ChannelFault]:
        if len(values) < _MIN_DELAY_S:
            return []
        card, amount, sensitivity = best_card(free @ np.median(values, axis=0), power, self._runs)
        least_s = max(_DELAY_S, _LONE_DELAY_S / float(np.sqrt(np.count_nonzero(card))))
        if abs(amount) < least_s or abs(amount) * sensitivity < _DELAY_RMS_S * np.sqrt(len(free)):
            return []
        paths = values @ card / sensitivity**2
        # Standard deviation of a median.
        return _named(card, Fault.DELAY, amount, 1.25 * float(paths.std()) / np.sqrt(len(paths)))


def _named(card: BoolArray, fault: Fault, amount: float, std: float) -> list[ChannelFault]:
    return [ChannelFault(channel, fault, amount, std=std) for channel in np.flatnonzero(card).tolist()]


# Incoherent power of a usable channel relative to the field: delay mismatch and self-noise of real arrays.
_NOISE = 0.2
# Incoherent power of a channel that does not predict others: its weight becomes negligible.
_UNUSABLE = 1e3


def position_weights(array: MicrophoneArray, frequencies_hz: FloatArray, usable: BoolArray) -> Float32Array:
    r"""Return the weights of all other microphones in the prediction at every position.

    .. math:: w_{pj} = -\frac{(\Gamma + \Lambda)^{-1}_{pj}}{(\Gamma + \Lambda)^{-1}_{pp}}, \qquad
              \Gamma_{ij} = \frac{\sin(k d_{ij})}{k d_{ij}}

    Shapes: frequencies_hz (K,), usable (M,).
    """
    field = diffuse_coherence(array.positions_m, frequencies_hz)
    inverse = np.linalg.inv(field + np.diag(np.where(usable, _NOISE, _UNUSABLE)))
    weights = -inverse / np.einsum("kmm->km", inverse)[:, :, None]
    np.einsum("kmm->km", weights)[...] = 0.0
    return np.asarray(weights, np.float32)


def position_scores(coherence: Float32Array, weights: Float32Array) -> FloatArray:
    r"""Return the score of every channel at every position, between -1 and 1.

    .. math:: S_{mp} = \frac{\sum_k \sum_{j \ne m} w_{k,pj} R_{k,jm}}
              {\sqrt{K \sum_k w_{k,p}^T R_k\, w_{k,p}}}

    Shapes: coherence (K, M, M), weights (K, M, M).
    """
    predicted = weights @ coherence
    power = (predicted * weights).sum(axis=(0, 2), dtype=np.float64)
    # Without this, a channel that contributed to the prediction would agree with itself.
    predicted -= np.einsum("kmm->km", coherence)[:, None, :] * weights
    agreement = predicted.sum(axis=0, dtype=np.float64).T
    return np.asarray(agreement / np.sqrt(np.maximum(power, np.finfo(np.float32).tiny) * len(coherence)))


# A mean over the last two seconds.
_FORGET = 1.0 - 1.0 / 20.0
# Median coherence below which there is no result: chance alone gives 0.02 in two seconds.
_MIN_COHERENCE = 0.15
# Coherence relative to the median at which a channel becomes suspect and recovers. In simulated streets,
# healthy channels are above 0.59 and incoherent ones below 0.07.
_SUSPECT, _WELL = 0.3, 0.45
# Smallest gain at a different position. In simulated streets, a channel at its correct position gains at most
# 0.18 elsewhere; swapped channels that are 9 cm or more apart across the road gain 0.25 to 0.75.
_MARGIN = 0.3
# Channels that may be reassigned have the first gain at some position. A swap is reported only if the channel
# whose position is taken has at least the second gain elsewhere.
_CANDIDATE_GAIN = 0.2
_PARTNER_MARGIN = 0.1


class PositionFit:
    r"""Compares every channel with every position; a fault requires two consecutive detections.

    In any field of plane waves, the sound at one position follows from that at the surrounding positions. The
    best linear prediction from all other microphones in a diffuse field, whose coherence over a distance d is
    sin(kd) / (kd), is

    .. math:: \hat x_p = -\sum_{j \ne p} \frac{(\Gamma + \Lambda)^{-1}_{pj}}{(\Gamma + \Lambda)^{-1}_{pp}}\,
              x_j

    and the score of channel m at position p is the coherence of x_m with that prediction without m,

    .. math:: S_{mp} = \frac{\sum_k \mathrm{Re}\, E[x_{k,m} \overline{\hat x_{k,p}}]}
                            {\sqrt{K \sum_k E|\hat x_{k,p}|^2}}

    over K bins of whitened spectra. A usable channel fits its own position best, and an incoherent one fits
    none. A channel with reversed polarity fits with the opposite sign, and a channel on the wrong input fits
    another position. Microphones that differ only along a direction without waves cannot be distinguished,
    and need not be.

    References
    ----------
    The prediction is kriging, or Gaussian process regression, with leave-one-out weights: C. Rasmussen and C.
    Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2. Coherence: R. Cook et al.,
    J. Acoust. Soc. Am., 1955.
    """

    def __init__(self, array: MicrophoneArray, frequencies_hz: FloatArray) -> None:
        n = array.n_microphones
        self.coherence: float | NotUsable = NotUsable("the first second is not over")
        self._geometry = array, frequencies_hz
        self._sum = np.zeros((len(frequencies_hz), n, n), np.float32)
        self._n_frames = 0.0
        self._usable = np.ones(n, bool)
        self._weights = position_weights(array, frequencies_hz, self._usable)
        self._suspects = np.zeros(n, bool)
        self._found: list[ChannelFault] = []
        self.faults: list[ChannelFault] = []  # Noisy, inverted and swapped channels

    def add(self, matrices: Complex64Array, n_frames: int) -> None:
        r"""Add the cross-spectra (K, M, M) of one hop, summed over its frames.

        .. math:: S_{ij} \leftarrow 0.95\, S_{ij} + \mathrm{Re} \sum_t Z_i \overline{Z_j}, \qquad
                  n \leftarrow 0.95\, n + T
        """
        self._sum *= np.float32(_FORGET)
        self._sum += matrices.real
        self._n_frames = _FORGET * self._n_frames + n_frames

    def evaluate(self, active: BoolArray) -> None:
        """Search for faults among the active channels, (M,)."""
        usable = active & ~self._suspects
        # The weights are stored because they take a few milliseconds.
        if not np.array_equal(usable, self._usable):
            self._usable, self._weights = usable, position_weights(*self._geometry, usable)
        scores = position_scores(self._sum / np.float32(self._n_frames), self._weights)
        typical = float(np.median(scores.diagonal()[self._usable])) if self._usable.any() else 0.0
        heard = typical >= _MIN_COHERENCE
        self.coherence = typical if heard else NotUsable(f"no coherent sound ({typical:.2f})")
        found = self._find(scores, typical, active) if heard else []
        self.faults, self._found = repeated(found, self._found)

    def _find(self, scores: FloatArray, typical: float, active: BoolArray) -> list[ChannelFault]:
        limit = typical * np.where(self._suspects, _WELL, _SUSPECT)
        own = scores.diagonal()
        inverted = active & (own < -limit)
        swapped = displaced(scores, active & ~inverted & (scores.max(axis=1) > 0.5 * limit))
        moved = np.isin(np.arange(len(own)), [fault.channel for fault in swapped])
        noisy = active & ~inverted & ~moved & (own < limit)
        self._suspects = noisy | inverted | moved
        both = ((Fault.NOISY, noisy), (Fault.INVERTED, inverted))
        return swapped + [one for kind, found in both for one in faults_where(kind, found, own / typical)]


def displaced(scores: FloatArray, candidates: BoolArray) -> list[ChannelFault]:
    r"""Assign channels to positions with the largest total score; return the channels that gain.

    .. math:: \hat\pi = \arg\max_\pi \sum_m S_{m, \pi(m)}, \qquad g_m = S_{m, \hat\pi(m)} - S_{mm}

    Shapes: scores (M, M), candidates (M,).
    """
    # Hungarian method over the channels that fit better elsewhere. The others keep their positions, so that a
    # swap does not move a third channel to its second-best position.
    movable_mask = scores.max(axis=1) - scores.diagonal() > _CANDIDATE_GAIN
    movable = np.flatnonzero(candidates & movable_mask)
    if len(movable) < 2:
        return []
    # Imported here because few arrays have exchanged channels.
    from scipy.optimize import linear_sum_assignment

    table = scores[np.ix_(movable, movable)]
    best = linear_sum_assignment(table, maximize=True)[1]
    gain = table[np.arange(len(movable)), best] - table.diagonal()
    leaves = gain > _PARTNER_MARGIN
    found = (gain > _MARGIN) & leaves[best]
    # In a swap of two channels, certainty about one implies the other.
    found |= (best[best] == np.arange(len(movable))) & found[best] & leaves
    return [
        ChannelFault(int(movable[i]), Fault.SWAPPED, float(gain[i]), looks_like=int(movable[best[i]]))
        for i in np.flatnonzero(found)
    ]


_EVERY_HOPS = 10
# Below this frequency, waves are too long to compare channels, and wind noise is stronger.
_LOWEST_HZ = 250.0
# Number of bins for large and for small arrays, so that the computing time per second remains about 5 ms.
_FEW_BINS, _MANY_BINS = 7, 14
_TINY = np.finfo(np.float32).tiny


class GeometryCheck:
    """Compares all channels with their stated positions; most faults require two consecutive detections."""

    # The position fit compares each channel with its neighbours. It finds noisy and inverted channels and, in
    # a large array, proposes exchanges. Plane waves over the whole array confirm these and give delays.

    def __init__(self, array: MicrophoneArray, frequencies_hz: FloatArray) -> None:
        n = array.n_microphones
        high = np.flatnonzero(frequencies_hz >= _LOWEST_HZ)
        most = _MANY_BINS if n <= MAX_CHANNELS else _FEW_BINS
        self._bins = high[:: max(-(-len(high) // most), 1)]
        chosen = frequencies_hz[self._bins]
        waves = PlaneWaves(array.centred_m, chosen, _directions())
        self.fit = PositionFit(array, frequencies_hz)
        self._order, self._delay = OrderCheck(waves.beams), DelayCheck(array, waves, chosen)
        self._sum = np.zeros((len(chosen), n, n), np.complex64)
        self._hops, self._n_frames = 0, 0
        self._late: list[ChannelFault] = []
        self._by_waves: list[ChannelFault] = []
        self.faults: list[ChannelFault] = []  # One per channel, the more specific one

    def push(self, matrices: Complex64Array, n_frames: int, active: BoolArray) -> None:
        r"""Add the cross-spectra (K, M, M) of one hop, summed over frames, and the active channels (M,).

        .. math:: R_{ij} = \frac{1}{T} \sum_t Z_i \overline{Z_j}
        """
        self.fit.add(matrices, n_frames)
        self._sum += matrices[self._bins]
        self._n_frames += n_frames
        self._hops += 1
        if self._hops % _EVERY_HOPS == 0:
            self.fit.evaluate(active)
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
        many = len(active) > MAX_CHANNELS
        proposed = [one for one in self.fit.faults if many and one.fault is Fault.SWAPPED]
        exchanged = self._order.push(coherence, proposed)
        confirmed, self._late = repeated(self._delay.faults(), self._late)
        # Exchanged channels also look late.
        self._by_waves = exchanged or confirmed

    def _most_specific(self) -> list[ChannelFault]:
        # Microphones 0.5 m apart hardly predict each other, so a noisy channel must also match no wave.
        incoherent = self._delay.incoherent
        inverted = [one for one in self.fit.faults if one.fault is Fault.INVERTED]
        noisy = [one for one in self.fit.faults if one.fault is Fault.NOISY and incoherent[one.channel]]
        crossed = {one.channel for one in inverted}
        found = [one for one in self._by_waves if one.channel not in crossed]
        elsewhere = {one.channel for one in found}
        return found + inverted + [one for one in noisy if one.channel not in elsewhere]
