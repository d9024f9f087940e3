"""What the sound of a moving source meets on its way."""

from dataclasses import dataclass, field

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ, smooth_step

from .receiver import Receiver

# Behind the corners both descriptions of a source between them agree, so the length matters little.
MOUTH_BLEND_M = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Walls and bodies between the sources and the microphones, and what they do to sound."""

    site: Site
    receiver: Receiver
    cap_db: float  # Largest screen attenuation
    # shape (8,): Share of the energy that rough walls scatter instead of mirroring it, per octave.
    scattering: FloatArray = field(default_factory=lambda: np.zeros(len(OCTAVES_HZ)))
    outdoors: bool = False  # Whether air and road change the sound

    def scattered(self, beyond_mouth: bool) -> FloatArray:
        """Share that the crossing street's facades, or the side walls, scatter, shape (8,)."""
        return np.minimum(self.scattering * self.site.roughness[int(beyond_mouth)], 1.0)


def in_own_street(site: Site, x_m: float | FloatArray, y_m: FloatArray) -> FloatArray:
    """1 where a source stands between the side walls of the ego's street, 0 beyond its mouth, shape (T,).

    Examples
    --------
    >>> plan = Site("SA1", 2.8, 2.8, 4.0, 10.0, 3.0, 3.0, 6.0)
    >>> in_own_street(plan, np.array([8.0, 3.0, -20.0, -20.0]), np.array([0.0, 0.0, 2.9, 9.0]))
    array([0., 1., 1., 0.])
    """
    before = smooth_step(np.asarray(site.corner_ahead_m - x_m) / MOUTH_BLEND_M)
    gap = np.minimum(site.side_wall_left_m - y_m, y_m + site.side_wall_right_m)
    return np.asarray(before * smooth_step(1.0 + gap / MOUTH_BLEND_M))
