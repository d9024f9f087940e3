"""The streaming acoustic front-end, which returns one `AcousticFrame` per hop of samples."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.approach.looming import EnergyFloor, Looming
from worldstate.frontend.approach.tone import ToneReading, ToneStage
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import one_blas_thread
from worldstate.frontend.direction import bearing as doa
from worldstate.frontend.direction.feature import FEATURE_SEGMENTS, feature_nfft, segment_feature
from worldstate.frontend.health.channel_health import ArrayHealth
from worldstate.frontend.hop_spectra import SILENCE, Hop, HopCutter, hop_end
from worldstate.frontend.spectra.resampling import Resampler
from worldstate.frontend.spectra.sound_character import SoundCharacter
from worldstate.frontend.spectra.stft import band_bins, bin_frequencies_hz
from worldstate.ground import FloatArray, InvalidArgumentError, NotUsable, mean, nanoseconds
from worldstate.ground.checks import check_shape, in_range
from worldstate.ground.typing import BoolArray, Complex128Array, Float32Array, IndexArray

from .hop_spectra import BANDS, HopSpectra, HopSums, LevelMeter, NoiseMeter, hop_window, looming_of, push_hop
from .settings import BEARING_HOPS, HOP_RATE_HZ, WINDOW_HOPS, FrontEndSettings

_NOT_MONITORED = NotUsable("microphones were not monitored")
CHARACTER_IS_OFF = NotUsable("the character is off: see FrontEndSettings.character")
TONE_IS_OFF = NotUsable("the tone is off: see FrontEndSettings.tone_band_hz")


@dataclass(frozen=True, slots=True, eq=False)
class AcousticFrame:
    r"""Results of the front-end at the end of one hop.

    .. math:: \hat\theta = \arg\max_\theta P(\theta), \qquad \rho = P(\hat\theta) / \mathrm{median}_\theta P

    where the bearing and its prominence rho come from the SRP-PHAT spectrum P of the last two hops.

    Parameters
    ----------
    stamp_ns : int
        Time at the end of the window, nanoseconds on the stream's clock.
    sample_index : int
        Number of samples up to this time.
    azimuths_rad : ndarray, shape (A,)
        Grid of `srp`, radians, ascending from right (negative) to left.
    srp : ndarray of float64, shape (A,)
        SRP-PHAT of the decision window, 0..1; the maximum over the elevations.
    bearing_rad, bearing_std_rad : float
        Azimuth of the highest peak over the last two hops and its standard deviation, radians.
    prominence : float
        Peak-to-median ratio of the bearing's spectrum.
    least_prominence : float
        Ratio that noise reaches with this array; a lower peak gives no direction.
    peaks : tuple of Peak
        Peaks of the bearing's spectrum, highest first, at most four; the first is the bearing.
    band_log_energy : ndarray of float64, shape (16,)
        Natural logarithm of the mean square per band in the last usable hop.
    looming : Looming or NotUsable
        Approach rate at the end of the window.
    feature : ndarray of float64, shape (60,)
        The published feature of the decision window: two halves x thirty azimuths, from left to right.
    bearing_age_s : float
        Time from the middle of the bearing's interval to `stamp_ns`, seconds.
    health : ArrayHealth or NotUsable
        Faults of the microphones, and which are excluded.
    tone : ToneReading or NotUsable
        Engine line over the decision window; not usable if it is off or no tone exceeds the noise.
    character : ndarray, shape (49,), or NotUsable
        Sound of the middle microphone in the last two seconds, independent of its level: modulation, its part
        that is common to the bands, tones and harmonics (inputs of a `DomainGuard`); also the distribution of
        the level over twelve bands (a further input of a `RoadUserModel`).
    lost : float
        Share of lost samples in the decision window: constant or repeated in all channels. STFT frames with
        lost samples are excluded from all results; means are over the other frames.
    heard : float or None
        Usable share of the latest hop or of the window, whichever is smaller; 0 if less than 0.4 of the
        window is usable. Hops with a usable share below 0.2 are excluded from all results. None for given
        spectra, because it is then not measured.
    unheard : str or None
        Reason why the rest is not usable: "lost samples", "wind", "noise far above this place's usual", "no
        sound common to the microphones" or "sound that contradicts the positions of the microphones".
    excess_db : float
        Level of the latest hop above the quiet street, averaged over bands, decibels.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> from worldstate.frontend.stream import FrontEnd
    >>> array = MicrophoneArray([[0, 0.2, 0], [0, 0.0, 0], [0, -0.3, 0]])
    >>> sound = np.random.default_rng(0).standard_normal((8000, 3))
    >>> frame = FrontEnd(array, 8000).process(sound)[0]
    >>> frame.stamp_ns, frame.srp.shape, frame.feature.shape
    (1000000000, (181,), (60,))
    """

    stamp_ns: int
    sample_index: int
    azimuths_rad: FloatArray
    srp: FloatArray
    bearing_rad: float
    bearing_std_rad: float
    prominence: float
    peaks: tuple[doa.Peak, ...]
    band_log_energy: FloatArray
    looming: Looming | NotUsable
    feature: FloatArray
    least_prominence: float = 1.0
    bearing_age_s: float = 0.0
    health: ArrayHealth | NotUsable = _NOT_MONITORED
    tone: ToneReading | NotUsable = TONE_IS_OFF
    character: FloatArray | NotUsable = CHARACTER_IS_OFF
    lost: float = 0.0
    heard: float | None = 1.0
    excess_db: float = 0.0
    unheard: str | None = None

    @property
    def at_edge(self) -> bool:
        """Whether the highest peak is at an end of the search sector, so that its source may be outside."""
        within = self.azimuths_rad[0] < self.bearing_rad < self.azimuths_rad[-1]
        return not (within or doa.is_all_round(self.azimuths_rad))


__all__ = ["AcousticFrame", "FrontEnd"]

# Far above full scale of any converter; the power of an STFT frame is still within single precision.
_LOUDEST = 1e15
# Usable share of a window. With 0.6 s lost, the errors of the feature and of the side evidence are as large
# as their changes within half a second (medians 0.08 against 0.10, and 0.29 against 0.30 nats, twelve
# simulated demos); with 0.7 s lost the latter is 0.39 nats.
_LEAST_OF_WINDOW = 0.4 - 1e-9
# A tenth of a second is too short for the feature. In fourteen demos after a lost second, the probability of
# an approaching vehicle is 0.349 with this feature, 0.361 if that of the whole window replaces it, and 0.43
# without the loss.
_LEAST_OF_HALF = 0.3
# The energy of less than half a hop varies too much for a point of the looming fit.
_LEAST_OF_HOP = 0.5


def _full_scale(dtype: np.dtype[Any]) -> np.float32:
    """Return the factor that scales integer samples of a converter to full scale 1."""
    if dtype not in (np.int16, np.int32):
        raise InvalidArgumentError(f"block: expected floats of full scale 1, int16 or int32, got {dtype}")
    return np.float32(1.0 / -float(np.iinfo(dtype).min))


class FrontEnd:
    r"""Bearing, approach rate and signature of the sound at an array, once per hop (0.1 s).

    .. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k} \Big| \sum_m \overline{a_{k,m}(\theta)}\,
              \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2, \qquad \hat\theta = \arg\max_\theta P(\theta)

    The SRP spectrum over the T STFT frames of the window is one of the results; `AcousticFrame` lists all. An
    STFT frame belongs to the hop in which it ends. Hop k ends at sample floor(k fs / 10 + 1/2), without
    drift. The first result is available after the first full window. Sums are stored per hop, so a window of
    one second needs only the computation of its latest hop. The stream is cut into hops first, so results do
    not depend on the length of the blocks. Memory is bounded.

    Parameters
    ----------
    array : MicrophoneArray
        One microphone per channel, in the order of the channels. With a planar array across the vehicle,
        sources behind it appear in front: see `MicrophoneArray.ambiguity`.
    sample_rate_hz : float
        Samples per second, the unit of `sample_index`; more than twice the highest frequency of the bands.
        `FrontEndSettings.heard_at` returns settings for any rate.
    settings : FrontEndSettings, optional
        Bands, windows, grids and stages; the values of the paper by default, with frames of `feature_nfft`.
    start_ns : int
        Time of the first sample, nanoseconds.

    Raises
    ------
    InvalidArgumentError
        If a band exceeds half the sample rate, or a hop is shorter than an STFT frame.

    References
    ----------
    "Evidence of Absence", section IV; J. DiBiase, H. Silverman and M. Brandstein, "Robust localization in
    reverberant rooms", in *Microphone Arrays*, 2001 (SRP-PHAT).

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import roof_array_56
    >>> front_end = FrontEnd(roof_array_56(), sample_rate_hz=16_000)
    >>> sound = np.random.default_rng(0).standard_normal((17_600, 56), dtype=np.float32)
    >>> frames = front_end.process(sound)
    >>> [frame.sample_index for frame in frames], frames[0].srp.shape, frames[0].feature.shape
    ([16000, 17600], (181,), (60,))
    """

    def __init__(
        self,
        array: MicrophoneArray,
        sample_rate_hz: float,
        settings: FrontEndSettings | None = None,
        *,
        start_ns: int = 0,
    ) -> None:
        self.array = array
        self.sample_rate_hz = in_range("sample_rate_hz", sample_rate_hz, 1.0, 1e7)
        self.settings = settings = settings or FrontEndSettings(nfft=feature_nfft(self.sample_rate_hz))
        wanted_hz, n_channels = settings.heard_rate_hz, array.n_microphones
        self._resampler = Resampler(n_channels, self.sample_rate_hz, wanted_hz) if wanted_hz else None
        self.heard_rate_hz = rate = self._resampler.rate_hz if self._resampler else self.sample_rate_hz
        band_bins(settings.srp_band_hz, self.sample_rate_hz, settings.nfft)  # Checks the original rate
        hop = rate / HOP_RATE_HZ
        if settings.nfft > hop:
            problem = f"expected at most one hop of {hop:.0f} samples, got {settings.nfft}"
            advice = "use a higher sample rate (at least 6 kHz) or shorter frames"
            raise InvalidArgumentError(f"nfft: {problem}: {advice}")
        self._start_ns = start_ns
        self._azimuths = settings.azimuths_rad()
        self._azimuths.flags.writeable = False
        self._scatter = doa.BearingScatter(doa.uniform_std_rad(self._azimuths))
        self._cutter, self._recorder = (HopCutter(n_channels, hz) for hz in (rate, self.sample_rate_hz))
        self._recorded: deque[Float32Array] = deque()
        with one_blas_thread():
            self._spectra = HopSpectra(array, rate, settings)
            frequencies = bin_frequencies_hz(self._spectra.srp_bins, rate, settings.nfft)
            n_frames = BEARING_HOPS * 2.0 * rate / (HOP_RATE_HZ * settings.nfft)
            self._least_prominence = doa.noise_prominence(self._spectra.beams, array, frequencies, n_frames)
        self._noise = NoiseMeter(settings.mask_rises) if settings.watch_channels else None
        self._levels: FloatArray = np.full(BANDS, np.log(SILENCE))
        self._meter = LevelMeter(n_channels, rate, settings, self.sample_rate_hz)
        band_hz = settings.tone_band_hz
        self._tone = None if band_hz is None else ToneStage(array, rate, band_hz)
        self._energy_floor = EnergyFloor()
        self._character = SoundCharacter(rate) if settings.character else None
        n_directions = sum([row.weights.shape[2] for row in self._spectra.beams])
        self._window = hop_window(WINDOW_HOPS, n_directions, n_channels)
        self._health = ArrayHealth.unknown(n_channels)
        self._nearest: tuple[bytes, int] = b"", 0  # Kept microphones, and the middle one of them

    def process(self, block: ArrayLike) -> list[AcousticFrame]:
        """Process the next samples; return one result for every completed hop after the first window.

        Parameters
        ----------
        block : array_like, shape (n, M)
            Samples, from a single sample to a whole file: floats of full scale 1, or int16 and int32 samples
            of a converter, which are scaled to it.

        Returns
        -------
        list of AcousticFrame
            Results in temporal order; empty if no hop is complete.

        Raises
        ------
        InvalidArgumentError
            On another number of channels, values that are not numbers, integers of another width, NaN,
            infinity or magnitudes above 1e15; the state is then unchanged.

        Examples
        --------
        >>> array = MicrophoneArray([[0, 0.2, 0], [0, 0.0, 0], [0, -0.3, 0]])
        >>> front_end = FrontEnd(array, 8000)
        >>> blocks = np.random.default_rng(0).standard_normal((5, 2000, 3))
        >>> [len(front_end.process(block)) for block in blocks]
        [0, 0, 0, 1, 2]
        """
        samples = self._checked(block)
        if self._resampler is not None:
            self._recorded.extend(hop.samples.copy() for hop in self._recorder.cut(samples))
            samples = self._resampler.push(samples)
        return self._process_hops(samples)

    def finish(self) -> list[AcousticFrame]:
        """Return the results of hops that wait for later samples of the resampler, at most 16 ms."""
        return [] if self._resampler is None else self._process_hops(self._resampler.flush())

    def skip(self, lost_ns: int) -> None:
        """Advance the time by lost sound that is not replaced by silence; all later stamps are later.

        Parameters
        ----------
        lost_ns : int
            Duration of the lost sound, nanoseconds.

        Raises
        ------
        InvalidArgumentError
            If it is negative.

        Examples
        --------
        >>> array = MicrophoneArray([[0, 0.2, 0], [0, 0.0, 0], [0, -0.3, 0]])
        >>> front_end = FrontEnd(array, 8000)
        >>> front_end.skip(2_000_000_000)
        >>> [frame.stamp_ns for frame in front_end.process(np.zeros((8000, 3)))]
        [3000000000]
        """
        in_range("lost_ns", lost_ns, 0, 10**18)
        self._start_ns += lost_ns

    def _checked(self, block: ArrayLike) -> Float32Array:
        try:
            samples: Float32Array = np.asarray(block)
            if samples.dtype != np.float32 or not samples.flags.c_contiguous:
                with np.errstate(over="ignore"):
                    samples = np.ascontiguousarray(samples, dtype=np.float32)
        except (TypeError, ValueError) as error:
            raise InvalidArgumentError(f"block: expected numbers, got {type(block).__name__}") from error
        if isinstance(block, np.ndarray) and block.dtype.kind in "iu":
            samples = samples * _full_scale(block.dtype)
        check_shape("block", samples.shape, (None, self.array.n_microphones))
        # With NaN both extremes are NaN and every comparison is false, so it is rejected.
        lowest, highest = [one(samples, None, initial=0.0) for one in (np.minimum.reduce, np.maximum.reduce)]
        if lowest >= -_LOUDEST and highest <= _LOUDEST:
            return samples
        if loud := (~(np.abs(samples).max(axis=0) <= _LOUDEST)).nonzero()[0].tolist():
            problem = f"expected finite numbers up to {_LOUDEST:g}, got others in channels {loud}"
            raise InvalidArgumentError(f"block: {problem}")
        return samples

    def _process_hops(self, samples: Float32Array) -> list[AcousticFrame]:
        recorded, hops = self._recorded, self._cutter.cut(samples)
        frames = (self._process_hop(hop, recorded.popleft() if recorded else hop.samples) for hop in hops)
        return [frame for frame in frames if frame is not None]

    def _process_hop(self, hop: Hop, recorded: Float32Array) -> AcousticFrame | None:
        with one_blas_thread():
            newest = self._spectra.push(hop.samples, recorded)
            self._health = newest.health
            levels = self._unmasked(self._meter.push(hop.samples, self._keep, newest.heard), newest)
            window = self._window
            self._energy_floor.push(float(mean(window["energies"][-1, self._used])))
            if self._tone is not None:
                self._tone.push(hop.samples, newest.health.mask)
            if self._character is not None and not newest.lost and window["n_frames"][-1]:
                self._character.push(hop.samples[:, self._middle()])
            return self._frame(hop, levels) if hop.index >= WINDOW_HOPS else None

    def _middle(self) -> int:
        """Return the microphone nearest to the centre among those used in the latest hop."""
        kept = self._keep.tobytes()
        if kept != self._nearest[0]:
            self._nearest = kept, int(self.array.nearest(self._keep)[0])
        return self._nearest[1]

    def _unmasked(self, levels: FloatArray, newest: HopSums) -> FloatArray:
        """Add the latest hop, empty if noise masks it; return its levels, or the last usable ones."""
        noise, share, reason = self._noise, 1.0, None
        if noise is not None and newest.n_frames:
            coherence = float(mean(self._scaled(newest.pairs[None], newest.n_frames)))
            share, reason = noise.push(levels, coherence, newest.common)
        elif noise is not None:
            noise.skip()
        push_hop(self._window, newest, share, reason)
        if noise is None or self._window["n_frames"][-1]:
            self._levels = levels
        return self._levels

    def _frame(self, hop: Hop, levels: FloatArray) -> AcousticFrame:
        hops = self._window
        # The last usable hops of the window, or the last hops if none is usable.
        heard = hops["n_frames"].nonzero()[0][-BEARING_HOPS:]
        heard = heard if len(heard) else np.arange(WINDOW_HOPS)[-BEARING_HOPS:]
        spectrum, azimuths = doa.about_the_peak(self._srp(heard), self._azimuths)
        peaks, floor = doa.find_peaks(spectrum, azimuths), self._least_prominence
        bearing = self._scatter.widened(doa.bearing_of(spectrum, peaks, azimuths, floor))
        weights = np.maximum(hops["n_frames"][heard], 1)
        centre = float(weights @ hops["centre"][heard] / np.add.reduce(weights))
        shares = hops["share"].tolist()
        window = sum(shares) / WINDOW_HOPS
        return AcousticFrame(
            stamp_ns=self._start_ns + nanoseconds(hop.end / self.heard_rate_hz),
            sample_index=hop_end(hop.index, self.sample_rate_hz),
            azimuths_rad=self._azimuths,
            srp=self._srp(slice(None)),
            bearing_rad=bearing.azimuth_rad,
            bearing_std_rad=bearing.std_rad,
            prominence=bearing.prominence,
            least_prominence=floor,
            peaks=peaks,
            band_log_energy=levels,
            looming=self._looming(hop.end),
            feature=self._feature(),
            bearing_age_s=(hop.end - centre) / self.heard_rate_hz,
            health=self._health,
            tone=TONE_IS_OFF if self._tone is None else self._tone.read(),
            character=CHARACTER_IS_OFF if self._character is None else self._character.read(),
            lost=sum(hops["lost"].tolist()) / WINDOW_HOPS,
            heard=0.0 if window < _LEAST_OF_WINDOW else min(window, shares[-1]),
            # The latest of the hops with the smallest usable share.
            unheard=hops["unheard"][WINDOW_HOPS - 1 - int(hops["share"][::-1].argmin())],
            excess_db=0.0 if self._noise is None else self._noise.excess_db,
        )

    @property
    def _keep(self) -> BoolArray:
        return self._health.mask.keep

    @property
    def _used(self) -> BoolArray | slice:
        """Microphones whose energy is used: those kept, or all if none is kept."""
        return self._keep if True in self._keep else slice(None)

    def _srp(self, hops: IndexArray | slice) -> FloatArray:
        """Return the SRP-PHAT of hops, (A,): the maximum over elevations."""
        some = self._window[hops]
        total, n_frames = np.add.reduce(some["power"]), sum(some["n_frames"].tolist())
        n_bins, n_microphones = len(self._spectra.srp_bins), self.array.n_microphones
        power = doa.normalised(total, max(n_frames, 1), n_bins, n_microphones)
        return np.asarray(np.maximum.reduce(power.reshape(-1, len(self._azimuths))))

    def _feature(self) -> FloatArray:
        half = WINDOW_HOPS // FEATURE_SEGMENTS
        return np.concatenate([self._segment(slice(i, i + half)) for i in range(0, WINDOW_HOPS, half)])

    def _segment(self, half: slice) -> FloatArray:
        """Return the feature of half a window, or of the whole window if the half is hardly usable."""
        window, n_hops = self._window, WINDOW_HOPS // FEATURE_SEGMENTS
        used = half if sum(window["share"][half].tolist()) >= _LEAST_OF_HALF * n_hops else slice(None)
        return self._scaled(window["pairs"][used], sum(window["n_frames"][used].tolist()))

    def _scaled(self, pairs: Complex128Array, n_frames: int) -> FloatArray:
        n_bins, n_microphones = len(self._spectra.feature_bins), self.array.n_microphones
        return segment_feature(pairs, max(n_frames, 1), n_bins, n_microphones)

    def _looming(self, end: int) -> Looming | NotUsable:
        window = self._window
        hops = (window["n_frames"] >= _LEAST_OF_HOP * np.maximum(window["n_new"], 1)).nonzero()[0]
        # The same microphones over the whole window, so that a failure does not look like a change of level.
        energies = mean(window["energies"][:, self._used], 1)[hops]
        return looming_of((window["centre"][hops] - end) / self.heard_rate_hz, energies, self._energy_floor)
