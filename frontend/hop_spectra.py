"""Cut a stream into hops that do not drift, and turn a hop into the sums that windows are made of."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from worldstate.frontend.array.microphone_array import ChannelMask, MicrophoneArray
from worldstate.frontend.array.steering import Steering, cross_spectra
from worldstate.frontend.direction.bearing import steered_power
from worldstate.frontend.direction.feature import FEATURE_BAND_HZ, feature_steering, pair_sum, pair_sum_of
from worldstate.frontend.ego_noise.ego_noise import EgoNoise, ElevationSplit, spanned
from worldstate.frontend.health.channel_health import ArrayHealth
from worldstate.frontend.health.channel_monitor import ChannelMonitor
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz, power, whiten
from worldstate.ground.typing import BoolArray, Complex64Array, Complex128Array, Float32Array, FloatArray
from worldstate.ground.values import LEAST_HEARD

from .settings import ELEVATIONS_RAD, HOP_RATE_HZ, LOOMING_BAND_HZ, FrontEndSettings


def hop_end(index: int, sample_rate_hz: float) -> int:
    """Sample at which hop k, `index`, ends: ``n_k = floor(k fs / r + 1/2)`` with r = 10 hops a second.

    Examples
    --------
    >>> [hop_end(k, 47_998) for k in (0, 1, 2, 10)]
    [0, 4800, 9600, 47998]
    """
    return math.floor(index * sample_rate_hz / HOP_RATE_HZ + 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class Hop:
    """The samples of one hop."""

    index: int  # From 1
    end: int  # Number of samples from the start of the stream to the end of this hop
    samples: Float32Array  # shape (n, M): Valid until the next hop is read


class HopCutter:
    """Collect blocks of any length and return whole hops, in time proportional to the samples."""

    def __init__(self, n_channels: int, sample_rate_hz: float) -> None:
        self._rate_hz = sample_rate_hz
        self._index = 1
        self._start, self._end = 0, hop_end(1, sample_rate_hz)
        self._filled = 0
        self._buffer = np.empty((math.ceil(sample_rate_hz / HOP_RATE_HZ) + 1, n_channels), np.float32)

    def cut(self, block: Float32Array) -> Iterator[Hop]:
        """Take a block (n, M) and yield the hops that it completes; the iterator must be read to its end."""
        while len(block):
            length = self._end - self._start
            part, block = np.split(block, [length - self._filled])
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


Steered = tuple[Complex64Array, Steering]


@dataclass(frozen=True, slots=True, eq=False)
class HopSums:
    """Sums over the STFT frames that end within one hop."""

    heard: BoolArray  # shape (frames,): Frames without lost samples, of which the sums are
    lost: float  # Share of the samples of the hop that are lost
    share: float  # Share of the hop that lost samples and noise leave to be heard
    unheard: str | None  # What takes the rest
    centre: float  # Mean of the middles of these frames, samples from the start of the stream
    # shape (elevations * azimuths,): Steered power. Where microphones are left out, power and pairs are
    # scaled to the value for all of them.
    power: FloatArray
    pairs: Complex128Array  # shape (30,): Pair sums of the published feature
    energies: FloatArray  # shape (M,): Mean square in the looming band of every microphone
    health: ArrayHealth  # Faults of the array, and the microphones used

    @property
    def n_frames(self) -> int:
        """Number of frames that the sums are of."""
        return int(np.count_nonzero(self.heard))

    def masked(self, share: float, reason: str | None) -> "HopSums":
        """Return the hop where noise leaves a share to be heard; below .2 its sums are empty."""
        if share >= self.share:
            return self
        if share >= LEAST_HEARD:
            return replace(self, share=share, unheard=reason)
        arrays = ("heard", "power", "pairs", "energies")
        nothing = {name: np.zeros_like(getattr(self, name)) for name in arrays}
        return replace(self, share=share, unheard=reason, **nothing)


class HopSpectra:
    """Transform, whiten and steer one hop; only the transform and the optional stages have a memory."""

    def __init__(self, array: MicrophoneArray, sample_rate_hz: float, settings: FrontEndSettings) -> None:
        nfft = settings.nfft
        self.srp_bins = band_bins(settings.srp_band_hz, sample_rate_hz, nfft)
        self.feature_bins = band_bins(FEATURE_BAND_HZ, sample_rate_hz, nfft)
        looming_bins = band_bins(LOOMING_BAND_HZ, sample_rate_hz, nfft)
        bands = (self.srp_bins, self.feature_bins, looming_bins)
        bins = range(min(b.start for b in bands), max(b.stop for b in bands))
        self._srp, self._feature, self._looming = (
            slice(b.start - bins.start, b.stop - bins.start) for b in bands
        )
        frequencies = bin_frequencies_hz(self.srp_bins, sample_rate_hz, nfft)
        # A row of elevation each: the few dimensions and nodes that do for one are too many for all together.
        azimuths = settings.azimuths_rad()
        self.beams = tuple(
            Steering.towards(array, frequencies, azimuths, elevation) for elevation in ELEVATIONS_RAD
        )
        self._feature_beams = feature_steering(array, self.feature_bins, sample_rate_hz, nfft)
        self._stft = StreamingStft(array.n_microphones, nfft, bins)
        self._nfft, self._order = nfft, settings.feature_order
        self._n_frames = 0
        self._lost_tail = np.zeros(0, bool)
        self._unmonitored = ArrayHealth.unknown(array.n_microphones, "channels are not monitored")
        heard_hz = bin_frequencies_hz(self.feature_bins, sample_rate_hz, nfft)
        self.monitor = ChannelMonitor(array, heard_hz) if settings.watch_channels else None
        self.ego_noise = self._ego_noise(array, sample_rate_hz, bins, settings)

    def push(self, samples: Float32Array) -> HopSums:
        """Return the sums over the frames that these samples (n, M) complete, lost ones left out."""
        lost = np.zeros(len(samples), bool) if self.monitor is None else self.monitor.find_lost(samples)
        spectra = self._stft.push(samples)
        heard = self._heard_frames(lost, len(spectra))
        centre, spectra = self._centre(heard), spectra if heard.all() else spectra[heard]
        powers = power(spectra)
        whitened = whiten(spectra, powers)
        energies = self._frame_energies(powers)
        matrices = cross_spectra(whitened[:, self._feature].transpose(1, 0, 2))
        health = self._unmonitored
        if self.monitor is not None:
            health = self.monitor.push(samples, energies, powers, matrices)
        prewhitened = self._whitened(spectra, health.mask)
        health.mask.silence(whitened)
        srp, pairs = self._sums(prewhitened, whitened, matrices, health.mask)
        mean_square = energies.sum(axis=0) / max(len(energies), 1)
        share = float(lost.mean())
        reason = "lost samples" if share else None
        return HopSums(heard, share, 1.0 - share, reason, centre, srp, pairs, mean_square, health)

    def _heard_frames(self, lost: BoolArray, n_new: int) -> BoolArray:
        """Return which new frames hold no lost sample; lost has shape (n,)."""
        # From the first sample of the first new frame on; neighbouring frames share a half.
        flags, half = np.concatenate([self._lost_tail, lost]), self._nfft // 2
        self._lost_tail = flags[n_new * half :]
        halves = np.asarray(flags[: (n_new + 1) * half].reshape(-1, half).any(axis=1))
        return np.asarray(~(halves[1:] | halves[:-1]))

    def _frame_energies(self, powers: Float32Array) -> FloatArray:
        """Mean square in the looming band per frame and microphone: see `bands.mean_square_per_bin`."""
        total = powers[:, self._looming].sum(axis=1, dtype=np.float64)
        return np.asarray(total * (2.0 / (0.375 * self._nfft**2)))

    def _whitened(self, spectra: Complex64Array, mask: ChannelMask) -> list[Steered]:
        """Prewhitened spectra, phase transform included, and their beams; none without ego-noise settings."""
        if self.ego_noise is None or not len(spectra):
            return []
        mask.silence(spectra)
        prewhitened = self.ego_noise.process(spectra)
        for whitened, _ in prewhitened:
            mask.silence(whitened)
        return prewhitened

    def _sums(
        self,
        prewhitened: list[Steered],
        whitened: Complex64Array,
        matrices: Complex64Array,
        mask: ChannelMask,
    ) -> tuple[FloatArray, Complex128Array]:
        """Return steered power and pair sums of one hop, scaled to all microphones."""
        n_rows = len(self.beams)
        rows = prewhitened[:n_rows] or [(whitened[:, self._srp], beams) for beams in self.beams]
        if len(prewhitened) > n_rows:
            pairs = pair_sum(*prewhitened[n_rows], self._order)
        else:
            pairs = pair_sum_of(mask.cross(matrices), self._feature_beams, self._order)
        power = np.concatenate([steered_power(*row) for row in rows]) * mask.power_scale
        if self.ego_noise is not None and len(whitened):
            power = self.ego_noise.levelled(power, len(whitened))
        return power, pairs * mask.pair_scale

    def _ego_noise(
        self, array: MicrophoneArray, sample_rate_hz: float, bins: range, settings: FrontEndSettings
    ) -> EgoNoise | None:
        chosen, nfft = settings.ego_noise, settings.nfft
        if chosen is None:
            return None
        beams = [(row, self._srp) for row in self.beams]
        if chosen.feature:
            beams.append((self._feature_beams, self._feature))
        learned = bins[spanned(part for _, part in beams)]
        split = ElevationSplit.of(array, bin_frequencies_hz(learned, sample_rate_hz, nfft))
        return EgoNoise(2.0 * sample_rate_hz / nfft, array.n_microphones, beams, split)

    def _centre(self, heard: BoolArray) -> float:
        """Middle of the new frames that are heard, of all if none is; frame t covers t N/2 .. t N/2 + N."""
        first, self._n_frames = self._n_frames, self._n_frames + len(heard)
        numbers = np.flatnonzero(heard if heard.any() else ~heard)
        return 0.5 * self._nfft * (float(numbers.mean()) + first + 1.0)
