"""Weather at the microphones: rain near each of them and from the whole street, gusts and wind."""

from functools import cache

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.octave_bands import REFERENCE_PA, level_curve
from worldstate.simulation.scene.settings import SoundSettings
from worldstate.simulation.sound.background import (
    ROOF_FLOOR_HZ,
    ROOF_SLOPE,
    noise_frequencies,
    shaped_noise,
    wind_density,
)
from worldstate.simulation.sound.receiver import Receiver
from worldstate.simulation.sound.static_field import StaticSources, azimuths_all_round, plane_wave_delays

from .emitter import a_weight, a_weighted
from .signals import add_ringing, bursts, gate, octave_noise

# Drops per second on the sheet metal within a hand's breadth of a microphone (assumed: moderate rain, 4
# mm/h). Each drop excites damped modes; masses have an exponential distribution.
DROPS_HZ = 40.0
MODES = ((700.0, 1.0, 0.006), (1600.0, 0.8, 0.004), (3300.0, 0.6, 0.0025), (5800.0, 0.3, 0.0015))
# Rain on paving has energy from 1 kHz up (assumed); it arrives from all azimuths and somewhat from above.
FAR_DB = (-20.0, -16.0, -12.0, -8.0, -4.0, 0.0, 2.0, 2.0)
FAR_WAVES, FAR_LIFT_RAD = 24, 0.3
FAR_SHARE = 0.3  # Share of the energy at a microphone
# Levels refer to the full band, of which a low sample rate contains only a part.
WHOLE_HZ = np.arange(1.0, 20_000.0, 5.0)
SHOWER_RAMP_S = 0.5  # Duration of the rise at the start of a shower


def add_rain(
    static: StaticSources, sound: SoundSettings, receiver: Receiver, rng: np.random.Generator
) -> None:
    """Add rain to all microphones; its level applies at each of them."""
    rate, samples = receiver.sample_rate_hz, static.out.shape[1]
    level = REFERENCE_PA * 10.0 ** ((sound.what.level_db + sound.level_offset_db) / 20.0)
    swell = _swell(samples, sound, receiver, SHOWER_RAMP_S)
    to_drops, to_street = rng.spawn(2)
    for channel, draws in zip(static.out, to_drops.spawn(len(static.out)), strict=True):
        channel += swell * _drumming(samples, rate, draws) * np.float32(level * np.sqrt(1.0 - FAR_SHARE))
    azimuth = azimuths_all_round(FAR_WAVES, to_street)
    waves = np.stack([octave_noise(FAR_DB, samples, rate, to_street) for _ in azimuth]).astype(np.float32)
    waves *= swell * np.float32(level * np.sqrt(FAR_SHARE / FAR_WAVES) / _hiss_pressure())
    lift = np.abs(to_street.normal(0.0, FAR_LIFT_RAD, FAR_WAVES))
    static.add(waves, plane_wave_delays(azimuth, lift, receiver))


def _swell(samples: int, sound: SoundSettings, receiver: Receiver, ramp_s: float) -> Float32Array:
    """Return the amplitude of a sound over time, which rises and falls within `ramp_s`."""
    begin = sound.start_s - receiver.knots_s[0]
    span = (begin, begin + sound.duration_s)
    return gate(samples, receiver.sample_rate_hz, [span], ramp_s).astype(np.float32)


def _drop(rate_hz: float) -> FloatArray:
    """Return the sound of one drop of unit strength within the band of a sample rate."""
    out = np.zeros(int(0.04 * rate_hz))
    add_ringing(out, 0.0, rate_hz, MODES)
    return out


def _drumming(samples: int, rate_hz: float, rng: np.random.Generator) -> Float32Array:
    """Draw drops at random times and of random strengths, of unit mean A-weighted pressure."""
    hits, drop = np.zeros(samples), _drop(rate_hz)
    count = int(rng.poisson(DROPS_HZ * samples / rate_hz))
    np.add.at(hits, rng.integers(samples, size=count), rng.exponential(1.0, count))
    n = next_fast_len(samples + len(drop), real=True)
    heard = irfft(rfft(hits, n) * rfft(drop, n), n)[:samples]
    # Campbell's theorem: the power of shot noise is its rate times the energy of one shot, times the mean
    # square of the strengths, which is 2 for an exponential of mean 1.
    return np.asarray(heard / np.sqrt(2.0 * DROPS_HZ * _drop_energy()), np.float32)


@cache
def _drop_energy() -> float:
    """Return the A-weighted energy of a drop of unit strength, Pa^2 s."""
    rate = 2.0 * WHOLE_HZ[-1]
    whole = a_weighted(np.pad(_drop(rate), 2048), rate)
    return float(np.square(whole).sum() / rate)


@cache
def _hiss_pressure() -> float:
    """Return the A-weighted pressure of a wave of the levels `FAR_DB`, Pa."""
    density = level_curve(np.array(FAR_DB), WHOLE_HZ) * a_weight(WHOLE_HZ) ** 2
    return float(np.sqrt(np.trapezoid(density, WHOLE_HZ)))


GUST_S, LULL_S, GUST_RAMP_S = (0.5, 2.5), (0.3, 2.0), 0.2


def add_gusts(
    static: StaticSources, sound: SoundSettings, receiver: Receiver, rng: np.random.Generator
) -> None:
    """Add independent gusts to the microphones that they hit."""
    if max(sound.channels) >= len(static.out) or min(sound.channels) < 0:
        problem = f"expected 0 to {len(static.out) - 1}, got {sound.channels}"
        raise InvalidArgumentError(f"channels of gusts: {problem}")
    rate, samples = receiver.sample_rate_hz, static.out.shape[1]
    level_db = sound.what.level_db + sound.level_offset_db
    density = wind_density(level_db, noise_frequencies(samples, rate)) * rate
    begin = sound.start_s - receiver.knots_s[0]
    for channel, draws in zip(sound.channels, rng.spawn(len(sound.channels)), strict=True):
        spans = bursts(sound.duration_s, GUST_S, LULL_S, draws)
        within = [(begin + a, begin + min(b, sound.duration_s)) for a, b in spans if a < sound.duration_s]
        blowing = gate(samples, rate, within, GUST_RAMP_S).astype(np.float32)
        static.out[channel] += blowing * shaped_noise(density, samples, draws)


def add_wind(
    static: StaticSources, sound: SoundSettings, receiver: Receiver, rng: np.random.Generator
) -> None:
    """Add one swell of wind to all microphones at once; its noise is independent at each."""
    rate, samples = receiver.sample_rate_hz, static.out.shape[1]
    level_db = sound.what.level_db + sound.level_offset_db
    density = wind_density(level_db, noise_frequencies(samples, rate), ROOF_SLOPE, ROOF_FLOOR_HZ) * rate
    # It rises for half of its duration and falls for the other half.
    swell = _swell(samples, sound, receiver, sound.duration_s)
    for channel, draws in zip(static.out, rng.spawn(len(static.out)), strict=True):
        channel += swell * shaped_noise(density, samples, draws)
