r"""Number of sources from the eigenvalues of the spatial covariance, by information criteria.

All criteria assume noise that is white across the microphones and independent frames. A real street has
neither: reflections are coherent with their source, wind and ego-noise are not white, overlapping frames are
not independent. The result is the number of plane waves that the noise model does not explain, not of
vehicles.
"""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray


def count_sources(eigenvalues: ArrayLike, frames: int) -> int:
    r"""Estimate the number of sources from the eigenvalues of one or more bins.

    With l_1 >= ... >= l_M the eigenvalues, T frames and a, g the arithmetic and geometric means of the M - k
    smallest,

    .. math::
        L(k) = T (M - k) \ln(a / g), \qquad \mathrm{MDL} = L + \tfrac12 k (2M - k) \ln T

    is consistent and needs T > M, because the geometric mean of a singular covariance is zero. Where T <= 2 M
    the criterion of Nadakuditi and Edelman takes its place, which compares the second moment of the smallest
    eigenvalues with that of a Wishart matrix and holds for T < M too:

    .. math::
        t_k = M \Big[ (M - k) \frac{\sum_{i>k} l_i^2}{(\sum_{i>k} l_i)^2} - 1 - \frac M T \Big], \qquad
        \mathrm{few} = \tfrac12 (T / M)^2 t_k^2 + 2 (k + 1).

    Criteria are log-likelihoods, so those of several bins add (independent bins, one number of sources).

    Parameters
    ----------
    eigenvalues : array_like, shape (M,) or (bins, M)
        All M eigenvalues of each covariance, any order, >= 0; zeros included where T < M.
    frames : int
        Number T >= 2 of independent frames behind the covariance.

    Returns
    -------
    int
        Number of sources, 0 .. min(M, T) - 1.

    Raises
    ------
    InvalidArgumentError
        On wrong shapes, negative eigenvalues or fewer than two frames.

    References
    ----------
    M. Wax and T. Kailath, "Detection of signals by information theoretic criteria", IEEE Trans. ASSP 33, 1985
    (MDL); R. R. Nadakuditi and A. Edelman, "Sample eigenvalue based detection of high-dimensional
    signals in white noise using relatively few samples", IEEE Trans. SP 56, 2008 (few).

    Examples
    --------
    >>> count_sources([9.0, 1.1, 1.0, 0.9], frames=200)
    1
    """
    values = finite_array("eigenvalues", np.atleast_2d(np.asarray(eigenvalues)), (None, None))
    if frames < 2 or values.min() < -1e-6 * values.max():
        raise InvalidArgumentError(
            f"eigenvalues: expected numbers >= 0 from two frames or more, got {frames}"
        )
    microphones = values.shape[1]
    ordered = np.sort(values, axis=1)[:, ::-1]
    score = _description_length if frames > 2 * microphones else _moment_score
    return int(np.argmin([score(ordered, k, frames).sum() for k in range(min(microphones, frames))]))


def _description_length(values: FloatArray, k: int, frames: int) -> FloatArray:
    """MDL of k sources, one per bin."""
    microphones = values.shape[1]
    noise = np.maximum(values[:, k:], np.finfo(float).tiny)
    misfit = frames * (microphones - k) * (np.log(noise.mean(axis=1)) - np.log(noise).mean(axis=1))
    return np.asarray(misfit + 0.5 * k * (2 * microphones - k) * np.log(frames))


def _moment_score(values: FloatArray, k: int, frames: int) -> FloatArray:
    """Nadakuditi-Edelman score of k sources for complex data, one per bin."""
    microphones = values.shape[1]
    noise = values[:, k:]
    total = np.maximum(noise.sum(axis=1), np.finfo(float).tiny)
    ratio = (microphones - k) * (noise**2).sum(axis=1) / total**2
    t = microphones * (ratio - 1.0 - microphones / frames)
    return np.asarray(0.5 * (frames / microphones) ** 2 * t**2 + 2.0 * (k + 1))
