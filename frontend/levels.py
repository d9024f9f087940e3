"""Band levels of a stream from a few of its microphones."""

import numpy as np

from worldstate.frontend.spectra.stft import StreamingStft, band_bins, power
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, IntArray

from .settings import FrontEndSettings

# Mean square below which a band is silent, far below 24-bit quantisation; keeps the logarithm finite.
SILENCE = 1e-20


def band_edges(bins: range, n_bands: int) -> IntArray:
    r"""Edges of bands that grow by an equal ratio, at least one bin wide each.

    .. math:: e_{b+1} = \max\big(e_b + 1,\; \mathrm{round}(e_b\, (e_B / e_b)^{1 / (B - b)})\big)

    with e_0 the first bin and e_B the end.
    """
    if not 1 <= n_bands <= len(bins) or bins.start < 1:
        raise InvalidArgumentError(f"n_bands: expected 1 to {len(bins)} bands within {bins}, got {n_bands}")
    edges = [bins.start]
    for remaining in range(n_bands, 0, -1):
        ratio = (bins.stop / edges[-1]) ** (1.0 / remaining)
        edges.append(max(edges[-1] + 1, round(edges[-1] * ratio)))
    return np.asarray(edges)


def mean_square_per_bin(powers: Float32Array, nfft: int) -> FloatArray:
    r"""Mean square of the sound per bin, averaged over frames and channels.

    .. math:: \overline{x^2}[k] = \frac{2 \langle |X[k]|^2 \rangle}{N \sum_n w[n]^2},
              \qquad \sum_n w^2 = 3 N / 8

    Shapes: powers (frames, bins, M).

    Examples
    --------
    >>> mean_square_per_bin(np.full((2, 1, 3), 48.0, np.float32), nfft=16)
    array([1.])
    """
    mean = powers.mean(axis=(0, 2), dtype=np.float64)
    return np.asarray(mean * (2.0 / (nfft * 0.375 * nfft)))


def log_band_energy(mean_square: FloatArray, edges: IntArray, first: int) -> FloatArray:
    r"""Natural logarithm of the mean square in each band; silence is floored at 1e-20.

    .. math:: L_b = \ln \max\Big(\sum_{k = e_b}^{e_{b+1} - 1} \overline{x^2}[k],\; 10^{-20}\Big)

    Shapes: mean_square (bins,), edges (bands + 1,).

    Examples
    --------
    >>> log_band_energy(np.array([1.0, 1.0, 0.0]), np.array([1, 3, 4]), first=1).round(2)
    array([  0.69, -46.05])
    """
    sums = np.add.reduceat(mean_square, edges[:-1] - first)
    return np.asarray(np.log(np.maximum(sums, SILENCE)))


# Highest frequency that the anti-aliasing filters of usual converters pass, relative to the sample rate.
_HIGHEST = 0.45
_BANDS = 16
# Microphones, evenly picked, that are averaged.
_MOST_CHANNELS = 8


class LevelMeter:
    """Log-energy per band and hop, averaged over a few microphones: the level is the same at all of them."""

    def __init__(self, n_channels: int, sample_rate_hz: float, settings: FrontEndSettings) -> None:
        low, high = settings.level_band_hz
        bins = band_bins((low, min(high, _HIGHEST * sample_rate_hz)), sample_rate_hz, settings.nfft)
        self._bins = range(max(bins.start, 1), bins.stop)
        self._edges = band_edges(self._bins, _BANDS)
        # A bin reaches half its width to either side of its frequency.
        self.edges_hz: FloatArray = (self._edges - 0.5) * sample_rate_hz / settings.nfft
        self._nfft = settings.nfft
        step = -(-n_channels // _MOST_CHANNELS)
        self._channels = slice(None, None, step)
        self._stft = StreamingStft(-(-n_channels // step), settings.nfft, self._bins)
        self._latest: FloatArray = np.full(_BANDS, np.log(SILENCE))

    def push(
        self, samples: Float32Array, keep: BoolArray | None = None, heard: BoolArray | None = None
    ) -> FloatArray:
        r"""Return the log-energy (bands,) of the heard frames among those that these samples (n, M) complete.

        .. math:: L_b = \ln \sum_{k \in b} \overline{x^2}[k]

        All are heard unless `heard` (frames,) says otherwise; where none is, it is that of the hop before.
        """
        # Only the picked microphones that are kept (M,) are averaged, or all picked ones if none is.
        powers = power(self._stft.push(np.ascontiguousarray(samples[:, self._channels])))
        if heard is not None and not heard.all():
            powers = powers[heard]
        if not len(powers):
            return self._latest
        kept = None if keep is None else keep[self._channels]
        if kept is not None and kept.any() and not kept.all():
            powers = powers[:, :, kept]
        mean_square = mean_square_per_bin(powers, self._nfft)
        self._latest = log_band_energy(mean_square, self._edges, self._bins.start)
        return self._latest
