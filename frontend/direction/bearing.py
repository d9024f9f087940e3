r"""Bearing of the strongest source, with a standard deviation that knows other peaks and the noise.

A spatial spectrum of a street has several peaks, and the highest is not always the vehicle: walls reflect it,
and another source may be as loud. What exceeds the median of the spectrum is read as a density over azimuth,

.. math:: q(\theta) \propto \Big(\frac{P(\theta) - \bar P}{\hat P - \bar P}\Big)_+^4, \qquad
          \bar P = \mathrm{median}_\theta P,

and all of it outside the lobe L of the peak is the chance that another peak is the right one. A weak plane
wave among many is taken at random from all directions with probability p:

.. math:: \sigma^2 = \frac{\sigma_0^2}{\max(\cos\hat\theta, .2)^2}
          + (1 - p) \int_{\theta \notin L} (\theta - \hat\theta)^2 q\, d\theta + p\, \frac{\Delta^2}{12},
          \qquad p = \min\Big(\frac12 \Big(\frac{w_0}{\hat P - \bar P}\Big)^2, 1\Big)

with the span Delta of the search, the share :math:`\hat P - \bar P` of the plane wave, w_0 = .08, and the
error sigma_0 of a lone source at broadside. A peak no higher than that of noise (`noise_prominence`) has no
direction: Delta / sqrt(12).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray

from .peaks import Peak

# Exponent and share were set on simulated streets (docs/bearing.md): of vehicles in view the error over the
# stated deviation has a root mean square of .9 to 1.4 with 56, 14, 7 and 4 microphones. The exponent 2
# states twice too much with 4.
_REVERBERANT_SHARE = 0.08
# Beyond 78 degrees from broadside the law 1/cos is cut: it has no meaning within a beamwidth of endfire.
_MIN_COSINE = 0.2


@dataclass(frozen=True, slots=True)
class AcousticBearing:
    """Peak of a spatial spectrum as a measurement."""

    azimuth_rad: float  # Left positive
    std_rad: float  # Standard deviation
    prominence: float  # Peak-to-median ratio, >= 1; 1 in silence


def bearing_of(
    spectrum: FloatArray,
    peaks: Sequence[Peak],
    azimuths_rad: FloatArray,
    least_prominence: float,
    lone_std_rad: float,
) -> AcousticBearing:
    """Return the first of the peaks of a spectrum (A,) as a bearing; the middle of the grid if none."""
    uniform = float(azimuths_rad[-1] - azimuths_rad[0]) / np.sqrt(12.0)
    if not peaks:
        return AcousticBearing(float(0.5 * (azimuths_rad[0] + azimuths_rad[-1])), uniform, 1.0)
    best = peaks[0]
    std = uniform
    if best.prominence > least_prominence:
        std = min(_std_rad(spectrum, best, azimuths_rad, lone_std_rad, uniform), uniform)
    return AcousticBearing(best.azimuth_rad, std, best.prominence)


def _std_rad(
    spectrum: FloatArray, best: Peak, azimuths_rad: FloatArray, lone_std_rad: float, uniform: float
) -> float:
    share = best.value * (1.0 - 1.0 / best.prominence)
    excess = np.maximum(spectrum / share - 1.0 / (best.prominence - 1.0), 0.0)
    density = np.square(np.square(excess))
    total = density.sum()
    first, last = _lobe(excess, int(spectrum.argmax()))
    density[first : last + 1] = 0.0
    others = float(density @ np.square(azimuths_rad - best.azimuth_rad) / total)
    astray = min(0.5 * (_REVERBERANT_SHARE / share) ** 2, 1.0)
    lone = lone_std_rad / max(np.cos(best.azimuth_rad), _MIN_COSINE)
    return float(np.sqrt(lone**2 + (1.0 - astray) * others + astray * uniform**2))


def _lobe(excess: FloatArray, peak: int) -> tuple[int, int]:
    """Return the first and last index of the lobe around a peak: up to where it rises again or is zero."""
    return peak - _width(excess[peak::-1]), peak + _width(excess[peak:])


def _width(side: FloatArray) -> int:
    # Where two rows of elevation cross, a lobe may rise a little above half its height.
    rises = (np.diff(side) > 0.0) & (side[:-1] < 0.5 * side[0])
    ends = np.flatnonzero(rises | (side[1:] == 0.0))
    return int(ends[0]) if len(ends) else len(side) - 1


# Simulated streets: of 4,500 hops of hidden, passed and distant vehicles none has .4 with 56, 7 or 4
# microphones; of those with a vehicle in the open behind the ego a quarter has. Sources in the open, 10 dB
# above ambience: .48 (4 microphones) to .67 (56) in nine of ten. Real windows of hidden vehicles: below .25.
_MIDDLE, _WIDTH = 0.4, 0.03
# Height above the median, relative to the peak, of another that makes them two.
_SECOND = 0.6


def direct_probability(peaks: Sequence[Peak]) -> float:
    r"""Return the probability that the highest peak is a source in the open, by how much is one plane wave.

    .. math:: s = \frac{\hat P - \bar P}{1 - \bar P}, \qquad P(direct) = \frac{1}{1 + e^{-(s - .4) / .03}}

    with the highest peak of SRP-PHAT and its median. Where walls reflect it, sound comes from many
    directions.

    Examples
    --------
    >>> one, weak, other = Peak(0.6, 0.8, 8.0), Peak(0.6, 0.3, 3.0), Peak(-0.6, 0.7, 7.0)
    >>> [round(direct_probability(peaks), 2) for peaks in ((one,), (weak,), (one, other))]
    [1.0, 0.0, 0.0]
    """
    if not peaks:
        return 0.0
    best = peaks[0]
    median = best.value / best.prominence
    excess = best.value - median
    if any(peak.value - median > _SECOND * excess for peak in peaks[1:]):
        return 0.0
    return 1.0 / (1.0 + math.exp((_MIDDLE - excess / (1.0 - median)) / _WIDTH)) if median < 1.0 else 0.0
