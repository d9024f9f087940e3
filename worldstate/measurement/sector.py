"""Azimuth sectors that a co-evidence channel is asked about."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from worldstate.ground import FloatArray, wrap_angle

from .measurement import Side


@dataclass(frozen=True, slots=True)
class Sector:
    """A range of azimuths.

    Parameters
    ----------
    centre_rad, half_width_rad : float
        In `base_link`, left positive.

    Examples
    --------
    >>> Sector(0.0, 0.2).touches(0.25, width_rad=0.12), Sector(0.0, 0.2).touches(0.3)
    (True, False)
    """

    centre_rad: float
    half_width_rad: float

    def touches(self, azimuth_rad: float, width_rad: float = 0.0) -> bool:
        """Tell whether an object of this width, centred there, reaches into the sector."""
        return abs(wrap_angle(azimuth_rad - self.centre_rad)) <= self.half_width_rad + width_rad / 2

    def overlap(self, other: "Sector") -> "Sector | None":
        """Return the intersection with another sector, None where empty; less than a full turn together."""
        offset = wrap_angle(self.centre_rad - other.centre_rad)
        low = max(offset - self.half_width_rad, -other.half_width_rad)
        high = min(offset + self.half_width_rad, other.half_width_rad)
        if high <= low:
            return None
        return Sector(wrap_angle(other.centre_rad + (low + high) / 2), (high - low) / 2)

    def midpoints(self, n: int) -> FloatArray:
        """Return the centres of n equal parts, radians, shape (n,), not wrapped."""
        return self.centre_rad + self.half_width_rad * ((2.0 * np.arange(n) + 1.0) / n - 1.0)

    @classmethod
    def between(cls, right_rad: float, left_rad: float) -> "Sector":
        """Return the sector that runs from `right_rad` to the left until `left_rad`."""
        half = (left_rad - right_rad) % (2.0 * math.pi) / 2.0
        return cls(wrap_angle(right_rad + half), half)

    @classmethod
    def in_sight(cls, edges_rad: Iterable[float]) -> "Sector":
        """Return the directions ahead that occluders with these edges leave free.

        Examples
        --------
        >>> sector = Sector.in_sight([0.56, -0.56])
        >>> sector.touches(0.5), sector.touches(0.7)
        (True, False)
        """
        edges = tuple(edges_rad)
        left = min((edge for edge in edges if edge > 0), default=math.pi / 2)
        right = max((edge for edge in edges if edge < 0), default=-math.pi / 2)
        return cls.between(right, left)


# Ahead only: the front-end's default grid ends at 90 deg, and so do the views of the cameras asked.
WHOLE_SIDES: dict[Side | None, Sector] = {
    "left": Sector(math.pi / 4, math.pi / 4),
    "right": Sector(-math.pi / 4, math.pi / 4),
    None: Sector(0.0, math.pi / 2),
}
