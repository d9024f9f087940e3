r"""Frequency of a tone that passes by on a straight line, on the receiver's clock.

At emission time tau a source of speed v, closest at range d when tau = tau_0, has

.. math:: r(\tau) = \sqrt{d^2 + v^2 (\tau - \tau_0)^2}, \qquad v_r = v^2 (\tau - \tau_0) / r,

and arrives at :math:`t = \tau + r(\tau)/c` with frequency :math:`f_r = f_0 / (1 + v_r / c)`. With
:math:`T = t - \tau_0` the emission time is closed-form,

.. math:: \tau - \tau_0 = \frac{c^2 T - \sqrt{d^2 (c^2 - v^2) + v^2 c^2 T^2}}{c^2 - v^2}.

Source: P. M. Morse and K. U. Ingard, *Theoretical Acoustics*, 1968, section 11.2 (sound of a moving source).
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from worldstate.ground.typing import FloatArray

# Limits of the fit: a slower source has no visible S-curve, a farther one no audible line.
SLOWEST_M_S, NEAREST_M, FARTHEST_M = 0.5, 0.3, 300.0
# Starting points of the fit, because chi-squared has local minima: times of the closest approach as shares of
# the track, and pairs of speed and range.
START_PLACES = (-0.1, 0.15, 0.35, 0.5, 0.65, 0.85, 1.1)
START_SHAPES = ((8.0, 4.0), (20.0, 10.0))
PARAMETERS = 4
# All starts are followed for a few evaluations, the best two to convergence.
ROUGH_EVALUATIONS, EVALUATIONS, FINALISTS = 12, 300, 2


@dataclass(frozen=True, slots=True)
class PassBy:
    """Parameters of a fitted pass-by with their covariance."""

    values: FloatArray  # f_0 in Hz, v in m/s, tau_0 in seconds on the receiver's clock, d in metres
    covariance: FloatArray  # Of these, from the information of the fit
    chi_squared: float  # Sum of squared normalised residuals


def radial_speed_m_s(
    time_s: FloatArray, speed_m_s: float, closest_s: float, range_m: float, sound_m_s: float
) -> FloatArray:
    r"""Return the radial speed at emission of the sound that arrives at `time_s`, positive while receding.

    .. math:: v_r = \frac{v^2 s}{\sqrt{d^2 + v^2 s^2}}, \qquad
              s = \frac{c^2 T - \sqrt{d^2 (c^2 - v^2) + v^2 c^2 T^2}}{c^2 - v^2}, \quad T = t - \tau_0

    Examples
    --------
    >>> radial_speed_m_s(np.array([-100.0, 0.01, 100.0]), 15.0, 0.0, 3.43, 343.0).round(2)
    array([-15.,   0.,  15.])
    """
    c, v, d = sound_m_s, speed_m_s, range_m
    T = time_s - closest_s
    emission = (c**2 * T - np.sqrt(d**2 * (c**2 - v**2) + (v * c * T) ** 2)) / (c**2 - v**2)
    return np.asarray(v**2 * emission / np.sqrt(d**2 + (v * emission) ** 2))


def fit_pass_by(
    time_s: FloatArray,
    frequency_hz: FloatArray,
    std_hz: FloatArray,
    max_speed_m_s: float,
    sound_m_s: float,
) -> PassBy:
    r"""Fit the four parameters by weighted least squares from several starting points.

    .. math:: \chi^2 = \min_{f_0, v, \tau_0, d} \sum_k
              \frac{\big[f_0 / (1 + v_r(t_k) / c) - f_k\big]^2}{\sigma_k^2}, \qquad
              \mathrm{cov} = (J^T J)^{-1}

    Shapes: time_s, frequency_hz, std_hz (K,).
    """
    duration = float(np.ptp(time_s))
    low = np.array([0.7 * frequency_hz.min(), SLOWEST_M_S, time_s[0] - 2 * duration - 1, NEAREST_M])
    high = np.array([1.4 * frequency_hz.max(), max_speed_m_s, time_s[-1] + 2 * duration + 1, FARTHEST_M])

    def residuals(values: FloatArray) -> FloatArray:
        received = values[0] / (1 + _radial_speed(time_s, values, sound_m_s) / sound_m_s)
        return np.asarray((received - frequency_hz) / std_hz)

    scale = np.array([frequency_hz.mean() * 0.01, 5.0, 0.5, 5.0])

    def fit(start: FloatArray, evaluations: int) -> OptimizeResult:
        inside = np.clip(start, low, high)
        return least_squares(residuals, inside, bounds=(low, high), x_scale=scale, max_nfev=evaluations)

    rough = [fit(start, ROUGH_EVALUATIONS) for start in _starts(time_s, frequency_hz)]
    rough.sort(key=lambda found: float(found.cost))
    finals = [fit(found.x, EVALUATIONS) for found in rough[:FINALISTS]]
    best = min(finals, key=lambda found: float(found.cost))
    covariance = np.linalg.pinv(best.jac.T @ best.jac, rcond=1e-14)
    return PassBy(best.x, covariance, 2.0 * float(best.cost))


def radial_speed_gradient(time_s: FloatArray, values: FloatArray, sound_m_s: float) -> FloatArray:
    r"""Differentiate the radial speed by (f_0, v, tau_0, d) with central differences, shape (K, 4).

    .. math:: \frac{\partial v_r}{\partial p_i} \approx \frac{v_r(p + h_i) - v_r(p - h_i)}{2 h_i}, \qquad
              h_i = 10^{-5} \max(1, |p_i|)

    Shapes: time_s (K,), values (4,).

    Examples
    --------
    >>> radial_speed_gradient(np.array([60.0]), np.array([100.0, 12.0, 0.0, 5.0]), 343.0).round(3) + 0.0
    array([[0., 1., 0., 0.]])
    """
    columns = [np.zeros_like(time_s)]
    for k in (1, 2, 3):
        step = np.zeros(4)
        step[k] = 1e-5 * max(1.0, abs(values[k]))
        ahead, behind = (_radial_speed(time_s, values + side, sound_m_s) for side in (step, -step))
        columns.append((ahead - behind) / (2 * step[k]))
    return np.stack(columns, axis=1)


def _radial_speed(time_s: FloatArray, values: FloatArray, sound_m_s: float) -> FloatArray:
    _, speed, closest, distance = values
    return radial_speed_m_s(time_s, float(speed), float(closest), float(distance), sound_m_s)


def _starts(time_s: FloatArray, frequency_hz: FloatArray) -> list[FloatArray]:
    middle = 0.5 * (frequency_hz.min() + frequency_hz.max())
    duration = float(np.ptp(time_s))
    return [
        np.array([middle, v, time_s[0] + place * duration, d])
        for place in START_PLACES
        for v, d in START_SHAPES
    ]
