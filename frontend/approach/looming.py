r"""Acoustic looming: the reciprocal time to arrival from the growth of the sound level.

For a point source at range d the band energy E goes as 1/d^2, eq. (2):

.. math:: \frac{d}{dt} \log E = -2 \frac{\dot d}{d} = \frac{2}{\mathrm{TTA}}

It depends on neither the source level nor the distance nor a constant attenuation. One window is read twice:

* the slope of log E over the window, which is 2 / TTA somewhere near its middle; * the straight line through
E^(-1/2), which is proportional to d itself: exact at constant speed, and evaluated
  at the END of the window.

Both are on the receiver's clock: what arrives now was emitted d / c ago. Noise from elsewhere and diffraction
round a corner bias both: what is measured is then the approach of the sound, not of the vehicle.

The accuracy is limited by the randomness of the sound itself, which no number of microphones averages out: n
energies over T seconds, each of scatter s = (bandwidth x interval)^(-1/2), give TTA with a relative error of
about (s / 2) (TTA / T + 1/2) sqrt(12 / n). Noise from 0.3 to 20 kHz, 1 to 3 s away, scattered by 4.0 % when
read from one second and by 1.5 % when read from two: `FrontEndSettings.looming_hops` is that choice.

References
----------
D. Lee, A theory of visual control of braking based on information about time-to-collision, Perception, 1976.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable

# Two parameters and a scatter of their own need two degrees of freedom.
MIN_POINTS = 4
# Scatter of log E about the fit, nats (3 dB), beyond which energy is not that of one approaching source.
MAX_LOG_STD = 0.7
# The fitted range at the end of the window must be this many standard deviations from zero: nearer to it the
# quotient 1/TTA has no useful variance.
_MIN_RANGE_SIGMA = 2.0


@dataclass(frozen=True, slots=True)
class Looming:
    r"""Approach rate from the growth of the sound level.

    .. math:: \frac{1}{\mathrm{TTA}} = -\frac{\dot d}{d}, \qquad \frac{d}{dt} \log E = \frac{2}{\mathrm{TTA}}

    Parameters
    ----------
    inverse_tta_hz : float
        1/TTA = -d_dot / d at the end of the window from the line through E^(-1/2), 1/s, positive while
        closing.
    std_hz : float
        Its standard error, 1/s, > 0.
    log_slope_hz : float
        Slope of log E over the window, 1/s: 2 / TTA near its middle.
    log_slope_std_hz : float
        Its standard error, 1/s.

    Examples
    --------
    >>> Looming(0.5, 0.05, 0.8, 0.1).inverse_tta_hz
    0.5
    """

    inverse_tta_hz: float
    std_hz: float
    log_slope_hz: float
    log_slope_std_hz: float


def looming(times_s: ArrayLike, log_energy: ArrayLike, floor_std: float) -> Looming | NotUsable:
    r"""Estimate 1/TTA from one window of band energies, eq. (2).

    .. math:: E^{-1/2}(t) \propto a + b\, t, \quad
              \frac{1}{\mathrm{TTA}} = -\frac{b}{a} \text{ at } t = 0, \qquad
              \frac{d}{dt} \log E = \frac{2}{\mathrm{TTA}}

    The line through :math:`E^{-1/2}` is weighted by the square of the exponential fit, because log E scatters
    evenly and E^(-1/2) in proportion to its value.

    Parameters
    ----------
    times_s : array_like, shape (n,)
        Centre of each energy's interval relative to the END of the window, ascending, seconds; n >= 4.
    log_energy : array_like, shape (n,)
        Natural logarithm of the band energy.
    floor_std : float
        Standard deviation of `log_energy` by chance alone, nats, > 0: 1 / sqrt(bandwidth x interval) for
        noise-like sound. The standard errors assume at least this.

    Returns
    -------
    Looming or NotUsable
        Rates in 1/s. Not usable if the energies scatter by more than 3 dB about the fit, or if the fitted
        range reaches zero within its error.

    Raises
    ------
    InvalidArgumentError
        On fewer than four points, another shape, unsorted times or numbers that are not finite.

    References
    ----------
    "Evidence of Absence", eq. (2); D. Lee, "A theory of visual control of braking based on information about
    time-to-collision", Perception 5, 1976. The line through :math:`E^{-1/2}` is derived here.

    Examples
    --------
    A source 20 m away at the end of the window, closing at 10 m/s:

    >>> times_s = np.arange(-0.95, 0.0, 0.1)
    >>> found = looming(times_s, -2 * np.log(20 - 10 * times_s), floor_std=0.01)
    >>> round(found.inverse_tta_hz, 3), round(found.log_slope_hz / 2, 3)
    (0.5, 0.403)
    """
    times = finite_array("times_s", times_s, (None,))
    energies = finite_array("log_energy", log_energy, times.shape)
    floor = in_range("floor_std", floor_std, 0.0, np.inf, open_low=True, open_high=True)
    if len(times) < MIN_POINTS or np.any(np.diff(times) <= 0.0):
        raise InvalidArgumentError(f"times_s: expected {MIN_POINTS} or more ascending times, got {times}")
    return fitted_looming(times, energies, floor)


def fitted_looming(times: FloatArray, energies: FloatArray, floor: float) -> Looming | NotUsable:
    """Return what `looming` does for arrays that are finite and fit each other.

    Shapes: times (n,), energies (n,).
    """
    centred = energies - energies.mean()
    exponential = _fit_line(times, centred, np.ones_like(times))
    # Weights from the exponential fit, which is smooth: weights from the noisy values would bias the line.
    model = np.exp(-0.5 * (exponential.level + exponential.slope * times))
    straight = _fit_line(times, np.exp(-0.5 * centred), model)
    scatter = 2.0 * straight.scatter
    if min(exponential.scatter, scatter) > MAX_LOG_STD:
        return NotUsable("energy scatters by more than 3 dB about the fit")
    return _read(exponential, straight, max(exponential.scatter, floor), 0.5 * max(scatter, floor))


def _read(exponential: "_Line", straight: "_Line", log_std: float, range_std: float) -> Looming | NotUsable:
    level, slope = straight.level, straight.slope
    if level < _MIN_RANGE_SIGMA * range_std * np.sqrt(straight.level_variance):
        return NotUsable("range reaches zero within the error of the window")
    rate = -slope / level
    variance = straight.slope_variance + rate**2 * straight.level_variance + 2.0 * rate * straight.covariance
    return Looming(
        inverse_tta_hz=rate,
        std_hz=float(range_std / level * np.sqrt(variance)),
        log_slope_hz=exponential.slope,
        log_slope_std_hz=float(log_std * np.sqrt(exponential.slope_variance)),
    )


@dataclass(frozen=True, slots=True)
class _Line:
    """Line ``value = level + slope t`` with variances for relative errors of unit variance."""

    slope: float
    level: float
    scatter: float
    slope_variance: float
    level_variance: float
    covariance: float


def _fit_line(times: FloatArray, values: FloatArray, scale: FloatArray) -> _Line:
    """Fit a line whose errors are in proportion to `scale`: closed form of weighted least squares."""
    weights = scale**-2.0
    s0, s1, s2 = float(weights.sum()), float(weights @ times), float(weights @ times**2)
    v0, v1 = float(weights @ values), float((weights * times) @ values)
    determinant = s0 * s2 - s1 * s1
    slope, level = (s0 * v1 - s1 * v0) / determinant, (s2 * v0 - s1 * v1) / determinant
    residual = (values - level - slope * times) / scale
    scatter = float(np.sqrt(residual @ residual / (len(times) - 2)))
    return _Line(slope, level, scatter, s0 / determinant, s2 / determinant, -s1 / determinant)
