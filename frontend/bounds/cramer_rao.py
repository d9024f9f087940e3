r"""Cramer-Rao bounds for the front-end's estimates: the least variance of any unbiased estimator.

All follow from :math:`\mathrm{var} \ge J^{-1}` with J the Fisher information. Signal-to-noise ratios are
power ratios, not decibels.
"""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S, direction_vectors
from worldstate.ground import FloatArray, InvalidArgumentError, finite_array, in_range


def delay_crb_s2(frequencies_hz: ArrayLike, coherence: ArrayLike, duration_s: float) -> float:
    r"""Return the bound on the variance of the delay between two microphones, eq. (3).

    .. math:: \mathrm{var}(\hat\tau) \ge \Big[2T \int_0^\infty (2\pi f)^2 \frac{C(f)}{1 - C(f)}\,df\Big]^{-1}

    Ego-noise, wind and reverberation reduce the coherence. The integral is computed by the trapezoidal rule.

    Parameters
    ----------
    frequencies_hz : array_like, shape (bins,)
        Ascending, >= 0, Hz.
    coherence : array_like, shape (bins,)
        Magnitude-squared coherence C, in [0, 1).
    duration_s : float
        Observation time T, seconds, > 0.

    Returns
    -------
    float
        Variance in seconds squared; infinite without coherence.

    Raises
    ------
    InvalidArgumentError
        On wrong shapes or values out of range.

    Notes
    -----
    The bound holds for small errors. Below a threshold SNR, the estimate jumps to another lobe and the
    variance is far larger.

    References
    ----------
    "Evidence of Absence", eq. (3), after C. Knapp and G. C. Carter, "The generalized correlation method for
    estimation of time delay", IEEE Trans. ASSP 24, 1976, and G. C. Carter, "Coherence and time delay
    estimation", Proc. IEEE 75, 1987.

    Examples
    --------
    >>> f = np.linspace(300.0, 1800.0, 151)
    >>> f"{delay_crb_s2(f, np.full(151, 0.5), duration_s=1.0) ** 0.5 * 1e6:.2f} microseconds"
    '2.56 microseconds'
    """
    frequencies = finite_array("frequencies_hz", frequencies_hz, (None,))
    C = finite_array("coherence", coherence, frequencies.shape)
    if len(frequencies) < 2 or frequencies[0] < 0 or np.any(np.diff(frequencies) <= 0):
        raise InvalidArgumentError("frequencies_hz: expected at least two ascending frequencies >= 0")
    if C.min() < 0 or C.max() >= 1:
        raise InvalidArgumentError(f"coherence: expected numbers in [0, 1), got {C.min()} .. {C.max()}")
    duration = in_range("duration_s", duration_s, 0.0, np.inf, open_low=True)
    integral = np.trapezoid((2 * np.pi * frequencies) ** 2 * C / (1 - C), frequencies)
    return _inverse(2.0 * duration * float(integral))


