"""MUSIC on a stream: the covariance of a running window, its tracked subspace, and the spectrum."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.channel_mask import ChannelMask
from worldstate.frontend.array.steering import Steering
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Complex64Array, ComplexArray, FloatArray
from worldstate.ground.values import NotUsable

from .peaks import find_peaks
from .subspace import SubspaceTracker

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
