"""Hops of a stream without drift, and the sums per hop that make up windows.

This module also computes the band levels of a hop and detects noise that is unusual for the place.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from worldstate.frontend.approach.looming import MIN_POINTS, EnergyFloor, Looming, approach_rate
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering, cross_spectra
from worldstate.frontend.direction import feature as published
from worldstate.frontend.direction.bearing import steered_power
from worldstate.frontend.health.channel_health import ArrayHealth
from worldstate.frontend.health.channel_monitor import ChannelMonitor
from worldstate.frontend.health.common_sound import CommonSound
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz, power, whiten
from worldstate.ground import LEAST_HEARD, InvalidArgumentError, NotUsable, falling, mean
from worldstate.ground.typing import BoolArray, Complex128Array, Float32Array, FloatArray, IntArray

from .settings import ELEVATIONS_RAD, HIGHEST_SHARE, HOP_RATE_HZ, LOOMING_BAND_HZ, FrontEndSettings


def hop_end(index: int, sample_rate_hz: float) -> int:
    """Return the end sample of hop k, `index`: ``n_k = floor(k fs / r + 1/2)`` with r = 10 hops per second.

    Examples
    --------
    >>> [hop_end(k, 47_998) for k in (0, 1, 2, 10)]
    [0, 4800, 9600, 47998]
    """
    return math.floor(index * sample_rate_hz / HOP_RATE_HZ + 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class Hop:
    """The samples of one hop."""

    index: int  # Number of the hop, from 1
    end: int  # Number of samples from the start of the stream to the end of this hop
    samples: Float32Array  # shape (n, M): Valid until the next hop is read


class HopCutter:
    """Collects blocks of any length and returns whole hops; time is proportional to the number of samples."""

    def __init__(self, n_channels: int, sample_rate_hz: float) -> None:
        self._rate_hz = sample_rate_hz
        self._index = 1
        self._start, self._end = 0, hop_end(1, sample_rate_hz)
        self._filled = 0
        self._buffer = np.empty((math.ceil(sample_rate_hz / HOP_RATE_HZ) + 1, n_channels), np.float32)

    def cut(self, block: Float32Array) -> Iterator[Hop]:
        """Process a block (n, M) and yield the hops that it completes; read the iterator to its end."""
        while len(block):
            length = self._end - self._start
            missing = length - self._filled
            part, block = block[:missing], block[missing:]
            # A whole hop is not copied.
            samples = part if len(part) == length else self._buffer[:length]
            if samples is not part:
                samples[self._filled :][: len(part)] = part
            self._filled += len(part)
            if self._filled == length:
                hop = Hop(self._index, self._end, samples)
                self._index, self._filled = self._index + 1, 0
                self._start, self._end = self._end, hop_end(self._index, self._rate_hz)
                yield hop


@dataclass(frozen=True, slots=True, eq=False)
class HopSums:
    """Sums over the STFT frames that end within one hop."""

    heard: BoolArray  # shape (frames,): Frames without lost samples, which the sums include
    lost: float  # Share of lost samples in the hop
    centre: float  # Mean of the middles of these frames, samples from the start of the stream
    # shape (elevations * azimuths,): Steered power. If microphones are excluded, power and pairs are rescaled
    # to the value for all microphones.
    power: FloatArray
    pairs: Complex128Array  # shape (30,): Pair sums of the published feature
    energies: FloatArray  # shape (M,): Mean square in the looming band at every microphone
    health: ArrayHealth  # Faults of the array, and the microphones used
    n_frames: int  # Number of frames in the sums
    # Usable share according to coherence and positions, and the reason why the rest is not usable.
    common: tuple[float, str | None]


def hop_window(n_hops: int, n_directions: int, n_channels: int) -> Any:
    """Return an empty window: the sums of its hops, one row per hop, oldest first, all zero."""
    numbers = [(name, float) for name in ("n_frames", "n_new", "share", "lost", "centre")]
    pairs = ("pairs", complex, len(published.FEATURE_AZIMUTHS_RAD))
    sums = [("power", float, n_directions), pairs, ("energies", float, n_channels)]
    return np.zeros(n_hops, [*numbers, ("unheard", object), *sums])


def push_hop(window: Any, hop: HopSums, share: float, unheard: str | None) -> None:
    """Add the latest hop to a window, with its usable share after noise; below 0.2 its sums are empty."""
    whole = 1.0 - hop.lost
    least = min(share, whole)
    heard = least == whole or least >= LEAST_HEARD
    window[:-1] = window[1:]
    sums = (hop.power, hop.pairs, hop.energies) if heard else (0.0, 0.0, 0.0)
    why = unheard if share < whole else "lost samples" if hop.lost else None
    window[-1] = (hop.n_frames * heard, len(hop.heard), least, hop.lost, hop.centre, why, *sums)


class HopSpectra:
    """Transforms, whitens and steers one hop; only the transform and the optional stages have a memory."""

    def __init__(self, array: MicrophoneArray, sample_rate_hz: float, settings: FrontEndSettings) -> None:
        nfft = settings.nfft
        self.srp_bins = band_bins(settings.srp_band_hz, sample_rate_hz, nfft)
        self.feature_bins = band_bins(published.FEATURE_BAND_HZ, sample_rate_hz, nfft)
        bands = (self.srp_bins, self.feature_bins, band_bins(LOOMING_BAND_HZ, sample_rate_hz, nfft))
        bins = range(min(b.start for b in bands), max(b.stop for b in bands))
        inside = (slice(b.start - bins.start, b.stop - bins.start) for b in bands)
        self._srp, self._feature, self._looming = inside
        frequencies = bin_frequencies_hz(self.srp_bins, sample_rate_hz, nfft)
        # One steering per elevation, because the rank and the number of nodes for all together are too large.
        azimuths = settings.azimuths_rad()
        self.beams = [
            Steering.towards(array, frequencies, azimuths, elevation) for elevation in ELEVATIONS_RAD
        ]
        self._feature_beams = published.feature_steering(array, self.feature_bins, sample_rate_hz, nfft)
        self._stft = StreamingStft(array.n_microphones, nfft, bins)
        self._nfft, self._order = nfft, settings.feature_order
        self._n_frames = 0
        self._lost_tail = np.zeros(0, bool)
        self._unmonitored = ArrayHealth.unknown(array.n_microphones, "channels are not monitored")
        heard_hz = bin_frequencies_hz(self.feature_bins, sample_rate_hz, nfft)
        self.monitor = ChannelMonitor(array, heard_hz) if settings.watch_channels else None
        self._common = CommonSound(array, heard_hz) if settings.watch_channels else None

    def push(self, samples: Float32Array, recorded: Float32Array) -> HopSums:
        """Return the sums over the frames that these samples (n, M) complete, without lost frames."""
        # Faults are detected in the recorded samples, because resampled clipping has no constant maximum.
        lost = np.zeros(len(recorded), bool) if self.monitor is None else self.monitor.find_lost(recorded)
        lost = lost[np.arange(len(samples)) * len(recorded) // len(samples)]
        spectra = self._stft.push(samples)
        heard = self._heard_frames(lost, len(spectra))
        n_heard = int(np.add.reduce(heard))
        centre, spectra = self._centre(heard), spectra if n_heard == len(heard) else spectra[heard]
        powers = power(spectra)
        whitened = whiten(spectra, powers)
        # Mean square in the looming band per frame and microphone: see `mean_square_per_bin`.
        energies = powers[:, self._looming].sum(axis=1, dtype=np.float64) * (2.0 / (0.375 * self._nfft**2))
        matrices = cross_spectra(whitened[:, self._feature].transpose(1, 0, 2))
        health = self._unmonitored
        if self.monitor is not None:
            health = self.monitor.push(recorded, energies, powers, matrices)
        keep = health.mask.keep
        common = self._common.push(matrices, n_heard, keep) if self._common else (1.0, None)
        health.mask.silence(whitened)
        inside = whitened[:, self._srp]
        srp = np.concatenate([steered_power(inside, row) for row in self.beams]) * health.mask.power_scale
        pairs = published.pair_sum(health.mask.cross(matrices), self._feature_beams, self._order)
        pairs = pairs * health.mask.pair_scale
        mean_square = energies.sum(axis=0) / max(n_heard, 1)
        share = float(np.add.reduce(lost)) / len(lost)
        return HopSums(heard, share, centre, srp, pairs, mean_square, health, n_heard, common)

    def _heard_frames(self, lost: BoolArray, n_new: int) -> BoolArray:
        """Return which new frames contain no lost sample; lost has shape (n,)."""
        # The flags start at the first sample of the first new frame; neighbouring frames share a half.
        flags, half = np.concatenate([self._lost_tail, lost]), self._nfft // 2
        self._lost_tail = flags[n_new * half :]
        halves = np.asarray(flags[: (n_new + 1) * half].reshape(-1, half).any(axis=1))
        return np.asarray(~(halves[1:] | halves[:-1]))

    def _centre(self, heard: BoolArray) -> float:
        """Return the centre of the usable new frames, or of all if none; frame t is t N/2 .. t N/2 + N."""
        first, self._n_frames = self._n_frames, self._n_frames + len(heard)
        numbers = heard.nonzero()[0] if True in heard else np.arange(len(heard))
        return 0.5 * self._nfft * (float(mean(numbers)) + first + 1.0)


# Mean square below which a band is silent, far below 24-bit quantisation; keeps the logarithm finite.
SILENCE = 1e-20


def looming_of(times_s: FloatArray, energies: FloatArray, floor: EnergyFloor) -> Looming | NotUsable:
    """Return the approach rate at time 0 from the energies of hops, (n,), and the noise floor."""
    lowest = min(energies.tolist(), default=0.0)
    if len(times_s) < MIN_POINTS or lowest <= SILENCE:
        return NotUsable("silence within the window")
    low, high = LOOMING_BAND_HZ
    scatter = ((high - low) / HOP_RATE_HZ) ** -0.5
    return approach_rate(times_s, np.log(energies), scatter, *floor.read(lowest, scatter))


def band_edges(bins: range, n_bands: int) -> IntArray:
    r"""Return the edges of bands whose widths grow by an equal ratio, each at least one bin wide.

    .. math:: e_{b+1} = \max\big(e_b + 1,\; \mathrm{round}(e_b\, (e_B / e_b)^{1 / (B - b)})\big)

    where e_0 is the first bin and e_B the end.
    """
    if not 1 <= n_bands <= len(bins) or bins.start < 1:
        raise InvalidArgumentError(f"n_bands: expected 1 to {len(bins)} bands within {bins}, got {n_bands}")
    edges = [bins.start]
    for remaining in range(n_bands, 0, -1):
        ratio = (bins.stop / edges[-1]) ** (1.0 / remaining)
        edges.append(max(edges[-1] + 1, round(edges[-1] * ratio)))
    return np.asarray(edges)


def mean_square_per_bin(powers: Float32Array, nfft: int) -> FloatArray:
    r"""Return the mean square of the sound per bin, averaged over frames and channels.

    .. math:: \overline{x^2}[k] = \frac{2 \langle |X[k]|^2 \rangle}{N \sum_n w[n]^2},
              \qquad \sum_n w^2 = 3 N / 8

    Shapes: powers (frames, bins, M).

    Examples
    --------
    >>> mean_square_per_bin(np.full((2, 1, 3), 48.0, np.float32), nfft=16)
    array([1.])
    """
    average = np.add.reduce(powers, (0, 2), np.float64) / max(powers.shape[0] * powers.shape[2], 1)
    return np.asarray(average * (2.0 / (nfft * 0.375 * nfft)))


def log_band_energy(mean_square: FloatArray, edges: IntArray, first: int) -> FloatArray:
    r"""Return the natural logarithm of the mean square in each band, at least that of 1e-20.

    .. math:: L_b = \ln \max\Big(\sum_{k = e_b}^{e_{b+1} - 1} \overline{x^2}[k],\; 10^{-20}\Big)

    Shapes: mean_square (bins,), edges (bands + 1,).

    Examples
    --------
    >>> log_band_energy(np.array([1.0, 1.0, 0.0]), np.array([1, 3, 4]), first=1).round(2)
    array([  0.69, -46.05])
    """
    return np.asarray(np.log(np.maximum(np.add.reduceat(mean_square, edges[:-1] - first), SILENCE)))


BANDS = 16
# Number of microphones, evenly spaced, that are averaged.
_MOST_CHANNELS = 8


class LevelMeter:
    """Log-energy per band and hop, averaged over some microphones, because all have similar levels."""

    def __init__(
        self, n_channels: int, sample_rate_hz: float, settings: FrontEndSettings, recorded_hz: float = np.inf
    ) -> None:
        low, high = settings.level_band_hz
        highest = HIGHEST_SHARE * min(sample_rate_hz, recorded_hz)
        bins = band_bins((low, min(high, highest)), sample_rate_hz, settings.nfft)
        self._bins = range(max(bins.start, 1), bins.stop)
        self._edges = band_edges(self._bins, BANDS)
        # A bin extends by half its width to both sides of its frequency.
        self.edges_hz: FloatArray = (self._edges - 0.5) * sample_rate_hz / settings.nfft
        self._nfft = settings.nfft
        step = -(-n_channels // _MOST_CHANNELS)
        self._channels = slice(None, None, step)
        self._stft = StreamingStft(-(-n_channels // step), settings.nfft, self._bins)

    def push(
        self, samples: Float32Array, keep: BoolArray | None = None, heard: BoolArray | None = None
    ) -> FloatArray:
        r"""Return the log-energy (bands,) of the usable frames that these samples (n, M) complete.

        .. math:: L_b = \ln \sum_{k \in b} \overline{x^2}[k]

        All frames are usable by default; without usable frames the result is that of silence.
        """
        # Average over the selected microphones that are kept (M,), or over all of them if none is kept.
        powers = power(self._stft.push(np.ascontiguousarray(samples[:, self._channels])))
        if heard is not None and False in heard:
            powers = powers[heard]
        kept = None if keep is None else keep[self._channels]
        if kept is not None and True in kept and False in kept:
            powers = powers[:, :, kept]
        return log_band_energy(mean_square_per_bin(powers, self._nfft), self._edges, self._bins.start)


_DB = 10.0 / float(np.log(10.0))
# One minute, evaluated once per second. The quiet level is its 20 % quantile, because passing vehicles are
# rarely present for a larger share of the time.
_MINUTE_HOPS, _EVERY_HOPS, _QUIET_SHARE = 600, 10, 0.2
# In twenty simulated demos, the incoherent share is at most 0.3 in hops with a vehicle. For white noise that
# is independent between the microphones it is 0.35 or more at 10 dB above the street, and 0.9 at 25 dB.
_INCOHERENT = 0.5
# Decibels above the quiet level. Vehicles that are hidden 1 to 8 s before they come into view have 1 to 10.
# Incoherent noise below the first value masks none of them, and above the second value all.
_NOISE_DB = (6.0, 12.0)
# Rise above the loudest of the last three hops. Vehicles, including a van at an edge, rise by less than 3 dB,
# and no hop is masked in five minutes of busy simulated streets. Of 394 real clips, one of 29 idling engines
# is masked, no siren of 32, and 27 of 29 shots.
_JUMP_DB, _JUMP_HOPS = (6.0, 10.0), 3
# A masking noise ends when it falls by this much below its loudest hop, or after ten seconds.
_END_DB, _LONGEST_HOPS = 5.0, 100
# Excess of the lowest over the highest quarter of the bands that only wind causes.
_WIND_DB = 10.0


class NoiseMeter:
    r"""Usable share of a hop in the presence of noise that is unusual for the place.

    .. math:: e = \Big\langle L_b - q_{20\%}(L_b) \Big\rangle_b, \qquad
              f = 1 - \frac{C}{\mathrm{median}\, C}

    L is the level of a band b, with its quantile over the last minute, and C the coherence of the sound over
    the array, the mean of the feature. Noise that is independent between the microphones (wind, rain) is far
    above the quiet level (6 to 12 dB) and mostly incoherent (f > 1/2). Noise that is common to them begins
    with a rise by 6 to 10 dB within 0.3 s. It ends when it falls by 5 dB or the street has become as loud,
    after at most ten seconds.

    Attributes
    ----------
    excess_db : float
        e of the latest hop, decibels.
    """

    def __init__(self, mask_rises: bool = True) -> None:
        self.excess_db, self._mask_rises = 0.0, mask_rises
        self._memory: deque[FloatArray] = deque(maxlen=_MINUTE_HOPS)
        self._n_hops = 0
        self._quiet: FloatArray = np.zeros(BANDS)
        self._usual_coherence = 0.0
        self._recent: deque[float] = deque(maxlen=_JUMP_HOPS)
        # Level before a jump, highest level since then, and first hop of the jump; None without a jump.
        self._jump: tuple[float, float, int] | None = None

    def skip(self) -> None:
        """Skip a lost hop; the sound after it may be louder than before."""
        self._recent.clear()
        self._jump = None

    def push(
        self, levels: FloatArray, coherence: float, common: tuple[float, str | None] = (1.0, None)
    ) -> tuple[float, str | None]:
        """Return the usable share of a hop, from its log-energies (bands,) and coherence, with the reason.

        `common` is the usable share without the comparison of levels; a hop that is unusable in this way does
        not change the usual level.
        """
        heard = common[0] >= LEAST_HEARD
        if not heard and not self._memory:
            return common
        masked = self._masked(levels * _DB, coherence, learn=heard)
        return masked if masked[0] <= common[0] else common

    def _masked(self, level_db: FloatArray, coherence: float, learn: bool) -> tuple[float, str | None]:
        """Return the usable share after unusual noise; update the usual level if `learn` is true."""
        if learn:
            self._memory.append(np.concatenate([level_db, [coherence]]))
        if self._n_hops < _EVERY_HOPS or self._n_hops % _EVERY_HOPS == 0:
            heard, rank = np.array(self._memory), int(_QUIET_SHARE * (len(self._memory) - 1))
            self._quiet = np.partition(heard[:, :BANDS], rank, axis=0)[rank]
            self._usual_coherence = float(np.median(heard[:, BANDS]))
        self._n_hops += 1
        excess = level_db - self._quiet
        self.excess_db = float(mean(excess))
        incoherent = coherence < (1.0 - _INCOHERENT) * self._usual_coherence
        jump = falling(self._rise_db(float(mean(level_db))), _JUMP_DB) if self._mask_rises else 1.0
        shares = (falling(self.excess_db, _NOISE_DB) if incoherent else 1.0, jump)
        if min(shares) >= 1.0:
            return 1.0, None
        quarter = BANDS // 4
        is_low = mean(excess[:quarter]) > mean(excess[-quarter:]) + _WIND_DB
        is_wind = is_low and coherence < self._usual_coherence
        return min(shares), "wind" if is_wind else "noise far above this place's usual"

    def _rise_db(self, loudness_db: float) -> float:
        """Return the level relative to that before a jump, 0 without a jump."""
        before = max(self._recent, default=loudness_db)
        self._recent.append(loudness_db)
        if self._jump is None and loudness_db - before > _JUMP_DB[0]:
            self._jump = before, loudness_db, self._n_hops
        if self._jump is None:
            return 0.0
        before, highest, begin = self._jump
        highest = max(highest, loudness_db)
        # The hop in which the noise ends still contains a part of it.
        has_ended = loudness_db < highest - _END_DB or self.excess_db < _JUMP_DB[0]
        is_old = self._n_hops - begin >= _LONGEST_HOPS
        self._jump = None if has_ended or is_old else (before, highest, begin)
        return loudness_db - before
