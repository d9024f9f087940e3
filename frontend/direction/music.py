r"""Wideband MUSIC for any set of steering vectors, on a stream too, and the number of sources.

In each bin the covariance of the microphones is split into k signal eigenvectors E_s and the noise subspace;
the spectrum is the reciprocal of the part of a steering vector a outside the signal subspace,

.. math::
    P_b(\theta) = \frac{1}{a_b^H (I - E_s E_s^H) a_b}, \qquad
    P(\theta) = \frac1B \sum_b w_b P_b(\theta),

with w_b = 1, or 1 / max P_b so that every bin has the same weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.array.microphone_array import ChannelMask
from worldstate.frontend.array.steering import Steering
from worldstate.ground import InvalidArgumentError, NotUsable
from worldstate.ground.checks import finite_array, finite_complex, in_range
from worldstate.ground.typing import Complex64Array, ComplexArray, FloatArray, RealArray

from .bearing import find_peaks


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
    r"""Track the k strongest eigenvectors of a running covariance.

    The basis of the last hop is the initial value for this one. A Chebyshev polynomial of the covariance
    amplifies eigenvalues above the noise (Y. Zhou et al., J. Comput. Phys. 219, 2006) and a Rayleigh-Ritz
    step orders the result. The degree follows the eigenvalues of the last hop: one or two with a strong
    source, up to eight in noise alone. Two failures are checked on every hop:

    - *A new source is orthogonal to the basis* and stays so under any polynomial. One probe vector is
      therefore added: the column of the covariance that the last basis explains worst.
    - *No convergence.* The sine of the angle to the true subspace is at most
      :math:`\|R e - \lambda e\| / (\lambda_k - \lambda_{k+1})` (Davis and Kahan). Bins in which that is too
      large are iterated once more, and then decomposed in full.
    """

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


def count_sources(eigenvalues: ArrayLike, frames: int) -> int:
    r"""Estimate the number of sources from the eigenvalues of one or more bins.

    All criteria assume noise that is white across the microphones and independent frames. A real street has
    neither: reflections are coherent with their source, wind and ego-noise are not white, overlapping frames
    are not independent. The result is the number of plane waves that the noise model does not explain, not of
    vehicles.

    With l_1 >= ... >= l_M the eigenvalues, T frames and a, g the arithmetic and geometric means of the M - k
    smallest,

    .. math::
        L(k) = T (M - k) \ln(a / g), \qquad \mathrm{MDL} = L + \tfrac12 k (2M - k) \ln T

    is consistent and needs T > M, because the geometric mean of a singular covariance is zero. Where T <= 2 M
    the criterion of Nadakuditi and Edelman takes its place, which compares the second moment of the smallest
    eigenvalues with that of a Wishart matrix and holds for T < M too:

    .. math::
        t_k = M \Big[ (M - k) \frac{\sum_{i>k} l_i^2}{(\sum_{i>k} l_i)^2} - 1 - \frac M T \Big], \qquad
        \mathrm{few} = \tfrac12 (T / M)^2 t_k^2 + 2 (k + 1).

    Criteria are log-likelihoods, so those of several bins add (independent bins, one number of sources).

    Parameters
    ----------
    eigenvalues : array_like, shape (M,) or (bins, M)
        All M eigenvalues of each covariance, any order, >= 0; zeros included where T < M.
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
        raise InvalidArgumentError(
            f"eigenvalues: expected numbers >= 0 from two frames or more, got {frames}"
        )
    microphones = values.shape[1]
    ordered = np.sort(values, axis=1)[:, ::-1]
    score = _description_length if frames > 2 * microphones else _moment_score
    return int(np.argmin([score(ordered, k, frames).sum() for k in range(min(microphones, frames))]))


def _description_length(values: FloatArray, k: int, frames: int) -> FloatArray:
    """MDL of k sources, one per bin."""
    microphones = values.shape[1]
    noise = np.maximum(values[:, k:], np.finfo(float).tiny)
    misfit = frames * (microphones - k) * (np.log(noise.mean(axis=1)) - np.log(noise).mean(axis=1))
    return np.asarray(misfit + 0.5 * k * (2 * microphones - k) * np.log(frames))


def _moment_score(values: FloatArray, k: int, frames: int) -> FloatArray:
    """Nadakuditi-Edelman score of k sources for complex data, one per bin."""
    microphones = values.shape[1]
    noise = values[:, k:]
    total = np.maximum(noise.sum(axis=1), np.finfo(float).tiny)
    ratio = (microphones - k) * (noise**2).sum(axis=1) / total**2
    t = microphones * (ratio - 1.0 - microphones / frames)
    return np.asarray(0.5 * (frames / microphones) ** 2 * t**2 + 2.0 * (k + 1))


# Round-off, relative to the sum, from which the window is summed again from its parts.
_MAX_ROUND_OFF = 1e-5
_EPS = float(np.finfo(np.float32).eps)


