r"""The phase transform: steered response power of an array (SRP-PHAT), and delays of pairs (GCC-PHAT).

.. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k}
          \Big| \sum_m \overline{a_{k,m}(\theta)}\, \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2

over T frames, K bins and M microphones: 1 for a single plane wave from theta, 1/M for noise that is
independent between microphones. The SRP of pyroomacoustics is M^2 / pairs = 2 M / (M - 1) times as large.

The weighted cross-correlation of a pair (i, j) over the observed bins is

.. math:: R_{ij}(\tau) = \mathrm{Re} \sum_f \Psi(f)\, G_{ij}(f)\, e^{j 2\pi f \tau},
          \qquad G_{ij}(f) = \langle X_i X_j^* \rangle_{frames}

with its maximum at the delay of microphone i after microphone j. The sum is band-limited and its derivatives
are known in closed form, so that Newton steps find the peak between lags; a parabola through three lags is
biased.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.spectra.stft import whiten
from worldstate.ground.checks import check_shape, finite_array, finite_complex, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Complex64Array, ComplexArray, FloatArray, IndexArray


def steered_power(whitened: Complex64Array, steering: Steering) -> FloatArray:
    r"""Sum the beam powers over frames and bins, the part of SRP that adds up over a running window.

    .. math:: S(\theta) = \sum_{t,k} \Big| \sum_m \overline{a_{k,m}(\theta)}\, Z_{t,k,m} \Big|^2

    Parameters
    ----------
    whitened : ndarray of complex64, shape (frames, bins, M)
        Spectra Z of modulus one.
    steering : Steering
        Beams for the same bins.

    Returns
    -------
    ndarray of float64, shape (directions,)
        Sum of the squared moduli of the beams, at most frames x bins x M^2.

    References
    ----------
    J. DiBiase, H. Silverman and M. Brandstein, "Robust localization in reverberant rooms", in *Microphone
    Arrays*, 2001.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> steering = Steering.towards(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), [500.0], [0.0, 0.5])
    >>> steered_power(np.ones((3, 1, 2), np.complex64), steering).round(1)
    array([12. ,  9.8])
    """
    return np.asarray(steering.quadratic_form(steering.covariance(whitened)).real)


def normalised(total: FloatArray, n_frames: int, n_bins: int, n_microphones: int) -> FloatArray:
    r"""Scale a sum of beam powers to 0..1; negative round-off is set to zero.

    .. math:: P(\theta) = \frac{\max(S(\theta), 0)}{T K M^2}

    Shapes: total (directions,).

    Examples
    --------
    >>> normalised(np.array([8.0, 4.0]), n_frames=1, n_bins=2, n_microphones=2)
    array([1. , 0.5])
    """
    return np.asarray(np.maximum(total, 0.0) / (n_frames * n_bins * n_microphones**2))


def srp_phat(spectra: Complex64Array, steering: Steering) -> FloatArray:
    r"""Compute SRP-PHAT of a set of frames: 1 for a single plane wave, 1/M for independent noise.

    .. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k}
              \Big| \sum_m \overline{a_{k,m}(\theta)}\, \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2

    Parameters
    ----------
    spectra : ndarray of complex64, shape (frames, bins, M)
        STFT of the microphones, at least one frame, any unit.
    steering : Steering
        Beams for the same bins.

    Returns
    -------
    ndarray of float64, shape (directions,)
        Between 0 and 1.

    Raises
    ------
    InvalidArgumentError
        If the spectra have other axes or another number of bins.

    References
    ----------
    J. DiBiase, H. Silverman and M. Brandstein, "Robust localization in reverberant rooms", in *Microphone
    Arrays*, 2001.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]])
    >>> steering = Steering.towards(array, [500.0], [-0.5, 0.0, 0.5])
    >>> plane_wave = array.steering(500.0, 0.5).transpose(2, 0, 1).astype(np.complex64)
    >>> srp_phat(plane_wave, steering).round(3)
    array([0.408, 0.819, 1.   ])
    """
    check_shape("spectra", spectra.shape, (None, len(steering.weights), None))
    n_frames, n_bins, n_microphones = spectra.shape
    return normalised(steered_power(whiten(spectra), steering), n_frames, n_bins, n_microphones)


# What three deviations reach in all directions together is called noise only up to this share of its excess:
# a vehicle in view, heard by 4 microphones, has a lower peak in a quarter of the hops, and a bearing of
# noise that is let through states 50 degrees, for it has many peaks.
_DEVIATIONS, _SHARE = 3.0, 0.6
_ALL_ROUND_RAD = np.radians(np.arange(-180.0, 180.0, 10.0))


def noise_prominence(
    rows: Sequence[Steering],
    array: MicrophoneArray,
    frequencies_hz: FloatArray,
    n_frames: float,
) -> float:
    r"""Return the peak-to-median ratio up to which a peak is taken for noise.

    Sound that comes from all horizontal directions alike is the noise of a street whose spectrum is least
    flat. After the phase transform the power of a beam in a frame and bin is about exponentially distributed,
    so that the mean over T frames and K bins scatters by epsilon:

    .. math:: D(\theta) = \frac{1}{K} \sum_k d_k(\theta), \qquad
              d_k(\theta) = \Big\langle \frac{|a_k(\theta)^H a_k(\phi)|^2}{M^2} \Big\rangle_\phi, \qquad
              \epsilon = \max_\theta \frac{\sqrt{\sum_k d_k^2(\theta)}}{\sqrt{T} \sum_k d_k(\theta)},

    .. math:: \rho_0 = 1 + 0.6 \Big( (1 + 3 \epsilon)\, \frac{\max_\theta D}{\mathrm{med}_\theta D} - 1 \Big)
    """
    horizon = array.steering(frequencies_hz, _ALL_ROUND_RAD).astype(np.complex64)
    by_row = np.array([_heard(row, horizon) for row in rows])
    diffuse = by_row.mean(axis=1).max(axis=0)
    # Of the last row: rows differ little in how their bins share the power.
    scatter = np.linalg.norm(by_row[-1], axis=0) / (np.sqrt(n_frames) * by_row[-1].sum(axis=0))
    reached = diffuse.max() / np.median(diffuse) * (1.0 + _DEVIATIONS * scatter.max())
    return float(1.0 + _SHARE * (reached - 1.0))


def _heard(row: Steering, waves: Complex64Array) -> FloatArray:
    """Return the mean power per bin and beam of plane waves (bins, M, waves), up to a factor."""
    return np.asarray(row.power_within(waves) / waves.shape[2])


# Lags per period of the highest frequency: the nearest one is then pi/8 rad from the peak at most.
LAGS_PER_PERIOD = 8
# Newton steps converge quadratically from there.
NEWTON_STEPS = 4


@dataclass(frozen=True, slots=True)
class PairDelays:
    r"""Delays of microphone pairs.

    .. math:: \hat\tau_{ij} = \arg\max_\tau R_{ij}(\tau)

    Parameters
    ----------
    pairs : ndarray of int, shape (P, 2)
        Microphone indices (i, j), from 0.
    delay_s : ndarray, shape (P,)
        Arrival at i minus arrival at j, seconds.
    peak : ndarray, shape (P,)
        Height of the peak over its largest possible value, <= 1: near one for a single coherent source.

    Examples
    --------
    >>> PairDelays(all_pairs(2), np.array([1e-4]), np.array([0.9])).pairs.tolist()
    [[0, 1]]
    """

    pairs: IndexArray
    delay_s: FloatArray
    peak: FloatArray


def all_pairs(microphones: int) -> IndexArray:
    """Return every pair i < j, shape (M (M - 1) / 2, 2)."""
    if microphones < 2:
        raise InvalidArgumentError(f"microphones: expected at least 2, got {microphones}")
    return np.column_stack(np.triu_indices(microphones, k=1))


def gcc_delays(
    spectra: ArrayLike,
    frequencies_hz: ArrayLike,
    max_delay_s: float,
) -> PairDelays:
    r"""Estimate the delay of every pair, between samples, by generalised cross-correlation.

    .. math:: \hat\tau_{ij} = \arg\max_{|\tau| \le \tau_{max}}
              \mathrm{Re} \sum_f \Psi(f)\, G_{ij}(f)\, e^{j 2\pi f \tau}

    Cross-spectra are averaged over frames first, then weighted by :math:`\Psi = 1 / |G_{ij}|` (PHAT); with a
    flat coherence that is maximum likelihood.

    Parameters
    ----------
    spectra : array_like of complex, shape (frames, bins, M)
        STFT of the microphones, convention e^{-j 2 pi f t}.
    frequencies_hz : array_like, shape (bins,)
        Centre of each bin, Hz, ascending.
    max_delay_s : float
        Largest delay to search, seconds; for microphones at distance d this is d / c.

    Returns
    -------
    PairDelays
        Delays in seconds within +-max_delay_s.

    Raises
    ------
    InvalidArgumentError
        On wrong shapes or values, or a search range in which equally spaced bins repeat themselves
        (max_delay_s >= 1 / (2 bin spacing)).

    References
    ----------
    C. Knapp and G. C. Carter, "The generalized correlation method for estimation of time delay", IEEE Trans.
    ASSP 24, 1976, table I (the weightings).

    Examples
    --------
    >>> f = np.arange(300.0, 1800.0, 100.0)
    >>> late = np.exp(-2j * np.pi * f * 123e-6)
    >>> spectra = np.stack([late, np.ones_like(late)], axis=-1)[None]
    >>> gcc_delays(spectra, f, 1e-3).delay_s.round(12)
    array([0.000123])
    """
    X = finite_complex("spectra", spectra, (None, None, None))
    frequencies = _checked_frequencies(frequencies_hz, X.shape[1])
    index = all_pairs(X.shape[2])
    limit = _checked_limit(max_delay_s, frequencies)
    cross = _whitened(X, index)
    delay, height = _peaks(cross, frequencies, limit)
    return PairDelays(index, delay, height)


def _whitened(X: ComplexArray, pairs: IndexArray) -> ComplexArray:
    """Cross-spectra averaged over frames, (P, bins), of modulus one."""
    R = np.einsum("fbi,fbj->bij", X, X.conj(), optimize=True) / X.shape[0]
    cross = R[:, pairs[:, 0], pairs[:, 1]].T
    magnitude = np.abs(cross)
    return np.asarray(np.divide(cross, magnitude, out=np.zeros_like(cross), where=magnitude > 0))


def _peaks(cross: ComplexArray, frequencies: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
    """Coarse search on a lag grid, then Newton steps held within one grid step of it."""
    omega = 2.0 * np.pi * frequencies
    step = 1.0 / (LAGS_PER_PERIOD * frequencies[-1])
    half = int(np.ceil(limit / step))
    lags = np.arange(-half, half + 1) * step
    correlation = (cross @ np.exp(1j * np.outer(omega, lags))).real
    correlation[:, np.abs(lags) > limit + 0.5 * step] = -np.inf
    coarse = lags[np.argmax(correlation, axis=1)]
    delay = np.clip(coarse, -limit, limit)
    for _ in range(NEWTON_STEPS):
        delay = _newton_step(cross, omega, delay)
        delay = np.clip(delay, coarse - step, coarse + step)
        delay = np.clip(delay, -limit, limit)
    reachable = np.abs(cross).sum(axis=1)
    height = (cross * np.exp(1j * delay[:, None] * omega)).real.sum(axis=1)
    return delay, np.divide(height, reachable, out=np.zeros_like(delay), where=reachable > 0)


def _newton_step(cross: ComplexArray, omega: FloatArray, delay: FloatArray) -> FloatArray:
    steered = cross * np.exp(1j * delay[:, None] * omega)
    slope = -(steered.imag @ omega)
    curvature = -(steered.real @ omega**2)
    # Outside the concave part of the peak a Newton step would move away from it.
    step = np.divide(slope, curvature, out=np.zeros_like(delay), where=curvature < 0)
    return np.asarray(delay - step)


def _checked_frequencies(frequencies_hz: ArrayLike, bins: int) -> FloatArray:
    frequencies = finite_array("frequencies_hz", frequencies_hz, (bins,))
    if bins == 0 or frequencies[0] < 0 or frequencies[-1] <= 0 or np.any(np.diff(frequencies) <= 0):
        raise InvalidArgumentError("frequencies_hz: expected ascending values >= 0, at least one > 0")
    return frequencies


def _checked_limit(max_delay_s: float, frequencies: FloatArray) -> float:
    limit = in_range("max_delay_s", max_delay_s, 0.0, np.inf, open_low=True)
    half_period = 0.5 / np.diff(frequencies).min() if len(frequencies) > 1 else np.inf
    if limit >= half_period:
        expected = f"less than {half_period:.3g} s, half the period of these bins"
        raise InvalidArgumentError(f"max_delay_s: expected {expected}, got {limit:.3g}")
    return limit
