"""From the samples of one hop to the sums that every window is made of."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .array import MicrophoneArray
from .bands import mean_square_per_bin
from .bins import band_bins, bin_frequencies_hz
from .ego_noise import EgoNoise
from .feature import feature_steering, pair_sum
from .phat import power, whiten
from .settings import FrontEndSettings
from .srp import steered_power
from .steering import Steering
from .stft import StreamingStft

Spectra = NDArray[np.complex64]
Steered = tuple[Spectra, Steering]


@dataclass(frozen=True, slots=True, eq=False)
class HopSums:
    """Sums over the frames that end within one hop.

    Parameters
    ----------
    n_frames : int
        Number of these frames.
    centre : float
        Mean of their middles, samples from the start of the stream.
    power : ndarray of float64, shape (A,)
        Steered power: see `worldstate.frontend.srp.steered_power`.
    pairs : ndarray of complex128, shape (30,)
        Pair sums: see `worldstate.frontend.feature.pair_sum`.
    energy : float
        Mean square in the looming band.
    """

    n_frames: int
    centre: float
    power: NDArray[np.float64]
    pairs: NDArray[np.complex128]
    energy: float


class Listener:
    """Transform, whiten and steer, hop by hop; only the transform remembers the past.

    Parameters
    ----------
    array : MicrophoneArray
        In the order of the channels.
    sample_rate_hz : float
        Samples per second.
    settings : FrontEndSettings
        Bands, grid and frame length.
    """

    def __init__(self, array: MicrophoneArray, sample_rate_hz: float, settings: FrontEndSettings) -> None:
        nfft, speed = settings.nfft, settings.speed_of_sound_m_s
        self.srp_bins = band_bins(settings.srp_band_hz, sample_rate_hz, nfft)
        self.feature_bins = band_bins(settings.feature_band_hz, sample_rate_hz, nfft)
        looming_bins = band_bins(settings.looming_band_hz, sample_rate_hz, nfft)
        bands = (self.srp_bins, self.feature_bins, looming_bins)
        bins = range(min(b.start for b in bands), max(b.stop for b in bands))
        self._srp, self._feature, self._looming = (
            slice(b.start - bins.start, b.stop - bins.start) for b in bands
        )
        frequencies = bin_frequencies_hz(self.srp_bins, sample_rate_hz, nfft)
        self._beams = Steering.towards(array, frequencies, settings.azimuths_rad(), speed_of_sound_m_s=speed)
        self._feature_beams = feature_steering(array, self.feature_bins, sample_rate_hz, nfft, speed)
        self._stft = StreamingStft(array.n_microphones, nfft, bins)
        self._nfft = nfft
        self._n_frames = 0
        self.ego_noise = self._ego_noise(array.n_microphones, 2.0 * sample_rate_hz / nfft, settings)

    def push(self, samples: NDArray[np.float32]) -> HopSums:
        """Sum over the frames that these samples (n, M) complete; at least one frame."""
        spectra = self._stft.push(samples)
        powers = power(spectra)
        whitened = whiten(spectra, powers)
        srp, feature = self._steered(spectra, whitened)
        return HopSums(
            n_frames=len(spectra),
            centre=self._centre(len(spectra)),
            power=steered_power(*srp),
            pairs=pair_sum(*feature),
            energy=float(mean_square_per_bin(powers[:, self._looming], self._nfft).sum()),
        )

    def _steered(self, spectra: Spectra, whitened: Spectra) -> tuple[Steered, Steered]:
        """Choose what the beams of SRP and of the feature listen to, and the beams."""
        srp = whitened[:, self._srp], self._beams
        feature = whitened[:, self._feature], self._feature_beams
        if self.ego_noise is None:
            return srp, feature
        quiet = self.ego_noise.process(spectra)
        return quiet[0], quiet[1] if len(quiet) > 1 else feature

    def _ego_noise(
        self, n_microphones: int, frame_rate_hz: float, settings: FrontEndSettings
    ) -> EgoNoise | None:
        if settings.ego_noise is None:
            return None
        beams = [(self._beams, self._srp)]
        if settings.ego_noise.feature:
            beams.append((self._feature_beams, self._feature))
        return EgoNoise(settings.ego_noise, frame_rate_hz, n_microphones, beams)

    def _centre(self, n_new: int) -> float:
        """Middle of the new frames; frame t covers samples t N/2 .. t N/2 + N."""
        first, self._n_frames = self._n_frames, self._n_frames + n_new
        return 0.5 * self._nfft * (0.5 * (first + self._n_frames - 1) + 1.0)
