r"""Comparison of an array's stated positions with its sound: order, size and mounting.

If the sound of a quarter of a second comes mostly from one direction u, its coherence in a narrow band k is

.. math:: R_{kij} = w_k\, a_{ki}(u)\, \overline{a_{kj}(u)}
          + v_k\, \frac{\sin(2 \pi f_k d_{ij} / c)}{2 \pi f_k d_{ij} / c}, \qquad w_k, v_k \ge 0,

the sum of a plane wave and a diffuse field. A hypothesis about the positions is evaluated by the part of
:math:`|R|^2` that this explains, by least squares with the best u near the horizon. The positions are
accepted if no other order of the channels and no other size of the array explains more. All hypotheses use
the same sound, so neither the room nor the sources need to be known.

References
----------
R. K. Cook et al., J. Acoust. Soc. Am. 27, 1955 (the diffuse field); O. Thiergart, G. Del Galdo and E. A. P.
Habets, "On the spatial coherence in mixed sound fields", J. Acoust. Soc. Am. 132, 2012 (the mixture).
"""

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S, MicrophoneArray
from worldstate.frontend.array.steering import cross_spectra
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz, whiten
from worldstate.ground.typing import BoolArray, Complex64Array, Float32Array, FloatArray, IndexArray
from worldstate.ground.values import wrap_angle

from .geometry_check import PlaneWaves, diffuse_coherence

# Duration of a frame, and of a part: a syllable of speech, while one source dominates.
_FRAME_S, _PART_S = 0.032, 0.25
# Most channels for which every exchange of two is tested; a single test with 56 channels takes 0.5 s.
FEW = 16
# Number of parts kept, those with the most coherent sound; bands times channels; fewest and most bands.
_PARTS, _BANDS, _FEWEST, _MOST = 60, 192, 10, 24
# Number of tested delays between two channels: at 16 kHz and 10 cm about a third of a sample apart.
_DELAYS = 201
# At least two seconds, so that a single word does not determine the result.
LEAST_PARTS = 8
# From wavelengths of eight spacings, at which phases begin to differ, to wavelengths with slight aliasing.
# The limits in Hz also suit a smaller array, in case the positions are in inches.
_BAND, _LEAST_TOP_HZ, _BOTTOM_HZ = (0.25, 1.5), 2000.0, (200.0, 1000.0)
# Phases hardly change in a band with a width of the speed of sound over this many extents of the array.
_EXTENTS = 16.0
# Near the horizon: for a flat array, steep waves look like horizontal waves at a smaller array.
_ELEVATIONS_RAD = np.radians([0.0, 13.0, -13.0, 26.0, -26.0])
# Starting from ahead, so that of two equivalent directions the one ahead is kept.
_AZIMUTHS_RAD = np.radians(sorted(range(-180, 180, 5), key=abs))
_WAVES_RAD = np.array(np.meshgrid(_AZIMUTHS_RAD, _ELEVATIONS_RAD)).reshape(2, -1)
# Sizes within 9 % are accepted: sources above the plane of an array make it seem smaller.
_RIGHT = (1.0, 0.92, 1.09)
_OFF = (0.5, 0.6, 0.7, 0.77, 0.85, 1.18, 1.3, 1.43, 1.67, 2.0, 10.0, 25.4, 39.37, 1 / 10, 1 / 25.4, 1 / 39.37)
# Smallest gain of another order and of another size in the logarithm of the unexplained part, and in standard
# deviations. In simulated rooms, right orders lose at least 0.5 by a change. Right sizes lose at least 0.09
# (rings of 4) or 0.01 (56 microphones; one direction explains a tenth). Wrong sizes gain at least
# 0.02.
_ORDER_GAIN, SIZE_GAIN, _SIGMAS = 0.05, 0.015, 4.0
# Mean square of the coherence below which the microphones have no common sound.
_COHERENT = 0.02
# With four microphones every order is a few exchanges away from the right one.
_RANDOM_ORDERS, _LEAST_BY_CHANCE, _MOSTLY = 3, 4, 0.6
# Sizes that the sound must exclude before the stated size is confirmed.
OFF_BY_30 = (0.77, 1.3)
# Smallest unexplained share of the coherent energy, and the distance relative to the array's extent below
# which two microphones are considered to be at one place.
_LEAST_LEFT, _SAME_PLACE = 0.02, 0.05
# Single wave: smallest share that one direction explains, and smallest share of the parts from it. With 56
# simulated microphones, one direction explains 0.2 to 0.6 in rooms and 0.64 or more of single sources in the
# open, and nine tenths of their parts are within 5 degrees.
_DIRECT, _PARTS_OF_ONE = 0.5, 0.8
# For sound from a known side: error of the bearing, and the difference below which two mountings fit equally.
_SIDE_RAD = math.radians(15.0)
_ALIKE_RAD = math.radians(7.0)

