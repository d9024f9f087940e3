r"""Track the fundamental of an engine from its harmonics.

The harmonic sum scores every candidate in every window, and `best_path` selects the track with the highest
total score. The frequency of each partial is then measured along this track (`Windows`). Finally, all
partials are combined into the fundamental and its variance. Their reduced chi-squared checks harmonic
consistency: it is near one if the partials are multiples of one fundamental.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy import ndimage

from worldstate.ground import InvalidArgumentError, finite_array, in_range
from worldstate.ground.typing import Complex128Array, FloatArray, IndexArray

from .tone import MEDIAN_OF_EXPONENTIAL

# Half way between two bins, the Hann window loses 1.4 dB without padding and 0.1 dB with fourfold padding.
ZERO_PADDING = 4
BAND_HIGH_HZ = 1200.0  # Highest partial used
WINDOW_S, STEP_S = 0.25, 0.1  # Analysis window (Hann) and its step
_MOST_RATE_HZ = 0.4  # Largest relative change of the fundamental, |df/dt| / f, per second
# q, nats per partial. An empty partial has 0.6 nats on average. With a lower price, f / 2 would have the
# highest score; with a much higher price, 2 f would have it if upper harmonics are missing.
_PARTIAL_PRICE = 1.0
_FLOOR_WIDTH_HZ = 250.0  # Width of the running median that estimates the noise floor


# Range of the fundamental that the window resolves (firing frequencies: 20 to 200 Hz); most partials used.
LOW_HZ, HIGH_HZ, MOST_HARMONICS = 25.0, 200.0, 20


def spectrum_and_floor(frames: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    r"""Return power and noise floor of zero-padded windows up to the highest partial, (K, bins) each.

    .. math:: P_k[b] = \Big| \sum_n x_k[n]\, e^{-j 2\pi b n / 4N} \Big|^2, \qquad
              \nu_k[b] = \frac{1}{\ln 2}\, \mathrm{median}_{b'}\, P_k[b'] \text{ around } b

    Shapes: frames (K, n).
    """
    size = ZERO_PADDING * frames.shape[1]
    keep = int(np.ceil(BAND_HIGH_HZ * 1.02 * size / rate)) + 2
    power = np.abs(np.fft.rfft(frames, size)[:, :keep]) ** 2
    # A running median as the floor (ordered statistics, as in Rohling 1983), because a partial would raise a
    # mean. The padded bins are interpolations, so every fourth is sufficient for the median.
    width = round(_FLOOR_WIDTH_HZ * frames.shape[1] / rate) | 1
    floor = ndimage.median_filter(power[:, ::ZERO_PADDING], size=(1, width), mode="nearest")
    grid = np.arange(keep)
    spread = np.stack([np.interp(grid, grid[::ZERO_PADDING], row) for row in floor])
    least = np.finfo(float).tiny + 1e-12 * power.max()
    return power, np.maximum(spread / MEDIAN_OF_EXPONENTIAL, least)


def best_path(ratio: FloatArray, bin_hz: float) -> FloatArray:
    r"""Return the track of the fundamental with the highest score on a logarithmic grid, shape (K,), Hz.

    The score of a candidate f in window k is computed from the power P of its partials and the noise floor,

    .. math:: Q_k(f) = \sum_h \big[\ln(1 + P_k(h f) / \nu_k(h f)) - q\big],

    where the price q per partial lowers the score of f / 2: half of its partials are empty. The rate of
    change along the track is limited.

    Source: A. M. Noll, "Pitch determination of human speech by the harmonic product spectrum, the harmonic
    sum spectrum and a maximum likelihood estimate", 1969; the track by A. J. Viterbi's algorithm, 1967.

    .. math:: \hat f = \arg\max_{f_1 .. f_K} \sum_k \Big[ Q_k(f_k) - \frac{(i_k - i_{k-1})^2}{r^2} \Big],
              \qquad |i_k - i_{k-1}| \le r

    with i_k the index of f_k on the grid, and r the largest change between windows.

    Shapes: ratio (K, bins).
    """
    # Half a resolution at the highest partial, so that no partial is between two candidates.
    step = 0.5 / (WINDOW_S * BAND_HIGH_HZ)
    grid = np.geomspace(LOW_HZ, HIGH_HZ, int(np.log(HIGH_HZ / LOW_HZ) / step) + 2)
    gain = np.log1p(ratio) - _PARTIAL_PRICE
    evidence = np.zeros((len(ratio), len(grid)))
    for h in range(1, MOST_HARMONICS + 1):
        inside = h * grid <= BAND_HIGH_HZ
        evidence[:, inside] += gain[:, np.round(h * grid[inside] / bin_hz).astype(np.intp)]
    reach = max(1, int(np.ceil(_MOST_RATE_HZ * STEP_S / step)))
    return np.asarray(grid[_viterbi(evidence, reach)])


def _viterbi(evidence: FloatArray, reach: int) -> IndexArray:
    """Return the indices of the best path with steps of at most `reach`; a full step costs one nat."""
    offsets = np.arange(-reach, reach + 1)
    cost = (offsets / reach) ** 2
    columns = np.arange(evidence.shape[1])
    score, back = evidence[0], np.zeros(evidence.shape, dtype=np.intp)
    for k in range(1, len(evidence)):
        padded = np.pad(score, reach, constant_values=-np.inf)
        reached = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1) - cost
        best = np.argmax(reached, axis=1)
        back[k] = columns + offsets[best]
        score = evidence[k] + reached[columns, best]
    path = np.empty(len(evidence), dtype=np.intp)
    path[-1] = np.argmax(score)
    for k in range(len(evidence) - 1, 0, -1):
        path[k - 1] = back[k, path[k]]
    return path


# Largest correction in one Newton step, in resolutions 1 / window: near the edge of the main lobe.
REACH = 0.75
# Smallest ratio of power and floor for a partial to be used in the combined estimate.
_LEAST_SNR = 15.0


@dataclass(frozen=True, slots=True)
class HarmonicTrack:
    """Fundamental over time; windows without a usable partial are omitted."""

    time_s: FloatArray  # Centre of each window from the first sample, on the receiver's clock
    frequency_hz: FloatArray  # Fundamental
    # Variance of the fundamental from the SNR of its partials, increased if they disagree
    variance_hz2: FloatArray
    n_partials: IndexArray  # Number of partials used
    # Reduced chi-squared of harmonic consistency; 0 with a single partial, which cannot be checked
    misfit: FloatArray
    level_db: FloatArray  # Power of all partials, 10 log10, relative to samples of unit mean square
    windows: int  # Number of analysed windows, K of them usable


@dataclass(frozen=True, slots=True)
class Windows:
    r"""Samples of every window and the noise floor of their spectra.

    Each partial is demodulated with the current track and its slope, so that a gliding partial stays narrow.
    A Newton step then moves its frequency to the maximum of the windowed periodogram. To first order in the
    noise, with n counted from the centre of the window w,

    .. math:: \sigma_h^2 = \frac{1}{2\,\mathrm{SNR}} \frac{(\sum w)^2}{\sum w^2}
              \frac{\sum w^2 n^2}{(\sum w n^2)^2}, \qquad \mathrm{SNR} = \text{peak power over floor}.

    The partials are combined by

    .. math:: \hat f = \frac{\sum_h h f_h / \sigma_h^2}{\sum_h h^2 / \sigma_h^2}, \qquad
              \chi^2 = \frac{1}{H - 1} \sum_h \frac{(f_h - h \hat f)^2}{\sigma_h^2}.

    Source: the variance is the first-order perturbation of the windowed maximum of Rife and Boorstyn 1974.
    """

    time_s: FloatArray  # Centres of the windows
    frames: FloatArray  # Samples, not windowed
    shape: FloatArray  # The window
    floor: FloatArray  # Noise power of the windowed, zero-padded spectra
    rate_hz: float  # Sample rate

    @property
    def n(self) -> FloatArray:
        """Sample index from the centre of the window, (n,)."""
        return np.asarray(np.arange(len(self.shape)) - 0.5 * (len(self.shape) - 1), dtype=np.float64)


def measure_fundamental(
    windows: Windows, fundamental_hz: FloatArray, slope_hz_s: FloatArray
) -> HarmonicTrack:
    r"""Refine a track of the fundamental with all its partials; windows without partials are marked.

    .. math:: \hat f = \frac{\sum_h h f_h / \sigma_h^2}{\sum_h h^2 / \sigma_h^2}, \qquad
              \mathrm{var}(\hat f) = \frac{\max(\chi^2, 1)}{\sum_h h^2 / \sigma_h^2}

    Shapes: fundamental_hz, slope_hz_s (K,).
    """
    partials = np.arange(1, min(MOST_HARMONICS, int(BAND_HIGH_HZ / fundamental_hz.min())) + 1)
    n, rate = windows.n, windows.rate_hz
    turn = np.outer(fundamental_hz, n / rate) + 0.5 * np.outer(slope_hz_s, (n / rate) ** 2)
    back = np.exp(-2j * np.pi * turn)
    demodulated = np.asarray(windows.shape * windows.frames, dtype=np.complex128)
    measured = []
    for h in partials:
        demodulated *= back
        measured.append(_partial(windows, demodulated, h * fundamental_hz))
    frequency, variance, power = (np.stack(part, axis=1) for part in zip(*measured, strict=True))
    # All partials combined into one fundamental per window, with inverse variances as weights.
    weight = 1.0 / variance
    count = np.count_nonzero(weight, axis=1)
    information = np.maximum((weight * partials**2).sum(axis=1), np.finfo(float).tiny)
    fundamental = (weight * partials * frequency).sum(axis=1) / information
    squares = (weight * (frequency - np.outer(fundamental, partials)) ** 2).sum(axis=1)
    misfit = np.where(count > 1, squares / np.maximum(count - 1, 1), 0.0)
    # A tone of amplitude A peaks at (A sum(w) / 2)^2 and has mean square A^2 / 2.
    mean_square = 2.0 * power.sum(axis=1) / windows.shape.sum() ** 2
    with np.errstate(divide="ignore"):
        level_db = 10.0 * np.log10(mean_square)
    variance = np.maximum(misfit, 1.0) / information
    return HarmonicTrack(windows.time_s, fundamental, variance, count, misfit, level_db, len(count))


def _partial(
    windows: Windows, demodulated: Complex128Array, expected_hz: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return frequency, variance and power of a partial in each window; infinite variance if too weak."""
    n, w, turns = windows.n, windows.shape, windows.rate_hz / (2 * np.pi)
    shift, peak = _newton_shift(demodulated, n)
    bins = np.round(expected_hz * ZERO_PADDING * len(n) / windows.rate_hz).astype(np.intp)
    floor = windows.floor[np.arange(len(bins)), np.minimum(bins, windows.floor.shape[1] - 1)]
    snr = peak / floor
    use = (snr >= _LEAST_SNR) & (np.abs(shift) < 2 * np.pi * REACH / len(n)) & (expected_hz <= BAND_HIGH_HZ)
    # Variance of the peak of a windowed periodogram, (rad per sample)^2 at unit SNR.
    spread = np.sum(w**2 * n**2) / np.sum(w * n**2) ** 2
    unit = float(0.5 * w.sum() ** 2 / np.sum(w**2) * spread)
    variance = unit / np.maximum(snr, 1.0) * turns**2
    return expected_hz + shift * turns, np.where(use, variance, np.inf), np.where(use, peak - floor, 0.0)


