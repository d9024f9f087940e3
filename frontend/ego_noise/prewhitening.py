r"""Prewhitening: coordinates in which the noise is spatially white, and the beams in them.

.. math:: y = R^{-1/2} x, \qquad b(\theta) = \sqrt{M}\, \frac{R^{-1/2} a(\theta)}{\|R^{-1/2} a(\theta)\|}

with the noise covariance R per bin and its Hermitian root, the root that changes the microphones least: where
R is a multiple of the identity, y is x and b is a. Whitening attenuates the steering vector as it does the
sound, hence its new length.

MUSIC in these coordinates is the generalised eigenvalue form (R. Roy and T. Kailath, IEEE Trans. ASSP 37,
1989; for ego-noise K. Nakamura et al., IROS 2009): the eigenvectors v of :math:`R^{-1/2} R_x R^{-1/2}` are
:math:`R^{1/2} u` with :math:`R_x u = \lambda R u`.
"""

import numpy as np

from worldstate.frontend.array.steering import Steering
from worldstate.ground.typing import Complex64Array, ComplexArray

# Noise power of a microphone, relative to the mean, below which it is dead and left out: its inverse would
# dominate.
_DEAD = 1e-9


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
    r"""Return the Hermitian inverse root of a noise covariance, shrunk towards white noise of equal power.

    .. math:: \big[(1 - s) R / p + s I\big]^{-1/2} =
              V \operatorname{diag}\big[(1 - s) \lambda / p + s\big]^{-1/2} V^H, \qquad p = \operatorname{tr}
              R / M

    Shapes: R (M, M).
    """
    # Shrinkage after O. Ledoit and M. Wolf (2004): no direction is amplified by more than 1 / sqrt(s), and s
    # = 1 changes nothing. The Hermitian root after A. Kessy et al. (2018). Dead microphones give zeros; where
    # all are silent the identity is returned.
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


_TINY = np.float32(1e-30)


class WhitenedBeams:
    r"""Beams for whitened spectra, updated bin by bin.

    With :math:`W = B C` of `Steering`, the weights for :math:`y = R^{-1/2} x` are
    :math:`\overline{R^{-1/2}} B C`, scaled to length :math:`\sqrt M` in every direction (M counts the
    microphones that are not dead).
    """

    def __init__(self, plain: Steering) -> None:
        self.plain = plain
        basis = None if plain.basis is None else plain.basis.copy()
        self.steering = Steering(basis, plain.weights.copy(), plain.conjugate.copy())

    def update(self, bin_index: int, root: Complex64Array) -> None:
        r"""Set the inverse root (M, M) of one bin.

        .. math:: w(\theta) = \sqrt M\, \frac{\overline{R^{-1/2}}\, \overline{a(\theta)}}
                  {\|R^{-1/2}\, a(\theta)\|}
        """
        plain, ours = self.plain, self.steering
        weights = plain.weights[bin_index]
        if plain.basis is None or ours.basis is None:
            weights = root.conj() @ weights
            gram = np.square(np.abs(weights)).sum(axis=0)
        else:
            basis = root.conj() @ plain.basis[bin_index]
            ours.basis[bin_index] = basis
            gram = (weights.conj() * ((basis.conj().T @ basis) @ weights)).real.sum(axis=0)
        alive = np.float32(np.count_nonzero(np.einsum("mm->m", root)))
        scaled = weights * np.sqrt(alive / np.maximum(gram, _TINY))
        ours.weights[bin_index], ours.conjugate[bin_index] = scaled, scaled.conj()