NO_SIDE = ("a mirrored or rotated mounting: this needs sound from a known azimuth (--heard-from)",)


class Hypothesis:
    """Energy that plane waves and a diffuse field explain, for positions (M, 3) and frequencies (K,)."""

    def __init__(self, positions_m: FloatArray, frequencies_hz: FloatArray) -> None:
        self.waves = PlaneWaves(positions_m, frequencies_hz, _WAVES_RAD)
        self._pairs = len(positions_m) * (len(positions_m) - 1)
        self._diffuse = diffuse_coherence(positions_m, frequencies_hz)
        np.einsum("kmm->km", self._diffuse)[...] = 0.0
        self._power = np.square(self._diffuse).sum(axis=(1, 2))[:, None] / self._pairs
        self._shared = self._on_beams(self._diffuse.astype(np.complex64))

    def _on_beams(self, coherence: Complex64Array) -> FloatArray:
        return np.asarray(self.waves.agreement(coherence).real.sum(axis=-2) / self._pairs)

    def explained(self, coherence: Complex64Array) -> FloatArray:
        """Return the energy explained by a wave from each direction, (S, D), for coherence (S, K, M, M)."""
        wave = self._on_beams(coherence)
        field = ((coherence.real * self._diffuse).sum(axis=(2, 3)) / self._pairs)[:, :, None]
        w, v = wave * self._power - field * self._shared, field - wave * self._shared
        determinant = self._power - self._shared**2
        mixed = (w > 0.0) & (v > 0.0) & (determinant > 1e-3 * self._power)
        one = np.maximum(np.maximum(wave, 0.0) ** 2, np.maximum(field, 0.0) ** 2 / self._power)
        both = (wave * w + field * v) / np.where(mixed, determinant, 1.0)
        return np.asarray(np.where(mixed, both, one).sum(axis=1))

    def best(self, coherence: Complex64Array) -> FloatArray:
        """Return the energy that the best direction of every part explains, (S,)."""
        return np.asarray(self.explained(coherence).max(axis=1))


@dataclass(frozen=True, slots=True)
class PositionVerdict:
    """Result of the comparison of a recording's sound with the positions of the microphones.

    Parameters
    ----------
    order : tuple of int or None
        Place of every channel, from 0, in an order that fits better; empty if no single order fits best.
        None if the order fits or is undetermined.
    size : float or None
        Factor on the positions that fits better; None if the size fits or is undetermined.
    mounting : tuple of str
        Possible mountings that explain a wrong bearing of a sound from a known side.
    unjudged : tuple of str
        Properties that this sound does not determine, with reasons.

    Examples
    --------
    >>> PositionVerdict(order=(1, 0, 2)).fits, PositionVerdict().fits
    (False, True)
    """

    order: tuple[int, ...] | None = None
    size: float | None = None
    mounting: tuple[str, ...] = ()
    unjudged: tuple[str, ...] = ()

    @property
    def fits(self) -> bool:
        """Whether the sound agrees with the positions as far as it determines them."""
        return self.order is None and self.size is None and not self.mounting


NOTHING_AGAINST = PositionVerdict()


