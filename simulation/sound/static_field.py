"""Many fixed sources at all microphones at once.

Delays across an array are a few milliseconds at most, so every source is a phase ramp per block of a weighted
overlap-add; one batched matrix product carries all sources to all microphones. Most of the cost is the
inverse transform, once per microphone for any number of sources, so sources are best rendered together.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ
from worldstate.simulation.scene.presets import Preset
from worldstate.simulation.scene.vehicle import SOURCE_HEIGHT_M

from .delay import KNOT_SAMPLES, Emission
from .diffraction import SPEED_OF_SOUND_MPS
from .receiver import Receiver, distance_m

BLOCK = 4096
HOP = BLOCK // 2
BINS, FINE_BINS = HOP + 1, 64
BLOCKS_AT_ONCE = 16
PENDING = 160  # Number of sources that are collected before they are rendered together


def plane_wave_delays(azimuth_rad: FloatArray, elevation_rad: FloatArray, receiver: Receiver) -> FloatArray:
    """Return the delay of plane waves at every microphone relative to the centre, shape (Q, M), s.

    Shapes: azimuth_rad, elevation_rad (Q,).
    """
    flat = np.cos(elevation_rad)
    directions = np.stack([flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.sin(elevation_rad)], 1)
    return -(directions @ (receiver.positions_m - receiver.centre_m).T) / SPEED_OF_SOUND_MPS


def azimuths_all_round(count: int, rng: np.random.Generator) -> FloatArray:
    """Draw evenly spaced azimuths with a random start."""
    return np.asarray(2.0 * np.pi * (np.arange(count) + rng.random()) / count)


@dataclass(frozen=True, slots=True, eq=False)
class StaticSources:
    """Sources that are collected and rendered together."""

    out: Float32Array  # shape (M, n): Signals of the microphones, to which the sources are added
    sample_rate_hz: float
    _waiting: list[tuple[Float32Array, FloatArray, FloatArray]] = field(default_factory=list)

    def add(self, signals: Float32Array, delays_s: FloatArray, gains: FloatArray | None = None) -> None:
        """Collect sources whose delayed copies are added to every microphone.

        Shapes: signals (Q, n), delays_s (Q, M), gains (Q, M).
        """
        factors = np.ones_like(delays_s) if gains is None else gains
        self._waiting.append((signals, delays_s, factors))
        if sum(len(delays) for _, delays, _ in self._waiting) > PENDING:
            self.render()

    def render(self) -> None:
        """Render the collected sources."""
        if not self._waiting:
            return
        delays, gains = (np.concatenate([one[i] for one in self._waiting]) for i in (1, 2))
        signals = [one for one, _, _ in self._waiting]
        self._waiting.clear()
        steering, samples = _phase_ramps(delays, gains, self.sample_rate_hz), self.out.shape[1]
        for start, spectra in _analyse(signals):
            heard = np.matmul(spectra, steering).transpose(1, 2, 0)  # (blocks, M, F)
            for i, block in enumerate(irfft(heard, BLOCK)):
                first, last = max((start + i - 1) * HOP, 0), min((start + i + 1) * HOP, samples)
                at = (start + i - 1) * HOP
                self.out[:, first:last] += block[:, first - at : last - at]


def _phase_ramps(delays_s: FloatArray, gains: FloatArray, sample_rate_hz: float) -> Complex64Array:
    r"""Return :math:`g\, e^{-2 \pi j f \tau}` at the bins of a block, shapes (Q, M) -> (F, Q, M)."""
    # Bin k = 64 i + j is a product of two powers of the first: a tenth of the time of one exponential per
    # bin, which takes longer than the rest of a recording of half a second.
    first = -2j * np.pi * sample_rate_hz / BLOCK * delays_s
    fine = np.exp(np.arange(FINE_BINS)[:, None, None] * first)
    ramps = np.empty((-(-BINS // FINE_BINS), *fine.shape), np.complex64)
    for i, bins in enumerate(ramps):
        np.multiply(fine, gains * np.exp(i * FINE_BINS * first), out=bins, casting="same_kind")
    return ramps.reshape(-1, *delays_s.shape)[:BINS]


def _analyse(signals: list[Float32Array]) -> Iterator[tuple[int, Complex64Array]]:
    """Yield spectra (F, blocks, Q) of Hann-windowed blocks that sum to the signal, a few at a time."""
    window = (0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(BLOCK) / BLOCK)).astype(np.float32)
    sources, samples = sum(len(one) for one in signals), signals[0].shape[1]
    cut, blocks = np.empty((sources, BLOCK), np.float32), -(-samples // HOP) + 1
    for start in range(0, blocks, BLOCKS_AT_ONCE):
        stop = min(start + BLOCKS_AT_ONCE, blocks)
        spectra = np.empty((BINS, stop - start, sources), np.complex64)
        for i in range(start, stop):
            at = (i - 1) * HOP  # The first block begins one hop before the signals
            first, last = max(at, 0), min(at + BLOCK, samples)
            cut[:, : first - at], cut[:, last - at :] = 0.0, 0.0
            np.concatenate([one[:, first:last] for one in signals], out=cut[:, first - at : last - at])
            cut *= window
            # Transposed while it is in the cache; transposing all blocks at once took as long as the
            # transforms.
            spectra[:, i - start] = rfft(cut, axis=-1).T
        yield start, spectra


SCATTER_HZ = 400.0  # Relief of a few decimetres: below this frequency a facade is smooth
DIRECTIONS = 48
LOBES, LOBE_CONCENTRATION, LOBE_SPAN_RAD = 4, 8.0, 1.3
ELEVATION_RAD = 0.3
LATE_DISTANCE_M = 8.0  # Distance from the mouth at which a source feeds the late field half as much
WAVES_AT_ONCE = 4
TAIL_DECAYS = 1.0  # Length of a tail in reverberation times (60 dB)


def street_field(site: Site, lobe_share: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return azimuths and elevations from which late sound reaches the array, and their energy shares.

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import site
    >>> azimuth_rad, elevation_rad, shares = street_field(site("SA1"), 0.5)
    >>> len(azimuth_rad), round(float(shares.sum()), 6)
    (48, 1.0)
    """
    # Between walls and under an open sky late sound arrives near the horizon. It enters by the mouth and from
    # objects there, so that each site has its own late directions ahead.
    rng = site_generator(site.name, "late")
    azimuth = azimuths_all_round(DIRECTIONS, rng)
    elevation = np.abs(rng.normal(0.0, ELEVATION_RAD, DIRECTIONS))
    centres, weights = rng.uniform(-LOBE_SPAN_RAD, LOBE_SPAN_RAD, LOBES), rng.dirichlet(np.full(LOBES, 3.0))
    lobes = np.exp(LOBE_CONCENTRATION * (np.cos(azimuth[:, None] - centres) - 1.0))
    shares = lobe_share * (lobes / lobes.sum(axis=0)) @ weights + (1.0 - lobe_share) / DIRECTIONS
    return azimuth, elevation, shares


