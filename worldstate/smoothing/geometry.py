r"""Entities in the plane of an ego that stands: modified polar coordinates, and what is measured.

An entity is :math:`(\theta, \dot\theta, \rho, \log r)` about the ego; in Cartesian coordinates, with d the
unit vector at :math:`\theta` and n that to its left,

.. math:: p = r\, d, \qquad v = r\,(\rho\, d + \dot\theta\, n).
"""

import math

import numpy as np

from worldstate.belief.kinematics.motion import LEAST_Q
from worldstate.ground.typing import FloatArray

# No entity comes nearer to the ego than this; at 0 bearings have no derivative.
_NEAREST_SQUARE_M2 = 0.25
# exp overflows where approach rates that contradict each other drive log r, which is not measured.
_FARTHEST_LOG_M = math.log(1e4)


def cartesian(state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (x, y, vx, vy) of a polar state, and its derivative, shape (4, 4)."""
    theta, turning, closing, log_range = state.tolist()
    r = math.exp(min(log_range, _FARTHEST_LOG_M))
    x, y = r * math.cos(theta), r * math.sin(theta)
    vx, vy = closing * x - turning * y, closing * y + turning * x
    slope = np.array([[-y, 0.0, 0.0, x], [x, 0.0, 0.0, y], [-vy, -y, x, vx], [vx, x, y, vy]])
    return np.array([x, y, vx, vy]), slope


def moved(state: FloatArray, step_s: float) -> FloatArray:
    """Return a polar state after so many seconds of constant velocity, its azimuth not wrapped.

    Examples
    --------
    >>> moved(np.array([6.0, 0.0, -0.1, 2.0]), 1.0).round(3).tolist()
    [6.0, 0.0, -0.111, 1.895]
    """
    theta, turning, closing, log_m = state.tolist()
    # The filter's `propagate` takes the same steps for arrays, and forty times as long for one entity.
    a, b = 1.0 + closing * step_s, turning * step_s
    q = max(a * a + b * b, LEAST_Q)
    radial = (a * closing + b * turning) / q
    return np.array([theta + math.atan2(b, a), turning / q, radial, log_m + 0.5 * math.log(q)])


def azimuth(place: FloatArray) -> tuple[float, FloatArray]:
    """Return the azimuth of a place, and its derivative by (x, y, vx, vy)."""
    x, y = place[:2].tolist()
    square = max(x * x + y * y, _NEAREST_SQUARE_M2)
    return math.atan2(y, x), np.array([[-y / square, x / square, 0.0, 0.0]])


def closing_rate(place: FloatArray) -> tuple[float, FloatArray]:
    """Return 1/TTA = -r_dot/r of a place and its relative velocity, and its derivative."""
    x, y, vx, vy = place.tolist()
    square = max(x * x + y * y, _NEAREST_SQUARE_M2)
    rate = -(x * vx + y * vy) / square
    slope = np.array([[-vx - 2.0 * x * rate, -vy - 2.0 * y * rate, -x, -y]]) / square
    return rate, slope


def log_range(place: FloatArray) -> tuple[float, FloatArray]:
    """Return the logarithm of the distance, and its derivative."""
    x, y = place[:2].tolist()
    square = max(x * x + y * y, _NEAREST_SQUARE_M2)
    return 0.5 * math.log(square), np.array([[x / square, y / square, 0.0, 0.0]])
