"""Peaks of a spatial spectrum: azimuth, height and prominence."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
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


def find_peaks(spectrum: ArrayLike, azimuths_rad: ArrayLike, *, max_peaks: int = 4) -> tuple[Peak, ...]:
    r"""Find the highest local maxima, interpolated by a parabola through three grid points.

    With P at the grid point i of a maximum and at its neighbours,

    .. math:: \delta = \frac{P_{i-1} - P_{i+1}}{2 (P_{i-1} - 2 P_i + P_{i+1})}, \qquad
              \hat\theta = \theta_i + \delta\, \Delta\theta, \qquad
              \hat P = P_i - \tfrac14 (P_{i-1} - P_{i+1})\, \delta.

    A spectrum of zeros (silence) has no peak. A maximum at an end of the grid is not interpolated.

    Parameters
    ----------
    spectrum : array_like, shape (A,)
        Non-negative, any unit.
    azimuths_rad : array_like, shape (A,)
        Ascending, evenly spaced, radians; A >= 3.
    max_peaks : int
        Largest number of peaks.

    Returns
    -------
    tuple of Peak
        Highest first; empty in silence.

    Raises
    ------
    InvalidArgumentError
        On another shape, fewer than three points, NaN or infinity.

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
    azimuths = finite_array("azimuths_rad", azimuths_rad, (None,))
    values = finite_array("spectrum", spectrum, azimuths.shape)
    if len(values) < 3:
        raise InvalidArgumentError(f"azimuths_rad: expected at least three points, got {len(values)}")
    return highest_peaks(values, azimuths, max_peaks)


def highest_peaks(values: FloatArray, azimuths: FloatArray, max_peaks: int) -> tuple[Peak, ...]:
    """Return what `find_peaks` finds in arrays that are finite and fit each other.

    Shapes: values (A,), azimuths (A,).
    """
    if values.max() <= 0.0:
        return ()
    median = max(float(np.median(values)), np.finfo(np.float64).tiny)
    candidates = _local_maxima(values)
    highest = candidates[np.argsort(-values[candidates], kind="stable")][:max_peaks]
    peaks = (_interpolate(values, azimuths, int(index), median) for index in highest)
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
