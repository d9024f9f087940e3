r"""Entities, ego and walls in one plane: modified polar coordinates about an anchor, and what is measured.

An entity is :math:`(\theta, \dot\theta, \rho, \log r)` about a fixed place, which is where the ego stood when
it was first observed; in Cartesian coordinates, with d the unit vector at :math:`\theta` and n that to its
left,

.. math:: p = p_0 + r\, d, \qquad v = r\,(\rho\, d + \dot\theta\, n).
"""

import math

import numpy as np

from worldstate.belief.kinematics.motion import LEAST_Q
from worldstate.ground.typing import FloatArray

# No entity comes nearer to the ego than this; at 0 bearings have no derivative.
_NEAREST_SQUARE_M2 = 0.25
# exp overflows where approach rates that contradict each other drive log r, which is not measured.
_FARTHEST_LOG_M = math.log(1e4)


def cartesian(state: FloatArray, anchor_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (x, y, vx, vy) of a polar state, and its derivative, shape (4, 4)."""
    theta, turning, closing, log_range = state.tolist()
    r = math.exp(min(log_range, _FARTHEST_LOG_M))
    x, y = r * math.cos(theta), r * math.sin(theta)
    vx, vy = closing * x - turning * y, closing * y + turning * x
    slope = np.array([[-y, 0.0, 0.0, x], [x, 0.0, 0.0, y], [-vy, -y, x, vx], [vx, x, y, vy]])
    return np.array([x + anchor_m[0], y + anchor_m[1], vx, vy]), slope


def polar(place: FloatArray, anchor_m: FloatArray) -> FloatArray:
    """Return the polar state of (x, y, vx, vy).

    Examples
    --------
    >>> here = np.array([3.0, 4.0])
    >>> state = polar(np.array([13.0, 4.0, -2.0, 1.0]), here)
    >>> state.round(3).tolist(), cartesian(state, here)[0].round(3).tolist()
    ([0.0, 0.1, -0.2, 2.303], [13.0, 4.0, -2.0, 1.0])
    """
    x, y = place[:2] - anchor_m
    vx, vy = place[2:]
    square = max(x * x + y * y, _NEAREST_SQUARE_M2)
    turning, closing = (x * vy - y * vx) / square, (x * vx + y * vy) / square
    return np.array([math.atan2(y, x), turning, closing, 0.5 * math.log(square)])


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


def in_ego_axes(place: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a place (x, y, vx, vy) in the ego's axes, and its derivatives by place and pose.

    The derivative by the pose is that by a small motion in the ego's own axes, as gtsam counts it.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[c, s, 0.0, 0.0], [-s, c, 0.0, 0.0], [0.0, 0.0, c, s], [0.0, 0.0, -s, c]])
    x, y, vx, vy = (turn @ (place - np.array([pose[0], pose[1], 0.0, 0.0]))).tolist()
    by_pose = np.array([[-1.0, 0.0, y], [0.0, -1.0, -x], [0.0, 0.0, vy], [0.0, 0.0, -vx]])
    return np.array([x, y, vx, vy]), turn, by_pose


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


def reflected_place(place: FloatArray, wall: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    r"""Return the image of a place in a wall, and its derivatives by place and wall.

    The wall is (phi, d), the line :math:`n \cdot p = d` with the normal n at azimuth phi:

    .. math:: p' = p - 2 (n \cdot p - d)\, n.

    Examples
    --------
    >>> image, _, _ = reflected_place(np.array([5.0, 2.0, 0.0, -4.0]), np.array([0.0, 8.0]))
    >>> image.round(3).tolist()
    [11.0, 2.0, 0.0, -4.0]
    """
    phi, distance = wall.tolist()
    n, t = np.array([math.cos(phi), math.sin(phi)]), np.array([-math.sin(phi), math.cos(phi)])
    flip = np.eye(2) - 2.0 * np.outer(n, n)
    p, v = place[:2], place[2:]
    image = np.concatenate([flip @ p + 2.0 * distance * n, flip @ v])
    by_phi = -2.0 * np.concatenate([(t @ p) * n + (n @ p - distance) * t, (t @ v) * n + (n @ v) * t])
    by_distance = np.concatenate([2.0 * n, [0.0, 0.0]])
    by_place = np.zeros((4, 4))
    by_place[:2, :2] = by_place[2:, 2:] = flip
    return image, by_place, np.stack([by_phi, by_distance], axis=1)