def _newton_shift(demodulated: Complex128Array, n: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the Newton step (rad) from d = 0 to the peak of |sum z exp(-j d n)|^2, and the peak value."""
    s0, s1, s2 = (demodulated @ np.stack([np.ones_like(n), n, n**2], axis=1)).T
    height = np.abs(s0) ** 2
    slope = 2.0 * (s0.conj() * s1).imag
    curvature = 2.0 * (np.abs(s1) ** 2 - (s0.conj() * s2).real)
    reach = 2 * np.pi * REACH / len(n)
    step = np.divide(-slope, curvature, out=np.sign(slope) * reach, where=curvature < 0)
    step = np.clip(step, -reach, reach)
    return step, np.maximum(height + slope * step + 0.5 * curvature * step**2, height)


# Each pass measures along the track and the slope of the previous pass.
PASSES = 3
# Longest signal per call: an hour at 48 kHz has 1.7e8 samples.
MAX_SAMPLES = 200_000_000


def track_fundamental(samples: ArrayLike, sample_rate_hz: float) -> HarmonicTrack:
    r"""Track the fundamental of the strongest harmonic series in one channel.

    .. math:: f^{(0)} = \arg\max_{f_1 .. f_K} \sum_k Q_k(f_k), \qquad
              f_k = \frac{\sum_h h f_{k,h} / \sigma_{k,h}^2}{\sum_h h^2 / \sigma_{k,h}^2}

    with the evidence :math:`Q_k(f) = \sum_h [\ln(1 + P_k(h f) / \nu_k(h f)) - q]` of the harmonics over the
    noise floor :math:`\nu` and the frequencies :math:`f_{k,h}` of the partials with variances
    :math:`\sigma_{k,h}^2`.

    Parameters
    ----------
    samples : array_like, shape (n,)
        One microphone or one beam, at least one window long.
    sample_rate_hz : float
        Samples per second, at least three times the highest partial.

    Returns
    -------
    HarmonicTrack
        Frequencies in Hz at the centres of the windows; empty if nothing exceeds the noise.

    Raises
    ------
    InvalidArgumentError
        If the shape is wrong, samples are too few or not finite, or the sample rate is too low.

    References
    ----------
    A. M. Noll, "Pitch determination of human speech by the harmonic product spectrum, the harmonic sum
    spectrum and a maximum likelihood estimate", 1969; A. J. Viterbi, IEEE Trans. IT 13, 1967 (the track); D.
    C. Rife and R. R. Boorstyn, IEEE Trans. IT 20, 1974 (the variance of a partial).

    Examples
    --------
    >>> t = np.arange(8000) / 4000.0
    >>> noise = np.random.default_rng(0).normal(size=t.size)
    >>> engine = sum(np.cos(2 * np.pi * h * 60.5 * t + h) for h in (1, 2, 3, 4, 6))
    >>> track = track_fundamental(engine + noise, 4000.0)
    >>> bool(np.abs(track.frequency_hz - 60.5).max() < 0.3)
    True
    """
    x = finite_array("samples", samples, (None,))
    rate = in_range("sample_rate_hz", sample_rate_hz, 3.0 * BAND_HIGH_HZ, np.inf)
    shortest = int(np.ceil(WINDOW_S * rate)) + 1
    if not shortest <= len(x) <= MAX_SAMPLES:
        raise InvalidArgumentError(f"samples: expected {shortest} .. {MAX_SAMPLES} samples, got {len(x)}")
    # Decimation with zero phase, to at least three times the highest partial.
    factor = int(rate // (3.0 * BAND_HIGH_HZ))
    if factor > 1:
        x, rate = scipy.signal.decimate(x, factor, ftype="fir", zero_phase=True), rate / factor
    size, step = round(WINDOW_S * rate), STEP_S * rate
    starts = np.round(np.arange(0, len(x) - size + 1, step)).astype(np.intp)
    frames = x[starts[:, None] + np.arange(size)]
    shape = np.asarray(np.hanning(size + 2)[1:-1], dtype=np.float64)
    power, floor = spectrum_and_floor(frames * shape, rate)
    fundamental = best_path(power / floor, rate / (ZERO_PADDING * size))
    time = np.asarray((starts + 0.5 * (size - 1)) / rate, dtype=np.float64)
    windows = Windows(time, frames, shape, floor, rate)
    for _ in range(PASSES):
        slope = np.zeros_like(fundamental)
        if len(time) >= 5:  # Straight lines through five windows
            step_s = float(np.diff(time).mean())
            slope = scipy.signal.savgol_filter(fundamental, 5, 1, deriv=1, delta=step_s)
        found = measure_fundamental(windows, fundamental, slope)
        fundamental = np.where(found.n_partials > 0, found.frequency_hz, fundamental)
    usable = found.n_partials > 0
    columns = (one.name for one in fields(found) if one.name != "windows")
    return replace(found, **{name: getattr(found, name)[usable] for name in columns})
