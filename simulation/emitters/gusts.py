"""Gusts: turbulence at one to three microphones, on and off within seconds."""

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation.scene.sound_settings import SoundSettings
from worldstate.simulation.sound.background import noise_frequencies, shaped_noise, wind_density
from worldstate.simulation.sound.receiver import Receiver
from worldstate.simulation.sound.static_field import StaticSources

from .signals import bursts, gate

GUST_S, LULL_S, RAMP_S = (0.5, 2.5), (0.3, 2.0), 0.2


def add_gusts(
    static: StaticSources, sound: SoundSettings, receiver: Receiver, rng: np.random.Generator
) -> None:
    """Add gusts to the microphones that they hit, to each of them by itself."""
    if max(sound.channels) >= len(static.out) or min(sound.channels) < 0:
        raise InvalidArgumentError(
            f"channels of gusts: expected 0 to {len(static.out) - 1}, got {sound.channels}"
        )
    rate, samples = receiver.sample_rate_hz, static.out.shape[1]
    level_db = sound.what.level_db + sound.level_offset_db
    density = wind_density(level_db, noise_frequencies(samples, rate)) * rate
    begin = sound.start_s - receiver.knots_s[0]
    for channel, draws in zip(sound.channels, rng.spawn(len(sound.channels)), strict=True):
        spans = bursts(sound.duration_s, GUST_S, LULL_S, draws)
        within = [(begin + a, begin + min(b, sound.duration_s)) for a, b in spans if a < sound.duration_s]
        blowing = gate(samples, rate, within, RAMP_S).astype(np.float32)
        static.out[channel] += blowing * shaped_noise(density, samples, draws, 1)[0]
