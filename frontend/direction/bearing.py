r"""SRP-PHAT, its peaks, and the bearing of the strongest source with its standard deviation.

The steered response power after the phase transform over T frames, K bins and M microphones,

.. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k}
          \Big| \sum_m \overline{a_{k,m}(\theta)}\, \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2,

is 1 for a single plane wave from theta, 1/M for noise that is independent between microphones. The SRP of
pyroomacoustics is M^2 / pairs = 2 M / (M - 1) times as large.

A spatial spectrum has several peaks, and the highest is not always the source: noise adds to one, walls
reflect. What decides is the power of the wave over that of all the rest,

.. math:: \gamma = \frac{\hat P - \bar P}{1 - \hat P}, \qquad \bar P = \mathrm{median}_\theta P.

Within the lobe L of the peak, of width w by the curvature of its top, the rest moves the top by a share of w,
and the chance that another direction is the right one falls exponentially with what it lacks:

.. math:: \sigma^2 = \sigma_0^2 + \Big(\frac{c\, w}{\gamma}\Big)^2
          + \frac{\int_{\theta \notin L} (\theta - \hat\theta)^2 q\, d\theta}{\int q\, d\theta}, \qquad
          w^2 = \frac{\hat P - \bar P}{|P''(\hat\theta)|}, \qquad
          q = \exp \frac{(P - \hat P)_{P > \bar P}}{\tau\, (1 - \hat P)},

with c = .024, tau = .0125 and sigma_0 = 1 degree. A peak no higher than that of noise (`noise_prominence`)
has no direction: Delta / sqrt(12) of the span Delta of the search. That of an image in a wall is as high and
as sharp as any, which no spectrum shows; a stream of bearings does: see `BearingScatter`.
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
from worldstate.ground.typing import Complex64Array, FloatArray, IndexArray
from worldstate.ground.values import median, vertex, wrap_angle

_TINY = np.finfo(np.float64).tiny


def steered_power(whitened: Complex64Array, steering: Steering) -> FloatArray:
    r"""Sum the beam powers over frames and bins, the part of SRP that adds up over a running window.

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
    r"""Scale a sum of beam powers to 0..1; negative round-off is set to zero.

    .. math:: P(\theta) = \frac{\max(S(\theta), 0)}{T K M^2}

    Shapes: total (directions,).

    Examples
    --------
    >>> normalised(np.array([8.0, 4.0]), n_frames=1, n_bins=2, n_microphones=2)
    array([1. , 0.5])
    """
    return np.asarray(np.maximum(total, 0.0) / (n_frames * n_bins * n_microphones**2))


