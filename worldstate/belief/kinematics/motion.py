r"""Gaussians over the motion of entities: an extended Kalman filter in modified polar coordinates.

Constant velocity relative to an ego vehicle at rest has the state

.. math:: x = (\theta,\; \dot\theta,\; \rho = \dot r / r = -1/\mathrm{TTA},\; \log r)

Bearing and looming are linear in it. Neither of them measures the range, which is separate. In complex
numbers :math:`u = \log r + i\theta` and :math:`w = \rho + i\dot\theta`

.. math:: \dot u = w, \quad \dot w = -w^2, \qquad\text{so that}\qquad
          u' = u + \log z, \quad w' = w / z, \quad z = 1 + w t

with z the place of the vehicle after a time t, in units of the first range and relative to its bearing.

References
----------
Aidala and Hammel, "Utilization of modified polar coordinates for bearings-only tracking", 1983.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Self, TypeAlias

import numpy as np

from worldstate.ground import TINY, FloatArray, InvalidArgumentError, wrap_angle
from worldstate.ground.serialisation import Via

DIMENSIONS = 4
AZIMUTH, AZIMUTH_RATE, RADIAL_RATE, LOG_RANGE = range(DIMENSIONS)

_Numbers: TypeAlias = float | FloatArray  # One value, or one per belief


def propagate(state: FloatArray, step_s: float) -> tuple[FloatArray, FloatArray]:
    r"""Return states (theta, theta_dot, rho, log r) after `step_s`, theta not wrapped, and their Jacobians.

    .. math:: \frac{du'}{dw} = \frac{t}{z}, \qquad \frac{dw'}{dw} = \frac{1}{z^2}

    Shapes: state (..., 4), like the first result; the second is (..., 4, 4).
    """
    w = state[..., RADIAL_RATE] + 1j * state[..., AZIMUTH_RATE]
    z = 1.0 + w * step_s
    w, moved, by_rate, of_rate = w / z, np.log(z), step_s / z, z**-2
    after, slope = state.copy(), np.zeros((*state.shape, state.shape[-1]))
    after[..., AZIMUTH] += moved.imag
    after[..., LOG_RANGE] += moved.real
    after[..., AZIMUTH_RATE], after[..., RADIAL_RATE] = w.imag, w.real
    # A complex derivative x + iy acts on (real, imaginary) as the matrix ((x, -y), (y, x)).
    slope[..., AZIMUTH, AZIMUTH] = slope[..., LOG_RANGE, LOG_RANGE] = 1.0
    slope[..., AZIMUTH, AZIMUTH_RATE] = slope[..., LOG_RANGE, RADIAL_RATE] = by_rate.real
    slope[..., AZIMUTH, RADIAL_RATE], slope[..., LOG_RANGE, AZIMUTH_RATE] = by_rate.imag, -by_rate.imag
    slope[..., AZIMUTH_RATE, AZIMUTH_RATE] = slope[..., RADIAL_RATE, RADIAL_RATE] = of_rate.real
    slope[..., AZIMUTH_RATE, RADIAL_RATE], slope[..., RADIAL_RATE, AZIMUTH_RATE] = of_rate.imag, -of_rate.imag
    return after, slope


def process_noise(acceleration_psd: _Numbers, range_m: _Numbers, step_s: float) -> FloatArray:
    r"""Return Q, shape (..., 4, 4), of a white acceleration a, which changes both rates by a/r at range r."""
    strength = np.asarray(acceleration_psd / np.square(range_m))
    return np.asarray(strength[..., None, None] * _unit_noise(step_s))


def white_acceleration(step_s: float) -> FloatArray:
    """Return the covariance of place and speed for a white acceleration of density 1, shape (2, 2)."""
    return np.array([[step_s**3 / 3.0, step_s**2 / 2.0], [step_s**2 / 2.0, step_s]])


@lru_cache
def _unit_noise(step_s: float) -> FloatArray:
    noise, unit = np.zeros((DIMENSIONS, DIMENSIONS)), white_acceleration(step_s)
    noise[:RADIAL_RATE, :RADIAL_RATE], noise[RADIAL_RATE:, RADIAL_RATE:] = unit, unit[::-1, ::-1]
    return noise


def _checked_covariance(row: FloatArray) -> FloatArray:
    """Return the covariance from the row of a checkpoint."""
    covariance = row.reshape(DIMENSIONS, DIMENSIONS)
    if not (covariance == covariance.T).all() or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise InvalidArgumentError("expected a symmetric positive definite matrix")
    return covariance


# No sensor measures a bearing to 0.006 degrees or an approach rate to 1e-4 1/s. Smaller deviations make a
# covariance singular to rounding, and its checkpoint is refused; a hundred radians contain no information.
LEAST_STD, LARGEST_STD = 1e-4, 1e2
# Smallest variance as a share of the largest: rounding errors, 1e-16 of the largest, then leave no negative
# one.
_CONDITION = 0.1 * TINY


def conditioned(covariance: FloatArray, largest_std: float = LARGEST_STD) -> FloatArray:
    r"""Return a covariance that is symmetric and positive definite in spite of rounding.

    .. math:: P \leftarrow S P S + \kappa \max_i (S P S)_{ii}\, I, \qquad
              s_i = \min(1,\ \sigma_{max} / \sigma_i)

    A deviation above the largest one contains no information but would reduce the precision of the others.
    """
    covariance = 0.5 * (covariance + covariance.mT)
    # A view of the diagonals.
    variance = covariance.reshape(*covariance.shape[:-2], -1)[..., :: covariance.shape[-1] + 1]
    largest = np.maximum.reduce(variance, -1)[..., None]
    if True in (largest > largest_std**2):
        scale = np.minimum(largest_std / np.sqrt(np.maximum(variance, LEAST_STD**2)), 1.0)
        covariance *= _outer(scale, scale)
        largest = variance.max(axis=-1, keepdims=True)
    variance += _CONDITION * largest
    return covariance


@dataclass(frozen=True, slots=True, eq=False)
class GaussianBelief:
    """Mean and covariance of four coordinates.

    Shapes: mean (4,), covariance (4, 4) symmetric and positive definite. For many entities both have leading
    axes: with twenty, a step takes half the time if all are predicted and updated at once.
    """

    mean: Annotated[FloatArray, Via(FloatArray, np.asarray, lambda row: row.reshape(DIMENSIONS))]
    covariance: Annotated[FloatArray, Via(FloatArray, np.ravel, _checked_covariance)]

    @classmethod
    def stacked(cls, beliefs: Sequence[Self]) -> Self:
        """Return many beliefs, or none, as one with a leading axis."""
        covariance = np.reshape([one.covariance for one in beliefs], (-1, DIMENSIONS, DIMENSIONS))
        return cls(np.reshape([one.mean for one in beliefs], (-1, DIMENSIONS)), covariance)

    def each(self) -> list[Self]:
        """Return the beliefs of a stack one by one."""
        return list(map(type(self), self.mean, self.covariance))


# The range only scales the angular noise of an acceleration, and bearings from an ego at rest do not measure
# it. Outside these limits the noise would vanish or dominate the bearing.
NEAREST_M, FARTHEST_M = 3.0, 200.0
_LOG_NEAREST, _LOG_FARTHEST = math.log(NEAREST_M), math.log(FARTHEST_M)
# Within one step a vehicle comes no closer than half its range; below that, the closed form passes through
# the array.
_CLOSEST_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class MotionBelief(GaussianBelief):
    """Gaussian over the modified polar coordinates (theta, theta_dot, rho, log r).

    Theta is wrapped into (-pi, pi].
    """

    @classmethod
    def around(cls, mean: Sequence[float], std: Sequence[float]) -> "MotionBelief":
        """Return a belief with independent components."""
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
    start[..., RADIAL_RATE] = np.maximum(start[..., RADIAL_RATE], -_CLOSEST_SHARE / max(step_s, TINY))
    # Clipped before exp: contradictory approach rates can drive log r, which is not measured, so far that exp
    # overflows.
    range_m = np.exp(np.minimum(np.maximum(belief.mean[..., LOG_RANGE], _LOG_NEAREST), _LOG_FARTHEST))
    mean, flow = propagate(start, step_s)
    covariance = flow @ belief.covariance @ flow.mT + process_noise(acceleration_psd, range_m, step_s)
    return _belief(mean, covariance)


def relax(
    belief: MotionBelief, towards: MotionBelief, bearing_kept: _Numbers, radial_kept: _Numbers
) -> MotionBelief:
    r"""Return the belief relaxed towards another one by an Ornstein-Uhlenbeck process.

    .. math:: m \leftarrow m_0 + \Phi (m - m_0), \quad P \leftarrow \Phi P \Phi + (I - \Phi^2) P_0

    with :math:`\Phi` diagonal, `bearing_kept` for (theta, theta_dot) and `radial_kept` for (rho, log r), and
    P_0 diagonal.
    """
    # Without relaxation a hidden vehicle would leave its occlusion without evidence or, at a constant bearing
    # and unmeasured range, pass through the array.
    phi = np.empty_like(belief.mean)
    phi[..., :RADIAL_RATE] = np.asarray(bearing_kept)[..., None]
    phi[..., RADIAL_RATE:] = np.asarray(radial_kept)[..., None]
    offset = belief.mean - towards.mean
    offset[..., AZIMUTH] = wrap_angle(offset[..., AZIMUTH])
    covariance = _outer(phi, phi) * belief.covariance + (1.0 - phi**2)[..., None] * towards.covariance
    return _belief(towards.mean + phi * offset, covariance)


def _expected(belief: MotionBelief, row: int, ago_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a component's earlier mean, its covariance with the state, and its variance."""
    mean, column = belief.mean[..., row], belief.covariance[..., row]
    if not ago_s:
        return mean, column, column[..., row]
    rate = row + 1  # Only the azimuth is measured late, and its rate is the next component
    column = column - ago_s * belief.covariance[..., rate]
    return mean - ago_s * belief.mean[..., rate], column, column[..., row] - ago_s * column[..., rate]


