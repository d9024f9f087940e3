"""Where a vehicle goes: a line on the ground, measured from where it comes into sight."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

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
