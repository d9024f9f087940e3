r"""Peaks of a spatial spectrum, and the bearing of the strongest source with its standard deviation.

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

from worldstate.ground.typing import FloatArray, IndexArray


@dataclass(frozen=True, slots=True)
class Peak:
    r"""A local maximum of a spatial spectrum.

    .. math:: \rho = \hat P / \mathrm{median}_\theta P

    Parameters
    ----------
    azimuth_rad : float
        Azimuth at the interpolated maximum, radians, left positive.
    value : float
        Height there, in the unit of the spectrum.
    prominence : float
        Peak-to-median ratio, >= 1 for the highest peak.

    Examples
    --------
    >>> Peak(0.3, 0.5, 1.4).prominence
    1.4
    """

    azimuth_rad: float
    value: float
    prominence: float


def find_peaks(values: FloatArray, azimuths_rad: FloatArray, max_peaks: int = 4) -> tuple[Peak, ...]:
    r"""Find the highest local maxima, interpolated by a parabola through three grid points.

    With P at the grid point i of a maximum and at its neighbours,

    .. math:: \delta = \frac{P_{i-1} - P_{i+1}}{2 (P_{i-1} - 2 P_i + P_{i+1})}, \qquad
              \hat\theta = \theta_i + \delta\, \Delta\theta, \qquad
              \hat P = P_i - \tfrac14 (P_{i-1} - P_{i+1})\, \delta.

    A spectrum of zeros (silence) has no peak. A maximum at an end of the grid is not interpolated.

    Parameters
    ----------
    values : ndarray, shape (A,)
        The spectrum, non-negative, any unit; it is not checked.
    azimuths_rad : ndarray, shape (A,)
        Ascending, evenly spaced, radians; A >= 2.
    max_peaks : int
        Largest number of peaks.

    Returns
    -------
    tuple of Peak
        Highest first; empty in silence.

    References
    ----------
    J. O. Smith and X. Serra, "PARSHL: an analysis/synthesis program for non-harmonic sounds", ICMC 1987 (the
    parabola).

    Examples
    --------
    >>> grid = np.radians(np.arange(-90.0, 91.0))
    >>> beam = 0.1 + np.exp(-((grid - 0.30) ** 2) / 0.02) + 0.5 * np.exp(-((grid + 0.60) ** 2) / 0.02)
    >>> [(round(p.azimuth_rad, 3), round(p.value, 3)) for p in find_peaks(beam, grid)]
    [(0.3, 1.1), (-0.6, 0.6)]
    """
    if values.max() <= 0.0:
        return ()
    median = max(float(np.median(values)), np.finfo(np.float64).tiny)
    candidates = _local_maxima(values)
    highest = candidates[np.argsort(-values[candidates], kind="stable")][:max_peaks]
    peaks = (_interpolate(values, azimuths_rad, int(index), median) for index in highest)
    return tuple(peak for peak in peaks if peak.prominence >= 1.0)


def _local_maxima(values: FloatArray) -> IndexArray:
    """Return the indices of local maxima; of a plateau the first."""
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    return np.flatnonzero((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]))


def _interpolate(values: FloatArray, azimuths: FloatArray, index: int, median: float) -> Peak:
    height, shift = float(values[index]), 0.0
    if 0 < index < len(values) - 1:
        left, right = float(values[index - 1]), float(values[index + 1])
        bend = left - 2.0 * height + right
        shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
        height -= 0.25 * (left - right) * shift
    azimuth = azimuths[index] + shift * (azimuths[1] - azimuths[0])
    return Peak(float(azimuth), height, height / median)


# Exponent and share were set on simulated streets (docs/bearing.md): of vehicles in view the error over the
# stated deviation has a root mean square of .9 to 1.4 with 56, 14, 7 and 4 microphones. The exponent 2
# states twice too much with 4.
_REVERBERANT_SHARE = 0.08
# Of a lone vehicle at broadside.
_LONE_STD_RAD = float(np.radians(3.4))
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
) -> AcousticBearing:
    """Return the first of the peaks of a spectrum (A,) as a bearing; the middle of the grid if none."""
    uniform = float(azimuths_rad[-1] - azimuths_rad[0]) / np.sqrt(12.0)
    if not peaks:
        return AcousticBearing(float(0.5 * (azimuths_rad[0] + azimuths_rad[-1])), uniform, 1.0)
    best = peaks[0]
    std = uniform
    if best.prominence > least_prominence:
        std = min(_std_rad(spectrum, best, azimuths_rad, uniform), uniform)
    return AcousticBearing(best.azimuth_rad, std, best.prominence)


def _std_rad(spectrum: FloatArray, best: Peak, azimuths_rad: FloatArray, uniform: float) -> float:
    share = best.value * (1.0 - 1.0 / best.prominence)
    excess = np.maximum(spectrum / share - 1.0 / (best.prominence - 1.0), 0.0)
    density = np.square(np.square(excess))
    total = density.sum()
    first, last = _lobe(excess, int(spectrum.argmax()))
    density[first : last + 1] = 0.0
    others = float(density @ np.square(azimuths_rad - best.azimuth_rad) / total)
    astray = min(0.5 * (_REVERBERANT_SHARE / share) ** 2, 1.0)
    lone = _LONE_STD_RAD / max(np.cos(best.azimuth_rad), _MIN_COSINE)
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
