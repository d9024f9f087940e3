"""What a stream keeps throughout: the faults of its microphones, and a background without a seam."""

from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.ambience import Ambience, recording_ambience, site_ambience
from worldstate.simulation.sound.background import add_background
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.receiver import Receiver, standing_m

from .settings import StreamSettings


@dataclass(frozen=True, slots=True, eq=False)
class Microphones:
    """Where the microphones are and how they differ."""

    positions_m: FloatArray  # shape (M, 3): In `base_link`, z above the road
    skew_s: FloatArray  # shape (M,): Phase mismatch as a delay
    gains: FloatArray  # shape (M,): About 1
    sample_rate_hz: float


def draw_microphones(
    settings: StreamSettings, array: MicrophoneArray, rng: np.random.Generator
) -> Microphones:
    """Draw what differs between the channels, once for a whole stream."""
    positions = standing_m(array)
    skew = settings.preset.delay_mismatch_s * rng.standard_normal(len(positions))
    gains = 10.0 ** (settings.preset.gain_mismatch_db * rng.standard_normal(len(positions)) / 20.0)
    return Microphones(positions, skew, gains, settings.sample_rate_hz)


# As long as a distant vehicle swells or fades: one that is cut by a piece's end would begin within a shorter
# overlap as no vehicle does (with 2 s the spectrogram showed where the pieces begin).
OVERLAP_S = 8.0


def stream_ambience(settings: StreamSettings, rng: np.random.Generator) -> Ambience:
    """Draw what a stream makes of its site's ambience, which stays the same through the stream."""
    return recording_ambience(site_ambience(settings.site, settings.preset), settings.preset, rng)


def ambience_piece(
    settings: StreamSettings,
    here: Ambience,
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
    receiver = Receiver(
        microphones.positions_m, microphones.skew_s, np.arange(2) * KNOT_SAMPLES / settings.sample_rate_hz
    )
    add_background(sound, receiver, settings.site, settings.preset, rng, here)
    rise = np.sin(0.5 * np.pi * (np.arange(overlap) + 0.5) / overlap).astype(np.float32)
    if not begins:
        sound[:, :overlap] *= rise
    sound[:, samples:] *= rise[::-1]
    return sound


def overlap_samples(settings: StreamSettings) -> int:
    """Length of a cross-fade; a drive is one piece."""
    return round(OVERLAP_S * settings.sample_rate_hz) if settings.ego.stands else 0
