"""The band of a spatial spectrum that fits the spacing of the microphones."""

import math

from .microphone_array import MicrophoneArray

# The paper's band, for microphones 8.8 cm apart.
BAND_HZ = (300.0, 1800.0)
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
