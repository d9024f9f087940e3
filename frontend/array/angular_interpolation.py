r"""Beam power at a few directions says it at all others.

A quadratic form :math:`\sum_k a_k(\theta)^H Q_k\, a_k(\theta)` is a smooth function of the direction,
whatever the Q_k: below the alias frequency of an array it lives in some thirty dimensions, however fine the
grid. So many directions are computed, the rest follow by one small product.

The directions are chosen by a pivoted Cholesky factorisation of the kernel

.. math:: G(\theta, \phi) = \sum_k \big| a_k(\theta)^H a_k(\phi) \big|^2,

each where the ones before foretell least, until all are foretold.

References
----------
N. J. Higham, "Analysis of the Cholesky decomposition of a semi-definite matrix", 1990.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import Complex128Array, FloatArray, IndexArray

# What no direction's power is missed by, relative to the largest that there can be: single precision's own.
_TOLERANCE = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class AngularInterpolation:
    """Directions that are computed, and how the others follow.

    Examples
    --------
    Two microphones: power is a constant and a wave, so that three directions say it all.

    >>> phase = np.linspace(-1.5, 1.5, 31)
    >>> nodes = AngularInterpolation.of(np.stack([np.exp(1j * phase), np.exp(-1j * phase)])[None])
    >>> power = 1.0 + 0.5 * np.cos(2 * phase + 0.3)
    >>> len(nodes.index), bool(np.allclose(power[nodes.index] @ nodes.spread, power))
    (3, True)
    """

    index: IndexArray  # shape (N,): Among all directions
    spread: FloatArray  # shape (N, directions): Power at all directions is power at the nodes times this

    @classmethod
    def of(cls, vectors: Complex128Array) -> "AngularInterpolation | None":
        r"""Choose for steering vectors (bins, M, directions); None where more than half would be needed.

        .. math:: P(\theta) = \sum_n P(\theta_n)\, s_n(\theta), \qquad s = G_{NN}^{-1} G_{N\theta}

        with the kernel G of the module's head and N the directions chosen.

        Shapes: vectors (bins, M, directions).
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
