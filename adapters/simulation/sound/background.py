"""What an empty street sounds like: coherent anisotropic ambience, distant traffic, wind and noise."""

import numpy as np
from scipy.fft import irfft, next_fast_len, rfftfreq

from worldstate.adapters.simulation.scene.junction import Site, site_generator
from worldstate.adapters.simulation.scene.octave_bands import REFERENCE_PA, level_curve
from worldstate.adapters.simulation.scene.presets import Preset
from worldstate.ground.typing import Float32Array, FloatArray

from .static_field import StaticSources, plane_wave_delays, unit_vectors

FLUCTUATION_STEP_S = 1.0
LOBES = 3
# A distant vehicle swells and fades with these standard deviations; two of them off it is 17 dB down.
FAR_WIDTH_S, FAR_AUDIBLE_S = (1.5, 4.0), 8.0
FAR_SPAN_S, MAX_FAR = 10.0, 16  # the rate is that in so many seconds
WIND_SLOPE = -2.2
WIND_FLOOR_HZ = 20.0  # below, wind stays as it is there


def add_background(
    static: StaticSources, site: Site, preset: Preset, positions_m: FloatArray, rng: np.random.Generator
) -> None:
    """Add everything that a street without a vehicle sounds like.

    Shapes: positions_m (M, 3).
    """
    offsets = positions_m - positions_m.mean(axis=0)
    level_db = np.array(preset.ambient_octaves_db) + preset.ambient_spread_db * rng.standard_normal()
    azimuth, power = ambient_directions(site, preset, rng)
    waves = _octave_noise(static, level_db, rng, len(power))
    time = np.arange(waves.shape[1]) / static.sample_rate_hz
    duration_s = waves.shape[1] / static.sample_rate_hz
    knots = np.arange(0.0, duration_s + 2.0 * FLUCTUATION_STEP_S, FLUCTUATION_STEP_S)
    for wave, share in zip(waves, power, strict=True):
        wander_db = preset.wave_fluctuation_db * rng.standard_normal(len(knots))
        wave *= np.interp(time, knots, np.sqrt(share) * 10.0 ** (wander_db / 20.0)).astype(np.float32)
    static.add(waves, plane_wave_delays(_low_directions(azimuth, rng), offsets))
    for loudest_s in far_passages_s(preset, duration_s, rng):
        # A vehicle some streets away: one direction, one facade reflection, gone in seconds.
        noise = _octave_noise(static, level_db + preset.far_level_db, rng, 1)
        noise *= np.exp(-0.5 * ((time - loudest_s) / rng.uniform(*FAR_WIDTH_S)) ** 2).astype(np.float32)
        echo = np.roll(noise, int(rng.uniform(0.01, 0.05) * static.sample_rate_hz))
        echo *= np.float32(rng.uniform(0.3, 0.8))
        directions = _low_directions(rng.uniform(-np.pi, np.pi, 2), rng)
        static.add(np.concatenate([noise, echo]), plane_wave_delays(directions, offsets))
    _add_channel_noise(static, preset, rng)


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


def _low_directions(azimuth_rad: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Directions with a small random elevation, as traffic between buildings has, shape (Q, 3)."""
    return unit_vectors(azimuth_rad, np.abs(rng.normal(0.0, 0.2, len(azimuth_rad))))


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


def _octave_noise(
    static: StaticSources, level_db: FloatArray, rng: np.random.Generator, channels: int
) -> Float32Array:
    """Noise of given octave levels (8,), as long as the recording."""
    samples, rate = static.out.shape[1], static.sample_rate_hz
    density = level_curve(level_db, noise_frequencies(samples, rate)) * rate
    return shaped_noise(density, samples, rng, channels)


def far_passages_s(preset: Preset, duration_s: float, rng: np.random.Generator) -> FloatArray:
    """Draw when distant vehicles are loudest, a Poisson process that knows nothing of a recording's ends."""
    expected = preset.far_rate * (duration_s + 2.0 * FAR_AUDIBLE_S) / FAR_SPAN_S
    number = min(int(rng.poisson(expected)), MAX_FAR)
    return rng.uniform(-FAR_AUDIBLE_S, duration_s + FAR_AUDIBLE_S, number)


def wind_density(octave_100hz_db: float, frequencies_hz: FloatArray) -> FloatArray:
    """Power spectral density of wind at a microphone, Pa^2/Hz, from its level in the octave of 100 Hz."""
    at_100hz = REFERENCE_PA**2 * 10.0 ** (octave_100hz_db / 10.0) / (100.0 / np.sqrt(2.0))
    return np.asarray(at_100hz * (np.maximum(frequencies_hz, WIND_FLOOR_HZ) / 100.0) ** WIND_SLOPE)


def _add_channel_noise(static: StaticSources, preset: Preset, rng: np.random.Generator) -> None:
    """Add wind and electronic noise: every microphone by itself."""
    samples, rate = static.out.shape[1], static.sample_rate_hz
    wind = wind_density(preset.wind_100hz_db, noise_frequencies(samples, rate))
    electronic = REFERENCE_PA**2 * 10.0 ** (preset.self_noise_db / 10.0) / (rate / 2.0)
    for channel in static.out:
        channel += shaped_noise((wind + electronic) * rate, samples, rng, 1)[0]