@dataclass(frozen=True, slots=True, eq=False)
class PlacedSource:
    """The sound of one point and its position at its emission knots."""

    emission: Emission
    time_s: FloatArray  # shape (T,): The knots
    x_m: FloatArray  # shape (T,)
    y_m: FloatArray
    height_m: float  # Above the road

    def straight_m(self, position_m: FloatArray, receiver: Receiver) -> tuple[FloatArray, FloatArray]:
        """Return the distance to a position (3,) on the ego and the ego's place at arrival, (T,) each."""
        place = np.stack([self.x_m, self.y_m, np.full(len(self.x_m), self.height_m)])
        return receiver.arrivals(self.time_s, partial(distance_m, place, offset_m=position_m))

    def during(self, span: slice) -> "PlacedSource":
        """Return the part of it at some of its knots."""
        return replace(self, time_s=self.time_s[span], x_m=self.x_m[span], y_m=self.y_m[span])


@dataclass(frozen=True, slots=True, eq=False)
class StreetSound:
    """Outputs to which the sounds of a street are added, and the properties of the street."""

    static: StaticSources
    site: Site
    preset: Preset
    receiver: Receiver

    def scattered(self, beyond_mouth: bool) -> FloatArray:
        """Return the share of the energy that facades beyond the mouth, or the side walls, scatter, (8,)."""
        relief = (OCTAVES_HZ / SCATTER_HZ) ** 2
        coefficient = self.preset.wall_scattering * relief / (1.0 + relief)
        return np.minimum(coefficient * self.site.roughness[int(beyond_mouth)], 1.0)

    def source(
        self,
        signal: Float32Array,
        time_s: FloatArray,
        place_m: tuple[FloatArray, FloatArray],
        height_m: float = SOURCE_HEIGHT_M,
    ) -> PlacedSource:
        """Return the source of a signal that is at a place (x, y) at each of its knots."""
        emission = Emission.of(signal, float(time_s[0]), self.receiver.sample_rate_hz)
        return PlacedSource(emission, time_s, *place_m, height_m)


