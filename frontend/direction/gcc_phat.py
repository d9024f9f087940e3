r"""Delays of microphone pairs by generalised cross-correlation with the phase transform (GCC-PHAT).

The weighted cross-correlation of a pair (i, j) over the observed bins is

.. math:: R_{ij}(\tau) = \mathrm{Re} \sum_f \Psi(f)\, G_{ij}(f)\, e^{j 2\pi f \tau},
          \qquad G_{ij}(f) = \langle X_i X_j^* \rangle_{frames}

with its maximum at the delay of microphone i relative to microphone j. The sum is band-limited and its
derivatives have a closed form, so Newton steps find the peak between lags. A parabola through three lags
would be biased.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, finite_complex, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import ComplexArray, FloatArray, IndexArray

# Lags per period of the highest frequency: the nearest lag is then at most pi/8 rad from the peak.
LAGS_PER_PERIOD = 8
# From there, Newton steps converge quadratically.
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
        Height of the peak relative to its largest possible value, <= 1; near one for a single coherent
        source.

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


def gcc_delays(spectra: ArrayLike, frequencies_hz: ArrayLike, max_delay_s: float) -> PairDelays:
    r"""Estimate the delay of every pair with sub-sample resolution by generalised cross-correlation.

    .. math:: \hat\tau_{ij} = \arg\max_{|\tau| \le \tau_{max}}
              \mathrm{Re} \sum_f \Psi(f)\, G_{ij}(f)\, e^{j 2\pi f \tau}

    Cross-spectra are first averaged over frames and then weighted by :math:`\Psi = 1 / |G_{ij}|` (PHAT). With
    a flat coherence this is the maximum-likelihood estimate.

    Parameters
    ----------
    spectra : array_like of complex, shape (frames, bins, M)
        STFT of the microphones, convention e^{-j 2 pi f t}.
    frequencies_hz : array_like, shape (bins,)
        Centre of each bin, Hz, ascending.
    max_delay_s : float
        Largest delay of the search, seconds; d / c for microphones at a distance d.

    Returns
    -------
    PairDelays
        Delays in seconds within +-max_delay_s.

    Raises
    ------
    InvalidArgumentError
        On wrong shapes or values, or if the search range exceeds half the period of equally spaced bins
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
    frequencies = finite_array("frequencies_hz", frequencies_hz, X.shape[1:2])
    ascending = len(frequencies) and frequencies[0] >= 0 and np.all(np.diff(frequencies) > 0)
    if not ascending or frequencies[-1] <= 0:
        raise InvalidArgumentError("frequencies_hz: expected ascending values >= 0, at least one > 0")
    limit = in_range("max_delay_s", max_delay_s, 0.0, np.inf, open_low=True)
    half_period = 0.5 / np.diff(frequencies).min() if len(frequencies) > 1 else np.inf
    if limit >= half_period:
        expected = f"less than {half_period:.3g} s, half the period of these bins"
        raise InvalidArgumentError(f"max_delay_s: expected {expected}, got {limit:.3g}")
    pairs = all_pairs(X.shape[2])
    R = np.einsum("fbi,fbj->bij", X, X.conj(), optimize=True) / X.shape[0]
    cross = R[:, pairs[:, 0], pairs[:, 1]].T
    magnitude = np.abs(cross)
    whitened = np.divide(cross, magnitude, out=np.zeros_like(cross), where=magnitude > 0)
    return PairDelays(pairs, *_peaks(whitened, frequencies, limit))


def _peaks(cross: ComplexArray, frequencies: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
    """Search on a lag grid, then refine by Newton steps within one grid step."""
    omega = 2.0 * np.pi * frequencies
    step = 1.0 / (LAGS_PER_PERIOD * frequencies[-1])
    half = int(np.ceil(limit / step))
    lags = np.arange(-half, half + 1) * step
    correlation = (cross @ np.exp(1j * np.outer(omega, lags))).real
    correlation[:, np.abs(lags) > limit + 0.5 * step] = -np.inf
    coarse = lags[np.argmax(correlation, axis=1)]
    delay = np.clip(coarse, -limit, limit)
    for _ in range(NEWTON_STEPS):
        steered = cross * np.exp(1j * delay[:, None] * omega)
        slope, curvature = -(steered.imag @ omega), -(steered.real @ omega**2)
        # Outside the concave part of the peak, a Newton step would lead away from it.
        delay = delay - np.divide(slope, curvature, out=np.zeros_like(delay), where=curvature < 0)
        delay = np.clip(delay, coarse - step, coarse + step)
        delay = np.clip(delay, -limit, limit)
    reachable = np.abs(cross).sum(axis=1)
    height = (cross * np.exp(1j * delay[:, None] * omega)).real.sum(axis=1)
    return delay, np.divide(height, reachable, out=np.zeros_like(delay), where=reachable > 0)
