r"""SRP-PHAT, its peaks, and the bearing of the strongest source with its standard deviation.

The steered response power after the phase transform over T frames, K bins and M microphones,

.. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k}
          \Big| \sum_m \overline{a_{k,m}(\theta)}\, \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2,

is 1 for a single plane wave from theta and 1/M for noise that is independent between microphones. The SRP of
pyroomacoustics is M^2 / pairs = 2 M / (M - 1) times as large.

Because of noise and reflections, the highest peak is not always the source. The accuracy depends on the ratio
of the wave's power to the remaining power,

.. math:: \gamma = \frac{\hat P - \bar P}{1 - \hat P}, \qquad \bar P = \mathrm{median}_\theta P.

Within the lobe L of the peak, whose width w follows from its curvature, the remaining power displaces the
peak by a part of w. The probability of another direction falls exponentially with its distance from the
peak's power:

.. math:: \sigma^2 = \sigma_0^2 + \Big(\frac{c\, w}{\gamma}\Big)^2
          + \frac{\int_{\theta \notin L} (\theta - \hat\theta)^2 q\, d\theta}{\int q\, d\theta}, \qquad
          w^2 = \frac{\hat P - \bar P}{|P''(\hat\theta)|}, \qquad
          q = \exp \frac{(P - \hat P)_{P > \bar P}}{\tau\, (1 - \hat P)},

with c = 0.024, tau = 0.0125 and sigma_0 = 1 degree. A peak that is not higher than peaks of noise
(`noise_prominence`) has no direction; its deviation is Delta / sqrt(12) for the span Delta of the search. A
reflection in a wall has an equally high and sharp peak, so a single spectrum does not reveal it, but a
sequence of bearings does: see `BearingScatter`.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.spectra.stft import whiten
from worldstate.ground.checks import check_shape
from worldstate.ground.typing import Complex64Array, FloatArray
from worldstate.ground.values import median, vertex, wrap_angle

_TINY = np.finfo(np.float64).tiny


def steered_power(whitened: Complex64Array, steering: Steering) -> FloatArray:
    r"""Return the sum of the beam powers over frames and bins, which can be updated in a running window.

    .. math:: S(\theta) = \sum_{t,k} \Big| \sum_m \overline{a_{k,m}(\theta)}\, Z_{t,k,m} \Big|^2

    Parameters
    ----------
    whitened : ndarray of complex64, shape (frames, bins, M)
        Spectra Z of modulus one.
    steering : Steering
        Beams for the same bins.

    Returns
    -------
    ndarray of float64, shape (directions,)
        Sum of the squared moduli of the beams, at most frames x bins x M^2.

    References
    ----------
    J. DiBiase, H. Silverman and M. Brandstein, "Robust localization in reverberant rooms", in *Microphone
    Arrays*, 2001.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> steering = Steering.towards(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), [500.0], [0.0, 0.5])
    >>> steered_power(np.ones((3, 1, 2), np.complex64), steering).round(1)
    array([12. ,  9.8])
    """
    return np.asarray(steering.quadratic_form(steering.covariance(whitened)).real)


def normalised(total: FloatArray, n_frames: int, n_bins: int, n_microphones: int) -> FloatArray:
    r"""Scale a sum of beam powers to 0..1; negative rounding errors become zero.

    .. math:: P(\theta) = \frac{\max(S(\theta), 0)}{T K M^2}

    Shapes: total (directions,).

    Examples
    --------
    >>> normalised(np.array([8.0, 4.0]), n_frames=1, n_bins=2, n_microphones=2)
    array([1. , 0.5])
    """
    return np.asarray(np.maximum(total, 0.0) / (n_frames * n_bins * n_microphones**2))


def srp_phat(spectra: Complex64Array, steering: Steering) -> FloatArray:
    r"""Return the SRP-PHAT of a set of frames: 1 for a single plane wave, 1/M for independent noise.

    .. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k}
              \Big| \sum_m \overline{a_{k,m}(\theta)}\, \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2

    Parameters
    ----------
    spectra : ndarray of complex64, shape (frames, bins, M)
        STFT of the microphones, at least one frame, any unit.
    steering : Steering
        Beams for the same bins.

    Returns
    -------
    ndarray of float64, shape (directions,)
        Power between 0 and 1.

    Raises
    ------
    InvalidArgumentError
        If the spectra have other axes or another number of bins.

    References
    ----------
    J. DiBiase, H. Silverman and M. Brandstein, "Robust localization in reverberant rooms", in *Microphone
    Arrays*, 2001.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]])
    >>> steering = Steering.towards(array, [500.0], [-0.5, 0.0, 0.5])
    >>> plane_wave = array.steering(500.0, 0.5).transpose(2, 0, 1).astype(np.complex64)
    >>> srp_phat(plane_wave, steering).round(3)
    array([0.408, 0.819, 1.   ])
    """
    check_shape("spectra", spectra.shape, (None, len(steering.weights), None))
    n_frames, n_bins, n_microphones = spectra.shape
    return normalised(steered_power(whiten(spectra), steering), n_frames, n_bins, n_microphones)


# Noise reaches a certain excess with three deviations; a peak below this share of it is considered noise.
# With 4 microphones, the peak of a visible vehicle is below the full excess in a quarter of the hops.
# Accepted noise does little harm: with its many peaks, the bearing has a stated deviation of 50 degrees.
_DEVIATIONS, _SHARE = 3.0, 0.6
_ALL_ROUND_RAD = np.radians(np.arange(-180.0, 180.0, 10.0))


def noise_prominence(
    rows: Sequence[Steering], array: MicrophoneArray, frequencies_hz: FloatArray, n_frames: float
) -> float:
    r"""Return the peak-to-median ratio below which a peak is considered noise.

    Sound that arrives equally from all horizontal directions is the street noise with the least flat
    spectrum. After the phase transform, the power of a beam in a frame and bin is approximately exponentially
    distributed, so the mean over T frames and K bins has the relative deviation epsilon:

    .. math:: D(\theta) = \frac{1}{K} \sum_k d_k(\theta), \qquad
              d_k(\theta) = \Big\langle \frac{|a_k(\theta)^H a_k(\phi)|^2}{M^2} \Big\rangle_\phi, \qquad
              \epsilon = \max_\theta \frac{\sqrt{\sum_k d_k^2(\theta)}}{\sqrt{T} \sum_k d_k(\theta)},

    .. math:: \rho_0 = 1 + 0.6 \Big( (1 + 3 \epsilon)\, \frac{\max_\theta D}{\mathrm{med}_\theta D} - 1 \Big)
    """
    horizon = array.steering(frequencies_hz, _ALL_ROUND_RAD).astype(np.complex64)
    by_row = np.array([row.power_within(horizon) / horizon.shape[2] for row in rows])
    diffuse = by_row.mean(axis=1).max(axis=0)
    # Computed from the last row, because the rows have similar ratios between their bins.
    scatter = np.linalg.norm(by_row[-1], axis=0) / (np.sqrt(n_frames) * by_row[-1].sum(axis=0))
    reached = diffuse.max() / np.median(diffuse) * (1.0 + _DEVIATIONS * scatter.max())
    return float(1.0 + _SHARE * (reached - 1.0))


@dataclass(frozen=True, slots=True)
class Peak:
    r"""A local maximum of a spatial spectrum.

    .. math:: \rho = \hat P / \mathrm{median}_\theta P

    Parameters
    ----------
    azimuth_rad : float
        Azimuth at the interpolated maximum, radians, left positive.
    value : float
        Height at the maximum, in the unit of the spectrum.
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

    A zero spectrum (silence) has no peak. A maximum at an end of the grid is not interpolated.

    Parameters
    ----------
    values : ndarray, shape (A,)
        The spectrum, non-negative, in any unit; it is not checked.
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
    middle = max(float(median(values)), _TINY)
    # Local maxima; for a plateau the first index.
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    candidates = ((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:])).nonzero()[0]
    highest = candidates[(-values[candidates]).argsort(kind="stable")][:max_peaks].tolist()
    peaks = [_interpolate(values, azimuths_rad, index, middle) for index in highest]
    return tuple([peak for peak in peaks if peak.prominence >= 1.0])


