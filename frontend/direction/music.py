r"""Wideband MUSIC for any set of steering vectors.

In each bin the covariance of the microphones is split into k signal eigenvectors E_s and the noise subspace;
the spectrum is the reciprocal of the part of a steering vector a outside the signal subspace,

.. math::
    P_b(\theta) = \frac{1}{a_b^H (I - E_s E_s^H) a_b}, \qquad
    P(\theta) = \frac1B \sum_b w_b P_b(\theta),

with w_b = 1, or 1 / max P_b so that every bin has the same weight.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.spectra.finite_complex import finite_complex
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import ComplexArray, FloatArray, RealArray


@dataclass(frozen=True, slots=True)
class Subspace:
    """Signal subspace of every bin."""

    vectors: ComplexArray  # Orthonormal columns, strongest last
    eigenvalues: RealArray  # Power along them, ascending


def covariance(spectra: ArrayLike) -> ComplexArray:
    r"""Average the spatial covariance over frames: :math:`R_b = \langle x_b x_b^H \rangle`.

    Shapes: spectra (frames, bins, M).
    """
    X = _checked_spectra(spectra)
    by_bin = np.ascontiguousarray(X.transpose(1, 2, 0))
    return (by_bin @ by_bin.conj().transpose(0, 2, 1)) / np.float32(X.shape[0])


def signal_subspace(spectra: ArrayLike, sources: int) -> Subspace:
    r"""Return the signal subspace from frames, by the smaller of two eigenproblems.

    With fewer frames T than microphones M the non-zero eigenvalues of :math:`X X^H / T` (M x M) are those of
    the Gram matrix :math:`X^H X / T` (T x T), and :math:`E_s = X V \Lambda^{-1/2} / \sqrt T`: exact, and (M /
    T)^3 cheaper.

    Shapes: spectra (frames, bins, M).
    """
    X = _checked_spectra(spectra)
    frames, _, microphones = X.shape
    if not 1 <= sources < microphones or sources > frames:
        raise InvalidArgumentError(
            f"sources: expected 1 .. {min(microphones - 1, frames)} for {frames} frames of {microphones} "
            f"microphones, got {sources}"
        )
    if frames >= microphones:
        return covariance_subspace(covariance(X), sources)
    by_bin = X.transpose(1, 2, 0)
    gram = (by_bin.conj().transpose(0, 2, 1) @ by_bin) / np.float32(frames)
    inner = _leading(gram, sources)
    vectors = by_bin @ inner.vectors
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return Subspace(vectors / np.maximum(norm, np.finfo(norm.dtype).tiny), inner.eigenvalues)


def covariance_subspace(covariance_matrix: ArrayLike, sources: int) -> Subspace:
    r"""Return the signal subspace of given covariances by a full eigendecomposition.

    .. math:: R\, e_i = \lambda_i e_i, \quad \lambda_i \le \lambda_{i+1}, \qquad E_s = [e_{M-k+1} \dots e_M]

    Shapes: covariance_matrix (bins, M, M).
    """
    R = finite_complex("covariance", covariance_matrix, (None, None, None))
    if R.shape[1] != R.shape[2]:
        raise InvalidArgumentError(f"covariance: expected shape (bins, M, M), got {R.shape}")
    if not 1 <= sources < R.shape[1]:
        raise InvalidArgumentError(f"sources: expected 1 .. {R.shape[1] - 1}, got {sources}")
    return _leading(R, sources)


def music_spectrum(subspace: Subspace, steering: ArrayLike, *, normalised: bool = False) -> FloatArray:
    r"""Compute the MUSIC spectrum of a set of steering vectors, averaged over bins.

    .. math:: P(\theta) = \frac1B \sum_b \frac{w_b}{\|a_b\|^2 - \|E_s^H a_b\|^2}

    Parameters
    ----------
    subspace : Subspace
        Signal subspace of the same bins and microphones.
    steering : array_like of complex, shape (bins, M, D)
        :math:`a_{bm}(\theta) = e^{+j 2\pi f_b\, u(\theta) \cdot p_m / c}` for a plane wave from direction u,
        so that X = S a with the STFT convention e^{-j 2 pi f t}; or any measured response.
    normalised : bool
        False: bins are averaged as they are, so that those with the sharpest peaks dominate. True: each bin
        is divided by its maximum first. Both as pyroomacoustics does (`frequency_normalization`, off by
        default).

    Returns
    -------
    ndarray, shape (D,)
        Positive, no unit; at most 1 if normalised.

    Raises
    ------
    InvalidArgumentError
        If the steering set does not fit the subspace or is not finite.

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
    return _spectrum(E, A, _power(A, axis=1), normalised)


def _spectrum(E: ComplexArray, A: ComplexArray, norm: RealArray, normalised: bool) -> FloatArray:
    outside = norm - _power(E.conj().transpose(0, 2, 1) @ A, axis=1)
    # Round-off may leave a tiny or negative remainder where the steering vector lies in the subspace.
    floor = np.finfo(outside.dtype).eps * norm
    score = 1.0 / np.maximum(outside, floor).astype(np.float64)
    if normalised:
        score /= score.max(axis=1, keepdims=True)
    return np.asarray(score.mean(axis=0))


def _power(values: ComplexArray, axis: int) -> RealArray:
    return np.asarray((values.real**2 + values.imag**2).sum(axis=axis))


def _leading(R: ComplexArray, count: int) -> Subspace:
    values, vectors = np.linalg.eigh(R)
    return Subspace(vectors[..., -count:], values[..., -count:])


def _checked_spectra(spectra: ArrayLike) -> ComplexArray:
    X = finite_complex("spectra", spectra, (None, None, None))
    if 0 in X.shape:
        raise InvalidArgumentError(f"spectra: expected at least one frame, bin and microphone, got {X.shape}")
    return X
