r"""Radial speed from the Doppler shift of an engine line, if it is identifiable.

.. math:: f_r = f_0 / (1 + v_r / c), \qquad v_r > 0 \text{ receding},

on the receiver's clock, with v_r at the time of emission. The rest frequency f_0 of an unknown vehicle is
unknown, and the speed of its engine varies, so a change of the line alone does not show motion. It is
interpreted as Doppler shift only if, within the measured variance, the S-curve of a straight pass-by explains
it better than a constant line or a smoothly drifting engine. In addition, the harmonics must agree and the
level must follow the range of this pass-by. Otherwise the result is `NotUsable`.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import OptimizeResult, least_squares

from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S
from worldstate.ground import FloatArray, NotUsable

from .engine_line import HarmonicTrack

# Limits of the fit: a slower source has no visible S-curve, and the line of a more distant one is inaudible.
SLOWEST_M_S, FASTEST_M_S, NEAREST_M, FARTHEST_M = 0.5, 40.0, 0.3, 300.0
# Starting points of the fit, because chi-squared has local minima: times of the closest approach relative to
# the track, and pairs of speed and range.
START_PLACES = (-0.1, 0.15, 0.35, 0.5, 0.65, 0.85, 1.1)
START_SHAPES = ((8.0, 4.0), (20.0, 10.0))
PARAMETERS = 4
# All starts get some evaluations, and the best two continue to convergence.
ROUGH_EVALUATIONS, EVALUATIONS, FINALISTS = 12, 300, 2


def radial_speed_m_s(time_s: FloatArray, speed_m_s: float, closest_s: float, range_m: float) -> FloatArray:
    r"""Return the radial speed at emission for sound that arrives at `time_s`, positive while receding.

    At the emission time tau, a source with speed v and a smallest range d at tau = tau_0 has

    .. math:: r(\tau) = \sqrt{d^2 + v^2 (\tau - \tau_0)^2}, \qquad v_r = v^2 (\tau - \tau_0) / r,

    The sound arrives at :math:`t = \tau + r(\tau)/c` with frequency :math:`f_r = f_0 / (1 + v_r / c)`. With
    :math:`T = t - \tau_0` the emission time has the closed form

    .. math:: \tau - \tau_0 = \frac{c^2 T - \sqrt{d^2 (c^2 - v^2) + v^2 c^2 T^2}}{c^2 - v^2}.

    Source: P. M. Morse and K. U. Ingard, *Theoretical Acoustics*, 1968, section 11.2 (sound of a moving
    source).

    Examples
    --------
    >>> radial_speed_m_s(np.array([-100.0, 0.01, 100.0]), 15.0, 0.0, 3.43).round(2)
    array([-15.,   0.,  15.])
    """
    c, v, d = SPEED_OF_SOUND_M_S, speed_m_s, range_m
    T = time_s - closest_s
    emission = (c**2 * T - np.sqrt(d**2 * (c**2 - v**2) + (v * c * T) ** 2)) / (c**2 - v**2)
    return np.asarray(v**2 * emission / np.sqrt(d**2 + (v * emission) ** 2))


def fit_pass_by(
    time_s: FloatArray, frequency_hz: FloatArray, std_hz: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    r"""Fit f_0, v, tau_0 and d from several starting points; return values, covariance and chi-squared.

    .. math:: \chi^2 = \min_{f_0, v, \tau_0, d} \sum_k
              \frac{\big[f_0 / (1 + v_r(t_k) / c) - f_k\big]^2}{\sigma_k^2}, \qquad
              \mathrm{cov} = (J^T J)^{-1}

    Shapes: time_s, frequency_hz, std_hz (K,).
    """
    duration = float(np.ptp(time_s))
    low = np.array([0.7 * frequency_hz.min(), SLOWEST_M_S, time_s[0] - 2 * duration - 1, NEAREST_M])
    high = np.array([1.4 * frequency_hz.max(), FASTEST_M_S, time_s[-1] + 2 * duration + 1, FARTHEST_M])

    def residuals(values: FloatArray) -> FloatArray:
        received = values[0] / (1 + radial_speed_m_s(time_s, *values[1:]) / SPEED_OF_SOUND_M_S)
        return np.asarray((received - frequency_hz) / std_hz)

    scale = np.array([frequency_hz.mean() * 0.01, 5.0, 0.5, 5.0])

    def fit(start: FloatArray, evaluations: int) -> OptimizeResult:
        inside = np.clip(start, low, high)
        return least_squares(residuals, inside, bounds=(low, high), x_scale=scale, max_nfev=evaluations)

    middle = 0.5 * (frequency_hz.min() + frequency_hz.max())
    starts = product((time_s[0] + place * duration for place in START_PLACES), START_SHAPES)
    rough = [fit(np.array([middle, v, closest, d]), ROUGH_EVALUATIONS) for closest, (v, d) in starts]
    rough.sort(key=lambda found: float(found.cost))
    finals = [fit(found.x, EVALUATIONS) for found in rough[:FINALISTS]]
    best = min(finals, key=lambda found: float(found.cost))
    covariance = np.linalg.pinv(best.jac.T @ best.jac, rcond=1e-14)
    return best.x, covariance, 2.0 * float(best.cost)


def radial_speed_gradient(time_s: FloatArray, values: FloatArray) -> FloatArray:
    r"""Return derivatives of the radial speed by (f_0, v, tau_0, d), shape (K, 4), by central differences.

    .. math:: \frac{\partial v_r}{\partial p_i} \approx \frac{v_r(p + h_i) - v_r(p - h_i)}{2 h_i}, \qquad
              h_i = 10^{-5} \max(1, |p_i|)

    Shapes: time_s (K,), values (4,).

    Examples
    --------
    >>> radial_speed_gradient(np.array([60.0]), np.array([100.0, 12.0, 0.0, 5.0])).round(3) + 0.0
    array([[0., 1., 0., 0.]])
    """
    columns = [np.zeros_like(time_s)]
    for k in (1, 2, 3):
        step = np.zeros(4)
        step[k] = 1e-5 * max(1.0, abs(values[k]))
        ahead, behind = (radial_speed_m_s(time_s, *(values + side)[1:]) for side in (step, -step))
        columns.append((ahead - behind) / (2 * step[k]))
    return np.stack(columns, axis=1)


# A drifting engine: polynomials up to a cubic, which has as many parameters as the S-curve.
DRIFT_DEGREES = (1, 2, 3)
# If the expected level changes less, it cannot be tested, because engines vary by as much.
LEAST_SWING_DB = 3.0
# Fewest windows in the track, three per parameter of the S-curve, and their smallest share of the analysed
# windows.
_FEWEST_WINDOWS, _LEAST_SHARE = 12, 0.6
# Largest median reduced chi-squared of the harmonics relative to one fundamental, and largest of the S-curve.
_MOST_DISAGREEMENT, _MOST_MISFIT = 4.0, 4.0
# Relative standard deviation added to every frequency: the jitter of a steady engine.
_JITTER = 3e-4
# Smallest difference in BIC to each alternative; 10 is "very strong" on the usual scale.
_LEAST_GAIN = 10.0
# Limits for the slope of the line's level over -20 log10 of the fitted range (1 in the free field), and their
# smallest correlation. The level of a slowing engine at the kerb remains constant.
_LEVEL_GAINS, _LEAST_CORRELATION = (0.4, 2.5), 0.8
_MOST_STD_M_S = 1.0  # Largest median standard deviation of the radial speed over the track


@dataclass(frozen=True, slots=True)
class RadialSpeed:
    r"""Radial speed of one vehicle over its track.

    .. math:: v_r(t) = \frac{d}{dt} |p(t)| \quad \text{at emission, positive while receding}

    Parameters
    ----------
    time_s : ndarray, shape (K,)
        Time on the receiver's clock, as in the track, seconds.
    radial_speed_m_s : ndarray, shape (K,)
        v_r at emission, m/s, positive while receding.
    variance_m2_s2 : ndarray, shape (K,)
        Its variance from the fit, (m/s) squared.
    rest_frequency_hz : float
        f_0, Hz.
    speed_m_s, closest_range_m, closest_time_s : float
        Speed v (m/s) and smallest range d (m) of the straight pass-by, and the arrival time (s) of the sound
        from the closest point.
    misfit : float
        Reduced chi-squared of the S-curve.

    Examples
    --------
    >>> at_rest = RadialSpeed(*np.zeros((3, 1)), 100.0, 12.0, 5.0, 2.0, misfit=1.1)
    >>> at_rest.rest_frequency_hz, at_rest.speed_m_s
    (100.0, 12.0)
    """

    time_s: FloatArray
    radial_speed_m_s: FloatArray
    variance_m2_s2: FloatArray
    rest_frequency_hz: float
    speed_m_s: float
    closest_range_m: float
    closest_time_s: float
    misfit: float


def radial_speed(track: HarmonicTrack, *, min_partials: int = 1) -> RadialSpeed | NotUsable:
    r"""Estimate the radial speed from a tracked engine line, or return the reason why it is unknown.

    The S-curve with k = 4 parameters (f_0, v, tau_0, d) is compared with a constant line and with polynomial
    drifts over the K windows by

    .. math:: f_r = \frac{f_0}{1 + v_r / c}, \qquad \mathrm{BIC} = \chi^2 + k \ln K.

    Parameters
    ----------
    track : HarmonicTrack
        From `worldstate.frontend.approach.engine_line.track_fundamental`.
    min_partials : int
        Fewest harmonics (median over windows); with 1, a single tone is accepted without a check of
        agreement.

    Returns
    -------
    RadialSpeed or NotUsable
        The reason is one of: too few windows, too few harmonics, harmonics that disagree, a constant line, a
        line that a drift explains equally well, a line that no S-curve explains, a level that does not follow
        the range, or too large a variance.

    Notes
    -----
    If the engine speed decreases along an S-curve during the pass-by, the estimated speed is too high,
    because line and level are the same as for a faster vehicle (5 of 100 simulated decelerations by 10 %
    within a passage, none of 100 at the kerb).

    References
    ----------
    "Evidence of Absence", section IV; P. M. Morse and K. U. Ingard, *Theoretical Acoustics*, 1968, section
    11.2 (the S-curve); G. Schwarz, "Estimating the dimension of a model", Ann. Statist. 6, 1978 (BIC).

    Examples
    --------
    >>> t = np.arange(0.0, 4.0, 0.1)
    >>> v_r = radial_speed_m_s(t, 12.0, 2.0, 5.0)
    >>> ones, level_db = np.ones(40), -20 * np.log10(np.hypot(5, 12 * (t - 2)))
    >>> rest = (1e-4 * ones, ones.astype(int), 0 * ones, level_db, 40)
    >>> moving = radial_speed(HarmonicTrack(t, 100 / (1 + v_r / 343), *rest))
    >>> bool(np.abs(moving.radial_speed_m_s - v_r).max() < 0.01)
    True
    >>> radial_speed(HarmonicTrack(t, 100 * ones, *rest))
    NotUsable(reason='the line does not move: its frequency at rest is unknown')
    """
    time, frequency = track.time_s, track.frequency_hz
    insufficient = _insufficient(track, min_partials)
    if insufficient is not None:
        return insufficient
    std = np.sqrt(track.variance_hz2 + (_JITTER * frequency) ** 2)
    values, covariance, chi_squared = fit_pass_by(time, frequency, std)
    speed = _read_out(time, values, covariance, chi_squared)
    rejected = _rejected(time, frequency, std, chi_squared) or _wrong_level(track.level_db, speed)
    if rejected is not None:
        return rejected
    typical = float(np.sqrt(np.median(speed.variance_m2_s2)))
    if not typical <= _MOST_STD_M_S:
        return NotUsable(f"radial speed known to {typical:.1f} m/s only, more than {_MOST_STD_M_S:g}")
    return speed


def _insufficient(track: HarmonicTrack, min_partials: int) -> NotUsable | None:
    found = len(track.time_s)
    if found < _FEWEST_WINDOWS or found < _LEAST_SHARE * track.windows:
        return NotUsable(f"no stable line: found in {found} of {track.windows} windows")
    count = float(np.median(track.n_partials))
    if count < min_partials:
        return NotUsable(f"{count:g} harmonics, fewer than {min_partials}")
    disagreement = float(np.median(track.misfit))
    if disagreement > _MOST_DISAGREEMENT:
        return NotUsable(f"the harmonics disagree: reduced chi-squared {disagreement:.1f}")
    return None


def _rejected(
    time: FloatArray, frequency: FloatArray, std: FloatArray, chi_squared: float
) -> NotUsable | None:
    """Return the reason why the S-curve is rejected, if there is one."""
    price, y = np.log(len(time)), frequency / std
    unit = 2.0 * (time - time[0]) / (time[-1] - time[0]) - 1.0

    def polynomial(degree: int) -> float:
        H = legendre.legvander(unit, degree) / std[:, None]
        chi_squared = np.sum((y - H @ np.linalg.lstsq(H, y, rcond=None)[0]) ** 2)
        return float(chi_squared + (degree + 1) * price)

    beaten = chi_squared + PARAMETERS * price + _LEAST_GAIN
    if polynomial(0) < beaten:
        return NotUsable("the line does not move: its frequency at rest is unknown")
    misfit = chi_squared / (len(time) - PARAMETERS)
    if misfit > _MOST_MISFIT:
        return NotUsable(f"the line wanders: reduced chi-squared {misfit:.1f} against a pass-by")
    if min(map(polynomial, DRIFT_DEGREES)) < beaten:
        return NotUsable("a change of engine speed explains the tone as well as a passing vehicle")
    return None


def _wrong_level(level_db: FloatArray, speed: RadialSpeed) -> NotUsable | None:
    """Return the reason if the level of the line does not follow the range of the pass-by."""
    emission = speed.time_s - speed.closest_time_s
    expected = -20.0 * np.log10(np.hypot(speed.closest_range_m, speed.speed_m_s * emission))
    if np.ptp(expected) < LEAST_SWING_DB:
        return None
    centred = expected - expected.mean()
    measured = level_db - level_db.mean()
    gain = float(centred @ measured / (centred @ centred))
    correlation = gain * float(np.linalg.norm(centred) / max(np.linalg.norm(measured), np.finfo(float).tiny))
    if _LEVEL_GAINS[0] <= gain <= _LEVEL_GAINS[1] and correlation >= _LEAST_CORRELATION:
        return None
    fit = f"gain {gain:.2f}, correlation {correlation:.2f}"
    return NotUsable(f"the level does not follow the range of a pass-by: {fit}")


def _read_out(
    time: FloatArray, values: FloatArray, covariance: FloatArray, chi_squared: float
) -> RadialSpeed:
    f0, v, closest, d = values.tolist()
    misfit = chi_squared / (len(time) - PARAMETERS)
    gradient = radial_speed_gradient(time, values)
    variance = np.einsum("ki,ij,kj->k", gradient, covariance, gradient) * max(misfit, 1.0)
    return RadialSpeed(
        time_s=time,
        radial_speed_m_s=radial_speed_m_s(time, v, closest, d),
        variance_m2_s2=variance,
        rest_frequency_hz=f0,
        speed_m_s=v,
        closest_range_m=d,
        closest_time_s=closest + d / SPEED_OF_SOUND_M_S,
        misfit=misfit,
    )