def _add_late_field(street: StreetSound, dry: Float32Array, rng: np.random.Generator) -> None:
    """Add a diffuse tail of a dry signal: its energy without its direction.

    Every direction has its own tail; one common tail on all microphones would be a source at broadside.

    Shapes: dry (pre + samples,).
    """
    static = street.static
    azimuth, elevation, shares = street_field(street.site, street.preset.late_lobe_share)
    samples = static.out.shape[1]
    tail = max(int(TAIL_DECAYS * street.preset.late_decay_s * static.sample_rate_hz), 1)
    n = next_fast_len(len(dry) + tail, real=True)
    spectrum = rfft(dry, n)
    envelope = 10.0 ** (-3.0 * np.arange(tail) / tail * TAIL_DECAYS)
    envelope /= np.sqrt((envelope**2).sum())
    waves = np.empty((len(shares), samples), np.float32)
    # Transforms of a few tails together are fastest: one by one, or all at once, they take twice as long.
    for first in range(0, len(shares), WAVES_AT_ONCE):
        some = slice(first, first + WAVES_AT_ONCE)
        drawn = rng.standard_normal((len(shares[some]), tail))
        responses = (np.sqrt(shares[some])[:, None] * envelope * drawn).astype(np.float32)
        tails = rfft(responses, n)
        tails *= spectrum
        waves[some] = irfft(tails, n)[:, len(dry) - samples : len(dry)]
    static.add(waves, plane_wave_delays(azimuth, elevation, street.receiver))


def add_late_sound(
    street: StreetSound,
    signal: Float32Array,
    place_m: tuple[FloatArray, FloatArray],
    time_s: FloatArray,
    rng: np.random.Generator,
) -> None:
    """Add the late sound of a source; its signal extends from the first of its emission knots to the last.

    Shapes: signal (n,), place_m (x (T,), y (T,)), time_s (T,).
    """
    if not street.site.is_open:  # The open has no objects that return late sound
        fed = signal * _late_gain(street, *place_m, time_s)
        _add_late_field(street, _until_the_end(fed, time_s[0], street.receiver), rng)


def late_level_db(site: Site, preset: Preset) -> float:
    """Return the late field of a source at the mouth relative to its pressure at 1 m."""
    return preset.late_open_db if site.opposite_wall_m is None else preset.late_walled_db


def _late_gain(street: StreetSound, x_m: FloatArray, y_m: FloatArray, time_s: FloatArray) -> Float32Array:
    """Return the gain of a source into the late field, which falls with its and the ego's distance."""
    away = np.hypot(x_m - street.site.corner_ahead_m, y_m) - street.receiver.ego.x_m(time_s)
    level = 10.0 ** (late_level_db(street.site, street.preset) / 20.0)
    gain = level * LATE_DISTANCE_M / (LATE_DISTANCE_M + away)
    knots = np.arange(len(gain)) * KNOT_SAMPLES
    return np.asarray(np.interp(np.arange((len(gain) - 1) * KNOT_SAMPLES), knots, gain), np.float32)


def _until_the_end(signal: Float32Array, start_s: float, receiver: Receiver) -> Float32Array:
    """Return a signal from its start, or the recording's if that is earlier, to the recording's end."""
    offset = round((start_s - receiver.knots_s[0]) * receiver.sample_rate_hz)
    out, at = np.zeros(max(-offset, 0) + receiver.samples, np.float32), max(offset, 0)
    piece = signal[: max(len(out) - at, 0)]
    out[at : at + len(piece)] = piece
    return out
