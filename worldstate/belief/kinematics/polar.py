r"""Constant velocity seen from a standing ego, in modified polar coordinates.

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

import numpy as np

from worldstate.ground.typing import FloatArray

AZIMUTH, AZIMUTH_RATE, RADIAL_RATE, LOG_RANGE = range(4)

# q = 0 is a vehicle at the array itself, where the coordinates are singular; 1e-3 is 3 % of the first range.
LEAST_Q = 1e-3


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


def process_noise(
    acceleration_psd: float | FloatArray, range_m: float | FloatArray, step_s: float
) -> FloatArray:
    r"""Return Q, shape (..., 4, 4), of a white acceleration: at range r it turns and closes by a/r."""
    q = np.asarray(acceleration_psd / np.square(range_m))
    return q[..., None, None] * _unit_noise(step_s)


def _unit_noise(t: float) -> FloatArray:
    twice, once, rate = t**3 / 3.0, t**2 / 2.0, t
    return np.array(
        [[twice, once, 0.0, 0.0], [once, rate, 0.0, 0.0], [0.0, 0.0, rate, once], [0.0, 0.0, once, twice]]
    )
