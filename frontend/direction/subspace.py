r"""Track the signal subspace of a covariance from hop to hop by filtered subspace iteration.

The basis of the last hop is the initial value for this one. A Chebyshev polynomial of the covariance
amplifies eigenvalues above the noise (Y. Zhou et al., J. Comput. Phys. 219, 2006) and a Rayleigh-Ritz step
orders the result. The degree follows the eigenvalues of the last hop: one or two with a strong source, up to
eight in noise alone. Two failures are checked on every hop:

- *A new source is orthogonal to the basis* and stays so under any polynomial. One probe vector is therefore
added:
  the column of the covariance that the last basis explains worst.
- *No convergence.* The sine of the angle to the true subspace is at most
  :math:`\|R e - \lambda e\| / (\lambda_k - \lambda_{k+1})` (Davis and Kahan). Bins in which that is too
  large are iterated once more, and then decomposed in full.
"""

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import ComplexArray, RealArray

from .music import Subspace

# Bins that two rounds do not settle are decomposed in full.
ROUNDS = 2
# Beyond it single precision is lost: see `_SPREAD`.
_MAX_DEGREE = 8
# Least and largest amplification of the weakest signal eigenvector over the noise.
_GAIN, _MOST_GAIN = 100.0, 3000.0
# Largest amplification of the strongest over the weakest: of seven digits some must remain.
_SPREAD = 1e4
# Gap of eigenvalues, relative to the largest, that single precision does not resolve.
_LEAST_GAP = 1e-4


class SubspaceTracker:
    r"""Track the k strongest eigenvectors of a running covariance."""

    def __init__(self, sources: int, *, guard: int = 3, tolerance: float = 0.05) -> None:
        if sources < 1 or guard < 0:
            raise InvalidArgumentError(f"expected sources >= 1, guard >= 0, got {sources}, {guard}")
        self._sources = sources
        self._guard = guard
        self._tolerance = in_range("tolerance", tolerance, 0.0, 1.0, open_low=True)
        self._basis: ComplexArray | None = None
        self._values: RealArray | None = None
        self.full_decompositions = 0

    def update(self, R: ComplexArray) -> Subspace:
        r"""Return the signal subspace of covariances (bins, M, M), starting from that of the last call.

        .. math:: V \leftarrow \mathrm{Ritz}\big(T_m(2 R / c - I)\, [V, r]\big), \qquad
                  \sin\angle(e, E_s) \le \frac{\|R e - \lambda e\|}{\lambda_k - \lambda_{k+1}}

        with the Chebyshev polynomial T_m, the edge c of the noise and the probe r.
        """
        width = min(self._sources + self._guard, R.shape[1] - 1)
        if self._basis is None or self._values is None or self._basis.shape != (len(R), width, R.shape[1]):
            self._basis, self._values = self._decomposed(R, width)
        else:
            self._basis, self._values = self._refreshed(R, self._basis, self._values)
        vectors = self._basis[:, -self._sources :].conj().transpose(0, 2, 1)
        return Subspace(vectors, self._values[:, -self._sources :])

    def _refreshed(
        self, R: ComplexArray, basis: ComplexArray, values: RealArray
    ) -> tuple[ComplexArray, RealArray]:
        """Update all bins, then again those that have not converged."""
        basis, values, angle = _improved(R, basis, values, self._sources)
        for _ in range(ROUNDS - 1):
            late = np.flatnonzero(~(angle <= self._tolerance))
            if not len(late):
                return basis, values
            better = _improved(R[late], basis[late], values[late], self._sources)
            basis[late], values[late], angle[late] = better
        late = np.flatnonzero(~(angle <= self._tolerance))
        if len(late):
            basis[late], values[late] = self._decomposed(R[late], basis.shape[1])
        return basis, values

    def _decomposed(self, R: ComplexArray, width: int) -> tuple[ComplexArray, RealArray]:
        self.full_decompositions += len(R)
        values, vectors = np.linalg.eigh(R)
        return vectors[..., -width:].conj().transpose(0, 2, 1), values[..., -width:]


