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

import math

import numpy as np

from worldstate.ground.typing import FloatArray

AZIMUTH, AZIMUTH_RATE, RADIAL_RATE, LOG_RANGE = range(4)

# q = 0 is a vehicle at the array itself, where the coordinates are singular; 1e-3 is 3 % of the first range.
LEAST_Q = 1e-3


def propagate(state: FloatArray, step_s: float) -> FloatArray:
    """Return the state (theta, theta_dot, rho, log r) after `step_s`, shape (4,); theta is not wrapped.

    Shapes: state (4,).
    """
    theta, omega, rho, log_range = state.tolist()
    a, b = 1.0 + rho * step_s, omega * step_s
    q = max(a * a + b * b, LEAST_Q)
    return np.array(
        [theta + math.atan2(b, a), omega / q, (a * rho + b * omega) / q, log_range + 0.5 * math.log(q)]
    )


def jacobian(state: FloatArray, step_s: float) -> FloatArray:
    """Return d propagate / d state, shape (4, 4).

    Shapes: state (4,).
    """
    _, omega, rho, _ = state.tolist()
    t = step_s
    a, b = 1.0 + rho * t, omega * t
    q = max(a * a + b * b, LEAST_Q)
    radial = a * rho + b * omega
    u, v = a / q, b / q
    return np.array(
        [
            [1.0, u * t, -v * t, 0.0],
            [0.0, (1.0 - 2.0 * b * v) / q, -2.0 * omega * u * t / q, 0.0],
            [0.0, 2.0 * (omega - radial * v) * t / q, (1.0 + 2.0 * (rho - radial * u) * t) / q, 0.0],
            [0.0, v * t, u * t, 1.0],
        ]
    )


def process_noise(acceleration_psd: float, range_m: float, step_s: float) -> FloatArray:
    r"""Return Q, shape (4, 4), of a white acceleration: at range r it turns and closes by a/r."""
    q, t = acceleration_psd / range_m**2, step_s
    twice, once, rate = q * t**3 / 3.0, q * t**2 / 2.0, q * t
    return np.array(
        [[twice, once, 0.0, 0.0], [once, rate, 0.0, 0.0], [0.0, 0.0, rate, once], [0.0, 0.0, once, twice]]
    )
