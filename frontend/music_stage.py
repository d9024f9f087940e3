"""MUSIC on a stream: the covariance of the running window, its subspace from hop to hop, a bearing."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldstate.errors import InvalidArgumentError
from worldstate.values import NotUsable

from .masking import ChannelMask
from .peaks import find_peaks
from .spectra import ComplexArray
from .steering import cross_spectra
from .subspace import SubspaceTracker


@dataclass(frozen=True, slots=True, eq=False)
class MusicReading:
    """What MUSIC says of one window.

    Parameters
    ----------
    azimuth_rad : float
        Highest peak, left positive.
    prominence : float
        Its ratio to the median of the spectrum.
    spectrum : ndarray of float64, shape (A,)
        Over the grid of azimuths, the highest over elevations; every bin counts alike: at most 1.

    Examples
    --------
    >>> MusicReading(0.3, 4.0, np.ones(3)).azimuth_rad
    0.3
    """

    azimuth_rad: float
    prominence: float
    spectrum: NDArray[np.float64]


class MusicStage:
    """Running covariance of raw spectra, its signal subspace, and the spectrum over a grid.

    Parameters
    ----------
    steering : ndarray of complex64, shape (K, M, D)
        Responses at the directions of the grid, elevation by elevation.
    azimuths_rad : ndarray, shape (A,)
        Ascending, evenly spaced; D is a multiple of A.
    sources : int
        Dimension of the signal subspace, 1 to M - 1.
    window_hops : int
        Hops in the window.

    Raises
    ------
    InvalidArgumentError
        If there are not more microphones than sources.

    Examples
    --------
    >>> from worldstate.frontend.array import MicrophoneArray
    >>> array, grid = MicrophoneArray([[0, 0.1 * i, 0] for i in range(4)]), np.linspace(-1.5, 1.5, 31)
    >>> stage = MusicStage(array.steering([500.0, 700.0], grid).astype(np.complex64), grid, 1, window_hops=2)
    >>> wave = array.steering([500.0, 700.0], 0.4)[None, :, :, 0].astype(np.complex64)
    >>> stage.push(np.tile(wave, (5, 1, 1)))
    >>> round(stage.read(ChannelMask.all_of(4)).azimuth_rad, 2)
    0.4
    """

    def __init__(
        self,
        steering: NDArray[np.complex64],
        azimuths_rad: NDArray[np.float64],
        sources: int,
        window_hops: int,
    ) -> None:
        n_bins, n_microphones, _ = steering.shape
        if not 1 <= sources < n_microphones:
            expected = f"1 to {n_microphones - 1} with {n_microphones} microphones"
            raise InvalidArgumentError(f"music_sources: expected {expected}, got {sources}")
        self._all = self._steering = steering
        self._mask = ChannelMask.all_of(n_microphones)
        self._azimuths = azimuths_rad
        self._sources = sources
        self._hops: deque[NDArray[np.complex64]] = deque(maxlen=window_hops)
        self._total = np.zeros((n_bins, n_microphones, n_microphones), np.complex128)
        self._n_pushed = 0
        self._tracker = SubspaceTracker(sources)

    def push(self, spectra: NDArray[np.complex64]) -> None:
        """Take the frames of a hop (frames, K, M)."""
        if len(self._hops) == self._hops.maxlen:
            self._total -= self._hops[0]
        self._hops.append(cross_spectra(spectra.transpose(1, 0, 2)))
        self._n_pushed += 1
        if self._n_pushed % len(self._hops):
            self._total += self._hops[-1]
        else:
            self._sum_again()

    def _sum_again(self) -> None:
        """Add up the window once in its length: what was loud leaves no rounding behind."""
        self._total[...] = 0.0
        for matrices in self._hops:
            self._total += matrices

    def read(self, mask: ChannelMask) -> MusicReading | NotUsable:
        """Score the grid by the window so far, with the microphones of a mask."""
        if mask.n_kept <= self._sources:
            return NotUsable(f"{mask.n_kept} microphones left for {self._sources} sources")
        self._use(mask)
        covariance = mask.cross(self._total.astype(np.complex64))
        power = float(np.einsum("kmm->", covariance).real)
        if not power > 0.0:
            return NotUsable("silence")
        subspace = self._tracker.update(covariance / np.float32(power))
        heard = self._spectrum(subspace.vectors, mask.n_kept)
        profile = heard.reshape(-1, len(self._azimuths)).max(axis=0)
        peak = find_peaks(profile, self._azimuths, max_peaks=1)[0]
        return MusicReading(peak.azimuth_rad, peak.prominence, profile)

    def _spectrum(self, vectors: ComplexArray, n_kept: int) -> NDArray[np.float64]:
        """MUSIC as in `music.music_spectrum`, normalised; |a|^2 is the number of microphones left."""
        inside = vectors.conj().transpose(0, 2, 1) @ self._steering
        power = np.square(inside.real).sum(axis=1) + np.square(inside.imag).sum(axis=1)
        outside = np.maximum(n_kept - power, np.finfo(np.float32).eps * n_kept)
        score = outside.min(axis=1, keepdims=True) / outside
        return np.asarray(score.mean(axis=0, dtype=np.float64))

    def _use(self, mask: ChannelMask) -> None:
        """Keep the steering of the last mask; another one replaces it."""
        if not np.array_equal(mask.keep, self._mask.keep):
            self._mask = mask
            self._steering = self._all * mask.keep[None, :, None]
