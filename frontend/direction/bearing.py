"""Bearing of the strongest source with its standard deviation and prominence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray

from .peaks import Peak

# Excess of the prominence over one at which noise doubles the variance of a bearing.
_PROMINENCE_KNEE = 0.15
# Beyond 78 degrees from broadside the law 1/cos is cut: it has no meaning within a beamwidth of endfire.
_MIN_COSINE = 0.2


@dataclass(frozen=True, slots=True)
class AcousticBearing:
    """Peak of a spatial spectrum as a measurement."""

    azimuth_rad: float  # Left positive
    std_rad: float  # Standard deviation
    prominence: float  # Peak-to-median ratio, >= 1; 1 in silence


def bearing_std_rad(
    azimuth_rad: float, prominence: float, broadside_std_rad: float, span_rad: float
) -> float:
    r"""Model the standard deviation of a peak bearing.

    .. math:: \sigma = \min\Big( \frac{\sigma_0}{\max(\cos\theta, 0.2)}
              \sqrt{1 + \Big(\frac{0.15}{\rho - 1}\Big)^2},\; \frac{\Delta}{\sqrt{12}} \Big)
    """
    # An empirical model, not a bound: sigma_0 is measured on prominent line-of-sight sources, the cosine is
    # the geometry of eq. (4), and with falling prominence the error becomes uniform over the searched span
    # Delta.
    uniform = span_rad / np.sqrt(12.0)
    excess = prominence - 1.0
    if excess <= 0.0:
        return float(uniform)
    spread = broadside_std_rad / max(np.cos(azimuth_rad), _MIN_COSINE)
    return float(min(spread * np.hypot(1.0, _PROMINENCE_KNEE / excess), uniform))


def bearing_of(peaks: Sequence[Peak], azimuths_rad: FloatArray, broadside_std_rad: float) -> AcousticBearing:
    """Return the first of the peaks of a grid as a bearing; the middle of the grid if there is none."""
    span = float(azimuths_rad[-1] - azimuths_rad[0])
    if not peaks:
        middle = float(0.5 * (azimuths_rad[0] + azimuths_rad[-1]))
        return AcousticBearing(middle, bearing_std_rad(middle, 1.0, broadside_std_rad, span), 1.0)
    azimuth, prominence = peaks[0].azimuth_rad, peaks[0].prominence
    return AcousticBearing(azimuth, bearing_std_rad(azimuth, prominence, broadside_std_rad, span), prominence)
