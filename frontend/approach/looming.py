r"""Acoustic looming: the reciprocal of the time to arrival (TTA) from the growth of the sound level.

For a point source at range d the band energy E goes as 1/d^2, eq. (2):

.. math:: \frac{d}{dt} \log E = -2 \frac{\dot d}{d} = \frac{2}{\mathrm{TTA}}

It does not depend on the source level, the distance or a constant attenuation. One window gives two
estimates:

* the slope of log E over the window, which is 2 / TTA near its middle;
* the straight line through E^(-1/2), which is proportional to d. It is exact at constant speed and is
  evaluated at the END of the window.

Both refer to the receiver's clock: sound that arrives now was emitted d / c earlier. Other noise N reduces
both, by a seventh at 10 dB and by two thirds at 0 dB. If N is known, the range is computed from E - N. After
diffraction at a corner, both describe the approach of the sound, not of the vehicle.

The randomness of the sound limits the accuracy, and averaging over microphones does not reduce it. For n
energies over T seconds, each with a relative deviation s = (bandwidth x interval)^(-1/2), the relative error
of TTA is about (s / 2) (TTA / T + 1/2) sqrt(12 / n). For noise from 0.3 to 20 kHz and a TTA of 1 to 3 s, it
is 4.0 % with a window of one second, as used for a stream, and 1.5 % with two seconds.

References
----------
D. Lee, A theory of visual control of braking based on information about time-to-collision, Perception, 1976.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import FloatArray, InvalidArgumentError, NotUsable, finite_array, mean

# Two parameters and the residual deviation need two degrees of freedom.
MIN_POINTS = 4
# Deviation of log E from the fit, nats (3 dB), above which the energy is not that of one approaching source.
MAX_LOG_STD = 0.7
# The fitted range at the end of the window must be this many standard deviations above zero. Closer to zero,
# the quotient 1/TTA has no useful variance.
_MIN_RANGE_SIGMA = 2.0
# Below this ratio at the end of the window (1.8 dB), the beginning of the window is noise only.
_LEAST_RATIO = 1.5
# Smallest share of an energy that is attributed to the source, for the first guess only; steps of the
# subsequent fit (a third one changes 1/TTA by less than a tenth of its error); smallest ratio of the ranges.
_LEAST_EXCESS, _STEPS, _LEAST_RANGE = 0.1, 2, 0.02


@dataclass(frozen=True, slots=True)
class Looming:
    r"""Approach rate from the growth of the sound level.

    .. math:: \frac{1}{\mathrm{TTA}} = -\frac{\dot d}{d}, \qquad \frac{d}{dt} \log E = \frac{2}{\mathrm{TTA}}

    Parameters
    ----------
    inverse_tta_hz : float
        1/TTA = -d_dot / d at the end of the window, from the line through E^(-1/2), 1/s, positive for an
        approach.
    std_hz : float
        Its standard error, 1/s, > 0.
    log_slope_hz : float
        Slope of log E over the window, 1/s: 2 / TTA near its middle.

    Examples
    --------
    >>> Looming(0.5, 0.05, 0.8).inverse_tta_hz
    0.5
    """

    inverse_tta_hz: float
    std_hz: float
    log_slope_hz: float


def looming(
    times_s: ArrayLike,
    log_energy: ArrayLike,
    floor_std: float,
    noise_energy: float = 0.0,
    noise_energy_std: float = 0.0,
) -> Looming | NotUsable:
    r"""Estimate 1/TTA from one window of band energies, eq. (2).

    .. math:: (E - N)^{-1/2}(t) \propto a + b\, t, \quad
              \frac{1}{\mathrm{TTA}} = -\frac{b}{a} \text{ at } t = 0, \qquad
              \frac{d}{dt} \log E = \frac{2}{\mathrm{TTA}}

    The fit is weighted by the energies of the model, because log E has a constant variance.

    Parameters
    ----------
    times_s : array_like, shape (n,)
        Centre of each energy's interval relative to the END of the window, ascending, seconds; n >= 4.
    log_energy : array_like, shape (n,)
        Natural logarithm of the band energy.
    floor_std : float
        Standard deviation of `log_energy` by chance, nats, > 0: 1 / sqrt(bandwidth x interval) for noise-like
        sound. It is the lower limit for the standard errors.
    noise_energy, noise_energy_std : float
        Mean energy N of all other sources, in the unit of E, and its standard deviation.

    Returns
    -------
    Looming or NotUsable
        Rates in 1/s; the slope of log E includes the noise. Not usable if the energies deviate from the fit
        by more than 3 dB, if the fitted range is zero within its error, or if the source has less than 1.5
        times the energy of the noise.

    Raises
    ------
    InvalidArgumentError
        If there are fewer than four points, shapes differ, times are unsorted or numbers are not finite.

    References
    ----------
    "Evidence of Absence", eq. (2); D. Lee, "A theory of visual control of braking based on information about
    time-to-collision", Perception 5, 1976. The line through :math:`E^{-1/2}` is derived here.

    Examples
    --------
    A source that is 20 m away at the end of the window and approaches at 10 m/s:

    >>> times_s = np.arange(-0.95, 0.0, 0.1)
    >>> found = looming(times_s, -2 * np.log(20 - 10 * times_s), floor_std=0.01)
    >>> round(found.inverse_tta_hz, 3), round(found.log_slope_hz / 2, 3)
    (0.5, 0.403)

    The same source in noise that is as loud as the source at the end:

    >>> energy = (20 - 10 * times_s) ** -2.0 + 1 / 1000
    >>> round(looming(times_s, np.log(energy), 0.01, noise_energy=1 / 1000).inverse_tta_hz, 3)
    0.5
    """
    times = finite_array("times_s", times_s, (None,))
    energies = finite_array("log_energy", log_energy, times.shape)
    if len(times) < MIN_POINTS or np.any(np.diff(times) <= 0.0) or not floor_std > 0.0:
        raise InvalidArgumentError(f"times_s: expected {MIN_POINTS} or more ascending times, floor_std > 0")
    return approach_rate(times, energies, floor_std, noise_energy, noise_energy_std)


def approach_rate(
    times: FloatArray, energies: FloatArray, floor_std: float, noise_energy: float, noise_energy_std: float
) -> Looming | NotUsable:
    """Return the result of `looming` without checks of the arguments."""
    level = float(mean(energies))
    scale = float(np.exp(-level))
    design = np.array([np.ones(len(times)), times])
    log_slope, _, log_scatter = _fit_line(design, energies - level, None)
    source = _fit_source(design, np.exp(energies - level), noise_energy * scale)
    if source is None:
        return NotUsable("range reaches zero within the window")
    at_end, slope, scatter, unit, by_noise = source
    if min(log_scatter, scatter) > MAX_LOG_STD:
        return NotUsable("energy scatters by more than 3 dB about the fit")
    if at_end**-2 < _LEAST_RATIO * noise_energy * scale:
        return NotUsable(f"the source has less than {_LEAST_RATIO} times the energy of the noise")
    scatter, noise_std = max(scatter, floor_std), noise_energy_std * scale
    covariance = scatter**2 * unit + noise_std**2 * by_noise[:, None] * by_noise
    if at_end < _MIN_RANGE_SIGMA * math.sqrt(covariance[0, 0]):
        return NotUsable("range reaches zero within the error of the window")
    rate = -slope / at_end
    gradient = np.array([-rate, -1.0]) / at_end
    return Looming(rate, math.sqrt(gradient @ covariance @ gradient), log_slope)


def _fit_source(
    design: FloatArray, energy: FloatArray, noise: float
) -> tuple[float, float, float, FloatArray, FloatArray] | None:
    """Fit E = N + (a + b t)^-2 with errors proportional to E; None if the range reaches zero.

    Return a, b, the relative deviation of the energies, the covariance of (a, b) for a relative deviation of
    one, (2, 2), and the derivative of (a, b) by the noise, (2,).
    """
    # Gauss-Newton from the line through E^(-1/2).
    excess = np.log(np.maximum(energy - noise, _LEAST_EXCESS * energy))
    # Weights from the smooth exponential fit, because weights from the noisy values would bias the line.
    times, (smooth_slope, smooth_level, _) = design[1], _fit_line(design, excess, None)
    weights = np.exp(smooth_level + smooth_slope * times)
    slope, level, _ = _fit_line(design, np.exp(-0.5 * excess), weights)
    for _ in range(_STEPS + 1):
        # A straight line has its minimum at one end.
        ranges, ends = level + slope * times, (level + slope * times[0], level + slope * times[-1])
        if min(ends) <= _LEAST_RANGE * max(ends):
            return None
        power = 1.0 / (ranges * ranges)
        weights = 1.0 / (power + noise)
        by_level = -2.0 * power / ranges * weights
        jacobian = np.array([by_level, by_level * times])
        residual = (energy - noise - power) * weights
        (a, b), (_, d) = (jacobian @ jacobian.T).tolist()
        covariance = np.array([[d, -b], [-b, a]]) / (a * d - b * b)
        steps = (covariance @ (jacobian @ residual)).tolist()
        level, slope = level + steps[0], slope + steps[1]
    # The residuals are those before the last step, which is too small to matter.
    scatter = math.sqrt(residual @ residual / (len(times) - 2))
    return level, slope, scatter, covariance, -covariance @ (jacobian @ weights)


def _fit_line(
    design: FloatArray, values: FloatArray, weights: FloatArray | None
) -> tuple[float, float, float]:
    """Fit a line to rows of ones and of times by (weighted) least squares; return slope, level, deviation."""
    weighted = design if weights is None else design * weights
    (s0, s1), (_, s2) = (weighted @ design.T).tolist()
    v0, v1 = (weighted @ values).tolist()
    determinant = s0 * s2 - s1 * s1
    slope, level = (s0 * v1 - s1 * v0) / determinant, (s2 * v0 - s1 * v1) / determinant
    squared = (values - level - slope * design[1]) ** 2
    total = np.add.reduce(squared) if weights is None else squared @ weights
    return slope, level, math.sqrt(total / (len(values) - 2))


# An approach is audible for three to six seconds. The lower third of half a minute is therefore noise; that
# of less than five seconds is not.
_LONGEST_HOPS, _FEWEST_HOPS = 300, 50
_Z10, _Z30 = -1.2816, -0.5244
# With a shorter history, the noise is between zero and the lowest energy of the window.
_UNKNOWN_SHARE = 0.25


class EnergyFloor:
    r"""Running level of the noise without an approaching source.

    It is computed from lower quantiles of the log-energies of the last half minute, assuming a normal
    distribution:

    .. math:: \sigma = \frac{q_{30} - q_{10}}{\Phi^{-1}(0.3) - \Phi^{-1}(0.1)}, \qquad
              \log N = q_{30} - \Phi^{-1}(0.3)\, \sigma
    """

    def __init__(self) -> None:
        self._log_energies: deque[float] = deque(maxlen=_LONGEST_HOPS)

    def push(self, energy: float) -> None:
        """Add the energy of a hop; zero energy is ignored."""
        if energy > 0.0:
            self._log_energies.append(math.log(energy))

    def read(self, lowest: float, least_log_std: float) -> tuple[float, float]:
        """Return mean and deviation; for a short history, zero and a share of the lowest energy."""
        count = len(self._log_energies)
        if count < _FEWEST_HOPS:
            return 0.0, _UNKNOWN_SHARE * lowest
        tenth, third = count // 10, 3 * count // 10
        ordered = np.partition(np.fromiter(self._log_energies, np.float64, count), (tenth, third))
        spread = max(float(ordered[third] - ordered[tenth]) / (_Z30 - _Z10), least_log_std)
        mean = math.exp(float(ordered[third]) - _Z30 * spread)
        return mean, spread * mean