def is_all_round(azimuths_rad: FloatArray) -> bool:
    """Return whether a grid (A,) covers a full circle."""
    step = azimuths_rad[1] - azimuths_rad[0]
    return bool(azimuths_rad[-1] - azimuths_rad[0] >= 2.0 * math.pi - 0.5 * step)


def about_the_peak(values: FloatArray, azimuths_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a full-circle spectrum (A,) and its grid, opened opposite the peak; other spectra unchanged.

    The first and the last direction of a full circle are the same, so a source there has one peak.

    Examples
    --------
    >>> grid = np.radians([-180, -90, 0, 90, 180])
    >>> values, grid = about_the_peak(np.array([4.0, 3.0, 1.0, 2.0, 4.0]), grid)
    >>> values.tolist(), np.degrees(grid).round().tolist()
    ([1.0, 2.0, 4.0, 3.0], [-360.0, -270.0, -180.0, -90.0])
    """
    if not is_all_round(azimuths_rad):
        return values, azimuths_rad
    step, count = azimuths_rad[1] - azimuths_rad[0], len(values) - 1
    order = int(values[:-1].argmax()) - count // 2 + np.arange(count)
    return values[:-1].take(order, mode="wrap"), azimuths_rad[0] + step * order


def _interpolate(values: FloatArray, azimuths: FloatArray, index: int, median: float) -> Peak:
    height, shift = float(values[index]), 0.0
    if 0 < index < len(values) - 1:
        left, right = float(values[index - 1]), float(values[index + 1])
        shift = vertex(left, height, right)
        height -= 0.25 * (left - right) * shift
    azimuth = float(azimuths[index] + shift * (azimuths[1] - azimuths[0]))
    return Peak(azimuth if abs(azimuth) <= math.pi else wrap_angle(azimuth), height, height / median)


# Fitted together with _APART by the Gaussian likelihood of the errors: sources in rooms and in the open with
# rings of 4 to 8 microphones, 3 to 10 cm, and visible vehicles in simulated streets with 56, 14, 7 and 4
# microphones.
_DISPLACEMENT, _TEMPERATURE = 0.024, 0.0125
# Smallest deviation: the search has only two elevations, so single waves at random arrays that are not
# horizontal have azimuth errors of 1.1 degrees. Smallest remaining power, against rounding errors.
_LEAST_STD_RAD, _LEAST_REST = float(np.radians(1.0)), 1e-3


@dataclass(frozen=True, slots=True)
class AcousticBearing:
    """Peak of a spatial spectrum as a measurement."""

    azimuth_rad: float  # Left positive
    std_rad: float  # Standard deviation
    prominence: float  # Peak-to-median ratio, >= 1; 1 in silence


def uniform_std_rad(azimuths_rad: FloatArray) -> float:
    """Return the standard deviation of an unknown direction on a grid."""
    return float(azimuths_rad[-1] - azimuths_rad[0]) / math.sqrt(12.0)


def bearing_of(
    spectrum: FloatArray, peaks: Sequence[Peak], azimuths_rad: FloatArray, least_prominence: float
) -> AcousticBearing:
    """Return the first peak of a spectrum (A,) as a bearing; without peaks, the middle of the grid."""
    uniform = uniform_std_rad(azimuths_rad)
    if not peaks:
        return AcousticBearing(float(0.5 * (azimuths_rad[0] + azimuths_rad[-1])), uniform, 1.0)
    best = peaks[0]
    heard = best.prominence > least_prominence
    std = min(_std_rad(spectrum, best, azimuths_rad), uniform) if heard else uniform
    return AcousticBearing(best.azimuth_rad, std, best.prominence)


def _std_rad(spectrum: FloatArray, best: Peak, azimuths_rad: FloatArray) -> float:
    share, peak = best.value * (1.0 - 1.0 / best.prominence), int(spectrum.argmax())
    ratio = share / max(1.0 - best.value, _LEAST_REST)
    excess = np.maximum(spectrum / share - 1.0 / (best.prominence - 1.0), 0.0)
    density = np.exp((excess - excess[peak]) * (ratio / _TEMPERATURE))
    density /= density.sum()
    # Within the peak's own lobe there is no other direction.
    density[peak - _width(excess[peak::-1]) : peak + _width(excess[peak:]) + 1] = 0.0
    others = float(density @ np.square(wrap_angle(azimuths_rad - best.azimuth_rad)))
    # Width of the parabola through the peak, in grid steps; infinite at an end of the grid.
    fall = 3.0 * excess[peak] - excess[peak - 1 : peak + 2].sum()
    width = 1.0 / math.sqrt(fall) if 0 < peak < len(excess) - 1 and fall > 0.0 else math.inf
    moved = _DISPLACEMENT * width * float(azimuths_rad[1] - azimuths_rad[0]) / ratio
    return math.hypot(_LEAST_STD_RAD, moved, math.sqrt(others))


# Number of hops between compared bearings; memory of half a minute; spread. Without the spread, a few sharp
# and consistent bearings, such as those of a reflection, outweigh all contradicting ones: the errors in
# streets are then 1.2 times the stated deviation (0.9 times with it).
_APART, _KEEP, _SPREAD_RAD = 5, math.exp(-1.0 / 300.0), float(np.radians(10.0))


class BearingScatter:
    r"""Increases standard deviations if the bearings of a stream contradict each other, as with reflections.

    .. math:: \sigma_k'^2 = \sigma_k^2 + \frac{\sum_{j \le k} a^{k-j} w_j (\theta_j - \theta_{j-5})^2}
              {\sum_{j \le k} a^{k-j} w_j}, \qquad
              w_j = \frac{1}{\sigma_j^2 + \sigma_{j-5}^2 + (10^\circ)^2}

    Examples
    --------
    >>> scatter = BearingScatter(most_rad=1.0)
    >>> stated = [scatter.widened(AcousticBearing(0.2 * (k % 3), 0.1, 2.0)).std_rad for k in range(7)]
    >>> [round(one, 2) for one in stated]
    [0.1, 0.1, 0.1, 0.1, 0.1, 0.41, 0.33]
    """

    def __init__(self, most_rad: float) -> None:
        self._most_rad, self._sum, self._weight = most_rad, 0.0, 0.0
        self._past: deque[AcousticBearing] = deque(maxlen=_APART)

    def widened(self, bearing: AcousticBearing) -> AcousticBearing:
        """Add the next bearing; return it with a standard deviation that includes the contradictions."""
        if len(self._past) == _APART:
            before = self._past[0]
            weight = 1.0 / (bearing.std_rad**2 + before.std_rad**2 + _SPREAD_RAD**2)
            squared = wrap_angle(bearing.azimuth_rad - before.azimuth_rad) ** 2
            self._sum = _KEEP * self._sum + weight * squared
            self._weight = _KEEP * self._weight + weight
        self._past.append(bearing)
        added = math.sqrt(self._sum / self._weight) if self._weight else 0.0
        std_rad = min(math.hypot(bearing.std_rad, added), self._most_rad)
        return AcousticBearing(bearing.azimuth_rad, std_rad, bearing.prominence)


def _width(side: FloatArray) -> int:
    # Where two rows of elevation intersect, a lobe may rise slightly above half its height.
    later, before = side[1:], side[:-1]
    ends = (((later > before) & (before < 0.5 * side[0])) | (later == 0.0)).nonzero()[0]
    return int(ends[0]) if len(ends) else len(side) - 1


# Simulated streets: none of 4,500 hops with hidden, passed or distant vehicles reaches 0.4 with 56, 7 or 4
# microphones; a quarter of the hops with a vehicle in the open behind the ego does. Sources in the open, 10
# dB above the ambience, have 0.48 (4 microphones) to 0.67 (56) in nine of ten hops. Real windows of hidden
# vehicles are below 0.25.
_MIDDLE, _WIDTH = 0.4, 0.03
# Smallest height of a second peak above the median, relative to the first, that shows two sources.
_SECOND = 0.6


def direct_probability(peaks: Sequence[Peak]) -> float:
    r"""Return the probability that the highest peak is a source in the open, from its share of the power.

    .. math:: s = \frac{\hat P - \bar P}{1 - \bar P}, \qquad P(direct) = \frac{1}{1 + e^{-(s - 0.4) / 0.03}}

    with the highest peak of SRP-PHAT and its median. Reflected sound arrives from many directions and has a
    small share.

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
