"""Settings of the front-end, with the values of the paper."""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from worldstate.frontend.approach.tone import ENGINE_BAND_HZ
from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S, MicrophoneArray
from worldstate.frontend.direction import feature as published
from worldstate.ground import FloatArray, InvalidArgumentError, in_range

Band = tuple[float, float]

# A decision every tenth of a second on the latest second; the feature has two halves.
HOP_RATE_HZ, WINDOW_HOPS = 10.0, 10
# Hops for the bearing. More hops suppress noise, but the azimuth of a passing car changes by tens of degrees
# per second, and the bearing refers to the middle of the interval.
BEARING_HOPS = 2
# The horizon, and the street from 5 to 20 m ahead of a roof: tyres at 8 m are 10 degrees below the horizon.
# With a search at the horizon only, an array with rows at several heights interprets the path difference as
# another azimuth. The median error for simulated visible vehicles is then 5 degrees with 56 microphones and
# 50 with 4; with both elevations it is 3 and 1.
ELEVATIONS_RAD = np.radians([-12.0, 0.0])
# Band of the paper, for microphones 8.8 cm apart.
BAND_HZ = (300.0, 1800.0)
LOOMING_BAND_HZ = BAND_HZ


@dataclass(frozen=True, slots=True)
class FrontEndSettings:
    """Settings of `FrontEnd`.

    Parameters
    ----------
    nfft : int
        Frame length, samples, even; frames overlap by half.
    azimuth_span_deg : (float, float)
        First and last azimuth of the search, a whole number of degrees apart, left positive.
    tone_band_hz : (float, float), optional
        Band of the search for an engine line, Hz, for example (20, 400); None switches it off.
    srp_band_hz, level_band_hz : (float, float)
        Bands, Hz; the upper end of `level_band_hz` is limited to 0.45 of the sample rate.
    watch_channels : bool
        Detect faulty microphones, lost samples and masking noise, and exclude them.
    mask_rises : bool
        Exclude sound that rises by 6 to 10 dB within 0.3 s, because it masks other sound, until it falls.
    character : bool
        Measure the character of the sound at one microphone over two seconds: `AcousticFrame.character`.
    feature_order : tuple of int, optional
        Order of the channels in the pairs of the feature, if it is not that of the array.
    heard_rate_hz : float, optional
        Rate to which the sound is resampled, except for the check of microphones; None: no resampling.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or a band is empty.

    Examples
    --------
    >>> FrontEndSettings(azimuth_span_deg=(-45.0, 45.0)).azimuths_rad().shape
    (91,)
    """

    nfft: int = published.FEATURE_NFFT
    azimuth_span_deg: tuple[float, float] = (-90.0, 90.0)
    tone_band_hz: Band | None = None
    srp_band_hz: Band = BAND_HZ
    level_band_hz: Band = (50.0, 8000.0)
    watch_channels: bool = True
    mask_rises: bool = True
    character: bool = False
    feature_order: tuple[int, ...] | None = None
    heard_rate_hz: float | None = None

    def __post_init__(self) -> None:
        if self.nfft != int(self.nfft) or self.nfft % 2 or not 4 <= self.nfft <= 65536:
            expected = "an even whole number in [4, 65536]"
            raise InvalidArgumentError(f"nfft: expected {expected}, got {self.nfft}")
        first, last = self.azimuth_span_deg
        in_range("azimuth_span_deg: first", first, -180.0, 180.0)
        width = in_range("azimuth_span_deg: last", last, first + 2.0, 180.0) - first
        if abs(width - round(width)) > 1e-9:
            raise InvalidArgumentError(f"azimuth_span_deg: expected whole degrees, got {width}")
        for name in ("srp_band_hz", "level_band_hz", "tone_band_hz"):
            low, high = getattr(self, name) or ENGINE_BAND_HZ
            in_range(f"{name}: lower end", low, 0.0, np.inf)
            in_range(f"{name}: upper end", high, low, np.inf, open_low=True, open_high=True)

    @classmethod
    def heard_at(cls, sample_rate_hz: float, **others: Any) -> Self:
        """Return settings for sound of any rate, with frames that suit the published feature.

        Examples
        --------
        >>> chosen = FrontEndSettings.heard_at(44_100)
        >>> chosen.nfft, chosen.heard_rate_hz, FrontEndSettings.heard_at(47_998).heard_rate_hz
        (512, 48000.0, None)
        """
        rate = published.feature_rate_hz(sample_rate_hz)
        heard = None if rate == sample_rate_hz else rate
        return cls(published.feature_nfft(rate), heard_rate_hz=heard, **others)

    def azimuths_rad(self) -> FloatArray:
        """Return the grid of azimuths in steps of one degree, ascending from right to left.

        Returns
        -------
        ndarray, shape (A,)
            Radians, left positive.

        Examples
        --------
        >>> np.degrees(FrontEndSettings(azimuth_span_deg=(-1.0, 1.0)).azimuths_rad())
        array([-1.,  0.,  1.])
        """
        first, last = self.azimuth_span_deg
        return np.radians(np.linspace(first, last, round(last - first) + 1))


