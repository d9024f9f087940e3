r"""Number of sources from the eigenvalues of the spatial covariance, by information criteria.

All criteria assume noise that is white across the microphones and independent frames. A real street has
neither: reflections are coherent with their source, wind and ego-noise are not white, overlapping frames are
not independent. The result is the number of plane waves that the noise model does not explain, not of
vehicles.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

Criterion = Literal["mdl", "aic", "few"]
CRITERIA: tuple[Criterion, ...] = ("mdl", "aic", "few")


def count_sources(
    eigenvalues: ArrayLike, frames: int, *, criterion: Criterion | None = None, max_sources: int | None = None
) -> int:
    r"""Estimate the number of sources from the eigenvalues of one or more bins.

    With l_1 >= ... >= l_M the eigenvalues, T frames and a, g the arithmetic and geometric means of the M - k
    smallest,

    .. math::
        L(k) = T (M - k) \ln(a / g), \qquad
        \mathrm{AIC} = 2 L + 2 k (2M - k), \qquad
        \mathrm{MDL} = L + \tfrac12 k (2M - k) \ln T.

    MDL is consistent; AIC finds weaker sources and overestimates now and then. Both need T > M, because the
    geometric mean of a singular covariance is zero. ``few`` is the criterion of Nadakuditi and Edelman, which
    compares the second moment of the smallest eigenvalues with that of a Wishart matrix and holds for T < M
    too:

    .. math::
        t_k = M \Big[ (M - k) \frac{\sum_{i>k} l_i^2}{(\sum_{i>k} l_i)^2} - 1 - \frac M T \Big], \qquad
        \mathrm{few} = \tfrac12 (T / M)^2 t_k^2 + 2 (k + 1).

    Criteria are log-likelihoods, so those of several bins add (independent bins, one number of sources).

    Parameters
    ----------
    eigenvalues : array_like, shape (M,) or (bins, M)
        All M eigenvalues of each covariance, any order, >= 0; zeros included where T < M.
    frames : int
        Number T of independent frames behind the covariance.
    criterion : {"mdl", "aic", "few"}, optional
        ``mdl`` where T > 2 M, else ``few``, if not given.
    max_sources : int, optional
        Largest answer; min(M, T) - 1 if not given.

    Returns
    -------
    int
        Number of sources, 0 .. max_sources.

    Raises
    ------
    InvalidArgumentError
        On wrong shapes, negative eigenvalues, an unknown criterion, or MDL or AIC with T <= M.

    References
    ----------
    M. Wax and T. Kailath, "Detection of signals by information theoretic criteria", IEEE Trans. ASSP 33, 1985
    (AIC, MDL); R. R. Nadakuditi and A. Edelman, "Sample eigenvalue based detection of high-dimensional
    signals in white noise using relatively few samples", IEEE Trans. SP 56, 2008 (few).

    Examples
    --------
    >>> count_sources([9.0, 1.1, 1.0, 0.9], frames=200)
    1
    """
    values = finite_array("eigenvalues", np.atleast_2d(np.asarray(eigenvalues)), (None, None))
    microphones = values.shape[1]
    chosen = criterion or ("mdl" if frames > 2 * microphones else "few")
    largest = _checked_largest(values, frames, chosen, max_sources)
    ordered = np.sort(values, axis=1)[:, ::-1]
    score = _moment_score if chosen == "few" else _likelihood_score
    scores = [score(ordered, k, frames, chosen).sum() for k in range(largest + 1)]
    return int(np.argmin(scores))


def _likelihood_score(values: FloatArray, k: int, frames: int, criterion: Criterion) -> FloatArray:
    """AIC or MDL of k sources, one per bin."""
    microphones = values.shape[1]
    noise = np.maximum(values[:, k:], np.finfo(float).tiny)
    misfit = frames * (microphones - k) * (np.log(noise.mean(axis=1)) - np.log(noise).mean(axis=1))
    parameters = k * (2 * microphones - k)
    if criterion == "aic":
        return np.asarray(2.0 * misfit + 2.0 * parameters)
    return np.asarray(misfit + 0.5 * parameters * np.log(frames))


def _moment_score(values: FloatArray, k: int, frames: int, _criterion: Criterion) -> FloatArray:
    """Nadakuditi-Edelman score of k sources for complex data, one per bin."""
    microphones = values.shape[1]
    noise = values[:, k:]
    total = np.maximum(noise.sum(axis=1), np.finfo(float).tiny)
    ratio = (microphones - k) * (noise**2).sum(axis=1) / total**2
    t = microphones * (ratio - 1.0 - microphones / frames)
    return np.asarray(0.5 * (frames / microphones) ** 2 * t**2 + 2.0 * (k + 1))


def _checked_largest(values: FloatArray, frames: int, criterion: Criterion, max_sources: int | None) -> int:
    microphones = values.shape[1]
    if values.min() < -1e-6 * values.max():
        raise InvalidArgumentError(f"eigenvalues: expected numbers >= 0, got {values.min()}")
    if criterion not in CRITERIA:
        raise InvalidArgumentError(f"criterion: expected one of {CRITERIA}, got {criterion!r}")
    if frames < 2 or (criterion != "few" and frames <= microphones):
        fewest = 1 if criterion == "few" else microphones
        raise InvalidArgumentError(f"frames: expected more than {fewest} for {criterion!r}, got {frames}")
    possible = min(microphones, frames) - 1
    largest = possible if max_sources is None else max_sources
    if not 0 <= largest <= possible:
        raise InvalidArgumentError(f"max_sources: expected a number in [0, {possible}], got {largest}")
    return largest
