r"""Constant velocity in Cartesian coordinates, for entities whose position a sensor measures.

.. math:: x = (p_x,\; p_y,\; v_x,\; v_y)

The position is that in `base_link`, the velocity that over ground along the same axes: with an ego speed u
ahead, p moves by :math:`(v_x - u,\; v_y)\,dt`. The acceleration is white noise of density q, as in
filterpy's `Q_continuous_white_noise`.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from worldstate.ground.serialisation import Via
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import wrap_angle
from worldstate.measurement.position import Position

from .motion import MotionBelief, checked_covariance

# m/s: without a measured velocity a road user in town may drive at up to twice this, in any direction.
_UNKNOWN_SPEED_STD = 10.0
# Polar coordinates are singular at the array itself, and no road user comes nearer than this.
_NEAREST_M = 1.0
# rad: no sensor knows a bearing better. Its square is added to polar variances, too: a sharp position far
# away would leave a covariance that is singular to rounding, and its checkpoint would be refused.
_LEAST_STD = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class CartesianBelief:
    """Gaussian over (x, y, vx, vy), m and m/s."""

    # shape (4,)
    mean: Annotated[FloatArray, Via(FloatArray, np.asarray, lambda row: row.reshape(4))]
    # shape (4, 4): Symmetric positive definite
    covariance: Annotated[FloatArray, Via(FloatArray, np.ravel, checked_covariance)]

    @property
    def position_std_m(self) -> float:
        """Standard deviation of the position along its longest axis."""
        return _longest(self.covariance[:2, :2])

    @property
    def velocity_std_mps(self) -> float:
        """Standard deviation of the velocity along its longest axis."""
        return _longest(self.covariance[2:, 2:])


def at_position(position: Position) -> CartesianBelief:
    """Return the belief of an object that a first measurement places."""
    measured, noise = full_measurement(position, _UNKNOWN_SPEED_STD)
    return CartesianBelief(measured, noise)


def full_measurement(position: Position, speed_std_mps: float) -> tuple[FloatArray, FloatArray]:
    """Return a measurement of all four components, an unknown velocity as 0 with a wide deviation."""
    noise = np.diag([0.0, 0.0, speed_std_mps**2, speed_std_mps**2])
    known = len(position.covariance)
    noise[:known, :known] = position.covariance
    return np.array([*position.position_m, *(position.velocity_mps or (0.0, 0.0))]), noise


def predict_place(
    belief: CartesianBelief, step_s: float, acceleration_psd: float, ego_speed_mps: float
) -> CartesianBelief:
    r"""Return the belief after `step_s` of constant velocity and white acceleration (m^2/s^3).

    .. math:: m \leftarrow F m - (u\,dt, 0, 0, 0), \quad P \leftarrow F P F^T + Q
    """
    flow = np.eye(4)
    flow[0, 2] = flow[1, 3] = step_s
    q, t = acceleration_psd, step_s
    block = np.array([[q * t**3 / 3.0, q * t**2 / 2.0], [q * t**2 / 2.0, q * t]])
    mean = flow @ belief.mean
    mean[0] -= ego_speed_mps * step_s
    return _belief(mean, flow @ belief.covariance @ flow.T + np.kron(block, np.eye(2)))


def update_position(belief: CartesianBelief, position: Position) -> CartesianBelief:
    """Return the belief after a position, and a velocity where that was measured."""
    known = len(position.covariance)
    measured = np.array([*position.position_m, *(position.velocity_mps or ())])
    return _update(belief, measured - belief.mean[:known], np.eye(4)[:known], np.array(position.covariance))


def update_bearing(belief: CartesianBelief, azimuth_rad: float, std_rad: float) -> CartesianBelief:
    r"""Return the belief after a bearing, by an extended Kalman filter with h(x) = atan2(y, x).

    .. math:: H = (-y,\; x,\; 0,\; 0) / r^2
    """
    x, y = belief.mean[:2].tolist()
    square = max(x * x + y * y, _NEAREST_M**2)
    residual = wrap_angle(azimuth_rad - math.atan2(y, x))
    slope = np.array([[-y / square, x / square, 0.0, 0.0]])
    return _update(belief, np.array([residual]), slope, np.array([[max(std_rad, _LEAST_STD) ** 2]]))


def polar_motion(belief: CartesianBelief, ego_speed_mps: float) -> MotionBelief:
    """Return the belief in modified polar coordinates, to first order."""
    x, y, vx, vy = belief.mean.tolist()
    vx -= ego_speed_mps
    r = math.hypot(x, y)
    if r < _NEAREST_M:
        x, y = (_NEAREST_M * x / r, _NEAREST_M * y / r) if r > 0.0 else (_NEAREST_M, 0.0)
    square = x * x + y * y
    cosine, sine = x / square, y / square
    turning, closing = vy * cosine - vx * sine, vx * cosine + vy * sine
    # In complex numbers d log z = dz / z, so that log r and theta, rho and theta_dot share their derivatives.
    slope = np.array(
        [
            [-sine, cosine, 0.0, 0.0],
            [
                vy / square - 2.0 * cosine * turning,
                -vx / square - 2.0 * sine * turning,
                -sine,
                cosine,
            ],
            [vx / square - 2.0 * cosine * closing, vy / square - 2.0 * sine * closing, cosine, sine],
            [cosine, sine, 0.0, 0.0],
        ]
    )
    covariance = slope @ belief.covariance @ slope.T + _LEAST_STD**2 * np.eye(4)
    mean = np.array([math.atan2(y, x), turning, closing, 0.5 * math.log(square)])
    return MotionBelief(mean, 0.5 * (covariance + covariance.T))


def _update(
    belief: CartesianBelief, residual: FloatArray, slope: FloatArray, noise: FloatArray
) -> CartesianBelief:
    """Return the belief after a measurement, in Joseph's form, which rounding leaves positive definite."""
    spread = slope @ belief.covariance
    gain = np.linalg.solve(spread @ slope.T + noise, spread).T
    keep = np.eye(4) - gain @ slope
    covariance = keep @ belief.covariance @ keep.T + gain @ noise @ gain.T
    return _belief(belief.mean + gain @ residual, covariance)


def _belief(mean: FloatArray, covariance: FloatArray) -> CartesianBelief:
    return CartesianBelief(mean, 0.5 * (covariance + covariance.T))


def _longest(covariance: FloatArray) -> float:
    """Return the square root of the larger eigenvalue of a covariance, shape (2, 2)."""
    a, b, c = covariance[0, 0], covariance[1, 1], covariance[0, 1]
    return math.sqrt(0.5 * (a + b) + math.hypot(0.5 * (a - b), c))
