"""What the sound of a moving source meets on its way."""

from dataclasses import dataclass, field

import numpy as np

from worldstate.adapters.simulation.scene.junction import Site
from worldstate.adapters.simulation.scene.octave_bands import OCTAVES_HZ
from worldstate.ground.typing import FloatArray

from .receiver import Receiver


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Walls and bodies between the sources and the microphones, and what they do to sound."""

    site: Site
    receiver: Receiver
    cap_db: float  # Largest screen attenuation
    # shape (8,): Share of the energy that rough walls scatter instead of mirroring it, per octave.
    scattering: FloatArray = field(default_factory=lambda: np.zeros(len(OCTAVES_HZ)))
    outdoors: bool = False  # Whether air and road change the sound
