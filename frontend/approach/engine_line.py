r"""Track the fundamental of an engine from its harmonics.

Three steps: the harmonic sum scores every candidate in every window and the most evident track is taken
(`harmonic_sum`); the frequency of each partial is measured along that track (`partials`); all partials are
combined into the fundamental with its variance. Their reduced chi-squared is the harmonic-consistency check:
near one if the partials are multiples of one fundamental.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import signal

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IndexArray

from .harmonic_sum import (
    BAND_HIGH_HZ,
    STEP_S,
    WINDOW_S,
    ZERO_PADDING,
    HarmonicSettings,
    best_path,
    spectrum_and_floor,
)
from .partials import Fundamental, Windows, measure_fundamental

__all__ = ["HarmonicSettings", "HarmonicTrack", "track_fundamental"]

# Each pass measures along the track and the slope of the one before.
PASSES = 3
# Longest signal at one call: an hour at 48 kHz is 1.7e8 samples.
MAX_SAMPLES = 200_000_000


@dataclass(frozen=True, slots=True)
class HarmonicTrack:
    """Fundamental over time; windows without a usable partial are left out."""

    time_s: FloatArray  # Centre of each window from the first sample, on the receiver's clock
    frequency_hz: FloatArray  # Fundamental
    variance_hz2: (
        FloatArray  # Of the fundamental, from the SNR of its partials, increased where they disagree
    )
    n_partials: IndexArray  # Number of partials used
    # Reduced chi-squared of harmonic consistency; 0 with a single partial, which has no check.
    misfit: FloatArray
    level_db: FloatArray  # Power of all partials, 10 log10, relative to samples of unit mean square
    windows: int  # Number of windows analysed, K of them usable


def track_fundamental(
    samples: ArrayLike, sample_rate_hz: float, settings: HarmonicSettings | None = None
) -> HarmonicTrack:
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
    settings : HarmonicSettings, optional
        Range of the fundamental and number of partials; the defaults suit a car's engine.

    Returns
    -------
    HarmonicTrack
        Frequencies in Hz at the centres of the windows; empty where nothing exceeds the noise.

    Raises
    ------
    InvalidArgumentError
        On a wrong shape, too few samples, non-finite values or too low a sample rate.

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
    chosen = settings or HarmonicSettings()
    x, rate = _decimated(*_checked(samples, sample_rate_hz))
    size, step = round(WINDOW_S * rate), STEP_S * rate
    starts = np.round(np.arange(0, len(x) - size + 1, step)).astype(np.intp)
    frames = x[starts[:, None] + np.arange(size)]
    shape = np.asarray(np.hanning(size + 2)[1:-1], dtype=np.float64)
    power, floor = spectrum_and_floor(frames * shape, rate)
    fundamental = best_path(power / floor, rate / (ZERO_PADDING * size), chosen)
    time = np.asarray((starts + 0.5 * (size - 1)) / rate, dtype=np.float64)
    windows = Windows(frames, shape, floor, rate)
    for _ in range(PASSES):
        found = measure_fundamental(windows, fundamental, _slope(time, fundamental), chosen.max_harmonics)
        fundamental = np.where(found.n_partials > 0, found.frequency_hz, fundamental)
    return _track(time, found, shape)


def _checked(samples: ArrayLike, sample_rate_hz: float) -> tuple[FloatArray, float]:
    x = finite_array("samples", samples, (None,))
    rate = in_range("sample_rate_hz", sample_rate_hz, 3.0 * BAND_HIGH_HZ, np.inf)
    shortest = int(np.ceil(WINDOW_S * rate)) + 1
    if not shortest <= len(x) <= MAX_SAMPLES:
        raise InvalidArgumentError(f"samples: expected {shortest} .. {MAX_SAMPLES} samples, got {len(x)}")
    return x, rate


def _decimated(x: FloatArray, rate: float) -> tuple[FloatArray, float]:
    """Decimate with zero phase to at least three times the highest partial."""
    factor = int(rate // (3.0 * BAND_HIGH_HZ))
    if factor <= 1:
        return x, rate
    return np.asarray(signal.decimate(x, factor, ftype="fir", zero_phase=True)), rate / factor


def _track(time: FloatArray, found: Fundamental, shape: FloatArray) -> HarmonicTrack:
    used = found.n_partials > 0
    # A tone of amplitude A peaks at (A sum(w) / 2)^2 and has mean square A^2 / 2.
    mean_square = 2.0 * found.power[used] / shape.sum() ** 2
    return HarmonicTrack(
        time_s=time[used],
        frequency_hz=found.frequency_hz[used],
        variance_hz2=found.variance_hz2[used],
        n_partials=found.n_partials[used],
        misfit=found.misfit[used],
        level_db=10.0 * np.log10(mean_square),
        windows=len(used),
    )


def _slope(time: FloatArray, frequency: FloatArray) -> FloatArray:
    """Slope of the track, Hz per second, by straight lines through five windows."""
    if len(time) < 5:
        return np.zeros_like(frequency)
    return np.asarray(signal.savgol_filter(frequency, 5, 1, deriv=1, delta=float(np.diff(time).mean())))
