"""The microphones of a stream: their places and the faults that they keep through it."""

from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import FloatArray
from worldstate.simulation.sound.receiver import standing_m

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