def log_azimuth_likelihood(
    belief: MotionBelief, azimuth_rad: float, std_rad: _Numbers, ago_s: float = 0.0
) -> FloatArray:
    """Return log N(z; h m, h P h^T + R) of an earlier bearing, residual wrapped, nats per rad."""
    mean, _, variance = _expected(belief, AZIMUTH, ago_s)
    variance = variance + np.square(std_rad)
    residual = wrap_angle(azimuth_rad - mean)
    return np.asarray(-0.5 * (residual**2 / variance + np.log(2.0 * math.pi * variance)))


def update(
    belief: MotionBelief,
    row: int,
    value: _Numbers,
    std: _Numbers,
    weight: _Numbers = 1.0,
    ago_s: float = 0.0,
) -> MotionBelief:
    r"""Return the belief after a measurement of one component, which is of this entity with probability w.

    Probabilistic data association: a bearing measures AZIMUTH, an approach rate -1/TTA measures RADIAL_RATE.
    A bearing from `ago_s` ago measures :math:`h^T m = \theta - t\dot\theta`.

    .. math:: m = m^- + w K\nu, \quad P = w P^+ + (1 - w) P^- + w (1 - w)\, K\nu\nu^T K^T,
        \quad K = P^- h / (h^T P^- h + R)
    """
    noise = np.square(np.maximum(std, LEAST_STD))[..., None]
    mean, column, variance = _expected(belief, row, ago_s)
    residual = value - mean
    if row == AZIMUTH:
        residual = wrap_angle(residual)
    gain = column / (variance[..., None] + noise)
    # Joseph's form stays positive definite; P - K H P does not if both the bearing and the belief are
    # precise. For one component it is two outer products.
    swept = belief.covariance - _outer(gain, column)
    crossed = column - gain * variance[..., None]
    updated = swept - _outer(crossed, gain) + noise[..., None] * _outer(gain, gain)
    step = gain * np.asarray(residual)[..., None]
    w = np.asarray(weight)[..., None]
    covariance = w[..., None] * updated + (1.0 - w)[..., None] * belief.covariance
    return _belief(belief.mean + w * step, covariance + (w * (1.0 - w))[..., None] * _outer(step, step))


def _outer(column: FloatArray, row: FloatArray) -> FloatArray:
    return column[..., :, None] * row[..., None, :]


def _belief(mean: FloatArray, covariance: FloatArray) -> MotionBelief:
    mean[..., AZIMUTH] = wrap_angle(mean[..., AZIMUTH])
    return MotionBelief(mean, conditioned(covariance))
