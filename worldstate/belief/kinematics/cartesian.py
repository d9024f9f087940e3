r"""Constant velocity in Cartesian coordinates: entities with a measured position, and the ego vehicle.

.. math:: x = (p_x,\; p_y,\; v_x,\; v_y)

The position is in `base_link`; the velocity is over ground, along the same axes. With an ego speed u ahead, p
changes by :math:`(v_x - u,\; v_y)\,dt`; if the ego vehicle turns, both turn the other way. The acceleration
is white noise of density q, as in filterpy's `Q_continuous_white_noise`.

The ego vehicle is dead-reckoned along arcs and corrected by a localiser. With speed v and yaw rate omega, the
chord after a time t is

.. math:: \Delta = v t\, \operatorname{sinc}\frac{\omega t}{2}
          \begin{pmatrix} \cos(\psi + \omega t / 2) \\ \sin(\psi + \omega t / 2) \end{pmatrix},
          \qquad P \leftarrow F P F^T + G \operatorname{diag}(\sigma_v^2, \sigma_\omega^2)\, G^T t^2
"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, TypeVar

import numpy as np

from worldstate.ground import TINY, FloatArray, wrap_angle
from worldstate.ground.serialisation import ADDED, Via
from worldstate.measurement import Odometry, Position

from .motion import DIMENSIONS, LEAST_STD, GaussianBelief, MotionBelief, conditioned, white_acceleration

# Polar coordinates are singular at the array itself; no road user comes closer than this.
_NEAREST_M = 1.0
_LARGEST_PLACE_STD = 1.0 / LEAST_STD  # m and m/s: ten times the most uncertain position that is accepted
_IDENTITY = np.eye(DIMENSIONS)
NumbersT = TypeVar("NumbersT", float, FloatArray)


@dataclass(frozen=True, slots=True, eq=False)
class CartesianBelief(GaussianBelief):
    """Gaussian over (x, y, vx, vy), m and m/s."""

    @property
    def position_std_m(self) -> float:
        """Standard deviation of the position along its longest axis."""
        return _longest(self.covariance[:2, :2])

    @property
    def velocity_std_mps(self) -> float:
        """Standard deviation of the velocity along its longest axis."""
        return _longest(self.covariance[2:, 2:])


def full_measurement(position: Position, speed_std_mps: float) -> tuple[FloatArray, FloatArray]:
    """Return a measurement of all four components; an unknown velocity is 0 with a wide deviation."""
    noise = np.diag([0.0, 0.0, speed_std_mps**2, speed_std_mps**2])
    known = len(position.covariance)
    noise[:known, :known] = position.covariance
    return np.array([*position.position_m, *(position.velocity_mps or (0.0, 0.0))]), noise


def arc(speed_mps: float, yaw_rate_rad_s: float, step_s: NumbersT) -> tuple[FloatArray, NumbersT]:
    """Return the chord of an arc in the axes at its start, shape (..., 2), and the turn."""
    turned = yaw_rate_rad_s * step_s
    # numpy's sinc has a factor of pi.
    length = speed_mps * step_s * np.sinc(0.5 * turned / math.pi)
    return np.stack([length * np.cos(0.5 * turned), length * np.sin(0.5 * turned)], axis=-1), turned


def constant_velocity(step_s: float) -> tuple[FloatArray, FloatArray]:
    """Return F, and Q of a white acceleration of density 1, shape (4, 4) each."""
    noise = np.asarray(np.kron(white_acceleration(step_s), np.eye(2)))
    return _IDENTITY + step_s * np.eye(len(_IDENTITY), k=2), noise


def predict_place(
    belief: CartesianBelief,
    step_s: float,
    acceleration_psd: float | FloatArray,
    ego_speed_mps: float,
    ego_yaw_rate_rad_s: float = 0.0,
) -> CartesianBelief:
    r"""Return the belief after `step_s` of constant velocity and white acceleration (m^2/s^3).

    .. math:: m \leftarrow R(F m - u), \quad P \leftarrow R (F P F^T + Q) R^T

    with the chord u of the ego vehicle, and the opposite turn R of its axes.
    """
    flow, noise = constant_velocity(step_s)
    mean = belief.mean @ flow.T
    chord, turned = arc(ego_speed_mps, ego_yaw_rate_rad_s, step_s)
    mean[..., :2] -= chord
    strength = np.asarray(acceleration_psd)[..., None, None]
    covariance = flow @ belief.covariance @ flow.T + strength * noise
    cosine, sine = math.cos(turned), math.sin(turned)
    turn = np.kron(np.eye(2), [[cosine, sine], [-sine, cosine]])
    return _belief(mean @ turn.T, turn @ covariance @ turn.T)


def update_position(belief: CartesianBelief, position: Position) -> CartesianBelief:
    """Return the belief after a position, with a velocity if that was measured."""
    known = len(position.covariance)
    measured = np.array([*position.position_m, *(position.velocity_mps or ())])
    return _update(belief, measured - belief.mean[:known], _IDENTITY[:known], np.array(position.covariance))


def update_bearing(belief: CartesianBelief, azimuth_rad: float, std_rad: float) -> CartesianBelief:
    r"""Return the belief after a bearing, by an extended Kalman filter with h(x) = atan2(y, x).

    .. math:: H = (-y,\; x,\; 0,\; 0) / r^2
    """
    x, y = belief.mean[:2].tolist()
    square = max(x * x + y * y, _NEAREST_M**2)
    residual = wrap_angle(azimuth_rad - math.atan2(y, x))
    slope = np.array([[-y / square, x / square, 0.0, 0.0]])
    return _update(belief, np.array([residual]), slope, np.array([[max(std_rad, LEAST_STD) ** 2]]))


def polar_motion(
    belief: CartesianBelief, ego_speed_mps: float, ego_yaw_rate_rad_s: float = 0.0
) -> MotionBelief:
    """Return the belief in modified polar coordinates, to first order."""
    x, y, vx, vy = np.moveaxis(belief.mean, -1, 0)
    vx, r = vx - ego_speed_mps, np.hypot(x, y)
    # Moved out to the nearest distance; an entity at the array itself is assumed to be ahead of it.
    farther = _NEAREST_M / np.clip(r, TINY, _NEAREST_M)
    x, y = np.where(r > TINY, x * farther, _NEAREST_M), y * farther
    square = x * x + y * y
    cosine, sine = x / square, y / square
    turning, closing = vy * cosine - vx * sine, vx * cosine + vy * sine
    # In complex numbers d log z = dz / z, so that log r and theta, rho and theta_dot share their derivatives.
    none = np.zeros_like(r)
    rows = (
        (-sine, cosine, none, none),
        (vy / square - 2.0 * cosine * turning, -vx / square - 2.0 * sine * turning, -sine, cosine),
        (vx / square - 2.0 * cosine * closing, vy / square - 2.0 * sine * closing, cosine, sine),
        (cosine, sine, none, none),
    )
    slope = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    # A precise position far away would give a covariance that is singular to rounding.
    covariance = slope @ belief.covariance @ slope.mT + LEAST_STD**2 * _IDENTITY
    # In axes that turn with the ego vehicle, everything else turns the other way.
    seen_turning = turning - ego_yaw_rate_rad_s
    mean = np.stack([np.arctan2(y, x), seen_turning, closing, 0.5 * np.log(square)], axis=-1)
    return MotionBelief(mean, conditioned(covariance))


def _update(
    belief: CartesianBelief, residual: FloatArray, slope: FloatArray, noise: FloatArray
) -> CartesianBelief:
    """Return the belief after a measurement, in Joseph's form, which stays positive definite."""
    spread = slope @ belief.covariance
    gain = np.linalg.solve(spread @ slope.T + noise, spread).T
    keep = _IDENTITY - gain @ slope
    covariance = keep @ belief.covariance @ keep.T + gain @ noise @ gain.T
    return _belief(belief.mean + gain @ residual, covariance)