class WindowSum:
    """Sum of the last `length` sets of positive semidefinite matrices, in single precision."""

    # Adding the newest and subtracting the oldest set costs two passes, but leaves the round-off of loud sets
    # behind, in which a sound 100 dB below would be lost. The round-off is bounded by the traces added and
    # subtracted; where it may exceed 1e-5 of the sum, the window is summed again.

    def __init__(self, length: int, n_bins: int, size: int) -> None:
        self._parts = np.zeros((length, n_bins, size, size), np.complex64)
        self.total = np.zeros((n_bins, size, size), np.complex64)
        self._traces = np.zeros((length, n_bins))
        self._round_off = np.zeros(n_bins)
        self._slot = 0

    def open_slot(self) -> Complex64Array:
        r"""Subtract the oldest set and return its memory, into which the newest is to be written.

        .. math:: S \leftarrow S - A_{n - L}
        """
        oldest = self._parts[self._slot]
        self._round_off += _EPS * self._traces[self._slot]
        self.total -= oldest
        return np.asarray(oldest)

    def close_slot(self) -> None:
        r"""Add the set that was written.

        .. math:: S \leftarrow S + A_n, \qquad
                  S \leftarrow \sum_i A_i \text{ where } \epsilon \sum_j t_j > 10^{-5} \sum_i t_i

        with the traces t of the sets i in the window and of all sets j added or subtracted since the last
        full sum.
        """
        newest = self._parts[self._slot]
        self.total += newest
        self._traces[self._slot] = np.einsum("bmm->bm", newest).real.sum(axis=1)
        self._round_off += _EPS * self._traces[self._slot]
        self._slot = (self._slot + 1) % len(self._parts)
        if (self._round_off > _MAX_ROUND_OFF * self._traces.sum(axis=0)).any():
            np.sum(self._parts, axis=0, out=self.total)
            self._round_off[:] = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MusicReading:
    """MUSIC spectrum of one window and its highest peak."""

    azimuth_rad: float  # Highest peak, left positive
    prominence: float  # Its ratio to the median of the spectrum
    # shape (A,): Maximum over elevations; every bin has the same weight, so at most 1.
    spectrum: FloatArray


class MusicStage:
    r"""Running covariance of a window of spectra, its signal subspace, and the MUSIC spectrum over a grid.

    With prewhitened spectra and beams it is the generalised eigenvalue form: the
    eigenvectors of :math:`R^{-1/2} R_x R^{-1/2}`, R being the noise (`prewhitening`).
    """

    def __init__(
        self,
        beams: Sequence[Steering],
        azimuths_rad: FloatArray,
        sources: int,
        n_microphones: int,
        window_hops: int,
    ) -> None:
        if not 1 <= sources < n_microphones:
            expected = f"1 to {n_microphones - 1} with {n_microphones} microphones"
            raise InvalidArgumentError(f"music_sources: expected {expected}, got {sources}")
        self._beams = beams  # One row of elevation each
        self._whitened: Sequence[Steering] | None = None
        self._azimuths = azimuths_rad
        self._sources = sources
        self._window = WindowSum(window_hops, len(beams[0].weights), n_microphones)
        self._tracker = SubspaceTracker(sources)

    def push(self, spectra: Complex64Array, beams: Sequence[Steering] | None = None) -> None:
        r"""Take the frames of a hop (frames, K, M), and the beams that belong to them if they are whitened.

        .. math:: R_k = \sum_{t \in window} x_{t,k}\, x_{t,k}^H
        """
        by_bin = spectra.transpose(1, 0, 2)
        np.matmul(by_bin.transpose(0, 2, 1), by_bin.conj(), out=self._window.open_slot())
        self._window.close_slot()
        self._whitened = beams

    def read(self, mask: ChannelMask) -> MusicReading | NotUsable:
        r"""Return the spectrum of the window over the grid, from the microphones of a mask.

        .. math:: P(\theta) = \frac1K \sum_k \frac{\min_{\theta'} D_k(\theta')}{D_k(\theta)}, \qquad
                  D_k = \|a_k\|^2 - \|E_k^H a_k\|^2
        """
        if mask.n_kept <= self._sources:
            return NotUsable(f"{mask.n_kept} microphones left for {self._sources} sources")
        covariance = mask.cross(self._window.total)
        if not np.einsum("kmm->", covariance).real > 0.0:
            return NotUsable("silence")
        subspace = self._tracker.update(covariance)
        spectrum = self._spectrum(subspace.vectors, mask)
        profile = spectrum.reshape(-1, len(self._azimuths)).max(axis=0)
        peak = find_peaks(profile, self._azimuths, max_peaks=1)[0]
        return MusicReading(peak.azimuth_rad, peak.prominence, profile)

    def _spectrum(self, vectors: ComplexArray, mask: ChannelMask) -> FloatArray:
        """Return the normalised spectrum of `music_spectrum` on the factored beams."""
        beams = self._beams if self._whitened is None else self._whitened
        # A plain steering vector has modulus one at every microphone.
        lengths = [mask.n_kept if self._whitened is None else one.squared_lengths(mask.keep) for one in beams]
        rows = [length - one.power_within(vectors) for length, one in zip(lengths, beams, strict=True)]
        outside = np.maximum(np.concatenate(rows, axis=1), np.finfo(np.float32).eps * mask.n_kept)
        score = outside.min(axis=1, keepdims=True) / outside
        return np.asarray(score.mean(axis=0))
