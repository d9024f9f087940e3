r"""Prewhitening: a change of coordinates after which known noise is the same in every direction.

.. math:: y = R^{-1/2} x, \qquad b(\theta) = \sqrt{M}\, \frac{R^{-1/2} a(\theta)}{\|R^{-1/2} a(\theta)\|}

with the noise covariance R per bin and its Hermitian root, of all roots the one that leaves the microphones
most alike: where R is a multiple of the identity, y is x and b is a, and every spatial spectrum is what it
was. What whitening removes from the sound it removes from the steering vector too, hence its new length.

MUSIC in these coordinates is the generalised eigenvalue form: the eigenvectors v of
:math:`R^{-1/2} R_x R^{-1/2}` are :math:`R^{1/2} u` with :math:`R_x u = \lambda R u`.

References
----------
R. Roy and T. Kailath, "ESPRIT", IEEE Trans. ASSP 37, 1989 (generalised eigenvalues). K. Nakamura et al.,
"Intelligent sound source localization for dynamic environments", IROS 2009 (generalised MUSIC for ego-noise).
Y. Chen, A. Wiesel, Y. Eldar and A. Hero, "Shrinkage algorithms for MMSE covariance estimation", IEEE Trans.
Signal Processing 58, 2010.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.spectra.spectra import finite_complex
from worldstate.ground.blas_threads import one_blas_thread
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import ComplexArray

# A microphone whose noise is this far below the mean (power) is dead: it keeps no say in anything.
_DEAD = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Prewhitener:
    """Inverse roots of a noise covariance, applied to spectra, covariances and steering vectors alike.

    Examples
    --------
    Noise that reaches both microphones in phase no longer hides a source between them:

    >>> noise = np.array([[[1.0, 0.9], [0.9, 1.0]]])
    >>> whitener = Prewhitener.of(noise, shrinkage=0.0)
    >>> whitener.covariance(noise).real.round(6) + 0.0
    array([[[1., 0.],
            [0., 1.]]])
    """

    roots: ComplexArray  # shape (bins, M, M): Hermitian; from `inverse_root`

    @classmethod
    def of(cls, noise_covariance: ArrayLike, shrinkage: float = 0.03) -> "Prewhitener":
        r"""Make it from a covariance (bins, M, M); see `inverse_root` for the arguments and errors.

        .. math:: \mathrm{roots} = \big[(1 - s) R / p + s I\big]^{-1/2}, \qquad p = \operatorname{tr} R / M

        Shapes: noise_covariance (bins, M, M).

        References
        ----------
        As for `inverse_root`: O. Ledoit and M. Wolf 2004, A. Kessy et al. 2018.
        """
        return cls(inverse_root(noise_covariance, shrinkage))

    def spectra(self, spectra: ArrayLike) -> ComplexArray:
        """Whiten frames, (frames, bins, M) -> the same shape.

        .. math:: y = R^{-1/2} x

        Shapes: spectra (frames, bins, M).
        """
        X = finite_complex("spectra", spectra, (None, *self.roots.shape[:2]))
        # y_i = sum_j root_ij x_j, with x as rows: the transpose.
        return np.asarray((X.transpose(1, 0, 2) @ self.roots.transpose(0, 2, 1)).transpose(1, 0, 2))

    def covariance(self, covariance: ArrayLike) -> ComplexArray:
        """Whiten covariances, R -> root R root, (bins, M, M).

        .. math:: R_y = R^{-1/2} R_x R^{-1/2}

        Shapes: covariance (bins, M, M).
        """
        R = finite_complex("covariance", covariance, self.roots.shape)
        return np.asarray(self.roots @ R @ self.roots)

    def steering(self, steering: ArrayLike) -> ComplexArray:
        r"""Whiten steering vectors and give them their length back, (bins, M, directions).

        .. math:: b = \|a\|\, \frac{R^{-1/2} a}{\|R^{-1/2} a\|}

        Shapes: steering (bins, M, directions).
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

    References
    ----------
    O. Ledoit and M. Wolf, "A well-conditioned estimator for large-dimensional covariance matrices", J.
    Multivariate Anal. 88, 2004 (shrinkage); A. Kessy, A. Lewin and K. Strimmer, "Optimal whitening and
    decorrelation", Amer. Statist. 72, 2018 (which root).

    Examples
    --------
    >>> inverse_root([np.diag([3.0, 1.0])], shrinkage=0.0).real.round(3) + 0.0
    array([[[0.816, 0.   ],
            [0.   , 1.414]]])
    """
    # so that no direction is amplified by more than 1 / sqrt(s), and s = 1 leaves everything as it is. The
    # level of R plays no part. Microphones without any noise are dead and give zeros; a bin in which all are
    # silent is left alone.
    R = finite_complex("noise_covariance", noise_covariance, (None, None, None))
    if R.shape[1] != R.shape[2]:
        raise InvalidArgumentError(f"noise_covariance: expected shape (bins, M, M), got {R.shape}")
    s = in_range("shrinkage", shrinkage, 0.0, 1.0)
    with one_blas_thread():
        return np.stack([shrunk_inverse_root(matrix, s) for matrix in R]) if len(R) else R


def white_share(R: ComplexArray, n_frames: float) -> float:
    r"""Say how far a sample covariance should be shrunk towards white noise (oracle-approximating shrinkage).

    .. math:: s = \min\Big(1, \frac{(1 - 2/M) \operatorname{tr} R^2 + \operatorname{tr}^2 R}
              {(n + 1 - 2/M) (\operatorname{tr} R^2 - \operatorname{tr}^2 R / M)}\Big)

    Shapes: R (M, M).

    Examples
    --------
    >>> white_share(np.eye(4), 100), round(white_share(np.ones((4, 4)), 100), 3)
    (1.0, 0.02)
    """
    # One where the eigenvalues spread no more than n frames of white noise would make them, so that nothing
    # is whitened that was white; next to nothing where a few directions dominate.
    size = len(R)
    squares = float(np.square(R.real).sum() + np.square(R.imag).sum())
    trace = float(np.einsum("mm->", R).real) ** 2
    spread = (n_frames + 1.0 - 2.0 / size) * (squares - trace / size)
    share = (1.0 - 2.0 / size) * squares + trace
    return share / spread if spread > share else 1.0


def shrunk_inverse_root(R: ComplexArray, s: float) -> ComplexArray:
    r"""Invert one matrix (M, M) as `inverse_root` does, unchecked.

    .. math:: \big[(1 - s) R / p + s I\big]^{-1/2} =
              V \operatorname{diag}\big[(1 - s) \lambda / p + s\big]^{-1/2} V^H

    Shapes: R (M, M).

    References
    ----------
    As for `inverse_root`: O. Ledoit and M. Wolf 2004, A. Kessy et al. 2018.

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
