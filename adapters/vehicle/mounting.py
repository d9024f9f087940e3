"""Where and how a sensor is fixed to the vehicle, in the axes of `base_link`."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.typing import FloatArray

# No vehicle carries a sensor farther from its origin; such a number was written in millimetres.
MAX_OFFSET_M = 30.0


@dataclass(frozen=True, slots=True)
class Mounting:
    r"""Pose of a sensor: position, and yaw about z, then pitch, then roll about the sensor's own axes.

    .. math:: p_{base} = t + R_z(yaw)\, R_y(-pitch)\, R_x(roll)\, p_{sensor}

    Yaw is positive to the left. Pitch is positive upwards, as the elevation of what the sensor looks at: the
    rotation about y, which points left, is its negative. Roll is positive where it lifts the left side.

    Examples
    --------
    >>> Mounting((1.0, 0.0, 1.5), yaw_deg=90.0).applied([[0.2, 0.0, 0.0]]).round(3).tolist()
    [[1.0, 0.2, 1.5]]
    >>> Mounting(pitch_deg=90.0).applied([[0.2, 0.0, 0.0]]).round(3).tolist()
    [[0.0, 0.0, 0.2]]
    >>> Mounting(roll_deg=90.0).applied([[0.0, 0.2, 0.0]]).round(3).tolist()
    [[0.0, 0.0, 0.2]]
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def __post_init__(self) -> None:
        for axis, value in zip("xyz", self.position_m, strict=True):
            in_range(f"position_m.{axis}", value, -MAX_OFFSET_M, MAX_OFFSET_M)
        in_range("yaw_deg", self.yaw_deg, -180.0, 180.0)
        in_range("pitch_deg", self.pitch_deg, -90.0, 90.0)
        in_range("roll_deg", self.roll_deg, -180.0, 180.0)

    @property
    def rotation(self) -> FloatArray:
        """From the sensor's axes to those of `base_link`, shape (3, 3)."""
        yaw, pitch, roll = (math.radians(one) for one in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        about_z = [[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
        upwards = [
            [math.cos(pitch), 0.0, -math.sin(pitch)],
            [0.0, 1.0, 0.0],
            [math.sin(pitch), 0.0, math.cos(pitch)],
        ]
        about_x = [
            [1.0, 0.0, 0.0],
            [0.0, math.cos(roll), -math.sin(roll)],
            [0.0, math.sin(roll), math.cos(roll)],
        ]
        return np.asarray(np.array(about_z) @ np.array(upwards) @ np.array(about_x))

    def applied(self, points_m: ArrayLike) -> FloatArray:
        """Return points of the sensor, shape (n, 3), in `base_link`."""
        points = finite_array("points_m", points_m, (None, 3))
        return np.asarray(points @ self.rotation.T + self.position_m)
