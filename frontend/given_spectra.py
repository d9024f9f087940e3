"""Acoustic frames from spatial spectra of another front-end and one channel of sound."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.approach.looming import EnergyFloor
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering, one_blas_thread
from worldstate.frontend.direction import bearing as doa
from worldstate.frontend.direction.feature import FEATURE_AZIMUTHS_RAD, FEATURE_SEGMENTS
from worldstate.frontend.spectra.sound_character import SoundCharacter
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz, power
from worldstate.ground import FloatArray, InvalidArgumentError, nanoseconds
from worldstate.ground.checks import check_shape, freeze_arrays, in_range
from worldstate.ground.typing import Float32Array

from .hop_spectra import Hop, HopCutter, LevelMeter, hop_end, looming_of, mean_square_per_bin
from .settings import BEARING_HOPS, HOP_RATE_HZ, LOOMING_BAND_HZ, WINDOW_HOPS, FrontEndSettings
from .stream import CHARACTER_IS_OFF, AcousticFrame

HALF_HOPS = WINDOW_HOPS // FEATURE_SEGMENTS


@dataclass(frozen=True, slots=True, eq=False)
class GivenSpectra:
    r"""Pair sums of SRP-PHAT from another front-end, one row per hop of 0.1 s from the start.

    .. math:: F(\theta) = \frac{1}{T K P} \Big| \sum_{t,k} \sum_{i<j}
              \overline{a_{k,i}}\, Z_{t,k,i}\, \overline{Z_{t,k,j}}\, a_{k,j} \Big|, \qquad P = M (M - 1) / 2

    Parameters
    ----------
    values : ndarray, shape (hops, azimuths)
        Values in (0, 1] as in the published feature, without the diagonal.
    azimuths_rad : ndarray, shape (azimuths,)
        Ascending, evenly spaced, left positive; at least from -90 to 90 degrees.
    array : MicrophoneArray
        The M microphones of the spectra.
    hops : int
        Number of hops that a row covers, up to its own: 1, or 5 for half a window.

    Raises
    ------
    InvalidArgumentError
        If a value is out of range, the azimuths do not ascend over the sector ahead, or `hops` is neither 1
        nor 5.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import roof_array_56
    >>> ahead = np.radians(np.linspace(-90.0, 90.0, 180))
    >>> GivenSpectra(np.full((30, 180), 0.2), ahead, roof_array_56()).values.shape
    (30, 180)
    """

    values: FloatArray
    azimuths_rad: FloatArray
    array: MicrophoneArray
    hops: int = 1

    def __post_init__(self) -> None:
        freeze_arrays(self, values=(None, None), azimuths_rad=(None,))
        check_shape("values", self.values.shape, (None, len(self.azimuths_rad)))
        if not (np.diff(self.azimuths_rad) > 0.0).all() or np.ptp(self.azimuths_rad) < np.pi - 1e-6:
            raise InvalidArgumentError("azimuths_rad: expected ascending values from -90 to 90 degrees")
        if not ((self.values > 0.0) & (self.values <= 1.0)).all():
            raise InvalidArgumentError("values: expected pair sums in (0, 1]")
        if self.hops not in (1, HALF_HOPS):
            raise InvalidArgumentError(f"hops: expected 1 or {HALF_HOPS} per row, got {self.hops}")


class SpectrumFrontEnd:
    r"""Front-end for given spectra and one channel, with the results of `FrontEnd`.

    Feature, spectrum, bearing and prominence come from the spectra; levels, looming and character come from
    the sound. The spectrum is the pair sum F, which is close to the SRP-PHAT of many microphones, whose
    diagonal adds 1 / M. The health of channels and the usable share of the sound are not measured.

    Parameters
    ----------
    spectra : GivenSpectra
        Hop k of the sound is row k.
    sample_rate_hz : float
        Sample rate of the sound. It is not resampled, so frames of `settings.nfft` must be as long as the
        published ones.
    settings : FrontEndSettings
        Frames, bands and stages; the azimuths are those of the spectra.
    start_ns : int
        Time of the first sample, nanoseconds.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import roof_array_56
    >>> ahead = np.radians(np.linspace(-90.0, 90.0, 180))
    >>> spectra = GivenSpectra(np.full((12, 180), 0.2), ahead, roof_array_56())
    >>> front_end = SpectrumFrontEnd(spectra, 48_000, FrontEndSettings())
    >>> sound = np.random.default_rng(0).standard_normal((60_000, 1))
    >>> [(frame.sample_index, frame.feature.shape, frame.heard) for frame in front_end.process(sound)]
    [(48000, (60,), None), (52800, (60,), None), (57600, (60,), None)]
    """

    def __init__(
        self, spectra: GivenSpectra, sample_rate_hz: float, settings: FrontEndSettings, *, start_ns: int = 0
    ) -> None:
        if settings.heard_rate_hz is not None:
            raise InvalidArgumentError(f"sample_rate_hz: expected about 48 kHz, got {sample_rate_hz:g} Hz")
        self.spectra, self.array, self.settings = spectra, spectra.array, settings
        self.sample_rate_hz = in_range("sample_rate_hz", sample_rate_hz, 1.0, 1e7)
        self._start_ns, self._used = start_ns, 0
        with one_blas_thread():
            # `FrontEnd` computes the same value for this array.
            bins = band_bins(settings.srp_band_hz, sample_rate_hz, settings.nfft)
            hz = bin_frequencies_hz(bins, sample_rate_hz, settings.nfft)
            beams = [Steering.towards(spectra.array, hz, spectra.azimuths_rad)]
            n_frames = BEARING_HOPS * 2.0 * sample_rate_hz / (HOP_RATE_HZ * settings.nfft)
            self._least_prominence = doa.noise_prominence(beams, spectra.array, hz, n_frames)
        # The spectra at the thirty azimuths of the published feature, shape (hops, 30).
        published = [np.interp(FEATURE_AZIMUTHS_RAD, spectra.azimuths_rad, row) for row in spectra.values]
        self._published = np.array(published)
        self._scatter = doa.BearingScatter(doa.uniform_std_rad(spectra.azimuths_rad))
        self._cutter = HopCutter(1, sample_rate_hz)
        self._meter = LevelMeter(1, sample_rate_hz, settings)
        band = band_bins(LOOMING_BAND_HZ, sample_rate_hz, settings.nfft)
        self._stft = StreamingStft(1, settings.nfft, band)
        self._character = SoundCharacter(sample_rate_hz) if settings.character else None
        self._floor = EnergyFloor()
        self._energies: deque[float] = deque(maxlen=WINDOW_HOPS)

    def process(self, block: Float32Array) -> list[AcousticFrame]:
        """Process samples (n, 1) of full scale 1; return one frame for every hop with a spectrum.

        Raises
        ------
        InvalidArgumentError
            On another number of channels, NaN or infinity.
        """
        samples = np.ascontiguousarray(block, np.float32)
        check_shape("block", samples.shape, (None, 1))
        if not np.isfinite(samples).all():
            raise InvalidArgumentError("block: expected finite numbers")
        frames = [self._hop(hop) for hop in self._cutter.cut(samples)]
        return [frame for frame in frames if frame is not None]

    def finish(self) -> list[AcousticFrame]:
        """Return an empty list, because no hop waits for later samples."""
        return []

    def skip(self, lost_ns: int) -> None:
        """Raise an error, because the rows of the spectra refer to uninterrupted sound."""
        raise InvalidArgumentError(f"lost_ns: expected uninterrupted sound with spectra, got {lost_ns}")

    def _hop(self, hop: Hop) -> AcousticFrame | None:
        levels = self._meter.push(hop.samples)
        # The mean square in the looming band of the frames that end in the hop.
        powers = power(self._stft.push(hop.samples))
        self._energies.append(float(mean_square_per_bin(powers, self.settings.nfft).sum()))
        self._floor.push(self._energies[-1])
        if self._character is not None:
            self._character.push(hop.samples[:, 0])
        return self._frame(hop, levels) if WINDOW_HOPS <= hop.index <= len(self._published) else None

    def _frame(self, hop: Hop, levels: FloatArray) -> AcousticFrame:
        each, window = self.spectra.hops, slice(hop.index - WINDOW_HOPS, hop.index)
        rows = self.spectra.values[window][each - 1 :: each]
        newest = rows[-max(BEARING_HOPS // each, 1) :].mean(axis=0)
        spectrum, azimuths = doa.about_the_peak(newest, self.spectra.azimuths_rad)
        peaks, floor = doa.find_peaks(spectrum, azimuths), self._least_prominence
        bearing = self._scatter.widened(doa.bearing_of(spectrum, peaks, azimuths, floor))
        times_s = np.asarray((np.arange(-len(self._energies), 0) + 0.5) / HOP_RATE_HZ, np.float64)
        halves = self._published[window][each - 1 :: each].reshape(FEATURE_SEGMENTS, HALF_HOPS // each, -1)
        return AcousticFrame(
            stamp_ns=self._start_ns + nanoseconds(hop.end / self.sample_rate_hz),
            sample_index=hop_end(hop.index, self.sample_rate_hz),
            azimuths_rad=self.spectra.azimuths_rad,
            srp=rows.mean(axis=0),
            bearing_rad=bearing.azimuth_rad,
            bearing_std_rad=bearing.std_rad,
            prominence=bearing.prominence,
            least_prominence=floor,
            peaks=peaks,
            band_log_energy=levels,
            looming=looming_of(times_s, np.array(self._energies), self._floor),
            feature=halves.mean(axis=1).ravel(),
            bearing_age_s=0.5 * max(BEARING_HOPS, each) / HOP_RATE_HZ,
            character=CHARACTER_IS_OFF if self._character is None else self._character.read(),
            heard=None,
        )