# Highest frequency in the pass band of usual anti-aliasing filters, relative to the sample rate.
HIGHEST_SHARE = 0.45
# For microphones farther apart, the band is not lower than the paper's: over two octaves, the aliases of the
# spatial spectrum have different directions at each frequency, and low bands have a low resolution. For white
# sources at 0 dB and a pair 1 m apart, the median error is 0.9 deg in 150-900 Hz and 0.2 deg in 300-1800 Hz.
_MOST_OCTAVES = 2
_FRAME_S = published.FEATURE_NFFT / published.FEATURE_RATE_HZ


def default_band_hz(array: MicrophoneArray, sample_rate_hz: float) -> tuple[float, float]:
    r"""Return the paper's band, moved up by whole octaves as far as the spacing permits.

    .. math:: (300, 1800)\,\mathrm{Hz} \cdot 2^n, \qquad
              n = \Big\lfloor \log_2 \frac{f_{alias}}{1800\,\mathrm{Hz}} \Big\rfloor \in [0, 2]

    Shapes: returns (2,).
    """
    # Whole octaves, so that arrays with approximately the paper's spacing have exactly the paper's band.
    low, high = BAND_HZ
    spacing = min(max(math.floor(math.log2(array.alias_hz() / high)), 0), _MOST_OCTAVES)
    octaves = min(spacing, math.floor(math.log2(HIGHEST_SHARE * sample_rate_hz / high)))
    return low * 2.0**octaves, high * 2.0**octaves


def default_span_deg(array: MicrophoneArray, sample_rate_hz: float) -> float:
    r"""Return the sector ahead that an array resolves without a mirror image: 360 degrees, or 180.

    Microphones are not in one vertical plane if, at the highest frequency of the band, their deviations from
    the nearest such plane change the phase of a wave by a radian between a direction and its mirror image:

    .. math:: \frac{4 \pi f}{c} \sqrt{\frac1M \sum_m d_m^2} \ge 1

    The sector is 180 degrees if a wave takes longer through the array than an STFT frame, because it is then
    not coherent within the frame.

    Examples
    --------
    >>> ring = MicrophoneArray([[0.04, 0, 0], [0, 0.04, 0], [-0.04, 0, 0], [0, -0.04, 0]])
    >>> line = MicrophoneArray([[0, 0.1, 0], [0, 0, 0], [0, -0.1, 0]])
    >>> default_span_deg(ring, 16_000), default_span_deg(line, 16_000)
    (360.0, 180.0)
    """
    thickness_m = np.linalg.svd(array.centred_m[:, :2], compute_uv=False)[-1] / math.sqrt(array.n_microphones)
    top_hz = default_band_hz(array, sample_rate_hz)[1]
    is_deep = 4.0 * math.pi * top_hz * thickness_m >= SPEED_OF_SOUND_M_S
    return 360.0 if is_deep and array.widest_m < SPEED_OF_SOUND_M_S * _FRAME_S else 180.0
