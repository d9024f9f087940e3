"""The motion belief of one entity: a modified-polar extended Kalman filter over filterpy."""

import math
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from worldstate.ground.typing import FloatArray
from worldstate.ground.values import wrap_angle

from .polar import AZIMUTH, LOG_RANGE, RADIAL_RATE, jacobian, process_noise, propagate

# No range is ever measured from a standing ego; the belief about it only scales accelerations.
_NEAREST_M, _FARTHEST_M = 3.0, 200.0
# Nobody drives through the array: within a step a vehicle comes no closer than half its range.
_CLOSEST_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class MotionBelief:
    """Gaussian over (theta, theta_dot, rho, log r); see `polar`.

    Examples
    --------
    >>> belief = MotionBelief.around((0.9, 0.0, -0.2, 3.2), (0.35, 0.1, 0.2, 0.6))
    >>> belief = update_azimuth(belief, 0.6, 0.2, weight=1.0)
    >>> round(belief.azimuth_rad, 3), round(belief.azimuth_std_rad, 3)
    (0.674, 0.174)
    """

    mean: FloatArray  # shape (4,): theta wrapped into (-pi, pi]
    covariance: FloatArray  # shape (4, 4): Symmetric positive definite

    @classmethod
    def around(
        cls, mean: tuple[float, float, float, float], std: tuple[float, float, float, float]
    ) -> "MotionBelief":
        """Return independent components."""
        return cls(np.array(mean), np.diag(np.square(std)))

    @property
    def azimuth_rad(self) -> float:
        """Mean azimuth."""
        return float(self.mean[AZIMUTH])

    @property
    def azimuth_std_rad(self) -> float:
        """Standard deviation of the azimuth."""
        return math.sqrt(self.covariance[AZIMUTH, AZIMUTH])

    @property
    def inverse_tta_hz(self) -> float:
        """Mean of 1/TTA = -rho."""
        return -float(self.mean[RADIAL_RATE])

    @property
    def inverse_tta_std_hz(self) -> float:
        """Standard deviation of 1/TTA."""
        return math.sqrt(self.covariance[RADIAL_RATE, RADIAL_RATE])


class _PolarEngine(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter with the closed-form motion in place of its linear one."""

    def __init__(self, belief: MotionBelief, measured: int = 1) -> None:
        super().__init__(dim_x=4, dim_z=measured)
        self.x = belief.mean  # 1-D: a column state and a flat measurement would broadcast to a matrix
        self.P = belief.covariance
        self.step_s = 0.0

    def predict_x(self, u: float = 0) -> None:
        self.x = propagate(self.x, self.step_s)


def predict(belief: MotionBelief, step_s: float, acceleration_psd: float) -> MotionBelief:
    """Return the belief after `step_s` of constant velocity and white acceleration (m^2/s^3)."""
    start = belief.mean.copy()
    if step_s > 0.0:
        start[RADIAL_RATE] = max(start[RADIAL_RATE], -_CLOSEST_SHARE / step_s)
    engine = _PolarEngine(MotionBelief(start, belief.covariance))
    range_m = min(max(math.exp(belief.mean[LOG_RANGE]), _NEAREST_M), _FARTHEST_M)
    engine.step_s = step_s
    engine.F = jacobian(start, step_s)
    engine.Q = process_noise(acceleration_psd, range_m, step_s)
    engine.predict()
    return _belief(engine.x, engine.P)


def relax(
    belief: MotionBelief, towards: MotionBelief, bearing_kept: float, radial_kept: float
) -> MotionBelief:
    r"""Return the belief drawn towards another, as an Ornstein-Uhlenbeck process draws it.

    .. math:: m \leftarrow m_0 + \Phi (m - m_0), \quad P \leftarrow \Phi P \Phi + (I - \Phi^2) P_0

    with :math:`\Phi` diagonal: `bearing_kept` for (theta, theta_dot), `radial_kept` for (rho, log r). P_0 has
    to be diagonal. Constant velocity alone would drive a vehicle out of its occlusion unheard, or, at a
    constant bearing whose range nobody measures, straight through the array.
    """
    phi = np.array([bearing_kept, bearing_kept, radial_kept, radial_kept])
    offset = belief.mean - towards.mean
    offset[AZIMUTH] = wrap_angle(float(offset[AZIMUTH]))
    covariance = np.outer(phi, phi) * belief.covariance + (1.0 - phi**2)[:, None] * towards.covariance
    return _belief(towards.mean + phi * offset, covariance)


def update_azimuth(belief: MotionBelief, azimuth_rad: float, std_rad: float, weight: float) -> MotionBelief:
    """Return the belief after a bearing that is this entity's with probability `weight`."""
    return _update(belief, AZIMUTH, azimuth_rad, std_rad, weight)


def update_approach(
    belief: MotionBelief, inverse_tta_hz: float, std_hz: float, weight: float
) -> MotionBelief:
    """Return the belief after an approach rate, 1/s, that is this entity's with probability `weight`."""
    return _update(belief, RADIAL_RATE, -inverse_tta_hz, std_hz, weight)


def log_azimuth_likelihood(belief: MotionBelief, azimuth_rad: float, std_rad: float) -> float:
    """Return log N(z; theta, P_theta + R) of a bearing, residual wrapped, nats per rad."""
    variance = float(belief.covariance[AZIMUTH, AZIMUTH]) + std_rad**2
    residual = wrap_angle(azimuth_rad - belief.azimuth_rad)
    return -0.5 * (residual**2 / variance + math.log(2.0 * math.pi * variance))


def _update(belief: MotionBelief, row: int, value: float, std: float, weight: float) -> MotionBelief:
    r"""Probabilistic data association with one measurement, linear in one component.

    .. math:: m = m^- + w K\nu, \quad P = w P^+ + (1 - w) P^- + w (1 - w)\, K\nu\nu^T K^T
    """
    if weight <= 0.0:
        return belief
    engine = _PolarEngine(belief)
    pick = np.zeros((1, 4))
    pick[0, row] = 1.0
    engine.update(
        np.array([value]),
        HJacobian=lambda state: pick,
        Hx=lambda state: state[row : row + 1],
        R=np.array([[std**2]]),
        residual=_wrapped if row == AZIMUTH else np.subtract,
    )
    step = engine.x - belief.mean
    covariance = weight * engine.P + (1.0 - weight) * belief.covariance
    return _belief(belief.mean + weight * step, covariance + weight * (1.0 - weight) * np.outer(step, step))


def _wrapped(z: FloatArray, expected: FloatArray) -> FloatArray:
    return wrap_angle(z - expected)


def _belief(mean: FloatArray, covariance: FloatArray) -> MotionBelief:
    mean[AZIMUTH] = wrap_angle(float(mean[AZIMUTH]))
    return MotionBelief(mean, 0.5 * (covariance + covariance.T))
