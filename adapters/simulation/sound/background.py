"""What an empty street sounds like: coherent anisotropic ambience, distant traffic, wind and noise."""

import numpy as np
from scipy.fft import irfft, next_fast_len, rfftfreq

from worldstate.adapters.simulation.scene.junction import Site, site_generator
from worldstate.adapters.simulation.scene.octave_bands import REFERENCE_PA, level_curve
from worldstate.adapters.simulation.scene.presets import Preset
from worldstate.ground.typing import Float32Array, FloatArray

from .static_field import StaticSources, plane_wave_delays

FLUCTUATION_STEP_S = 1.0
LOBES = 3
# A distant vehicle swells and fades with these standard deviations; two of them off it is 17 dB down.
FAR_WIDTH_S, FAR_AUDIBLE_S = (1.5, 4.0), 8.0
FAR_SPAN_S, MAX_FAR = 10.0, 16  # the rate is that in so many seconds
WIND_SLOPE = -2.2
WIND_FLOOR_HZ = 20.0  # below, wind stays as it is there


def add_background(
    out: Float32Array,
    static: StaticSources,
    site: Site,
    preset: Preset,
    positions_m: FloatArray,
    sample_rate_hz: float,
    rng: np.random.Generator,
) -> None:
    """Add everything that a street without a vehicle sounds like.

    Shapes: out (M, n), positions_m (M, 3).
    """
    offsets = positions_m - positions_m.mean(axis=0)
    level_db = np.array(preset.ambient_octaves_db) + preset.ambient_spread_db * rng.standard_normal()
    azimuth, power = ambient_directions(site, preset, rng)
    waves = _ambient_waves(power, level_db, preset, out.shape[1], sample_rate_hz, rng)
    static.add(waves, plane_wave_delays(unit_vectors(azimuth, rng), offsets))
    far_db = level_db + preset.far_level_db
    for loudest_s in far_passages_s(preset, out.shape[1] / sample_rate_hz, rng):
        static.add(*_far_vehicle(loudest_s, out.shape[1], far_db, offsets, sample_rate_hz, rng))
    _add_channel_noise(out, preset, sample_rate_hz, rng)


def ambient_directions(site: Site, preset: Preset, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Azimuths of the ambient waves and their shares of the power, shape (Q,) each."""
    # A site has loud directions of its own; a recording shifts them a little.
    azimuth = 2.0 * np.pi * (np.arange(preset.ambient_waves) + rng.random()) / preset.ambient_waves
    fixed = site_generator(site.name, "ambient")
    centres = fixed.uniform(-np.pi, np.pi, LOBES) + 0.1 * rng.standard_normal(LOBES)
    weights = fixed.dirichlet(np.ones(LOBES))
    lobes = np.exp(preset.lobe_concentration * (np.cos(azimuth[:, None] - centres) - 1.0))
    shaped = (lobes / lobes.sum(axis=0)) @ weights
    return azimuth, preset.lobe_share * shaped + (1.0 - preset.lobe_share) / preset.ambient_waves


def unit_vectors(azimuth_rad: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Directions with a small random elevation, as traffic between buildings has, shape (Q, 3)."""
    elevation = np.abs(rng.normal(0.0, 0.2, len(azimuth_rad)))
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.sin(elevation)], axis=1)


def shaped_noise(density: FloatArray, samples: int, rng: np.random.Generator, channels: int) -> Float32Array:
    """Gaussian noise with a given power spectral density.

    Shapes: density (n // 2 + 1,).
    """
    n = next_fast_len(samples, real=True)
    shape = np.sqrt(density * n / 4.0).astype(np.float32)
    noise = np.empty((channels, samples), np.float32)
    for channel in noise:
        # The transform of white noise is white noise.
        white = rng.standard_normal(2 * len(shape), dtype=np.float32).view(np.complex64)
        channel[:] = irfft(white * shape, n)[:samples]
    return noise


def noise_frequencies(samples: int, sample_rate_hz: float) -> FloatArray:
    """Bins at which `shaped_noise` wants its density."""
    return np.asarray(rfftfreq(next_fast_len(samples, real=True), 1.0 / sample_rate_hz))


def _ambient_waves(
    power: FloatArray,
    level_db: FloatArray,
    preset: Preset,
    samples: int,
    rate: float,
    rng: np.random.Generator,
) -> Float32Array:
    density = level_curve(level_db, noise_frequencies(samples, rate)) * rate
    waves = shaped_noise(density, samples, rng, len(power))
    knots = np.arange(0.0, samples / rate + 2.0 * FLUCTUATION_STEP_S, FLUCTUATION_STEP_S)
    time = np.arange(samples) / rate
    for wave, share in zip(waves, power, strict=True):
        wander_db = preset.wave_fluctuation_db * rng.standard_normal(len(knots))
        wave *= np.interp(time, knots, np.sqrt(share) * 10.0 ** (wander_db / 20.0)).astype(np.float32)
    return waves


def far_passages_s(preset: Preset, duration_s: float, rng: np.random.Generator) -> FloatArray:
    """Draw when distant vehicles are loudest, a Poisson process that knows nothing of a recording's ends."""
    expected = preset.far_rate * (duration_s + 2.0 * FAR_AUDIBLE_S) / FAR_SPAN_S
    number = min(int(rng.poisson(expected)), MAX_FAR)
    return rng.uniform(-FAR_AUDIBLE_S, duration_s + FAR_AUDIBLE_S, number)


def _far_vehicle(
    loudest_s: float,
    samples: int,
    level_db: FloatArray,
    offsets_m: FloatArray,
    rate: float,
    rng: np.random.Generator,
) -> tuple[Float32Array, FloatArray]:
    """Draw a vehicle some streets away: one direction, one facade reflection, gone in seconds."""
    noise = shaped_noise(level_curve(level_db, noise_frequencies(samples, rate)) * rate, samples, rng, 1)
    time = np.arange(samples) / rate
    noise *= np.exp(-0.5 * ((time - loudest_s) / rng.uniform(*FAR_WIDTH_S)) ** 2).astype(np.float32)
    echo = np.roll(noise, int(rng.uniform(0.01, 0.05) * rate)) * np.float32(rng.uniform(0.3, 0.8))
    directions = unit_vectors(rng.uniform(-np.pi, np.pi, 2), rng)
    return np.concatenate([noise, echo]), plane_wave_delays(directions, offsets_m)


def _add_channel_noise(out: Float32Array, preset: Preset, rate: float, rng: np.random.Generator) -> None:
    """Add wind and electronic noise: every microphone by itself."""
    frequencies = noise_frequencies(out.shape[1], rate)
    wind_density = REFERENCE_PA**2 * 10.0 ** (preset.wind_100hz_db / 10.0) / (100.0 / np.sqrt(2.0))
    wind = wind_density * (np.maximum(frequencies, WIND_FLOOR_HZ) / 100.0) ** WIND_SLOPE
    electronic = REFERENCE_PA**2 * 10.0 ** (preset.self_noise_db / 10.0) / (rate / 2.0)
    for channel in out:
        channel += shaped_noise((wind + electronic) * rate, out.shape[1], rng, 1)[0]
