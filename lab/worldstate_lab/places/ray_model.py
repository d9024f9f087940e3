"""A plain likelihood to compare with: the mean of the spectrum where three kinds of rays arrive."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray

from .sound_paths import sound_paths
from .spatial_spectra import AZIMUTHS_RAD
from .street_walls import StreetWalls

# Constant weights of direct, bent and once reflected rays.
DIRECT, BENT, REFLECTED = 1.0, 0.5, 0.5
# Nats for a ray at the peak against one at the lowest level; of 2, 4, 8 and 16 the least error on the
# simulated passes on which the constants of our likelihood were set.
SHARPNESS = 16.0


@dataclass(frozen=True, slots=True, eq=False)
class RayModel:
    """Likelihood with constant weights; the same grid and the same filter as ours.

    Examples
    --------
    >>> model = RayModel.of(StreetWalls(4.45, 2.8, 2.8, 7.15), np.arange(-20.0, 21.0))
    >>> like, _ = model.log_likelihood(np.exp(-((AZIMUTHS_RAD - 0.3) ** 2) / 0.01))
    >>> int(model.along_m[like.argmax()])
    2
    """

    walls: StreetWalls
    along_m: FloatArray
    columns: FloatArray  # shape (G, N): Weights over azimuths

    @classmethod
    def of(cls, walls: StreetWalls, along_m: FloatArray) -> "RayModel":
        """Trace the rays from all places."""
        every, columns = np.arange(len(along_m)), np.zeros((len(AZIMUTHS_RAD), len(along_m)))
        for path in sound_paths(walls, walls.crossing_m, along_m, np.array([1000.0])):
            order = path.facades + sum(path.side_walls)
            if order <= 1:
                lit = path.passed[:, 0] >= 1.0 / 3.0
                weight = np.where(lit, REFLECTED, 0.0) if order else np.where(lit, DIRECT, BENT)
                nearest = np.abs(AZIMUTHS_RAD[:, None] - path.azimuth_rad).argmin(axis=0)
                columns[nearest, every] += weight
        return cls(walls, along_m, columns / columns.sum(axis=0))

    def log_likelihood(self, spectrum: FloatArray) -> tuple[FloatArray, float]:
        """Return the log-likelihood from every place; nobody is not a state of the plain filter."""
        level = (spectrum - spectrum.min()) / np.ptp(spectrum)
        return SHARPNESS * (level @ self.columns), -np.inf
