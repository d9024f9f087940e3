"""Band levels of a stream from a few of its microphones, and noise that its place does not usually have."""

from collections import deque

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
    mean = powers.sum(axis=(0, 2), dtype=np.float64) / max(powers.shape[0] * powers.shape[2], 1)
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
BANDS = 16
# Microphones, evenly picked, that are averaged.
_MOST_CHANNELS = 8


class LevelMeter:
    """Log-energy per band and hop, averaged over a few microphones: the level is the same at all of them."""

    def __init__(self, n_channels: int, sample_rate_hz: float, settings: FrontEndSettings) -> None:
        low, high = settings.level_band_hz
        bins = band_bins((low, min(high, _HIGHEST * sample_rate_hz)), sample_rate_hz, settings.nfft)
        self._bins = range(max(bins.start, 1), bins.stop)
        self._edges = band_edges(self._bins, BANDS)
        # A bin reaches half its width to either side of its frequency.
        self.edges_hz: FloatArray = (self._edges - 0.5) * sample_rate_hz / settings.nfft
        self._nfft = settings.nfft
        step = -(-n_channels // _MOST_CHANNELS)
        self._channels = slice(None, None, step)
        self._stft = StreamingStft(-(-n_channels // step), settings.nfft, self._bins)

    def push(
        self, samples: Float32Array, keep: BoolArray | None = None, heard: BoolArray | None = None
    ) -> FloatArray:
        r"""Return the log-energy (bands,) of the heard frames among those that these samples (n, M) complete.

        .. math:: L_b = \ln \sum_{k \in b} \overline{x^2}[k]

        All are heard unless `heard` (frames,) says otherwise; where none is, it is that of silence.
        """
        # Only the picked microphones that are kept (M,) are averaged, or all picked ones if none is.
        powers = power(self._stft.push(np.ascontiguousarray(samples[:, self._channels])))
        if heard is not None and not heard.all():
            powers = powers[heard]
        kept = None if keep is None else keep[self._channels]
        if kept is not None and kept.any() and not kept.all():
            powers = powers[:, :, kept]
        mean_square = mean_square_per_bin(powers, self._nfft)
        return log_band_energy(mean_square, self._edges, self._bins.start)


_DB = 10.0 / float(np.log(10.0))
# A minute, looked through once a second. The quiet street is what a fifth of it stays below: vehicles that
# pass are seldom there for longer.
_MINUTE_HOPS, _EVERY_HOPS, _QUIET_SHARE = 600, 10, 0.2
# Twenty simulated demos: the incoherent share of hops with a vehicle is at most .3, of white noise between
# the microphones 10 dB above the street .35 and more, 25 dB above it .9.
_INCOHERENT = 0.5
# Decibels above the quiet street: of vehicles that are hidden 1 to 8 s before they come into view 1 to 10.
# Below the first, incoherent noise hides none of them, above the second all.
_NOISE_DB = (6.0, 12.0)
# Rise above the loudest of the last three hops. Vehicles, van and edge included, rise by less than 3 dB; in
# five minutes of busy simulated streets no hop is masked. Of 394 real clips one of 29 idling engines is, no
# siren of 32, and 27 of 29 shots.
_JUMP_DB, _JUMP_HOPS = (6.0, 10.0), 3
# Fall below the loudest hop of a noise by which it ends; what lasts ten seconds is the place's own.
_END_DB, _LONGEST_HOPS = 5.0, 100
# Excess of the lowest quarter of the bands over the highest that only wind has.
_WIND_DB = 10.0


class NoiseMeter:
    r"""Share of a hop that noise leaves to be heard: noise that this place does not usually have.

    .. math:: e = \Big\langle L_b - q_{20\%}(L_b) \Big\rangle_b, \qquad
              f = 1 - \frac{C}{\mathrm{median}\, C}

    with the level L of a band b, its quantile over the last minute, and the coherence C of the sound over the
    array, the mean of the feature. Noise between the microphones (wind, rain) is far above the quiet street
    (6 to 12 dB) and mostly incoherent (f > 1/2). Noise that is the same in all of them begins with a rise by
    6 to 10 dB within .3 s, and lasts until it falls by 5 dB or the street has become as loud, at most ten
    seconds.

    Attributes
    ----------
    excess_db : float
        e of the newest hop, decibels.
    """

    def __init__(self) -> None:
        self.excess_db = 0.0
        self._memory: deque[FloatArray] = deque(maxlen=_MINUTE_HOPS)
        self._n_hops = 0
        self._quiet: FloatArray = np.zeros(BANDS)
        self._usual_coherence = 0.0
        self._recent: deque[float] = deque(maxlen=_JUMP_HOPS)
        # Level before a jump, the highest since, and the hop in which it began; None without one.
        self._jump: tuple[float, float, int] | None = None

    def skip(self) -> None:
        """Pass a hop that was lost: what comes after it may be louder than what was before."""
        self._recent.clear()
        self._jump = None

    def push(self, levels: FloatArray, coherence: float) -> tuple[float, str | None]:
        """Take log-energies (bands,) and the coherence of a hop; return its share and what takes the rest."""
        level_db = levels * _DB
        self._memory.append(np.append(level_db, coherence))
        if self._n_hops < _EVERY_HOPS or self._n_hops % _EVERY_HOPS == 0:
            heard, rank = np.array(self._memory), int(_QUIET_SHARE * (len(self._memory) - 1))
            self._quiet = np.partition(heard[:, :BANDS], rank, axis=0)[rank]
            self._usual_coherence = float(np.median(heard[:, BANDS]))
        self._n_hops += 1
        excess = level_db - self._quiet
        self.excess_db = float(excess.mean())
        incoherent = coherence < (1.0 - _INCOHERENT) * self._usual_coherence
        shares = (
            falling(self.excess_db, _NOISE_DB) if incoherent else 1.0,
            falling(self._rise_db(float(level_db.mean())), _JUMP_DB),
        )
        if min(shares) >= 1.0:
            return 1.0, None
        quarter = BANDS // 4
        is_low = excess[:quarter].mean() > excess[-quarter:].mean() + _WIND_DB
        is_wind = is_low and coherence < self._usual_coherence
        return min(shares), "wind" if is_wind else "noise far above this place's usual"

    def _rise_db(self, loudness_db: float) -> float:
        """Return how far the level is above that before a jump, 0 without one."""
        before = max(self._recent, default=loudness_db)
        self._recent.append(loudness_db)
        if self._jump is None and loudness_db - before > _JUMP_DB[0]:
            self._jump = before, loudness_db, self._n_hops
        if self._jump is None:
            return 0.0
        before, highest, begin = self._jump
        highest = max(highest, loudness_db)
        # The hop in which it ends still holds some of it.
        has_ended = loudness_db < highest - _END_DB or self.excess_db < _JUMP_DB[0]
        is_old = self._n_hops - begin >= _LONGEST_HOPS
        self._jump = None if has_ended or is_old else (before, highest, begin)
        return loudness_db - before


def falling(value: float, between: tuple[float, float]) -> float:
    """Return 1 below the first of two values, 0 above the second, linear between them.

    Examples
    --------
    >>> [falling(value, (6.0, 12.0)) for value in (3.0, 9.0, 20.0)]
    [1.0, 0.5, 0.0]
    """
    low, high = between
    return min(max((high - value) / (high - low), 0.0), 1.0)
