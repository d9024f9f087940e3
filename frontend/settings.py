"""Settings of the front-end, with the values of the paper."""

import math
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.approach.tone import ENGINE_BAND_HZ
from worldstate.frontend.array.geometry import SPEED_OF_SOUND_M_S
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import (
    CLEANED_FEATURE_VERSION,
    FEATURE_BAND_HZ,
    FEATURE_NFFT,
    FEATURE_SEGMENTS,
    FEATURE_VERSION,
)
from worldstate.frontend.ego_noise.ego_noise import EgoNoiseSettings
from worldstate.ground import FloatArray, InvalidArgumentError, in_range

Band = tuple[float, float]

# The paper's band, for microphones 8.8 cm apart.
BAND_HZ = (300.0, 1800.0)


@dataclass(frozen=True, slots=True)
class FrontEndSettings:
    """Settings of `FrontEnd`.

    Parameters
    ----------
    nfft : int
        Frame length, samples, even; frames overlap by half.
    hop_rate_hz : float
        Decisions per second.
    window_hops : int
        Hops in the decision window of `srp` and `feature`, even: the feature has two segments.
    bearing_hops : int
        Hops in the bearing, at most `window_hops`. More suppress noise, but the azimuth of a passing car
        changes by tens of degrees per second, and the bearing is that of the middle of the interval.
    azimuth_span_deg : (float, float)
        First and last azimuth searched, degrees, left positive.
    azimuth_step_deg : float
        Step of that grid, degrees; it must divide the span.
    elevation_span_deg : (float, float)
        First and last elevation searched, degrees, up positive; by default the horizon and the street from
        5 to 20 m ahead of a roof.
    elevation_step_deg : float
        Step of that grid, degrees; it must divide the span.
    max_peaks : int
        Largest number of peaks listed.
    tone_band_hz : (float, float), optional
        Band in which an engine line is searched, Hz, for example (20, 400); None switches it off.
    tone_hops : int
        Hops in the window of the tone fit.
    srp_band_hz, feature_band_hz, looming_band_hz, level_band_hz : (float, float)
        Bands, Hz; the upper end of `level_band_hz` is cut at 0.45 of the sample rate.
    looming_hops : int
        Hops in the window of the looming fit, >= 4.
    bearing_std_rad : float
        Standard deviation of the bearing of a lone vehicle, radians.
    speed_of_sound_m_s : float
        Speed of sound c, m/s.
    ego_noise : EgoNoiseSettings, optional
        Settings of ego-noise suppression, used with `FrontEnd.learn_ego_noise`; None switches it off.
    watch_channels : bool
        Detect faulty microphones and leave them out.
    character : bool
        Measure what one microphone hears over two seconds: `AcousticFrame.character`.
    feature_order : tuple of int, optional
        Channels in the order in which the feature forms its pairs, where it is not that of the array.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or a band is empty.

    Examples
    --------
    >>> FrontEndSettings(azimuth_step_deg=2.0).azimuths_rad().shape
    (91,)
    """

    nfft: int = FEATURE_NFFT
    hop_rate_hz: float = 10.0
    window_hops: int = 10
    bearing_hops: int = 2
    azimuth_span_deg: tuple[float, float] = (-90.0, 90.0)
    azimuth_step_deg: float = 1.0
    # Tyres 8 m away are 10 degrees below a roof. Searched at the horizon alone, an array with rows at several
    # heights takes the detour for another azimuth: simulated vehicles in view are 5 degrees
    # off in the median with 56 microphones and 50 with 4, with both rows 3 and 1.
    elevation_span_deg: tuple[float, float] = (-12.0, 0.0)
    elevation_step_deg: float = 12.0
    max_peaks: int = 4
    tone_band_hz: Band | None = None
    tone_hops: int = 10
    srp_band_hz: Band = BAND_HZ
    feature_band_hz: Band = FEATURE_BAND_HZ
    looming_band_hz: Band = (300.0, 1800.0)
    level_band_hz: Band = (50.0, 8000.0)
    looming_hops: int = 10
    bearing_std_rad: float = float(np.radians(3.4))
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
    ego_noise: EgoNoiseSettings | None = None
    watch_channels: bool = True
    character: bool = False
    feature_order: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        _even("nfft", self.nfft, 4, 65536)
        _even("window_hops", self.window_hops, FEATURE_SEGMENTS, 1000)
        in_range("bearing_hops", self.bearing_hops, 1, self.window_hops)
        in_range("looming_hops", self.looming_hops, 4, 1000)
        in_range("hop_rate_hz", self.hop_rate_hz, 0.1, 1000.0)
        in_range("bearing_std_rad", self.bearing_std_rad, 0.0, np.pi, open_low=True)
        in_range("speed_of_sound_m_s", self.speed_of_sound_m_s, 100.0, 10_000.0)
        in_range("max_peaks", self.max_peaks, 1, 1000)
        in_range("tone_hops", self.tone_hops, 1, 1000)
        self._check_grid()
        for name in ("srp_band_hz", "feature_band_hz", "looming_band_hz", "level_band_hz", "tone_band_hz"):
            low, high = getattr(self, name) or ENGINE_BAND_HZ
            in_range(f"{name}: lower end", low, 0.0, np.inf)
            in_range(f"{name}: upper end", high, low, np.inf, open_low=True, open_high=True)

    def _check_grid(self) -> None:
        first, last = self.azimuth_span_deg
        in_range("azimuth_span_deg: first", first, -180.0, 180.0)
        in_range("azimuth_span_deg: last", last, first, 180.0, open_low=True)
        in_range("azimuth_step_deg", self.azimuth_step_deg, 0.01, (last - first) / 2)
        _divides("azimuth_step_deg", self.azimuth_step_deg, last - first)
        lowest, highest = self.elevation_span_deg
        in_range("elevation_span_deg: first", lowest, -90.0, 90.0)
        in_range("elevation_span_deg: last", highest, lowest, 90.0)
        in_range("elevation_step_deg", self.elevation_step_deg, 0.01, 180.0)
        _divides("elevation_step_deg", self.elevation_step_deg, highest - lowest)

    @property
    def feature_version(self) -> str:
        """Which feature is computed, as a model names what it was trained on."""
        cleaned = self.ego_noise is not None and self.ego_noise.feature
        return CLEANED_FEATURE_VERSION if cleaned else FEATURE_VERSION

    def azimuths_rad(self) -> FloatArray:
        """Return the grid of azimuths, ascending from right to left.

        ``theta_i = first + i step``

        Returns
        -------
        ndarray, shape (A,)
            Radians, left positive.

        Examples
        --------
        >>> np.degrees(FrontEndSettings(azimuth_step_deg=90.0).azimuths_rad())
        array([-90.,   0.,  90.])
        """
        return _grid_rad(self.azimuth_span_deg, self.azimuth_step_deg)

    def elevations_rad(self) -> FloatArray:
        """Return the grid of elevations, ascending.

        ``phi_i = first + i step``

        Returns
        -------
        ndarray, shape (E,)
            Radians.

        Examples
        --------
        >>> np.degrees(FrontEndSettings(elevation_span_deg=(-24.0, 12.0)).elevations_rad()).round()
        array([-24., -12.,   0.,  12.])
        """
        return _grid_rad(self.elevation_span_deg, self.elevation_step_deg)