def bearing_crb_rad2(
    positions_m: ArrayLike,
    azimuth_rad: float,
    frequencies_hz: ArrayLike,
    snr: ArrayLike,
    snapshots: int,
    *,
    random_signal: bool = False,
) -> float:
    r"""Return the bound on the variance of an azimuth, eq. (4) for any array.

    With u the unit vector to the source and :math:`S = \sum_m (p_m - \bar p)(p_m - \bar p)^T`,

    .. math::
        \mathrm{var}(\hat\theta) \ge \Big[\frac{8\pi^2 N}{c^2}\, S(\theta) \sum_b
        f_b^2\,\mathrm{SNR}_b\Big]^{-1}, \qquad S(\theta) = \dot u_\theta^T S\, \dot u_\theta.

    For an array in the y-z plane this is eq. (4) of the paper, :math:`S(\theta) = S_{xx} \cos^2\theta`. With
    S_xx = 3.027 m^2, 1 kHz and c = 343 m/s it gives 1.80 deg / sqrt(2 N SNR) at broadside.

    Parameters
    ----------
    positions_m : array_like, shape (M, 3)
        Microphones in `base_link` axes (x forward, y left, z up), metres.
    azimuth_rad : float
        Azimuth of the source, at the horizon, radians, left positive.
    frequencies_hz : float or array_like, shape (bins,)
        Frequency of a narrow band, or of several bins whose information is added, Hz.
    snr : float or array_like, shape (bins,)
        Power ratio per microphone and snapshot, for spatially white noise.
    snapshots : int
        Number N of independent snapshots per bin.
    random_signal : bool
        True: the unconditional bound for a Gaussian signal, larger by 1 + 1 / (M SNR). False: the paper's
        bound.

    Returns
    -------
    float
        Variance in radians squared; infinite at endfire of a planar array.

    Raises
    ------
    InvalidArgumentError
        On wrong shapes or values out of range.

    References
    ----------
    "Evidence of Absence", eq. (4); H. L. Van Trees, *Optimum Array Processing*, 2002, section 8.4; P.
    Stoica and A. Nehorai, "Performance study of conditional and unconditional direction-of-arrival
    estimation", IEEE Trans. ASSP 38, 1990.

    Examples
    --------
    >>> y = np.linspace(-0.4, 0.4, 56) * np.sqrt(3.027 / (56 * 0.16 * 57 / 165))
    >>> plate = np.column_stack([0 * y, y, 0 * y])
    >>> print(round(np.rad2deg(np.sqrt(2 * bearing_crb_rad2(plate, 0.0, 1000.0, 1.0, 1))), 2))
    1.8
    """
    positions = finite_array("positions_m", positions_m, (None, 3))
    frequencies, ratio = np.broadcast_arrays(
        finite_array("frequencies_hz", np.atleast_1d(frequencies_hz), (None,)),
        finite_array("snr", np.atleast_1d(snr), (None,)),
    )
    if len(positions) < 2 or snapshots < 1 or ratio.min() < 0 or frequencies.min() < 0:
        raise InvalidArgumentError("expected at least 2 microphones and 1 snapshot, frequencies and snr >= 0")
    if random_signal:
        ratio = ratio * (len(positions) * ratio / (1.0 + len(positions) * ratio))
    azimuth = in_range("azimuth_rad", azimuth_rad, -np.inf, np.inf)
    # Derivatives of the direction by azimuth and elevation. The elevation is known, so only the first is
    # used.
    slopes = direction_vectors(azimuth + np.pi / 2), direction_vectors(azimuth, np.pi / 2)
    lever = (positions - positions.mean(axis=0)) @ np.stack(slopes, axis=1)
    weight = 8 * np.pi**2 * snapshots / SPEED_OF_SOUND_M_S**2 * np.sum(frequencies**2 * ratio)
    return _inverse((weight * lever.T @ lever)[0, 0])


def endfire_information(positions_m: ArrayLike, azimuths_rad: ArrayLike) -> FloatArray:
    r"""Return the bearing information relative to that in the array's best direction.

    .. math:: \frac{J(\theta)}{\max_\theta J(\theta)} = \frac{\dot u^T S \dot u}{\lambda_{max}(S_{xy})}

    For an array across the vehicle it is :math:`\cos^2\theta` and vanishes at endfire. The information on
    existence and radial speed does not depend on the bearing.

    Shapes: positions_m (M, 3).
    """
    moments, _ = _horizontal_moments(positions_m)
    azimuth = np.asarray(azimuths_rad, dtype=np.float64)
    slope = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=-1)
    return np.asarray(((slope @ moments) * slope).sum(axis=-1) / np.linalg.eigvalsh(moments)[-1])


def broadside_rad(positions_m: ArrayLike) -> float:
    r"""Return the azimuth with the largest bearing information.

    .. math:: \theta = \arg\max_\theta \dot u_\theta^T S\, \dot u_\theta

    Shapes: positions_m (M, 3).
    """
    _, axis = _horizontal_moments(positions_m)
    x, y = axis if axis[1] > 0.0 or (axis[1] == 0.0 and axis[0] < 0.0) else -axis
    return float(np.arctan2(-x, y)) + 0.0


