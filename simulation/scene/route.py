"""Ways on the ground: the route of a vehicle, from where it comes into sight, and the street of the ego."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import in_range
from worldstate.ground.typing import FloatArray

FAR_M = 600.0  # a route goes on straight this far at both ends
TURN_RADIUS_M = 3.5
LANE_FROM_MIDDLE_M = 1.2  # where a vehicle drives that turned into the ego's street
STOP_AHEAD_M = 3.0  # it stops here: the ego is in its way
ARC_STEPS = 24


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A polyline, parametrised by the distance driven; 0 is where line of sight begins."""

    driven_m: FloatArray  # shape (N,): Increasing
    points_m: FloatArray  # shape (N, 2): Positions there, x ahead and y left

    def at(self, driven_m: float | FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y after some distance, shape of `driven_m`."""
        along = np.asarray(driven_m)
        x, y = (np.interp(along, self.driven_m, column) for column in self.points_m.T)
        return np.asarray(x), np.asarray(y)


def along(points_m: ArrayLike, entry_m: float = 0.0) -> Route:
    """Return the route through `points_m` (N, 2), with 0 at `entry_m` after the first point.

    Examples
    --------
    >>> route = along([[6.0, 10.0], [6.0, -10.0]], entry_m=4.0)
    >>> [float(v) for v in route.at(2.0)]
    [6.0, 4.0]
    """
    points = np.asarray(points_m, dtype=np.float64)
    first, last = points[0] - points[1], points[-1] - points[-2]
    ahead = points[-1] + FAR_M * last / np.hypot(*last)
    behind = points[0] + FAR_M * first / np.hypot(*first)
    whole = np.concatenate([[behind], points, [ahead]])
    steps = np.hypot(*np.diff(whole, axis=0).T)
    return Route(np.r_[0.0, np.cumsum(steps)] - FAR_M - entry_m, whole)


def turn_in(lane_x_m: float, entry_y_m: float) -> tuple[Route, float]:
    """Return the route of a vehicle that turns into the ego's street, and how far it can drive.

    Examples
    --------
    >>> route, end = turn_in(8.0, 4.7)
    >>> [round(float(v), 2) for v in route.at(end)]
    [3.0, 1.2]
    """
    # It keeps to its right and stops before the ego.
    side = 1.0 if entry_y_m > 0 else -1.0
    begin_y = LANE_FROM_MIDDLE_M + side * TURN_RADIUS_M
    angle = np.linspace(0.0, 0.5 * np.pi, ARC_STEPS)
    arc_x = lane_x_m - TURN_RADIUS_M * (1.0 - np.cos(angle))
    arc_y = begin_y - side * TURN_RADIUS_M * np.sin(angle)
    start = max(abs(entry_y_m), abs(begin_y)) + 1.0
    points = np.concatenate([[[lane_x_m, side * start]], np.column_stack([arc_x, arc_y])])
    points = np.concatenate([points, [[min(STOP_AHEAD_M, arc_x[-1] - 0.1), LANE_FROM_MIDDLE_M]]])
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    entry = start - abs(entry_y_m)
    return along(points, entry), length - entry


BRAKING_MPS2 = 2.5
ARRAY_HEIGHT_M = 1.7  # origin of `base_link` above the road: the array's centre on the roof


@dataclass(frozen=True, slots=True)
class EgoMotion:
    """An ego that drives along its street at a constant speed, brakes and stops at the origin.

    Parameters
    ----------
    speed_mps : float
        Before braking; 0 for an ego that stands all the time.
    stop_s : float
        When it comes to stand.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> ego = EgoMotion(5.0, 8.0)
    >>> ego.x_m(np.array([5.0, 7.0, 9.0])), ego.at_mps(np.array([5.0, 7.0, 9.0]))
    (array([-10.  ,  -1.25,   0.  ]), array([5. , 2.5, 0. ]))
    """

    speed_mps: float = 0.0
    stop_s: float = 0.0

    def __post_init__(self) -> None:
        in_range("speed_mps", self.speed_mps, 0.0, 20.0)
        in_range("stop_s", self.stop_s, 0.0, 120.0)

    @property
    def stands(self) -> bool:
        """Whether it never moves."""
        return self.speed_mps == 0.0

    def later(self, start_s: float) -> "EgoMotion":
        """Return the same motion on a clock that begins so much later; it stands if it has stopped by then.

        Examples
        --------
        >>> EgoMotion(5.0, 8.0).later(-2.0).stop_s, EgoMotion(5.0, 8.0).later(9.0).stands
        (10.0, True)
        """
        left_s = self.stop_s - start_s
        return replace(self, stop_s=left_s) if left_s > 0.0 else EgoMotion()

    def at_mps(self, time_s: FloatArray) -> FloatArray:
        """Speed at any time, same shape as `time_s`."""
        return np.clip(BRAKING_MPS2 * (self.stop_s - time_s), 0.0, self.speed_mps)

    def x_m(self, time_s: FloatArray) -> FloatArray:
        """Position along the street, 0 where it stops, same shape as `time_s`."""
        left = np.maximum(self.stop_s - time_s, 0.0)
        braking = np.minimum(left, self.speed_mps / BRAKING_MPS2)
        return np.asarray(0.0 - 0.5 * BRAKING_MPS2 * braking**2 - self.speed_mps * (left - braking))
