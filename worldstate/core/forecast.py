r"""Where entities will be: constant velocity in modified polar coordinates, all entities at once.

With the state :math:`(\theta, \dot\theta, \rho, \log r)` and its covariance P, after t seconds

.. math:: \theta_t = \theta + \operatorname{atan2}(b, a), \quad a = 1 + \rho t, \quad b = \dot\theta t, \qquad
          \sigma_t^2 = h^T P h + \frac{s t^3}{3 r^2 q}, \quad h = (1, a t / q, -b t / q, 0), \quad
          q = a^2 + b^2,

with white acceleration of density s.
"""

import math
from typing import TypeAlias

import numpy as np

from worldstate.belief.kinematics.motion import FARTHEST_M, NEAREST_M
from worldstate.belief.kinematics.polar import LEAST_Q, LOG_RANGE
from worldstate.belief.settings import FilterSettings
from worldstate.belief.track import PARKED_ACCELERATION, Track
from worldstate.ground.typing import FloatArray

# Beyond two seconds vehicles at junctions have turned or braked.
_AFTER_S = np.array([1.0, 2.0])
_CUBES = _AFTER_S**3 / 3.0
_NAMES = tuple(f"{after_s:g}" for after_s in _AFTER_S)
Forecast: TypeAlias = dict[str, tuple[float, float]]


def forecasts(
    tracks: tuple[Track, ...], means: FloatArray, covariances: FloatArray, settings: FilterSettings
) -> list[Forecast]:
    """Return one forecast a track.

    Shapes: means (n, 4), covariances (n, 4, 4).
    """
    theta, omega, rho, log_range = means.T[:, :, None]
    a, b = 1.0 + rho * _AFTER_S, omega * _AFTER_S
    q = np.maximum(a * a + b * b, LEAST_Q)
    gradient = np.stack([np.ones_like(a), a * _AFTER_S / q, -b * _AFTER_S / q], axis=-1)
    known = (gradient @ covariances[:, :LOG_RANGE, :LOG_RANGE] * gradient).sum(axis=-1)
    density = np.array([settings.acceleration_psd if one.moving else PARKED_ACCELERATION for one in tracks])
    range_m = np.exp(np.minimum(np.maximum(log_range, math.log(NEAREST_M)), math.log(FARTHEST_M)))
    variance = known + density[:, None] * _CUBES / (range_m**2 * q)
    azimuth_rad = theta + np.arctan2(b, a)
    azimuth_rad -= math.tau * np.round(azimuth_rad / math.tau)
    # Full precision would take twice as long to write.
    rows = np.stack([azimuth_rad, np.sqrt(variance)], axis=-1)
    return [dict(zip(_NAMES, map(tuple, row), strict=True)) for row in rows.round(6).tolist()]
