r"""Gaussians over the motion of entities: an extended Kalman filter in modified polar coordinates.

Constant velocity seen from a standing ego has the state

.. math:: x = (\theta,\; \dot\theta,\; \rho = \dot r / r = -1/\mathrm{TTA},\; \log r)

Bearing and looming are linear in it, and the range, which neither of them tells, stands apart. From

.. math:: \ddot\theta = -2\rho\dot\theta, \quad \dot\rho = \dot\theta^2 - \rho^2, \quad (\log r)^\cdot = \rho

follows a closed form: in units of the first range the vehicle moves from (1, 0) to
:math:`(a, b) = (1 + \rho t,\; \dot\theta t)`, and with :math:`q = a^2 + b^2`

.. math::
    \theta' = \theta + \operatorname{atan2}(b, a), \quad \dot\theta' = \dot\theta / q, \quad
    \rho' = (a\rho + b\dot\theta) / q, \quad \log r' = \log r + \tfrac12 \log q.

References
----------
Aidala and Hammel, "Utilization of modified polar coordinates for bearings-only tracking", 1983.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self, TypeAlias

import numpy as np

from worldstate.ground import FloatArray, InvalidArgumentError, wrap_angle
from worldstate.ground.serialisation import Via

AZIMUTH, AZIMUTH_RATE, RADIAL_RATE, LOG_RANGE = range(4)

# q = 0 is a vehicle at the array itself, where the coordinates are singular; 1e-3 is 3 % of the first range.
LEAST_Q = 1e-3
_Numbers: TypeAlias = float | FloatArray  # Of one belief, or of each of many


def propagate(state: FloatArray, step_s: float) -> FloatArray:
    """Return states (theta, theta_dot, rho, log r) after `step_s`, theta not wrapped.

    Shapes: state (..., 4), as what is returned.
    """
    theta, omega, rho, log_range = np.moveaxis(state, -1, 0)
    a, b = 1.0 + rho * step_s, omega * step_s
    q = np.maximum(a * a + b * b, LEAST_Q)
    after = np.empty_like(state)
    after[..., AZIMUTH] = theta + np.arctan2(b, a)
    after[..., AZIMUTH_RATE] = omega / q
    after[..., RADIAL_RATE] = (a * rho + b * omega) / q
    after[..., LOG_RANGE] = log_range + 0.5 * np.log(q)
    return after


def jacobian(state: FloatArray, step_s: float) -> FloatArray:
    """Return d propagate / d state, shape (..., 4, 4).

    Shapes: state (..., 4).
    """
    _, omega, rho, _ = np.moveaxis(state, -1, 0)
    t = step_s
    a, b = 1.0 + rho * t, omega * t
    q = np.maximum(a * a + b * b, LEAST_Q)
    radial = a * rho + b * omega
    u, v = a / q, b / q
    slope = np.zeros((*state.shape, 4))
    slope[..., 0, 0] = slope[..., 3, 3] = 1.0
    slope[..., 0, 1] = slope[..., 3, 2] = u * t
    slope[..., 0, 2] = -v * t
    slope[..., 3, 1] = v * t
    slope[..., 1, 1] = (1.0 - 2.0 * b * v) / q
    slope[..., 1, 2] = -2.0 * omega * u * t / q
    slope[..., 2, 1] = 2.0 * (omega - radial * v) * t / q
    slope[..., 2, 2] = (1.0 + 2.0 * (rho - radial * u) * t) / q
    return slope


def process_noise(acceleration_psd: _Numbers, range_m: _Numbers, step_s: float) -> FloatArray:
    r"""Return Q, shape (..., 4, 4), of a white acceleration: at range r it turns and closes by a/r."""
    twice, once, rate = step_s**3 / 3.0, step_s**2 / 2.0, step_s
    unit = np.array(
        [[twice, once, 0.0, 0.0], [once, rate, 0.0, 0.0], [0.0, 0.0, rate, once], [0.0, 0.0, once, twice]]
    )
    return np.asarray(np.asarray(acceleration_psd / np.square(range_m))[..., None, None] * unit)


def _checked_covariance(row: FloatArray) -> FloatArray:
    """Return the covariance that a checkpoint holds as one row."""
    covariance = row.reshape(4, 4)
    if not (covariance == covariance.T).all() or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise InvalidArgumentError("expected it symmetric and positive definite")
    return covariance


# Of the largest variance, what every one has at least, so that rounding, 1e-16 of it, leaves none below zero.
_CONDITION = 1e-13


def conditioned(covariance: FloatArray, largest_std: float) -> FloatArray:
    r"""Return a covariance symmetric and positive definite, whatever rounding has left of it.

    .. math:: P \leftarrow S P S + \kappa \max_i (S P S)_{ii}\, I, \qquad
              s_i = \min(1,\ \sigma_{max} / \sigma_i)

    A deviation above the largest one says nothing, but leaves no digits to the others.
    """
    covariance = 0.5 * (covariance + covariance.mT)
    variance = np.einsum("...ii->...i", covariance)  # A view
    if variance.max() > largest_std**2:
        covariance *= _outer(np.minimum(largest_std / np.sqrt(np.maximum(variance, LEAST_STD**2)), 1.0))
    variance += _CONDITION * variance.max(axis=-1, keepdims=True)
    return covariance


@dataclass(frozen=True, slots=True, eq=False)
class GaussianBelief:
    """Mean and covariance of four coordinates.

    Shapes: mean (4,), covariance (4, 4) symmetric and positive definite, or with leading axes of many
    entities: with twenty a step takes half the time when all are predicted and updated at once.
    """

    mean: Annotated[FloatArray, Via(FloatArray, np.asarray, lambda row: row.reshape(4))]
    covariance: Annotated[FloatArray, Via(FloatArray, np.ravel, _checked_covariance)]

    @classmethod
    def stacked(cls, beliefs: Sequence[Self]) -> Self:
        """Return many beliefs as one with a leading axis."""
        return cls(np.array([one.mean for one in beliefs]), np.array([one.covariance for one in beliefs]))

    def each(self) -> list[Self]:
        """Return the beliefs that were stacked."""
        return list(map(type(self), self.mean, self.covariance))


# Range only scales the angular noise of an acceleration, and bearings from a standing ego do not measure it:
# outside these limits the noise would vanish or throw the bearing.
NEAREST_M, FARTHEST_M = 3.0, 200.0
_LOG_NEAREST, _LOG_FARTHEST = math.log(NEAREST_M), math.log(FARTHEST_M)
_IDENTITY = np.eye(4)
# Within one step a vehicle comes no closer than half its range: closer, the closed form passes through the
# array.
_CLOSEST_SHARE = 0.5
# No sensor knows a bearing to .006 degrees or an approach rate to 1e-4 1/s. Deviations below make a
# covariance singular to rounding, and its checkpoint is refused; a hundred radians say nothing.
LEAST_STD, LARGEST_STD = 1e-4, 1e2


@dataclass(frozen=True, slots=True, eq=False)
class MotionBelief(GaussianBelief):
    """Gaussian over (theta, theta_dot, rho, log r), the modified polar coordinates of `polar`.

    Theta is wrapped into (-pi, pi].
    """

    @classmethod
    def around(
        cls, mean: tuple[float, float, float, float], std: tuple[float, float, float, float]
    ) -> "MotionBelief":
        """Return independent components."""
        return cls(np.array(mean), np.diag(np.square(np.clip(std, LEAST_STD, LARGEST_STD))))

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


def predict(belief: MotionBelief, step_s: float, acceleration_psd: _Numbers) -> MotionBelief:
    r"""Return the belief after `step_s` of constant velocity and white acceleration (m^2/s^3).

    .. math:: m \leftarrow f(m), \quad P \leftarrow F P F^T + Q
    """
    start = belief.mean.copy()
    if step_s > 0.0:
        start[..., RADIAL_RATE] = np.maximum(start[..., RADIAL_RATE], -_CLOSEST_SHARE / step_s)
    # Clipped before exp: approach rates that contradict each other drive log r, which is not measured, so far
    # that exp overflows.
    range_m = np.exp(np.minimum(np.maximum(belief.mean[..., LOG_RANGE], _LOG_NEAREST), _LOG_FARTHEST))
    flow = jacobian(start, step_s)
    covariance = flow @ belief.covariance @ flow.mT + process_noise(acceleration_psd, range_m, step_s)
    return _belief(propagate(start, step_s), covariance)


def relax(
    belief: MotionBelief, towards: MotionBelief, bearing_kept: _Numbers, radial_kept: _Numbers
) -> MotionBelief:
    r"""Return the belief drawn towards another, as an Ornstein-Uhlenbeck process draws it.

    .. math:: m \leftarrow m_0 + \Phi (m - m_0), \quad P \leftarrow \Phi P \Phi + (I - \Phi^2) P_0

    with :math:`\Phi` diagonal, `bearing_kept` for (theta, theta_dot) and `radial_kept` for (rho, log r), and
    P_0 diagonal.
    """
    # Constant velocity alone would move a hidden vehicle out of its occlusion without evidence or, at a
    # constant bearing without a measured range, through the array.
    phi = np.empty_like(belief.mean)
    phi[..., :RADIAL_RATE] = np.asarray(bearing_kept)[..., None]
    phi[..., RADIAL_RATE:] = np.asarray(radial_kept)[..., None]
    offset = belief.mean - towards.mean
    offset[..., AZIMUTH] = wrap_angle(offset[..., AZIMUTH])
    covariance = _outer(phi) * belief.covariance + (1.0 - phi**2)[..., None] * towards.covariance
    return _belief(towards.mean + phi * offset, covariance)


def log_azimuth_likelihood(belief: MotionBelief, azimuth_rad: float, std_rad: float) -> float:
    """Return log N(z; theta, P_theta + R) of a bearing, residual wrapped, nats per rad."""
    variance = float(belief.covariance[AZIMUTH, AZIMUTH]) + std_rad**2
    residual = wrap_angle(azimuth_rad - belief.azimuth_rad)
    return -0.5 * (residual**2 / variance + math.log(2.0 * math.pi * variance))


def update(belief: MotionBelief, row: int, value: _Numbers, std: _Numbers, weight: _Numbers) -> MotionBelief:
    r"""Return the belief after one component was measured, of this entity with probability `weight`.

    Probabilistic data association: a bearing is one of AZIMUTH, an approach rate -1/TTA one of RADIAL_RATE.

    .. math:: m = m^- + w K\nu, \quad P = w P^+ + (1 - w) P^- + w (1 - w)\, K\nu\nu^T K^T,
        \quad K = P^- h / (h^T P^- h + R)
    """
    noise = np.square(np.maximum(std, LEAST_STD))[..., None]
    residual = value - belief.mean[..., row]
    if row == AZIMUTH:
        residual = wrap_angle(residual)
    gain = belief.covariance[..., row] / (belief.covariance[..., row, row, None] + noise)
    # Joseph's form stays positive definite where P - K H P loses it to rounding: a sharp bearing on a belief
    # that is sharp already.
    keep = _IDENTITY - gain[..., None] * _IDENTITY[row]
    updated = keep @ belief.covariance @ keep.mT + noise[..., None] * _outer(gain)
    step, w = gain * np.asarray(residual)[..., None], np.asarray(weight)[..., None]
    covariance = w[..., None] * updated + (1.0 - w)[..., None] * belief.covariance
    return _belief(belief.mean + w * step, covariance + (w * (1.0 - w))[..., None] * _outer(step))


def _outer(row: FloatArray) -> FloatArray:
    return row[..., :, None] * row[..., None, :]


def _belief(mean: FloatArray, covariance: FloatArray) -> MotionBelief:
    mean[..., AZIMUTH] = wrap_angle(mean[..., AZIMUTH])
    return MotionBelief(mean, conditioned(covariance, LARGEST_STD))
