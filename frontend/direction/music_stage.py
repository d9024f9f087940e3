"""MUSIC on a stream: the covariance of a running window, its tracked subspace, and the spectrum."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.channel_mask import ChannelMask
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.spectra.window_sum import WindowSum
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Complex64Array, ComplexArray, FloatArray
from worldstate.ground.values import NotUsable

from .peaks import find_peaks
from .subspace import SubspaceTracker


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
