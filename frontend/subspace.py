r"""Signal subspace of a covariance that changes little from hop to hop: warm-started block iteration.

The basis of the last hop is a good guess for this one, so that two block iterations and a Rayleigh-Ritz step
replace a full eigendecomposition. Two things can go wrong, and both are looked for on every hop:

- *The guess has lost the source.* A basis orthogonal to a new source stays so for ever under the iteration.
  One probe is therefore added: the column of the covariance which the last basis explains worst.
- *The iteration has not converged.* The relative residual :math:`\|R e - \lambda e\| / \lambda` says so, per
  bin; those bins are decomposed in full.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from worldstate.checks import in_range
from worldstate.errors import InvalidArgumentError

from .music import Subspace, checked_covariance
from .spectra import ComplexArray

FloatArray = NDArray[np.floating[Any]]


class SubspaceTracker:
    r"""Follows the k strongest eigenvectors of a running covariance.

    Parameters
    ----------
    sources : int
        Dimension k of the signal subspace.
    guard : int
        Extra columns carried along; the convergence rate is (lambda_{k+guard+1} / lambda_k)^iterations.
    iterations : int
        Multiplications by the covariance per update.
    tolerance : float
        Largest relative residual of the signal eigenpairs before a bin is decomposed in full.

    Raises
    ------
    InvalidArgumentError
        If a setting is out of range.

    Notes
    -----
    Source: G. H. Golub and C. F. Van Loan, *Matrix Computations*, section on orthogonal iteration with Ritz
    acceleration.

    Examples
    --------
    >>> tracker = SubspaceTracker(sources=1)
    >>> R = np.diag([1.0, 2.0, 9.0, 1.0, 1.0, 1.0])[None].astype(complex)
    >>> [float(tracker.update(R).eigenvalues[0, 0].round(6)) for _ in range(2)]
    [9.0, 9.0]
    >>> tracker.full_decompositions
    1
    """

    def __init__(self, sources: int, *, guard: int = 2, iterations: int = 2, tolerance: float = 0.05) -> None:
        if sources < 1 or guard < 0 or iterations < 1:
            raise InvalidArgumentError(
                f"expected sources >= 1, guard >= 0, iterations >= 1, got {sources}, {guard}, {iterations}"
            )
        self._sources = sources
        self._guard = guard
        self._iterations = iterations
        self._tolerance = in_range("tolerance", tolerance, 0.0, 1.0, open_low=True)
        self._basis: ComplexArray | None = None
        self._values: FloatArray | None = None
        self.full_decompositions = 0

    def update(self, covariance: ArrayLike) -> Subspace:
        """Return the signal subspace of this covariance, starting from the last one.

        Parameters
        ----------
        covariance : (bins, M, M) complex
            Hermitian. Another shape than last time starts anew.

        Returns
        -------
        Subspace
            k eigenpairs per bin, strongest last.

        Raises
        ------
        InvalidArgumentError
            On a wrong shape or non-finite values.
        """
        R = checked_covariance(covariance, self._sources)
        width = min(self._sources + self._guard, R.shape[1])
        if self._basis is None or self._values is None or self._basis.shape != (*R.shape[:2], width):
            return self._restart(R, width)
        start = np.concatenate([self._basis, _probe(R, self._basis, self._values)], axis=2)
        basis, values, residual = _iterate(R, start, self._iterations, self._sources)
        basis, values = basis[..., -width:], values[..., -width:]
        lost = ~(residual <= self._tolerance)
        if lost.any():
            basis[lost], values[lost] = self._decompose(R[lost], width)
        return self._remember(basis, values)

    def _restart(self, R: ComplexArray, width: int) -> Subspace:
        return self._remember(*self._decompose(R, width))

    def _decompose(self, R: ComplexArray, width: int) -> tuple[ComplexArray, FloatArray]:
        self.full_decompositions += len(R)
        values, vectors = np.linalg.eigh(R)
        return vectors[..., -width:], values[..., -width:]

    def _remember(self, basis: ComplexArray, values: FloatArray) -> Subspace:
        self._basis, self._values = basis, values
        return Subspace(basis[..., -self._sources :], values[..., -self._sources :])


def _probe(R: ComplexArray, V: ComplexArray, values: FloatArray) -> ComplexArray:
    """Return the column of each covariance that the basis explains worst, shape (bins, M, 1)."""
    power = np.einsum("bmm->bm", R).real
    explained = ((V.real**2 + V.imag**2) * values[:, None, :]).sum(axis=2)
    worst = np.argmax(power - explained, axis=1)
    column = R[np.arange(len(R)), :, worst][..., None]
    return column - V @ (V.conj().transpose(0, 2, 1) @ column)


def _iterate(
    R: ComplexArray, V: ComplexArray, iterations: int, sources: int
) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Block power steps, then Rayleigh-Ritz: basis, ascending Ritz values, worst relative residual."""
    for _ in range(iterations):
        V = R @ V
        V = V / np.maximum(np.linalg.norm(V, axis=1, keepdims=True), np.finfo(V.real.dtype).tiny)
    Q = np.linalg.qr(V)[0]
    RQ = R @ Q
    values, rotation = np.linalg.eigh(Q.conj().transpose(0, 2, 1) @ RQ)
    basis, image = Q @ rotation, RQ @ rotation[..., -sources:]
    miss = np.linalg.norm(image - basis[..., -sources:] * values[:, None, -sources:], axis=1)
    # Two equally strong sources share a subspace: the strongest value is the scale that matters there.
    scale = np.maximum(values[:, -sources:], np.finfo(values.dtype).tiny)
    worst: FloatArray = (miss / scale).max(axis=1)
    return basis, values, worst