class PositionCheck:
    """Collects the coherence of a recording in quarters of a second and checks the positions with it."""

    def __init__(self, array: MicrophoneArray, sample_rate_hz: float) -> None:
        n = array.n_microphones
        self.positions_m, self.sample_rate_hz = array.positions_m, sample_rate_hz
        nfft = 2 ** round(math.log2(_FRAME_S * sample_rate_hz))
        low, high = (share * array.alias_hz() for share in _BAND)
        top = min(max(high, _LEAST_TOP_HZ), 0.45 * sample_rate_hz)
        bins = band_bins((float(np.clip(low, *_BOTTOM_HZ)), top), sample_rate_hz, nfft)
        width_hz = SPEED_OF_SOUND_M_S / (_EXTENTS * array.widest_m)
        wide = min(max(int(width_hz * nfft / sample_rate_hz), 1), len(bins))
        bands = min(max(_BANDS // n, _FEWEST), _MOST, len(bins) // wide)
        first = np.linspace(0, len(bins) - wide, bands).astype(int)
        self._bands = first[:, None] + np.arange(wide)
        self.frequencies_hz = bin_frequencies_hz(bins, sample_rate_hz, nfft)[self._bands].mean(axis=1)
        self._frames_a_part = round(2.0 * _PART_S * sample_rate_hz / nfft)
        # Mean square of independent noise by chance.
        self.noise = 1.0 / (self._frames_a_part * wide)
        self._stft = StreamingStft(n, nfft, bins)
        self._parts: list[tuple[float, Complex64Array]] = []

    def push(self, samples: Float32Array) -> None:
        r"""Process the next samples (n, M), ideally one second, and store the coherence of their parts.

        .. math:: R_{kij} = \frac1{TB} \sum_{t, b \in k} \frac{X_{tbi} \overline{X_{tbj}}}{|X_{tbi} X_{tbj}|}
        """
        frames = whiten(self._stft.push(samples))[:, self._bands]
        for part in np.array_split(frames, max(len(frames) // self._frames_a_part, 1)):
            if len(part) >= self._frames_a_part // 2:
                by_band = part.transpose(1, 0, 2, 3).reshape(len(self._bands), -1, part.shape[-1])
                coherence = cross_spectra(by_band) / np.float32(by_band.shape[1])
                np.einsum("kmm->km", coherence)[...] = 0.0
                self._parts.append((_power(coherence) - self.noise, coherence))
        if len(self._parts) > 2 * _PARTS:
            self._parts = self._strongest()

    def _strongest(self) -> list[tuple[float, Complex64Array]]:
        return sorted(self._parts, key=lambda one: -one[0])[:_PARTS]

    def heard(self) -> Complex64Array:
        """Return the coherence (S, K, M, M) of the most coherent parts."""
        kept = [coherence for power, coherence in self._strongest() if power > _COHERENT]
        shape = len(self.frequencies_hz), len(self.positions_m), len(self.positions_m)
        return np.asarray(kept, np.complex64).reshape(-1, *shape)

    def verdict(self, usable: BoolArray, heard_from_rad: float | None = None) -> PositionVerdict:
        """Check order and size of the usable channels (M,), and the mounting with sound of known azimuth."""
        heard = self.heard()
        if np.count_nonzero(usable) < 3:
            return PositionVerdict(unjudged=("order and size: three usable microphones are needed",))
        if len(heard) < LEAST_PARTS:
            few = f"{_PART_S * len(heard):.2g} s of coherent sound, 2 s are needed"
            return PositionVerdict(unjudged=(f"order and size: {few}",))
        return Comparison(self, usable, heard).verdict(heard_from_rad)


def _power(coherence: Complex64Array) -> float:
    """Return the mean square over the pairs of coherence (..., M, M), whose diagonal is zero."""
    n = coherence.shape[-1]
    return float(np.square(np.abs(coherence)).mean() * n / (n - 1))


class Comparison:
    """Comparison of hypotheses for the usable channels, (m,), on the same parts, coherence (S, K, M, M)."""

    def __init__(self, check: PositionCheck, usable: BoolArray, coherence: Complex64Array) -> None:
        self._channels = channels = np.flatnonzero(usable)
        self._positions = check.positions_m[channels] - check.positions_m[channels].mean(axis=0)
        self._frequencies = check.frequencies_hz
        self._coherence = coherence[:, :, channels][..., channels]
        self._power = (_power(self._coherence) - check.noise) * self._coherence[..., 0, 0].size
        self._claimed = Hypothesis(self._positions, self._frequencies)

    def explained(self, positions_m: FloatArray) -> FloatArray:
        """Return the share of the total coherent energy that positions (m, 3) explain in each part, (S,)."""
        return np.asarray(Hypothesis(positions_m, self._frequencies).best(self._coherence) / self._power)

    def delays_s(self, longest_s: float) -> FloatArray:
        """Return the delay of every channel relative to their mean, (S, m), with a limit between two."""
        grid_s = np.linspace(-longest_s, longest_s, _DELAYS)
        turns = np.exp(2j * np.pi * self._frequencies[:, None] * grid_s)
        by_pair = self._coherence.reshape(*self._coherence.shape[:2], -1)
        found = np.array([grid_s[(one.T @ turns).real.argmax(axis=1)] for one in by_pair])
        pairs = found.reshape(len(found), *self._coherence.shape[2:])
        return np.asarray((pairs - pairs.mT).mean(axis=2) / 2.0)

    def azimuths_rad(self, positions_m: FloatArray) -> FloatArray:
        """Return the azimuth that explains the most of each part with positions (m, 3), (S,)."""
        one = Hypothesis(positions_m, self._frequencies)
        return np.asarray(one.waves.azimuths_rad[one.explained(self._coherence).argmax(axis=1)])

    def is_better(self, new_m: FloatArray, old_m: FloatArray) -> bool:
        """Return whether positions (m, 3) explain more than others by the minimum gain of a size."""
        return self._gain(*(self._power * self.explained(one) for one in (new_m, old_m))) > SIZE_GAIN

    def verdict(self, heard_from_rad: float | None) -> PositionVerdict:
        """Compare orders first, then sizes in the best order, then the mounting if both fit."""
        order, unsure = self.best_order()
        size, by_chance, untold = self._best_size(order)
        if size is not None and self._is_one_wave:
            size, untold = None, ("the size: one wave does not determine the size of an upright array",)
        if by_chance:
            return PositionVerdict(order=())
        if not np.array_equal(order, np.arange(len(order))):
            return PositionVerdict(order=tuple(self._channels[np.argsort(order)].tolist()))
        if size is not None:
            return PositionVerdict(size=size)
        mounting, unheard = ((), NO_SIDE) if heard_from_rad is None else self._mounting(heard_from_rad)
        return PositionVerdict(mounting=mounting, unjudged=(*unsure, *untold, *unheard))

    @property
    def _is_one_wave(self) -> bool:
        """Whether an array in a vertical plane receives one wave: size and angle are then equivalent."""
        extent_m = float(np.abs(self._positions).max())
        if np.linalg.matrix_rank(self._positions[:, :2], tol=_SAME_PLACE * extent_m) > 1:
            return False
        direct = float(self._claimed.best(self._coherence).sum()) > _DIRECT * self._power
        return direct and float(np.quantile(self._azimuth()[1], _PARTS_OF_ONE)) < _ALIKE_RAD

    def _azimuth(self) -> tuple[float, FloatArray]:
        """Return the azimuth that explains most of all parts, and the distance of each part from it, (S,)."""
        explained, azimuths = self._claimed.explained(self._coherence), self._claimed.waves.azimuths_rad
        at = float(azimuths[explained.sum(axis=0).argmax()])
        return at, np.abs(wrap_angle(azimuths[explained.argmax(axis=1)] - at))

    def _in_order(self, order: IndexArray) -> Complex64Array:
        return np.asarray(self._coherence[:, :, order][..., order])

    def _gain(self, new: FloatArray, old: FloatArray) -> float:
        r"""Return the gain of one hypothesis over another, 0 if it is not significant.

        .. math:: \ln \frac{P - \sum_s E_s^{old}}{P - \sum_s E_s^{new}}
        """
        more = new - old
        if more.mean() < _SIGMAS * more.std() / math.sqrt(len(more)):
            return 0.0
        left = np.maximum(self._power - np.array([old.sum(), new.sum()]), _LEAST_LEFT * self._power)
        return math.log(left[0] / left[1])

    def best_order(self) -> tuple[IndexArray, tuple[str, ...]]:
        """Exchange channels in pairs while this explains more; return order and undetermined exchanges."""
        order = np.arange(len(self._positions))
        explained = self._claimed.best(self._coherence)
        while len(order) <= FEW:
            tried = [_exchanged(order, *pair) for pair in combinations(range(len(order)), 2)]
            found = [self._claimed.best(self._in_order(one)) for one in tried]
            best = int(np.argmax([one.sum() for one in found]))
            if self._gain(found[best], explained) < _ORDER_GAIN:
                return order, self._alike(order, explained, tried, found)
            order, explained = tried[best], found[best]
        return order, ()

    def _alike(
        self, order: IndexArray, explained: FloatArray, tried: list[IndexArray], found: list[FloatArray]
    ) -> tuple[str, ...]:
        """Return the exchanges that another sound could exclude, but not this one."""
        apart = np.linalg.norm(self._positions[:, None] - self._positions, axis=-1)
        pairs = [
            "{} and {}".format(*(self._channels[one != order] + 1))
            for one, energy in zip(tried, found, strict=True)
            if self._gain(explained, energy) < _ORDER_GAIN
            and np.abs(apart[one][:, one] - apart).max() > _SAME_PLACE * np.max(apart)
        ]
        named = ", ".join(pairs[:3]) + (f" and {len(pairs) - 3} more pairs" if len(pairs) > 3 else "")
        return (f"exchange of {named}: the sound fits both",) if pairs else ()

    def _best_size(self, order: IndexArray) -> tuple[float | None, bool, tuple[str, ...]]:
        """Return a size that fits better, whether any order fits equally, and undetermined sizes."""
        heard = self._in_order(order)
        found = {size: Hypothesis(self._positions * size, self._frequencies) for size in (*_RIGHT, *_OFF)}
        energy = {size: one.best(heard) for size, one in found.items()}
        right, off = (max(some, key=lambda size: energy[size].sum()) for some in (_RIGHT, _OFF))
        is_off = self._gain(energy[off], energy[right]) > SIZE_GAIN
        size = off if is_off else right
        # Positions in another unit fit in no order either, and a fit of most of the sound is not by chance.
        explains = energy[size].sum() > _MOSTLY * self._power
        if len(order) > _LEAST_BY_CHANCE and not explains and self._by_chance(found[size], energy[size]):
            return None, True, ()
        if is_off:
            return off, False, ()
        unsure = [f"{one:g} times" for one in OFF_BY_30 if self._gain(energy[right], energy[one]) < SIZE_GAIN]
        return None, False, (f"{' or '.join(unsure)} the size: the sound fits both",) if unsure else ()

    def _by_chance(self, hypothesis: Hypothesis, explained: FloatArray) -> bool:
        rng = np.random.default_rng(0)
        orders = (rng.permutation(len(self._positions)) for _ in range(_RANDOM_ORDERS))
        gains = (self._gain(explained, hypothesis.best(self._in_order(one))) for one in orders)
        return any(gain < _ORDER_GAIN for gain in gains)

    def _mounting(self, heard_from_rad: float) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the mountings that agree with sound from a known side, or the reason for no result."""
        at, misses_rad = self._azimuth()
        if np.median(misses_rad) > 2.0 * _SIDE_RAD:
            return (), ("mounting: sound comes from several sides",)
        misses = {name: self._miss(places, at) for name, places in self._places(heard_from_rad).items()}
        least = min(misses.values())
        fits = misses.pop("as claimed") < max(_SIDE_RAD, least + _ALIKE_RAD)
        alike = tuple(name for name, miss in misses.items() if miss < least + _ALIKE_RAD)
        if fits:
            both = f"whether it is {' or '.join(alike)}: sound from this azimuth fits both"
            return (), (both,) if alike else ()
        return (alike if least < _SIDE_RAD else (_turned(heard_from_rad - at),)), ()

    def _places(self, heard_from_rad: float) -> dict[str, FloatArray]:
        """Return the azimuths at which sound from this side would appear in every mounting."""
        turns, first_rad = _symmetry(self._positions)
        steps = 2.0 * np.pi / turns * np.arange(turns)
        mirrors = np.concatenate([[0.0, np.pi], 2.0 * first_rad + steps if turns > 1 else []])
        places = {"as claimed": np.array([heard_from_rad]), "mirrored": mirrors - heard_from_rad}
        return places | {_turned(one): np.array([heard_from_rad - one]) for one in steps[1:].tolist()}

    def _miss(self, azimuths_rad: FloatArray, at_rad: float) -> float:
        """Return the smallest angle between azimuths and a direction; equivalent directions are equal."""
        delays = MicrophoneArray(self._positions).delays_s(azimuths_rad)
        nearest = np.square(delays[:, None] - self._claimed.waves.delays_s).sum(axis=-1).argmin(axis=1)
        return float(np.abs(wrap_angle(self._claimed.waves.azimuths_rad[nearest] - at_rad)).min())


def _turned(angle_rad: float) -> str:
    return f"turned by {math.degrees(wrap_angle(angle_rad)):.0f} degrees"


def _exchanged(order: IndexArray, a: int, b: int) -> IndexArray:
    other = order.copy()
    other[[a, b]] = order[[b, a]]
    return other


def _symmetry(positions_m: FloatArray) -> tuple[int, float]:
    """Return the rotational symmetry of an array about the vertical and the azimuth of its first part."""
    plane = positions_m[:, 0] + 1j * positions_m[:, 1]
    outer = plane[np.abs(plane).argmax()]
    for turns in range(len(plane), 1, -1):
        turned = np.abs(plane[:, None] * np.exp(2j * np.pi / turns) - plane)
        apart = np.hypot(turned, positions_m[:, 2, None] - positions_m[:, 2]).min(axis=1)
        if apart.max() < _SAME_PLACE * abs(outer):
            return turns, float(np.angle(outer))
    return 1, 0.0