def _improved(
    R: ComplexArray, basis: ComplexArray, values: RealArray, sources: int
) -> tuple[ComplexArray, RealArray, RealArray]:
    """Return one iteration: vectors as rows v^H, ascending values, bound of the angle to the true ones."""
    initial = np.concatenate([_probe(R, basis, values), basis], axis=1)
    rows, found, angle = _ritz(R, _filtered(R, initial, values, sources), sources)
    return rows[:, 1:], found[:, 1:], angle


def _probe(R: ComplexArray, rows: ComplexArray, values: RealArray) -> ComplexArray:
    """Return the row of each covariance that the basis explains worst, shape (bins, 1, M)."""
    power = np.einsum("bmm->bm", R).real
    explained = (values[:, None, :] @ (np.square(rows.real) + np.square(rows.imag)))[:, 0]
    bins, worst = np.arange(len(R)), np.argmax(power - explained, axis=1)
    scale = np.maximum(power[bins, worst], np.finfo(power.dtype).tiny)
    return np.asarray((R[bins, worst] / scale[:, None])[:, None])


def _filtered(R: ComplexArray, rows: ComplexArray, values: RealArray, sources: int) -> ComplexArray:
    r"""Apply :math:`T_m(2 R / c - 1)` to vectors given as rows; c is where the noise begins."""
    strongest, weakest = values[:, -1], values[:, -sources]
    noise = np.maximum(values[:, 0], 1e-3 * weakest) + np.finfo(values.dtype).tiny
    degree = _degree(strongest, weakest, noise)
    # No more gain than needed: the assumed edge of the noise may be higher.
    edge = 2.0 * weakest / (1.0 + np.cosh(np.arccosh(_MOST_GAIN) / degree))
    scale = (2.0 / np.maximum(noise, edge)).astype(values.dtype)[:, None, None]
    before, now = rows, (rows * scale) @ R - rows
    scale *= 2.0
    for _ in range(degree - 1):
        after = (now * scale) @ R
        after -= before
        after -= now
        after -= now
        before, now = now, after
    return np.asarray(now)


def _degree(strongest: RealArray, weakest: RealArray, noise: RealArray) -> int:
    """Lowest degree that reaches the gain in every bin, as far as precision allows."""
    contrast = np.maximum(2.0 * weakest / noise - 1.0, 1.0 + 1e-3)
    needed = int(np.ceil((np.arccosh(_GAIN) / np.arccosh(contrast)).max()))
    spread = float((strongest / np.maximum(weakest, noise)).max())
    allowed = int(np.log(_SPREAD) / np.log(spread)) if spread > 1.0 else _MAX_DEGREE
    return max(min(needed, allowed, _MAX_DEGREE), 1)


def _ritz(R: ComplexArray, rows: ComplexArray, sources: int) -> tuple[ComplexArray, RealArray, RealArray]:
    """Rayleigh-Ritz step: orthonormal rows, ascending values, bound of the sine of the angle."""
    Q = np.ascontiguousarray(np.linalg.qr(rows.transpose(0, 2, 1))[0].transpose(0, 2, 1))
    QR = Q @ R
    values, rotation = np.linalg.eigh(QR @ Q.conj().transpose(0, 2, 1))
    turn = rotation.conj().transpose(0, 2, 1)
    basis, image = turn @ Q, turn[:, -sources:] @ QR
    image -= basis[:, -sources:] * values[:, -sources:, None]
    miss = np.sqrt((np.square(image.real) + np.square(image.imag)).sum(axis=2).max(axis=1))
    gap = values[:, -sources] - values[:, -sources - 1]
    # A gap below the resolution of single precision is not resolved by a full decomposition either.
    least = np.maximum(_LEAST_GAP * values[:, -1], np.finfo(values.dtype).tiny)
    return basis, values, miss / np.maximum(gap, least)
