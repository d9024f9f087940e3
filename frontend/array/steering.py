"""Steering matrices for many directions, factorised if the rank is small; products run on one thread."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

from worldstate.ground.typing import Complex64Array, Complex128Array, FloatArray, IndexArray

from .microphone_array import MicrophoneArray

# Largest errors of the interpolated power relative to the largest possible power, and of a factorised
# steering vector relative to its length: those of single precision.
_POWER_TOLERANCE, _TOLERANCE = 1e-7, 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Steering:
    r"""Weights :math:`w_k(\theta) = \overline{a_k(\theta)}` as a product of two thin matrices per bin.

    .. math:: y_t[k, \theta] = \sum_m \overline{a_{k,m}(\theta)}\, x_{t,k,m}
              \approx \big(x_{t,k}^T B_k\big)\, C_k(\theta)

    Examples
    --------
    >>> steering = Steering.towards(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), [500.0], [0.0, 0.5, 1.0])
    >>> steering.weights.shape[2], steering.basis is None
    (3, True)
    """

    # Below the alias frequency, beams over azimuth at one elevation span few of the M dimensions (15 to 20 of
    # 56). Products with B (M x r) and C (r x directions) then take a third of the time of W = B C.

    # shape (bins, M, r): Orthonormal columns; None if the factors would not be smaller than the weights.
    basis: Complex64Array | None
    weights: Complex64Array  # shape (bins, r or M, directions): C and its conjugate
    conjugate: Complex64Array
    # The same beams in the node directions, and the weights (nodes, directions) with which the power in all
    # directions is interpolated from them; None if this saves no time.
    nodes: "tuple[Steering, FloatArray] | None" = None

    @classmethod
    def towards(
        cls,
        array: MicrophoneArray,
        frequencies_hz: ArrayLike,
        azimuths_rad: ArrayLike,
        elevations_rad: ArrayLike = 0.0,
    ) -> "Steering":
        r"""Return the beams of an array at the given frequencies and directions.

        .. math:: W_k = \overline{A_k}, \qquad W_k \approx B_k C_k, \quad C_k = B_k^H W_k

        Shapes: frequencies_hz (bins,), azimuths_rad, elevations_rad (directions,).
        """
        azimuths = np.asarray(azimuths_rad, np.float64)
        elevations = np.broadcast_to(np.asarray(elevations_rad, np.float64), azimuths.shape)
        frequencies = np.asarray(frequencies_hz, np.float64)
        return _beams(*(one.tobytes() for one in (array.centred_m, frequencies, azimuths, elevations)))

    def covariance(self, spectra: Complex64Array) -> Complex64Array:
        r"""Return the sum of x x^H over frames in the basis, (frames, bins, M) -> (bins, r, r).

        .. math:: Q_k = \sum_t (B_k^T x_{t,k}) (B_k^T x_{t,k})^H
        """
        by_bin = spectra.transpose(1, 0, 2)
        return cross_spectra(by_bin if self.basis is None else by_bin @ self.basis)

    def compress(self, matrices: Complex64Array) -> Complex64Array:
        r"""Return R in the basis, :math:`Q_k = B_k^T R_k \overline{B_k}`: (bins, M, M) -> (bins, r, r)."""
        if self.basis is None:
            return matrices
        return np.asarray(self.basis.transpose(0, 2, 1) @ (matrices @ self.basis.conj()))

    def quadratic_form(self, matrices: Complex64Array) -> Complex128Array:
        r"""Return the sum of the beams' quadratic forms over bins, (bins, r, r) -> (directions,).

        .. math:: P(\theta) = \sum_k C_k(\theta)^T Q_k\, \overline{C_k(\theta)}
        """
        if self.nodes is not None:
            return np.asarray(self.nodes[0].quadratic_form(matrices) @ self.nodes[1])
        products = matrices @ self.conjugate
        products *= self.weights
        return np.asarray(products.sum(axis=(0, 1)), dtype=np.complex128)

    def power_within(self, vectors: Complex64Array) -> FloatArray:
        r"""Return the power of steering vectors in the span of columns (bins, M, k): (bins, directions).

        .. math:: p_k(\theta) = \|E_k^H a_k(\theta)\|^2
        """
        if self.nodes is not None:
            return np.asarray(self.nodes[0].power_within(vectors) @ self.nodes[1])
        rows = vectors.transpose(0, 2, 1)
        inner = (rows if self.basis is None else rows @ self.basis) @ self.weights
        power = np.square(inner.real).sum(axis=1, dtype=np.float64) + np.square(inner.imag).sum(axis=1)
        return np.asarray(power)


# Every stream of an array uses the same two sets of beams, whose computation takes nine tenths of the 50 ms
# to create a front-end for 56 microphones. Few sets are cached: one for 1024 microphones needs 15 MB.
@lru_cache(maxsize=4)
def _beams(centred: bytes, frequencies: bytes, azimuths: bytes, elevations: bytes) -> Steering:
    """Return the beams of `Steering.towards` from the bytes of its arguments, which can be cache keys."""
    array = MicrophoneArray(np.frombuffer(centred).reshape(-1, 3))
    frequencies_hz, azimuths_rad, elevations_rad = map(np.frombuffer, (frequencies, azimuths, elevations))
    weights = array.steering(frequencies_hz, azimuths_rad, elevations_rad).conj()
    basis = _thin_basis(weights, max_rank=array.n_microphones // 2)
    thin = None if basis is None else np.ascontiguousarray(basis, np.complex64)
    weights = weights if basis is None else basis.conj().transpose(0, 2, 1) @ weights
    single = weights.astype(np.complex64)
    found = interpolation_nodes(weights)
    if found is None:
        return Steering(thin, single, single.conj())
    index, spread = found
    chosen = np.ascontiguousarray(weights[:, :, index], np.complex64)
    return Steering(thin, single, single.conj(), (Steering(thin, chosen, chosen.conj()), spread))


def interpolation_nodes(vectors: Complex128Array) -> tuple[IndexArray, FloatArray] | None:
    r"""Select nodes N among the directions of steering vectors (bins, M, directions), with their weights.

    .. math:: P(\theta) = \sum_n P(\theta_n)\, s_n(\theta), \qquad s = G_{NN}^{-1} G_{N\theta}, \qquad
              G(\theta, \phi) = \sum_k \big| a_k(\theta)^H a_k(\phi) \big|^2

    A quadratic form :math:`P = \sum_k a_k(\theta)^H Q_k\, a_k(\theta)` is a smooth function of the direction
    for any Q_k. Below the alias frequency of an array it lies in a space of about thirty dimensions, however
    fine the grid is. The nodes follow from a pivoted Cholesky factorisation of G (N. J. Higham, "Analysis of
    the Cholesky decomposition of a semi-definite matrix", 1990). Each node is the direction with the largest
    prediction error from the previous ones, until all directions are predicted. The result is None if more
    than half of the directions would be needed.
    """
    count = vectors.shape[2]
    rest = np.square(np.square(np.abs(vectors)).sum(axis=1)).sum(axis=0)
    limit = _POWER_TOLERANCE**2 * rest.max()
    rows, index = np.empty((count // 2, count)), np.empty(count // 2, np.intp)
    for n in range(count // 2):
        worst = int(rest.argmax())
        if rest[worst] <= limit:
            return index[:n].copy(), np.linalg.solve(rows[:n, index[:n]], rows[:n])
        # G between this direction and all.
        inner = (vectors[:, None, :, worst].conj() @ vectors)[:, 0]
        kernel = (np.square(inner.real) + np.square(inner.imag)).sum(axis=0) - rows[:n, worst] @ rows[:n]
        index[n], rows[n] = worst, kernel / np.sqrt(rest[worst])
        rest = rest - np.square(rows[n])
        rest[index[: n + 1]] = 0.0
    return None


def _thin_basis(weights: Complex128Array, max_rank: int) -> Complex128Array | None:
    """Return orthonormal columns (bins, M, r) that span all weights to the tolerance; None if too many."""
    # Gram-Schmidt with pivoting: the vector with the largest remainder becomes the next column.
    remainder = weights.copy()
    columns: list[Complex128Array] = []
    limit = _TOLERANCE * np.sqrt(weights.shape[1])
    for _ in range(max_rank):
        lengths = np.linalg.norm(remainder, axis=1)
        worst = lengths.argmax(axis=1)[:, None]
        length = np.take_along_axis(lengths, worst, axis=1)
        if length.max() < limit:
            return np.stack(columns, axis=2)
        column = np.take_along_axis(remainder, worst[:, None], axis=2)[:, :, 0]
        # A bin that is complete receives a column of zeros.
        column = np.where(length < limit, 0.0, column / np.maximum(length, limit))
        columns.append(column)
        remainder -= column[:, :, None] * (column.conj()[:, None] @ remainder)
    return None


def cross_spectra(spectra: Complex64Array) -> Complex64Array:
    r"""Return :math:`R_{ij} = \sum_t x_{t,i} \overline{x_{t,j}}` from (bins, frames, M), (bins, M, M)."""
    return np.asarray(spectra.transpose(0, 2, 1) @ spectra.conj())


def one_blas_thread() -> AbstractContextManager[Any]:
    """Limit BLAS to the calling thread in a context and restore the limit afterwards."""
    # The front-end multiplies thousands of small matrices per second. A second BLAS thread does not
    # accelerate these; if other programs use the processor, every product would wait until it is scheduled
    # (four times the processor time on two busy cores). One thread also makes results bit-identical for any
    # number of cores. The limit applies to the process: products that other threads start meanwhile, about
    # one millisecond in a hundred, also run on one thread. The call takes 16 microseconds.
    several = any(library.get_num_threads() > 1 for library in _controller().lib_controllers)
    return _controller().limit(limits=1) if several else nullcontext()


@lru_cache(maxsize=1)
def _controller() -> Any:
    """Return the controller of the BLAS libraries; cached, because the search takes a millisecond."""
    return ThreadpoolController().select(user_api="blas")
