r"""Prewhitening: coordinates in which the noise is spatially white.

.. math:: y = R^{-1/2} x, \qquad b(\theta) = \sqrt{M}\, \frac{R^{-1/2} a(\theta)}{\|R^{-1/2} a(\theta)\|}

with the noise covariance R per bin and its Hermitian root, the root that changes the microphones least: where
R is a multiple of the identity, y is x and b is a. Whitening attenuates the steering vector as it does the
sound, hence its new length.

MUSIC in these coordinates is the generalised eigenvalue form (R. Roy and T. Kailath, IEEE Trans. ASSP 37,
1989; for ego-noise K. Nakamura et al., IROS 2009): the eigenvectors v of :math:`R^{-1/2} R_x R^{-1/2}` are
:math:`R^{1/2} u` with :math:`R_x u = \lambda R u`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.spectra.spectra import finite_complex
from worldstate.ground.blas_threads import one_blas_thread
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import ComplexArray

# Noise power of a microphone, relative to the mean, below which it is dead and left out: its inverse would
# dominate.
_DEAD = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Prewhitener:
    """Inverse roots of a noise covariance, applied to spectra, covariances and steering vectors alike.

    Examples
    --------
    Noise in phase at both microphones becomes white:

    >>> noise = np.array([[[1.0, 0.9], [0.9, 1.0]]])
    >>> whitener = Prewhitener.of(noise, shrinkage=0.0)
    >>> whitener.covariance(noise).real.round(6) + 0.0
    array([[[1., 0.],
            [0., 1.]]])
    """

    roots: ComplexArray  # shape (bins, M, M): Hermitian; from `inverse_root`

    @classmethod
    def of(cls, noise_covariance: ArrayLike, shrinkage: float = 0.03) -> "Prewhitener":
        """Build it from a covariance (bins, M, M): see `inverse_root`."""
        return cls(inverse_root(noise_covariance, shrinkage))

    def spectra(self, spectra: ArrayLike) -> ComplexArray:
        r"""Whiten frames (frames, bins, M): :math:`y = R^{-1/2} x`."""
        X = finite_complex("spectra", spectra, (None, *self.roots.shape[:2]))
        # y_i = sum_j root_ij x_j, with x as rows: the transpose.
        return np.asarray((X.transpose(1, 0, 2) @ self.roots.transpose(0, 2, 1)).transpose(1, 0, 2))

    def covariance(self, covariance: ArrayLike) -> ComplexArray:
        r"""Whiten covariances (bins, M, M): :math:`R_y = R^{-1/2} R_x R^{-1/2}`."""
        R = finite_complex("covariance", covariance, self.roots.shape)
        return np.asarray(self.roots @ R @ self.roots)

    def steering(self, steering: ArrayLike) -> ComplexArray:
        r"""Whiten steering vectors (bins, M, directions) and restore their length.

        .. math:: b = \|a\|\, \frac{R^{-1/2} a}{\|R^{-1/2} a\|}
        """
        A = finite_complex("steering", steering, (*self.roots.shape[:2], None))
        whitened = self.roots @ A
        length = np.linalg.norm(whitened, axis=1, keepdims=True)
        kept = np.linalg.norm(A, axis=1, keepdims=True) / np.maximum(length, np.finfo(length.dtype).tiny)
        return np.asarray(whitened * kept)


def inverse_root(noise_covariance: ArrayLike, shrinkage: float = 0.03) -> ComplexArray:
    r"""Hermitian :math:`R_s^{-1/2}` of a noise covariance, shrunk towards white noise of the same power.

    .. math:: R_s = (1 - s)\, \frac{R}{p} + s I, \qquad p = \frac{\operatorname{tr} R}{M}

    Shapes: noise_covariance (bins, M, M).

    Examples
    --------
    >>> inverse_root([np.diag([3.0, 1.0])], shrinkage=0.0).real.round(3) + 0.0
    array([[[0.816, 0.   ],
            [0.   , 1.414]]])
    """
    # Shrinkage after O. Ledoit and M. Wolf (2004): no direction is amplified by more than 1 / sqrt(s), and s
    # = 1 changes nothing. The Hermitian root after A. Kessy et al. (2018). Dead microphones give zeros; a bin
    # in which all are silent is unchanged.
    R = finite_complex("noise_covariance", noise_covariance, (None, None, None))
    if R.shape[1] != R.shape[2]:
        raise InvalidArgumentError(f"noise_covariance: expected shape (bins, M, M), got {R.shape}")
    s = in_range("shrinkage", shrinkage, 0.0, 1.0)
    with one_blas_thread():
        return np.stack([shrunk_inverse_root(matrix, s) for matrix in R]) if len(R) else R


def white_share(R: ComplexArray, n_frames: float) -> float:
    r"""Return the oracle-approximating shrinkage of a sample covariance towards white noise.

    .. math:: s = \min\Big(1, \frac{(1 - 2/M) \operatorname{tr} R^2 + \operatorname{tr}^2 R}
              {(n + 1 - 2/M) (\operatorname{tr} R^2 - \operatorname{tr}^2 R / M)}\Big)

    Shapes: R (M, M).

    Examples
    --------
    >>> white_share(np.eye(4), 100), round(white_share(np.ones((4, 4)), 100), 3)
    (1.0, 0.02)
    """
    # Y. Chen et al., IEEE Trans. Signal Processing 58, 2010. One if the eigenvalues spread no more than those
    # of n frames of white noise, so that white noise is not whitened; near zero if a few directions dominate.
    size = len(R)
    squares = float(np.square(R.real).sum() + np.square(R.imag).sum())
    trace = float(np.einsum("mm->", R).real) ** 2
    spread = (n_frames + 1.0 - 2.0 / size) * (squares - trace / size)
    share = (1.0 - 2.0 / size) * squares + trace
    return share / spread if spread > share else 1.0


def shrunk_inverse_root(R: ComplexArray, s: float) -> ComplexArray:
    r"""Return the shrunk inverse root of one matrix, without checks.

    .. math:: \big[(1 - s) R / p + s I\big]^{-1/2} =
              V \operatorname{diag}\big[(1 - s) \lambda / p + s\big]^{-1/2} V^H

    Shapes: R (M, M).

    Examples
    --------
    >>> shrunk_inverse_root(np.diag([7.0, 1.0]), 1.0)
    array([[1., 0.],
           [0., 1.]])
    """
    power = np.einsum("mm->m", R).real
    alive = power > _DEAD * power.mean()
    root = np.zeros_like(R) if alive.any() else np.eye(len(R), dtype=R.dtype)
    if alive.any():
        both = np.ix_(alive, alive)
        root[both] = _shrunk_root(R[both] / power[alive].mean(), s)
    return root


def _shrunk_root(R: ComplexArray, s: float) -> ComplexArray:
    if s >= 1.0:
        return np.eye(len(R), dtype=R.dtype)
    values, vectors = np.linalg.eigh(R)
    shrunk = (1.0 - s) * np.maximum(values, 0.0) + s
    gains = 1.0 / np.sqrt(np.maximum(shrunk, np.finfo(values.dtype).tiny))
    return np.asarray((vectors * gains.astype(values.dtype)) @ vectors.conj().T)
