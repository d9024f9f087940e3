"""Band levels of a stream from a few of its microphones."""

import numpy as np

from worldstate.frontend.spectra.bands import band_edges, log_band_energy, mean_square_per_bin
from worldstate.frontend.spectra.bins import band_bins
from worldstate.frontend.spectra.phat import power
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray

from .settings import FrontEndSettings

# Highest frequency that the anti-aliasing filters of usual converters pass, relative to the sample rate.
_HIGHEST = 0.45


class LevelMeter:
    """Log-energy per band and hop, averaged over a few microphones: the level is the same at all of them."""

    def __init__(self, n_channels: int, sample_rate_hz: float, settings: FrontEndSettings) -> None:
        low, high = settings.level_band_hz
        bins = band_bins((low, min(high, _HIGHEST * sample_rate_hz)), sample_rate_hz, settings.nfft)
        self._bins = range(max(bins.start, 1), bins.stop)
        self._edges = band_edges(self._bins, settings.level_bands)
        # A bin reaches half its width to either side of its frequency.
        self.edges_hz: FloatArray = (self._edges - 0.5) * sample_rate_hz / settings.nfft
        self._nfft = settings.nfft
        step = -(-n_channels // settings.level_channels)
        self._channels = slice(None, None, step)
        self._stft = StreamingStft(-(-n_channels // step), settings.nfft, self._bins)

    def push(self, samples: Float32Array, keep: BoolArray | None = None) -> FloatArray:
        r"""Return the log-energy (bands,) of the frames that these samples (n, M) complete; at least one.

        .. math:: L_b = \ln \sum_{k \in b} \overline{x^2}[k]
        """
        # Only the picked microphones that are kept (M,) are averaged, or all picked ones if none is.
        powers = power(self._stft.push(np.ascontiguousarray(samples[:, self._channels])))
        kept = None if keep is None else keep[self._channels]
        if kept is not None and kept.any() and not kept.all():
            powers = powers[:, :, kept]
        return log_band_energy(mean_square_per_bin(powers, self._nfft), self._edges, self._bins.start)