def tone_crb_hz2(snr: float, samples: int, sample_rate_hz: float) -> float:
    r"""Return the bound on the variance of a tone's frequency if amplitude and phase are unknown.

    .. math:: \mathrm{var}(\hat f) \ge \frac{12}{(2\pi)^2\,\eta\,N_s (N_s^2 - 1)\,T_s^2}

    Parameters
    ----------
    snr : float
        :math:`\eta`, a power ratio, > 0. A real tone :math:`A\cos` in white noise of variance
        :math:`\sigma^2` has :math:`\eta = A^2 / 2\sigma^2`. A complex one :math:`A e^{j\cdot}` has
        :math:`\eta = A^2 / \sigma^2`, with :math:`\sigma^2` the variance of the real and of the imaginary
        part (as in Rife and Boorstyn), i.e. twice the ratio of its power to that of the noise.
    samples : int
        Number of samples N_s >= 2.
    sample_rate_hz : float
        Samples per second, 1 / T_s.

    Returns
    -------
    float
        Variance in Hz squared.

    Raises
    ------
    InvalidArgumentError
        If an argument is out of range.

    Notes
    -----
    For a real tone it holds at a distance of a few times 1 / (N_s T_s) from 0 and half the sample rate.

    References
    ----------
    D. C. Rife and R. R. Boorstyn, "Single-tone parameter estimation from discrete-time observations", IEEE
    Trans. IT 20, 1974.

    Examples
    --------
    >>> print(f"{tone_crb_hz2(snr=10.0, samples=4800, sample_rate_hz=48_000.0) ** 0.5:.4f}")
    0.0252
    """
    eta = in_range("snr", snr, 0.0, np.inf, open_low=True)
    N = in_range("samples", samples, 2, np.inf)
    rate = in_range("sample_rate_hz", sample_rate_hz, 0.0, np.inf, open_low=True)
    return float(12.0 * rate**2 / ((2 * np.pi) ** 2 * eta * N * (N**2 - 1.0)))


def radial_speed_crb_m2_s2(frequency_variance_hz2: float, rest_frequency_hz: float) -> float:
    r"""Return the variance of a radial speed that is estimated from a tone with known rest frequency.

    .. math:: \mathrm{var}(\hat v_r) = (c / f_0)^2\, \mathrm{var}(\hat f)

    Parameters
    ----------
    frequency_variance_hz2 : float
        Variance of the received frequency, Hz squared, for example from `tone_crb_hz2`.
    rest_frequency_hz : float
        f_0 > 0, Hz.

    Returns
    -------
    float
        Variance in (m/s) squared, to first order in v_r / c.

    Raises
    ------
    InvalidArgumentError
        If an argument is out of range.

    Notes
    -----
    In a street, the stability of the tone limits the accuracy more than this bound does.

    References
    ----------
    "Evidence of Absence", section IV; P. M. Morse and K. U. Ingard, *Theoretical Acoustics*, 1968, section
    11.2.

    Examples
    --------
    >>> print(round(radial_speed_crb_m2_s2(tone_crb_hz2(10.0, 4800, 48e3), 100.0) ** 0.5, 4))
    0.0863
    """
    variance = in_range("frequency_variance_hz2", frequency_variance_hz2, 0.0, np.inf)
    rest = in_range("rest_frequency_hz", rest_frequency_hz, 0.0, np.inf, open_low=True)
    return float((SPEED_OF_SOUND_M_S / rest) ** 2 * variance)


def _horizontal_moments(positions_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the second moments of the microphones in x and y, (2, 2), and their main axis, (2,)."""
    positions = finite_array("positions_m", positions_m, (None, 3))
    horizontal = (positions - positions.mean(axis=0))[:, :2]
    moments = horizontal.T @ horizontal
    best, axes = np.linalg.eigh(moments)
    if best[-1] <= 0:
        raise InvalidArgumentError("positions_m: expected a horizontal extent, got none")
    return np.asarray(moments), np.asarray(axes[:, -1])


def _inverse(information: float) -> float:
    return float(1.0 / information) if information > 0 else float("inf")
