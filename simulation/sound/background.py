"""Background of an empty street: anisotropic ambience, distant traffic, wind and noise.

The background is noise from many directions whose powers change slowly. An open sky contributes a part from
all directions. The rest enters by the street's openings: along both arms of the crossing street, round the
corners and by the walls like the sound of a vehicle there, straight ahead, and from behind.
"""

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
import scipy
from scipy.fft import irfft, next_fast_len, rfftfreq

from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray, IndexArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ, REFERENCE_PA, level_curve
from worldstate.simulation.scene.presets import OPENINGS, Ambience, Preset

from .paths import trace_paths
from .receiver import Receiver
from .static_field import azimuths_all_round, plane_wave_delays

# Length of a block: long compared with the delays across an array (about 3 ms), which are circular within a
# block, and short compared with the second in which a level changes.
BLOCK_S = 0.043
BLOCKS_AT_ONCE = 32
NORMALS = 2**16


@dataclass(frozen=True, slots=True)
class BlockGrid:
    """Half-overlapping blocks that cover a recording."""

    samples: int
    sample_rate_hz: float

    @property
    def hop(self) -> int:
        """Samples from one block to the next."""
        return int(next_fast_len(round(0.5 * BLOCK_S * self.sample_rate_hz), real=True))

    @property
    def frequencies_hz(self) -> FloatArray:
        """Bins of a block, shape (F,)."""
        return np.asarray(np.fft.rfftfreq(2 * self.hop, 1.0 / self.sample_rate_hz))

    @property
    def middles_s(self) -> FloatArray:
        """Middle of each block, shape (B,); the first block begins a hop before the recording."""
        return np.arange(-(-self.samples // self.hop) + 1) * self.hop / self.sample_rate_hz


@dataclass(frozen=True, slots=True, eq=False)
class WaveField:
    r"""Plane waves of independent noise with a common spectrum and changing powers, and uncorrelated noise.

    Every block of a weighted overlap-add is drawn in the frequency domain:

    .. math:: X_m(f) = \sum_q \sqrt{G_q S(f)}\, e^{-2 \pi j f \tau_{qm}} W_q(f) + \sqrt{N(f)}\, V_m(f),

    W and V are white noise. A wave is never computed as a signal, so the cost is one product and one
    transform per microphone. Blocks are independent. The squares of their windows sum to one, so that the
    level is steady while the powers G may change from block to block.
    """

    grid: BlockGrid
    delays_s: FloatArray  # shape (Q, M): Delay of every wave at every microphone
    density: FloatArray  # shape (F,): Power spectral density of a wave of unit power, Pa^2/Hz
    power: FloatArray  # shape (B, Q): Power of every wave in every block
    noise_density: FloatArray  # shape (F,): Density of the uncorrelated noise of each microphone, Pa^2/Hz
    flicker_db: float = 0.0  # Flicker of the whole background; see `Preset`

    def add_to(self, out: Float32Array, rng: np.random.Generator) -> None:
        """Draw the noise, a few blocks at a time, and add it to the signals of all microphones, (M, n)."""
        hop, gains = self.grid.hop, np.sqrt(self.power).astype(np.float32)
        window = np.sin(np.pi * (np.arange(2 * hop) + 0.5) / (2 * hop)).astype(np.float32)
        steering, noise = self._steering(), self._amplitude(self.noise_density)[:, None, None]
        before = np.zeros((0, steering.shape[2], 2 * hop), np.float32)
        flicker = self._flicker(rng) if self.flicker_db else None
        for start in range(0, len(gains), BLOCKS_AT_ONCE):
            gain = gains[start : start + BLOCKS_AT_ONCE]
            spectra = np.matmul(_white((len(steering), *gain.shape), rng) * gain, steering)
            if noise.any():
                spectra += noise * _white(spectra.shape, rng)
            if flicker is not None:
                spectra *= flicker[:, start : start + BLOCKS_AT_ONCE, None]
            blocks = irfft(spectra.transpose(1, 2, 0), 2 * hop)
            blocks *= window
            whole = np.concatenate([before, blocks])
            heard = np.empty((blocks.shape[1], len(whole) - 1, hop), np.float32)
            np.add(whole[:-1, :, hop:].swapaxes(0, 1), whole[1:, :, :hop].swapaxes(0, 1), out=heard)
            room = out[:, max(start - 1, 0) * hop :][:, : heard.shape[1] * hop]
            room += heard.reshape(len(heard), -1)[:, : room.shape[1]]
            before = whole[-1:].copy()

    def _flicker(self, rng: np.random.Generator) -> Float32Array:
        """Draw the amplitude of every bin in every block, mean power one, shape (F, B)."""
        octaves = len(OCTAVES_HZ)
        kept = np.exp(-self.grid.hop / self.grid.sample_rate_hz / FLICKER_S)
        drawn = rng.standard_normal((octaves + 1, len(self.power)))
        drawn[:, 1:] *= np.sqrt(1.0 - kept**2)
        wander = self.flicker_db * scipy.signal.lfilter([1.0], [1.0, -kept], drawn)
        octave = np.log2(np.clip(self.grid.frequencies_hz, OCTAVES_HZ[0], OCTAVES_HZ[-1]) / OCTAVES_HZ[0])
        near = np.maximum(1.0 - np.abs(octave[:, None] - np.arange(octaves)), 0.0)
        # Between the middles of two octaves both contribute, and independent changes add by their squares.
        own = np.sqrt(near) @ wander[1:]
        level_db = np.sqrt(FLICKER_SHARED) * wander[0] + np.sqrt(1.0 - FLICKER_SHARED) * own
        mean = np.exp(0.5 * (self.flicker_db * np.log(10.0) / 10.0) ** 2)
        return np.asarray(np.sqrt(10.0 ** (level_db / 10.0) / mean), np.float32)

    def _steering(self) -> Complex64Array:
        phase = self.grid.frequencies_hz[:, None, None] * self.delays_s
        turned = np.exp(-2j * np.pi * phase).astype(np.complex64)
        return np.asarray(turned * self._amplitude(self.density)[:, None, None])

    def _amplitude(self, density: FloatArray) -> Float32Array:
        """Return the standard deviation of the real and of the imaginary part of a bin."""
        samples = 2 * self.grid.hop
        return np.sqrt(density * self.grid.sample_rate_hz * samples / 4.0).astype(np.float32)


def _white(shape: tuple[int, ...], rng: np.random.Generator) -> Complex64Array:
    """Draw complex normal numbers whose real and imaginary parts have unit variance."""
    # The numbers are drawn from a fixed set that samples the plane with that density. This is five times as
    # fast as the ziggurat algorithm, which took half of the time of a background. A sum of some hundred such
    # numbers has the same distribution.
    return np.asarray(_normal_plane()[rng.integers(0, NORMALS, shape, dtype=np.uint16)])


@cache
def _normal_plane() -> Complex64Array:
    """Return quantiles of the radius of complex normal numbers, each rotated by the golden angle."""
    index = np.arange(NORMALS)
    radius = np.sqrt(-2.0 * np.log((index + 0.5) / NORMALS))
    return np.asarray(radius * np.exp(1j * np.pi * (np.sqrt(5.0) - 1.0) * index), np.complex64)


ELEVATION_RAD = 0.25  # Traffic between buildings arrives from near the horizon
FAR_M, FAR_HEIGHT_M = 60.0, 1.4  # Distance of traffic in an arm, and its height below the array
FAR_OCTAVE = 3  # 500 Hz, the middle of the band of the feature
# Concentration of an opening, or of an image in rough walls: about 20 degrees. With twice as much, the empty
# windows of different sites differed more than real ones do.
OPENING_CONCENTRATION = 7.0
# Standard deviations of the rise and fall of a distant vehicle; at two of them the level is 17 dB lower.
FAR_WIDTH_S, FAR_AUDIBLE_S = (1.5, 4.0), 8.0
FAR_SPAN_S, MAX_FAR = 10.0, 512  # Time to which the rate refers; largest number of passages
FAR_DRIFT_RAD = 0.15  # Change of its direction during the rise
# Correlation time of the flicker, and the share of its variance that is common to all octaves. In real
# recordings without a hazard the loudness of a hop has a deviation of 0.77 dB, one of four bands 0.9 to 1.2
# dB, and the autocorrelation of the loudness at 0.1, 0.3, 1 s is 0.63, 0.34, 0.16. With these numbers and a
# flicker of 1.1 dB, simulated loudness has 0.75 dB and 0.70, 0.37, 0.19; without flicker 0.65 dB and 0.84,
# 0.75, 0.38.
FLICKER_S, FLICKER_SHARED = 0.12, 0.2
FLUCTUATION_STEP_S = 0.5  # Turbulence and moving sources change a distant sound in about this time
# Free turbulence falls with f^-2.2. The uncorrelated noise of a parked car's microphones is steeper, because
# screens average small eddies and a roof resonates at low frequencies. With -2.2 the bins at 94 and 188 Hz,
# at which the array cannot resolve directions, are so coherent that vehicles are less prominent than real
# ones.
WIND_SLOPE, ROOF_SLOPE = -2.2, -3.7
WIND_FLOOR_HZ, ROOF_FLOOR_HZ = 20.0, 60.0  # The density is constant below these frequencies
NOISE_BAND_HZ = 24_000.0  # Band to which the electronic noise refers


def add_background(
    out: Float32Array,
    receiver: Receiver,
    site: Site,
    preset: Preset,
    rng: np.random.Generator,
    here: Ambience,
) -> None:
    """Add the background of a street without a vehicle in an ambience, shape (M, n)."""
    grid = BlockGrid(out.shape[1], receiver.sample_rate_hz)
    azimuth = azimuths_all_round(preset.ambient_waves, rng)
    elevation = np.abs(rng.normal(0.0, ELEVATION_RAD, len(azimuth)))
    field = WaveField(
        grid,
        plane_wave_delays(azimuth, elevation, receiver) + receiver.skew_s,
        level_curve(here.octaves_db, grid.frequencies_hz),
        _Town(site, preset, here, azimuth).power(grid, rng),
        own_noise_density(preset, here, grid.frequencies_hz),
        preset.flicker_db,
    )
    field.add_to(out, rng)


def own_noise_density(preset: Preset, here: Ambience, frequencies_hz: FloatArray) -> FloatArray:
    """Return the density of a microphone's own noise, wind and electronics, Pa^2/Hz, (F,)."""
    wind = wind_density(preset.wind_100hz_db + here.wind_db, frequencies_hz, ROOF_SLOPE, ROOF_FLOOR_HZ)
    electronic = REFERENCE_PA**2 * 10.0 ** (preset.self_noise_db / 10.0) / NOISE_BAND_HZ
    return np.asarray(wind + electronic)


@dataclass(frozen=True, slots=True, eq=False)
class _Town:
    """Ambience of a site from several directions (Q,) around the array."""

    site: Site
    preset: Preset
    here: Ambience
    azimuth_rad: FloatArray

    def power(self, grid: BlockGrid, rng: np.random.Generator) -> FloatArray:
        """Return the power of every wave in every block, relative to the ambient level, shape (B, Q)."""
        sky = self.preset.sky_share
        steady = sky / len(self.azimuth_rad) + (1.0 - sky) * (self.shares @ self.lobes())
        return (steady + self.passing(grid, rng)) * self.fluctuation(grid, rng)

    @property
    def shares(self) -> FloatArray:
        """Return the power that enters by each of `OPENINGS`, shape (4,)."""
        return np.asarray(10.0 ** (self.here.openings_db / 10.0))

    def passing(self, grid: BlockGrid, rng: np.random.Generator) -> FloatArray:
        """Return the power of distant vehicles, shape (B, Q): each rises and falls in one opening."""
        preset, time = self.preset, grid.middles_s
        added = np.zeros((len(time), len(self.azimuth_rad)))
        for loudest_s in far_passages_s(preset, grid.samples / grid.sample_rate_hz, rng):
            opening = rng.choice(len(OPENINGS), p=self.shares / self.shares.sum())
            swell = np.exp(-(((time - loudest_s) / rng.uniform(*FAR_WIDTH_S)) ** 2))
            loud = 10.0 ** ((preset.far_level_db + preset.far_spread_db * rng.standard_normal()) / 10.0)
            drift = FAR_DRIFT_RAD * rng.standard_normal()
            first, last = (self.lobes(way * drift)[opening] for way in (-1.0, 1.0))
            gone = np.interp(time - loudest_s, [-FAR_WIDTH_S[1], FAR_WIDTH_S[1]], [0.0, 1.0])[:, None]
            added += loud * swell[:, None] * ((1.0 - gone) * first + gone * last)
        return added

    def fluctuation(self, grid: BlockGrid, rng: np.random.Generator) -> FloatArray:
        """Return independent fluctuations of the waves, mean power one, shape (B, Q)."""
        spread_db = self.preset.wave_fluctuation_db
        at = grid.middles_s / FLUCTUATION_STEP_S
        knots = spread_db * rng.standard_normal((int(at[-1]) + 2, len(self.azimuth_rad)))
        before, part = at.astype(int), np.mod(at, 1.0)[:, None]
        power = 10.0 ** (((1.0 - part) * knots[before] + part * knots[before + 1]) / 10.0)
        return np.asarray(power / np.exp(0.5 * (spread_db * np.log(10.0) / 10.0) ** 2))

    def lobes(self, turned_rad: float = 0.0) -> FloatArray:
        """Return the share of each direction in the sound of each of `OPENINGS`, (4, Q); rows sum to one."""
        turns = self.here.turned_rad + turned_rad
        lobes = np.stack(
            [
                np.exp(OPENING_CONCENTRATION * (np.cos(self.azimuth_rad[:, None] - at - turn) - 1.0)) @ weight
                for (at, weight), turn in zip(opening_images(self.site), turns, strict=True)
            ]
        )
        return np.asarray(lobes / lobes.sum(axis=1, keepdims=True))


def opening_images(site: Site) -> list[tuple[FloatArray, FloatArray]]:
    """Return the azimuths from which the sound of each of `OPENINGS` arrives, and their powers.

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import site
    >>> left, right, ahead, behind = opening_images(site("SA1"))
    >>> bool(left[0][left[1].argmax()] < 0.0)  # the far side wall sees deepest into an arm
    True
    """
    straight = [(np.array([direction]), np.ones(1)) for direction in (0.0, np.pi)]
    if site.is_open:  # In the open there are no reflections, and the road runs across
        return [(np.array([side]), np.ones(1)) for side in (0.5 * np.pi, -0.5 * np.pi)] + straight
    return [_arm_images(site, side) for side in (1.0, -1.0)] + straight


@lru_cache(maxsize=64)
def _arm_images(site: Site, side: float) -> tuple[FloatArray, FloatArray]:
    """Return the directions of the images of traffic far along an arm (side +1 left), and their powers."""
    paths = trace_paths(site, site.lanes_m[0], np.array([side * FAR_M]), FAR_HEIGHT_M, np.inf)
    ends = [one.receiver.sign * (one.edge_y_m[0] - one.receiver.offset_m) for one in paths]
    power = [float(one.gain[0, FAR_OCTAVE] / one.bent_m[0]) ** 2 for one in paths]
    return np.arctan2(ends, site.corner_ahead_m), np.array(power)


def shaped_noise(density: FloatArray, samples: int, rng: np.random.Generator) -> Float32Array:
    """Draw Gaussian noise with a given power spectral density, shape (samples,).

    Shapes: density (n // 2 + 1,).
    """
    n = next_fast_len(samples, real=True)
    shape = np.sqrt(density * n / 4.0).astype(np.float32)
    # The transform of white noise is white noise.
    white = rng.standard_normal(2 * len(shape), dtype=np.float32).view(np.complex64)
    return np.asarray(irfft(white * shape, n)[:samples], np.float32)


def noise_frequencies(samples: int, sample_rate_hz: float) -> FloatArray:
    """Return the bins of the density that `shaped_noise` takes."""
    return np.asarray(rfftfreq(next_fast_len(samples, real=True), 1.0 / sample_rate_hz))


def far_passages_s(preset: Preset, duration_s: float, rng: np.random.Generator) -> FloatArray:
    """Draw when distant vehicles are loudest: a Poisson process that extends beyond the recording."""
    expected = preset.far_rate * (duration_s + 2.0 * FAR_AUDIBLE_S) / FAR_SPAN_S
    return rng.uniform(-FAR_AUDIBLE_S, duration_s + FAR_AUDIBLE_S, min(int(rng.poisson(expected)), MAX_FAR))


def wind_density(
    octave_100hz_db: float,
    frequencies_hz: FloatArray,
    slope: float = WIND_SLOPE,
    floor_hz: float = WIND_FLOOR_HZ,
) -> FloatArray:
    """Return the density of wind at a microphone, Pa^2/Hz, from its level in the octave of 100 Hz."""
    at_100hz = REFERENCE_PA**2 * 10.0 ** (octave_100hz_db / 10.0) / (100.0 / np.sqrt(2.0))
    return np.asarray(at_100hz * (np.maximum(frequencies_hz, floor_hz) / 100.0) ** slope)


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """Surroundings of drawn walls or houses: plane waves from the sky and through the gaps."""

    here: Ambience
    own: np.random.Generator  # Generator that depends on the site alone
    opened: FloatArray  # shape (K,): Share of each of K equal sectors from -pi on
    sky_share: tuple[float, float] = (0.3, 0.8)
    louder_db: tuple[float, float] = (0.0, 0.0)


def direction_numbers(azimuth_rad: FloatArray, count: int) -> IndexArray:
    """Return the index of the equal sector of each azimuth in -pi to pi, shape (n,)."""
    return ((azimuth_rad + np.pi) * count / (2.0 * np.pi)).astype(np.intp) % count


WAVES, WANDER_DB, WANDER_S = 64, 2.5, 0.7
TOWN_DB, TOWN_S = 1.5, 12.0  # Common fluctuation of the whole background
OCTAVE_DB = 2.5  # Deviation of a street's spectrum from the preset's
PASSING_S, PASSING_DB = (2.0, 6.0), (-8.0, 4.0)


def add_town(
    out: Float32Array, receiver: Receiver, preset: Preset, rng: np.random.Generator, town: Town
) -> None:
    """Add the background of a street with drawn walls or houses, with distant traffic, shape (M, n)."""
    grid = BlockGrid(out.shape[1], receiver.sample_rate_hz)
    azimuth = rng.uniform(-np.pi, np.pi, WAVES)
    elevation = np.abs(rng.normal(0.0, 0.3, WAVES))
    opened = town.opened[direction_numbers(azimuth, len(town.opened))]
    by_gaps, sky, time = opened / opened.sum(), town.own.uniform(*town.sky_share), grid.middles_s
    octaves = town.here.octaves_db + OCTAVE_DB * town.own.standard_normal(len(town.here.octaves_db))
    octaves += town.own.uniform(*town.louder_db)
    wander = np.stack([_wander(time, WANDER_S, WANDER_DB, rng) for _ in azimuth], axis=1)
    power = np.broadcast_to(sky / WAVES + (1.0 - sky) * by_gaps, wander.shape).copy()
    for loudest_s in far_passages_s(preset, float(time[-1]), rng):
        side = np.exp(8.0 * (np.cos(azimuth - rng.choice(azimuth, p=by_gaps)) - 1.0))
        level = 10.0 ** (rng.uniform(*PASSING_DB) / 10.0) * side / side.sum()
        power += level * np.exp(-(((time - loudest_s) / rng.uniform(*PASSING_S)) ** 2))[:, None]
    power *= 10.0 ** ((wander + _wander(time, TOWN_S, TOWN_DB, rng)[:, None]) / 10.0)
    noise = own_noise_density(preset, town.here, grid.frequencies_hz)
    delays = plane_wave_delays(azimuth, elevation, receiver)
    density = level_curve(octaves, grid.frequencies_hz)
    WaveField(grid, delays + receiver.skew_s, density, power, noise, preset.flicker_db).add_to(out, rng)


def _wander(time_s: FloatArray, every_s: float, spread_db: float, rng: np.random.Generator) -> FloatArray:
    """Draw a level that varies by `spread_db` (standard deviation) within `every_s`, shape (B,)."""
    knots = spread_db * rng.standard_normal(int(time_s[-1] / every_s) + 2)
    return np.interp(time_s / every_s, np.arange(len(knots)), knots)
