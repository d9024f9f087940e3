r"""Wideband MUSIC for any set of steering vectors, and the number of sources.

In each bin, the covariance of the microphones is split into k signal eigenvectors E_s and the noise subspace.
The spectrum is the reciprocal of the part of a steering vector a outside the signal subspace,

.. math::
    P(\theta) = \frac1B \sum_b \frac{1}{a_b^H (I - E_s E_s^H) a_b}.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.spectra.stft import power
from worldstate.ground import InvalidArgumentError
from worldstate.ground.checks import finite_array, finite_complex
from worldstate.ground.typing import ComplexArray, FloatArray, RealArray


@dataclass(frozen=True, slots=True)
class Subspace:
    """Signal subspace of every bin."""

    vectors: ComplexArray  # Orthonormal columns, strongest last
    eigenvalues: RealArray  # Power along these columns, ascending


def covariance(spectra: ArrayLike) -> ComplexArray:
    r"""Return the spatial covariance averaged over frames: :math:`R_b = \langle x_b x_b^H \rangle`.

    Shapes: spectra (frames, bins, M).
    """
    X = _checked_spectra(spectra)
    by_bin = np.ascontiguousarray(X.transpose(1, 2, 0))
    return (by_bin @ by_bin.conj().transpose(0, 2, 1)) / np.float32(X.shape[0])


def signal_subspace(spectra: ArrayLike, sources: int) -> Subspace:
    r"""Return the signal subspace from frames, using the smaller of two eigenproblems.

    With fewer frames T than microphones M, the non-zero eigenvalues of :math:`X X^H / T` (M x M) are those of
    the Gram matrix :math:`X^H X / T` (T x T), and :math:`E_s = X V \Lambda^{-1/2} / \sqrt T`. This is exact
    and (M / T)^3 times cheaper.

    Shapes: spectra (frames, bins, M).
    """
    X = _checked_spectra(spectra)
    frames, _, microphones = X.shape
    if not 1 <= sources < microphones or sources > frames:
        most, heard = min(microphones - 1, frames), f"{frames} frames of {microphones} microphones"
        raise InvalidArgumentError(f"sources: expected 1 .. {most} for {heard}, got {sources}")
    if frames >= microphones:
        return _leading(covariance(X), sources)
    by_bin = X.transpose(1, 2, 0)
    gram = (by_bin.conj().transpose(0, 2, 1) @ by_bin) / np.float32(frames)
    inner = _leading(gram, sources)
    vectors = by_bin @ inner.vectors
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return Subspace(vectors / np.maximum(norm, np.finfo(norm.dtype).tiny), inner.eigenvalues)


def music_spectrum(subspace: Subspace, steering: ArrayLike) -> FloatArray:
    r"""Return the MUSIC spectrum of a set of steering vectors, averaged over bins.

    .. math:: P(\theta) = \frac1B \sum_b \frac{1}{\|a_b\|^2 - \|E_s^H a_b\|^2}

    Parameters
    ----------
    subspace : Subspace
        Signal subspace of the same bins and microphones.
    steering : array_like of complex, shape (bins, M, D)
        :math:`a_{bm}(\theta) = e^{+j 2\pi f_b\, u(\theta) \cdot p_m / c}` for a plane wave from direction u,
        so that X = S a with the STFT convention e^{-j 2 pi f t}; alternatively a measured response.

    Returns
    -------
    ndarray, shape (D,)
        Positive, without a unit. Bins have equal weights, so bins with the sharpest peaks dominate.

    Raises
    ------
    InvalidArgumentError
        If the steering vectors do not fit the subspace or are not finite.

    References
    ----------
    R. O. Schmidt, "Multiple emitter location and signal parameter estimation", IEEE Trans. AP 34, 1986.

    Examples
    --------
    >>> steering = np.exp(1j * np.outer([-1.0, 1.0], np.linspace(-1, 1, 5)))[None]
    >>> subspace = signal_subspace(np.tile(steering[..., 3], (2, 1, 1)), sources=1)
    >>> int(np.argmax(music_spectrum(subspace, steering)))
    3
    """
    E = subspace.vectors
    A = finite_complex("steering", steering, (E.shape[0], E.shape[1], None))
    norm = power(A).sum(axis=1)
    outside = norm - power(E.conj().transpose(0, 2, 1) @ A).sum(axis=1)
    # Rounding may leave a tiny or negative remainder for a steering vector in the subspace.
    floor = np.finfo(outside.dtype).eps * norm
    return np.asarray((1.0 / np.maximum(outside, floor).astype(np.float64)).mean(axis=0))


def _leading(R: ComplexArray, count: int) -> Subspace:
    values, vectors = np.linalg.eigh(R)
    return Subspace(vectors[..., -count:], values[..., -count:])


def _checked_spectra(spectra: ArrayLike) -> ComplexArray:
    X = finite_complex("spectra", spectra, (None, None, None))
    if 0 in X.shape:
        raise InvalidArgumentError(f"spectra: expected at least one frame, bin and microphone, got {X.shape}")
    return X


def count_sources(eigenvalues: ArrayLike, frames: int) -> int:
    r"""Estimate the number of sources from the eigenvalues of one or more bins.

    All criteria assume independent frames and noise that is white across the microphones. In a real street,
    reflections are coherent with their source, wind and ego-noise are not white, and overlapping frames are
    not independent. The result is therefore the number of plane waves that the noise model does not explain,
    not the number of vehicles.

    With l_1 >= ... >= l_M the eigenvalues, T frames and a, g the arithmetic and geometric means of the M - k
    smallest,

    .. math::
        L(k) = T (M - k) \ln(a / g), \qquad \mathrm{MDL} = L + \tfrac12 k (2M - k) \ln T

    is consistent and requires T > M, because the geometric mean of a singular covariance is zero. For T <= 2
    M it is replaced by the criterion of Nadakuditi and Edelman, which compares the second moment of the
    smallest eigenvalues with that of a Wishart matrix and also holds for T < M:

    .. math::
        t_k = M \Big[ (M - k) \frac{\sum_{i>k} l_i^2}{(\sum_{i>k} l_i)^2} - 1 - \frac M T \Big], \qquad
        \mathrm{few} = \tfrac12 (T / M)^2 t_k^2 + 2 (k + 1).

    Criteria are log-likelihoods, so they are added over independent bins with the same number of sources.

    Parameters
    ----------
    eigenvalues : array_like, shape (M,) or (bins, M)
        All M eigenvalues of each covariance, any order, >= 0, including zeros for T < M.
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
        expected = "numbers >= 0 from two frames or more"
        raise InvalidArgumentError(f"eigenvalues: expected {expected}, got {frames}")
    microphones = values.shape[1]
    ordered = np.sort(values, axis=1)[:, ::-1]
    score = _description_length if frames > 2 * microphones else _moment_score
    return int(np.argmin([score(ordered, k, frames).sum() for k in range(min(microphones, frames))]))


def _description_length(values: FloatArray, k: int, frames: int) -> FloatArray:
    """Return the MDL of k sources for each bin."""
    microphones = values.shape[1]
    noise = np.maximum(values[:, k:], np.finfo(float).tiny)
    misfit = frames * (microphones - k) * (np.log(noise.mean(axis=1)) - np.log(noise).mean(axis=1))
    return np.asarray(misfit + 0.5 * k * (2 * microphones - k) * np.log(frames))


def _moment_score(values: FloatArray, k: int, frames: int) -> FloatArray:
    """Return the Nadakuditi-Edelman score of k sources for complex data, for each bin."""
    microphones = values.shape[1]
    noise = values[:, k:]
    total = np.maximum(noise.sum(axis=1), np.finfo(float).tiny)
    ratio = (microphones - k) * (noise**2).sum(axis=1) / total**2
    t = microphones * (ratio - 1.0 - microphones / frames)
    return np.asarray(0.5 * (frames / microphones) ** 2 * t**2 + 2.0 * (k + 1))