def _belief(mean: FloatArray, covariance: FloatArray) -> CartesianBelief:
    return CartesianBelief(mean, conditioned(covariance, _LARGEST_PLACE_STD))


def _longest(covariance: FloatArray) -> float:
    """Return the square root of the larger eigenvalue of a covariance, shape (2, 2)."""
    a, b, c = covariance[0, 0], covariance[1, 1], covariance[0, 1]
    return math.sqrt(0.5 * (a + b) + math.hypot(0.5 * (a - b), c))


_POSE = 3
_ROW = Via(FloatArray, np.asarray, lambda row: row.reshape(_POSE))
_SQUARE = Via(FloatArray, np.ravel, lambda row: row.reshape(_POSE, _POSE))


@dataclass(frozen=True, slots=True, eq=False)
class EgoBelief:
    """Gaussian over the pose (x, y, yaw) in the map frame, with the present twist.

    Shapes: pose (3,), covariance (3, 3). It is `localised` once odometry has given a pose.
    """

    pose: Annotated[FloatArray, _ROW]
    covariance: Annotated[FloatArray, _SQUARE]
    speed_mps: float
    yaw_rate_rad_s: float
    speed_std_mps: float
    yaw_rate_std_rad_s: float
    localised: bool = field(default=False, metadata=ADDED)


def driven(ego: EgoBelief, step_s: float) -> EgoBelief:
    """Return the ego vehicle some seconds later.

    Examples
    --------
    >>> quarter = EgoBelief(np.zeros(3), np.zeros((3, 3)), math.pi, math.pi / 2.0, 0.0, 0.0)
    >>> driven(quarter, 1.0).pose.round(3)
    array([2.   , 2.   , 1.571])
    """
    chord, turned = arc(ego.speed_mps, ego.yaw_rate_rad_s, step_s)
    yaw, heading = float(ego.pose[2]), float(ego.pose[2]) + 0.5 * turned
    x, y = (np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]) @ chord).tolist()
    pose = ego.pose + np.array([x, y, turned])
    flow, gain = np.eye(_POSE), np.array([[math.cos(heading), 0.0], [math.sin(heading), 0.0], [0.0, 1.0]])
    flow[:2, 2] = -y, x
    noise = gain * (np.array([ego.speed_std_mps, ego.yaw_rate_std_rad_s]) * step_s) ** 2 @ gain.T
    pose[2] = wrap_angle(pose[2])
    return replace(ego, pose=pose, covariance=flow @ ego.covariance @ flow.T + noise)


def corrected(ego: EgoBelief | None, told: Odometry) -> EgoBelief:
    """Return the ego vehicle after odometry: with its twist, and its pose if there is one."""
    before = ego or EgoBelief(np.zeros(_POSE), np.zeros((_POSE, _POSE)), 0.0, 0.0, 0.0, 0.0)
    pose, covariance = before.pose, before.covariance
    if told.pose is not None:
        at = told.pose
        pose = np.array([*at.position_m, at.yaw_rad])
        covariance = np.diag([at.position_std_m**2] * 2 + [at.yaw_std_rad**2])
    twist = told.speed_mps, told.yaw_rate_rad_s, told.speed_std_mps, told.yaw_rate_std_rad_s
    return EgoBelief(pose, covariance, *twist, before.localised or told.pose is not None)
