"""A continuous stream after everything about it is drawn and before any of it is rendered."""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import Float32Array
from worldstate.simulation.dataset.recording import FULL_SCALE_PA

from .ambience import draw_microphones, stream_ambience
from .arrivals import SoundEvent, draw_events, draw_sounds
from .rendering import Block, StreamScene, render_blocks
from .settings import StreamSettings
from .truth import VehicleTruth, vehicle_truth

ARRIVALS, CHANNELS, LEVEL, SOUNDS = 0, 1, 2, 6  # purposes of generators; 3 and 4 are the pieces'


@dataclass(frozen=True, slots=True, eq=False)
class DrawnStream:
    """Who comes when, and what hears it; its sound can be written or listened to as it is rendered."""

    scene: StreamScene
    array: MicrophoneArray
    vehicles: tuple[VehicleTruth, ...]
    sounds: tuple[SoundEvent, ...]

    def blocks(self, jobs: int = 1) -> Generator[Block, None, None]:
        """Yield its sound from the beginning."""
        return render_blocks(self.scene, [*(one.event for one in self.vehicles), *self.sounds], jobs)

    def recorded(self, block: Block) -> Float32Array:
        """Return what the converters make of a block, shape (n, M), full scale 1."""
        # Gains are the converters': they come after everything that sounds, and are in no level of the truth.
        gains = (self.scene.microphones.gains / FULL_SCALE_PA).astype(np.float32)[:, None]
        return np.asarray(np.clip(block.pressure_pa * gains, -1.0, 1.0).T)


def draw_stream(settings: StreamSettings, array: MicrophoneArray) -> DrawnStream:
    """Draw vehicles, other sounds, background and microphones of a stream, each from its own generator."""
    arrivals, drawn = settings.generator(ARRIVALS), settings
    events = draw_events(drawn.site, drawn.traffic, drawn.preset, drawn.duration_s, arrivals, drawn.ego)
    return DrawnStream(
        StreamScene(
            settings,
            stream_ambience(settings, settings.generator(LEVEL)),
            draw_microphones(settings, array, settings.generator(CHANNELS)),
        ),
        array,
        tuple(vehicle_truth(number, event, settings) for number, event in enumerate(events)),
        tuple(draw_sounds(settings, array.n_microphones, settings.generator(SOUNDS))),
    )
