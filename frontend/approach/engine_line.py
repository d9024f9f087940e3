r"""The fundamental of an engine line over time, from its whole comb of harmonics.

Three steps: the comb scores every candidate in every window and the most evident track is taken (`comb`);
each tooth's frequency is measured along that track (`lines`); all teeth are combined into a fundamental with
its variance. Their reduced chi-squared is the harmonic-consistency check: near one if the lines are multiples
of one fundamental.

Sources: at the head of `comb` and `lines`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import signal

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IndexArray

from .harmonic_sum import ZERO_PADDING, HarmonicSettings, best_path, spectrum_and_floor
from .partials import Fundamental, Windows, measure_fundamental

__all__ = ["HarmonicSettings", "HarmonicTrack", "track_fundamental"]

# Each pass measures along the track, and the slope, of the one before.
PASSES = 3
# Longest signal at one call: an hour at 48 kHz is 1.7e8 samples.
MAX_SAMPLES = 200_000_000


@dataclass(frozen=True, slots=True)
class HarmonicTrack:
    """A fundamental over time; windows without a usable tooth are left out.

    Examples
    --------
    >>> one = np.ones(1)
    >>> HarmonicTrack(one, 60.0 * one, 0.01 * one, one.astype(int), 0.0 * one, 0.0 * one, windows=3).windows
    3
    """

    time_s: FloatArray  # Centre of each window from the first sample, on the receiver's clock
    frequency_hz: FloatArray  # Fundamental
    variance_hz2: FloatArray  # Of the fundamental, from the SNR of its teeth, widened where they disagree
    lines: IndexArray  # Teeth that entered
    # Reduced chi-squared of harmonic consistency; 0 with a single tooth, which proves nothing.
    misfit: FloatArray
    level_db: FloatArray  # Power of all teeth, 10 log10, relative to samples of unit mean square
    windows: int  # Number of windows looked at; K of them could be used


def track_fundamental(
    samples: ArrayLike, sample_rate_hz: float, settings: HarmonicSettings | None = None
) -> HarmonicTrack:
    r"""Track the fundamental of the strongest harmonic comb in one channel.

    .. math:: f^{(0)} = \arg\max_{f_1 .. f_K} \sum_k Q_k(f_k), \qquad
              f_k = \frac{\sum_h h f_{k,h} / \sigma_{k,h}^2}{\sum_h h^2 / \sigma_{k,h}^2}

    with the evidence Q of `comb.best_path` and the teeth f_h of `lines.measure_fundamental`.

    Parameters
    ----------
    samples : (n,) float
        One microphone or one beam, at least one window long.
    sample_rate_hz : float
        At least three times the highest tooth.
    settings : HarmonicSettings, optional
        Defaults suit a car's engine.

    Returns
    -------
    HarmonicTrack
        Possibly empty: nothing stands out of the noise.

    Raises
    ------
    InvalidArgumentError
        On a wrong shape, too few samples, non-finite values or too low a sample rate.

    References
    ----------
    A. M. Noll 1969 (the comb), A. J. Viterbi 1967 (the track), D. C. Rife and R. R. Boorstyn 1974 (the
    teeth): see `worldstate.frontend.approach.harmonic_sum` and `worldstate.frontend.approach.partials`.

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
    x, rate = _decimated(*_checked(samples, sample_rate_hz, chosen), chosen.band_high_hz)
    size, step = round(chosen.window_s * rate), chosen.hop_s * rate
    starts = np.round(np.arange(0, len(x) - size + 1, step)).astype(np.intp)
    frames = x[starts[:, None] + np.arange(size)]
    shape = np.asarray(np.hanning(size + 2)[1:-1], dtype=np.float64)
    power, floor = spectrum_and_floor(frames * shape, rate, chosen)
    fundamental = best_path(power / floor, rate / (ZERO_PADDING * size), chosen)
    time = np.asarray((starts + 0.5 * (size - 1)) / rate, dtype=np.float64)
    windows = Windows(frames, shape, floor, rate)
    for _ in range(PASSES):
        found = measure_fundamental(windows, fundamental, _slope(time, fundamental), chosen)
        fundamental = np.where(found.lines > 0, found.frequency_hz, fundamental)
    return _track(time, found, shape)


def _checked(
    samples: ArrayLike, sample_rate_hz: float, settings: HarmonicSettings
) -> tuple[FloatArray, float]:
    x = finite_array("samples", samples, (None,))
    rate = in_range("sample_rate_hz", sample_rate_hz, 3.0 * settings.band_high_hz, np.inf)
    shortest = int(np.ceil(settings.window_s * rate)) + 1
    if not shortest <= len(x) <= MAX_SAMPLES:
        raise InvalidArgumentError(f"samples: expected {shortest} .. {MAX_SAMPLES} samples, got {len(x)}")
    return x, rate


def _decimated(x: FloatArray, rate: float, highest: float) -> tuple[FloatArray, float]:
    """Filter (zero phase) and thin to no less than three times the highest tooth."""
    factor = int(rate // (3.0 * highest))
    if factor <= 1:
        return x, rate
    return np.asarray(signal.decimate(x, factor, ftype="fir", zero_phase=True)), rate / factor


def _track(time: FloatArray, found: Fundamental, shape: FloatArray) -> HarmonicTrack:
    used = found.lines > 0
    # A tone of amplitude A peaks at (A sum(w) / 2)^2 and has mean square A^2 / 2.
    mean_square = 2.0 * found.power[used] / shape.sum() ** 2
    return HarmonicTrack(
        time_s=time[used],
        frequency_hz=found.frequency_hz[used],
        variance_hz2=found.variance_hz2[used],
        lines=found.lines[used],
        misfit=found.misfit[used],
        level_db=10.0 * np.log10(mean_square),
        windows=len(used),
    )


def _slope(time: FloatArray, frequency: FloatArray) -> FloatArray:
    """Slope of the track, Hz per second, by straight lines through five windows."""
    if len(time) < 5:
        return np.zeros_like(frequency)
    return np.asarray(signal.savgol_filter(frequency, 5, 1, deriv=1, delta=float(np.diff(time).mean())))
