r"""Interpolate steered power over azimuth from a few node directions.

A quadratic form :math:`\sum_k a_k(\theta)^H Q_k\, a_k(\theta)` is a smooth function of the direction,
whatever the Q_k: below the alias frequency of an array it lies in a space of some thirty dimensions, however
fine the grid. So it is computed at that many directions, and the others follow by one small product.

The directions are chosen by a pivoted Cholesky factorisation (N. J. Higham, "Analysis of the Cholesky
decomposition of a semi-definite matrix", 1990) of the kernel

.. math:: G(\theta, \phi) = \sum_k \big| a_k(\theta)^H a_k(\phi) \big|^2,

each where the ones before predict the power worst, until all are predicted.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import Complex128Array, FloatArray, IndexArray

# Largest error of the power in any direction, relative to the largest possible power: that of single
# precision.
_TOLERANCE = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class AngularInterpolation:
    """Node directions, and the weights that give the power in all others."""

    index: IndexArray  # shape (N,): Nodes among all directions
    spread: FloatArray  # shape (N, directions): Power in all directions is the power at the nodes times this

    @classmethod
    def of(cls, vectors: Complex128Array) -> "AngularInterpolation | None":
        r"""Choose nodes for steering vectors (bins, M, directions); None if more than half would be needed.

        .. math:: P(\theta) = \sum_n P(\theta_n)\, s_n(\theta), \qquad s = G_{NN}^{-1} G_{N\theta}

        with the kernel G above and N the nodes.
        """
        count = vectors.shape[2]
        rest = np.square(np.square(np.abs(vectors)).sum(axis=1)).sum(axis=0)
        limit = _TOLERANCE**2 * rest.max()
        rows, index = np.empty((count // 2, count)), np.empty(count // 2, np.intp)
        for n in range(count // 2):
            worst = int(rest.argmax())
            if rest[worst] <= limit:
                spread = np.linalg.solve(rows[:n, index[:n]], rows[:n])
                return cls(index[:n].copy(), spread)
            kernel = _kernel(vectors, worst) - rows[:n, worst] @ rows[:n]
            index[n], rows[n] = worst, kernel / np.sqrt(rest[worst])
            rest = rest - np.square(rows[n])
            rest[index[: n + 1]] = 0.0
        return None


def _kernel(vectors: Complex128Array, index: int) -> FloatArray:
    """G between one direction and all, (directions,)."""
    inner = (vectors[:, None, :, index].conj() @ vectors)[:, 0]
    return np.asarray((np.square(inner.real) + np.square(inner.imag)).sum(axis=0))