def srp_phat(spectra: Complex64Array, steering: Steering) -> FloatArray:
    r"""Compute SRP-PHAT of a set of frames: 1 for a single plane wave, 1/M for independent noise.

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
        Between 0 and 1.

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


# What three deviations reach in all directions together is called noise only up to this share of its excess:
# a vehicle in view, heard by 4 microphones, has a lower peak in a quarter of the hops, and a bearing of
# noise that is let through states 50 degrees, for it has many peaks.
_DEVIATIONS, _SHARE = 3.0, 0.6
_ALL_ROUND_RAD = np.radians(np.arange(-180.0, 180.0, 10.0))


def noise_prominence(
    rows: Sequence[Steering], array: MicrophoneArray, frequencies_hz: FloatArray, n_frames: float
) -> float:
    r"""Return the peak-to-median ratio up to which a peak is taken for noise.

    Sound that comes from all horizontal directions alike is the noise of a street whose spectrum is least
    flat. After the phase transform the power of a beam in a frame and bin is about exponentially distributed,
    so that the mean over T frames and K bins scatters by epsilon:

    .. math:: D(\theta) = \frac{1}{K} \sum_k d_k(\theta), \qquad
              d_k(\theta) = \Big\langle \frac{|a_k(\theta)^H a_k(\phi)|^2}{M^2} \Big\rangle_\phi, \qquad
              \epsilon = \max_\theta \frac{\sqrt{\sum_k d_k^2(\theta)}}{\sqrt{T} \sum_k d_k(\theta)},

    .. math:: \rho_0 = 1 + 0.6 \Big( (1 + 3 \epsilon)\, \frac{\max_\theta D}{\mathrm{med}_\theta D} - 1 \Big)
    """
    horizon = array.steering(frequencies_hz, _ALL_ROUND_RAD).astype(np.complex64)
    by_row = np.array([row.power_within(horizon) / horizon.shape[2] for row in rows])
    diffuse = by_row.mean(axis=1).max(axis=0)
    # Of the last row: rows differ little in how their bins share the power.
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
    middle = max(float(median(values)), _TINY)
    candidates = _local_maxima(values)
    highest = candidates[(-values[candidates]).argsort(kind="stable")][:max_peaks].tolist()
    peaks = [_interpolate(values, azimuths_rad, index, middle) for index in highest]
    return tuple([peak for peak in peaks if peak.prominence >= 1.0])


def is_all_round(azimuths_rad: FloatArray) -> bool:
    """Return whether a grid (A,) ends where it begins."""
    step = azimuths_rad[1] - azimuths_rad[0]
    return bool(azimuths_rad[-1] - azimuths_rad[0] >= 2.0 * math.pi - 0.5 * step)


def about_the_peak(values: FloatArray, azimuths_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a spectrum (A,) all round, and its grid, cut open behind its peak; any other as it is.

    Where the search begins and ends is the same direction: a source there has one peak, not half of two.

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


def _local_maxima(values: FloatArray) -> IndexArray:
    """Return the indices of local maxima; of a plateau the first."""
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    return ((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:])).nonzero()[0]


def _interpolate(values: FloatArray, azimuths: FloatArray, index: int, median: float) -> Peak:
    height, shift = float(values[index]), 0.0
    if 0 < index < len(values) - 1:
        left, right = float(values[index - 1]), float(values[index + 1])
        shift = vertex(left, height, right)
        height -= 0.25 * (left - right) * shift
    azimuth = float(azimuths[index] + shift * (azimuths[1] - azimuths[0]))
    return Peak(azimuth if abs(azimuth) <= math.pi else wrap_angle(azimuth), height, height / median)


# Fitted with _APART to sources in rooms and in the open on rings of 4 to 8 microphones, 3 to 10 cm, and to
# vehicles in view in simulated streets heard by 56, 14, 7 and 4, by the Gaussian likelihood of the errors.
_DISPLACEMENT, _TEMPERATURE = 0.024, 0.0125
# Elevations between the two that are searched move the azimuth of an array that is not level: lone waves on
# arrays drawn at random are off by 1.1 degrees. And the least rest, where rounding would decide.
_LEAST_STD_RAD, _LEAST_REST = float(np.radians(1.0)), 1e-3


@dataclass(frozen=True, slots=True)
class AcousticBearing:
    """Peak of a spatial spectrum as a measurement."""

    azimuth_rad: float  # Left positive
    std_rad: float  # Standard deviation
    prominence: float  # Peak-to-median ratio, >= 1; 1 in silence


def uniform_std_rad(azimuths_rad: FloatArray) -> float:
    """Return the standard deviation of a direction that may be anywhere on a grid."""
    return float(azimuths_rad[-1] - azimuths_rad[0]) / math.sqrt(12.0)


def bearing_of(
    spectrum: FloatArray, peaks: Sequence[Peak], azimuths_rad: FloatArray, least_prominence: float
) -> AcousticBearing:
    """Return the first of the peaks of a spectrum (A,) as a bearing; the middle of the grid if none."""
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
    # Within the peak's own lobe nothing is another direction.
    density[peak - _width(excess[peak::-1]) : peak + _width(excess[peak:]) + 1] = 0.0
    others = float(density @ np.square(wrap_angle(azimuths_rad - best.azimuth_rad)))
    moved = _DISPLACEMENT * _top_width(excess, peak) * float(azimuths_rad[1] - azimuths_rad[0]) / ratio
    return math.hypot(_LEAST_STD_RAD, moved, math.sqrt(others))


def _top_width(excess: FloatArray, peak: int) -> float:
    """Return the width of a parabola of height one on a peak, in steps; infinite at an end of the grid."""
    fall = 3.0 * excess[peak] - excess[peak - 1 : peak + 2].sum()
    return 1.0 / math.sqrt(fall) if 0 < peak < len(excess) - 1 and fall > 0.0 else math.inf


# Hops; the memory is half a minute. Without the spread in the weights a few sharp bearings that agree, as of
# an image in a wall, outweigh all that contradict: streets are off by 1.2 times what is stated instead of .9.
_APART, _KEEP, _SPREAD_RAD = 5, math.exp(-1.0 / 300.0), float(np.radians(10.0))


class BearingScatter:
    r"""How far the bearings of a stream contradict one another, as where walls reflect.

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
        """Take the next bearing; return it with what the stream adds to its standard deviation."""
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
    # Where two rows of elevation cross, a lobe may rise a little above half its height.
    later, before = side[1:], side[:-1]
    ends = (((later > before) & (before < 0.5 * side[0])) | (later == 0.0)).nonzero()[0]
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