def _grid_rad(span_deg: tuple[float, float], step_deg: float) -> FloatArray:
    first, last = span_deg
    return np.radians(np.linspace(first, last, round((last - first) / step_deg) + 1))


def _divides(name: str, step: float, span: float) -> None:
    if abs(span / step - round(span / step)) > 1e-9:
        raise InvalidArgumentError(f"{name}: expected a divisor of {span}, got {step}")


def _even(name: str, value: int, low: int, high: int) -> None:
    if value != int(value) or value % 2 or not low <= value <= high:
        raise InvalidArgumentError(f"{name}: expected an even whole number in [{low}, {high}], got {value}")


# Room below half the sample rate for the anti-aliasing filter.
_HIGHEST_SHARE = 0.45
# No lower than the paper's band for microphones farther apart: over a band of two octaves the aliases of the
# spatial spectrum fall on other directions at each frequency, and low bands are blunt. White sources at 0 dB,
# a pair 1 m apart: median error .9 deg in 150-900 Hz, .2 deg in 300-1800 Hz.
_MOST_OCTAVES = 2


def default_band_hz(array: MicrophoneArray, sample_rate_hz: float) -> tuple[float, float]:
    r"""Return the paper's band, moved by whole octaves to the highest that the spacing samples.

    .. math:: (300, 1800)\,\mathrm{Hz} \cdot 2^n, \qquad
              n = \Big\lfloor \log_2 \frac{f_{alias}}{1800\,\mathrm{Hz}} \Big\rfloor \in [0, 2]

    Shapes: returns (2,).
    """
    # Whole octaves, so that arrays of about the paper's spacing keep the paper's band exactly.
    low, high = BAND_HZ
    spacing = min(max(math.floor(math.log2(array.alias_hz() / high)), 0), _MOST_OCTAVES)
    octaves = min(spacing, math.floor(math.log2(_HIGHEST_SHARE * sample_rate_hz / high)))
    return low * 2.0**octaves, high * 2.0**octaves
