"""The background of a stream, piece by piece, without a seam."""

from dataclasses import replace

import numpy as np

from worldstate.adapters.simulation.scene.presets import Preset
from worldstate.adapters.simulation.sound.background import add_background
from worldstate.adapters.simulation.sound.static_field import StaticSources
from worldstate.ground.typing import Float32Array

from .microphones import Microphones
from .settings import StreamSettings

# As long as a distant vehicle swells or fades: one that is cut by a piece's end would begin within a shorter
# overlap as no vehicle does (with 2 s the spectrogram showed where the pieces begin).
OVERLAP_S = 8.0


def stream_preset(settings: StreamSettings, rng: np.random.Generator) -> Preset:
    """Draw the level of the ambience, which stays the same through the stream."""
    own = settings.preset
    octaves = np.array(own.ambient_octaves_db) + own.ambient_spread_db * rng.standard_normal()
    return replace(own, ambient_octaves_db=tuple(octaves.tolist()), ambient_spread_db=0.0)


def ambience_piece(
    settings: StreamSettings,
    preset: Preset,
    microphones: Microphones,
    samples: int,
    rng: np.random.Generator,
    *,
    begins: bool,
) -> Float32Array:
    """Render background, shape (M, samples + overlap), faded at both ends; not where the stream begins."""
    # Neighbouring pieces know nothing of each other: where the squares of their fades add up to one, the
    # power stays the same. A fade of amplitudes would leave a dip of 3 dB in the middle.
    overlap = overlap_samples(settings)
    sound = np.zeros((len(microphones.positions_m), samples + overlap), np.float32)
    static = StaticSources(sound, settings.sample_rate_hz)
    add_background(static, settings.site, preset, microphones.positions_m, rng)
    static.render()
    rise = np.sin(0.5 * np.pi * (np.arange(overlap) + 0.5) / overlap).astype(np.float32)
    if not begins:
        sound[:, :overlap] *= rise
    sound[:, samples:] *= rise[::-1]
    return sound


def overlap_samples(settings: StreamSettings) -> int:
    """Length of a cross-fade."""
    return round(OVERLAP_S * settings.sample_rate_hz)
