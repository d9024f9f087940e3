r"""Frequency and variance of each partial, and the fundamental that they agree on.

Each partial is demodulated by the track found so far and its slope, so that a gliding one stays narrow, and
its frequency is moved to the maximum of the windowed periodogram by a Newton step. To first order in the
noise, with n counted from the centre of the window w,

.. math:: \sigma_h^2 = \frac{1}{2\,\mathrm{SNR}} \frac{(\sum w)^2}{\sum w^2}
          \frac{\sum w^2 n^2}{(\sum w n^2)^2}, \qquad \mathrm{SNR} = \text{peak power over floor}.

The partials are combined by

.. math:: \hat f = \frac{\sum_h h f_h / \sigma_h^2}{\sum_h h^2 / \sigma_h^2}, \qquad
          \chi^2 = \frac{1}{H - 1} \sum_h \frac{(f_h - h \hat f)^2}{\sigma_h^2}.

Source: the variance is the first-order perturbation of the windowed maximum of Rife and Boorstyn 1974.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import Complex128Array, FloatArray, IndexArray

from .harmonic_sum import BAND_HIGH_HZ, ZERO_PADDING

# Largest correction by one Newton step, in resolutions 1 / window: beyond it lies the edge of the main lobe.
REACH = 0.75
# Power over the floor from which a partial enters the combined estimate.
_LEAST_SNR = 15.0


@dataclass(frozen=True, slots=True)
class Fundamental:
    """Fundamental of K windows, combined from their partials."""

    # Fundamental and its variance, increased where the partials disagree; undefined without partials.
    frequency_hz: FloatArray
    variance_hz2: FloatArray
    n_partials: IndexArray  # Number of partials used
    misfit: FloatArray  # Reduced chi-squared of the partials; 0 with fewer than two
    power: FloatArray  # Sum of the partials's powers above the floor, in the units of the spectrum


@dataclass(frozen=True, slots=True)
class Windows:
    """Samples of every window with the noise floor of their spectra."""

    frames: FloatArray  # Samples, not windowed
    shape: FloatArray  # The window
    floor: FloatArray  # Noise power of the windowed, zero-padded spectra
    rate_hz: float  # Sample rate

    @property
    def n(self) -> FloatArray:
        """Sample index from the centre of the window, (n,)."""
        return np.asarray(np.arange(len(self.shape)) - 0.5 * (len(self.shape) - 1), dtype=np.float64)


def measure_fundamental(
    windows: Windows, fundamental_hz: FloatArray, slope_hz_s: FloatArray, max_harmonics: int
) -> Fundamental:
    r"""Refine a track of the fundamental by all its partials.

    .. math:: \hat f = \frac{\sum_h h f_h / \sigma_h^2}{\sum_h h^2 / \sigma_h^2}, \qquad
              \mathrm{var}(\hat f) = \frac{\max(\chi^2, 1)}{\sum_h h^2 / \sigma_h^2}

    Shapes: fundamental_hz, slope_hz_s (K,).
    """
    most = min(max_harmonics, int(BAND_HIGH_HZ / fundamental_hz.min()))
    partials = np.arange(1, most + 1)
    n, rate = windows.n, windows.rate_hz
    turn = np.outer(fundamental_hz, n / rate) + 0.5 * np.outer(slope_hz_s, (n / rate) ** 2)
    back = np.exp(-2j * np.pi * turn)
    demodulated = np.asarray(windows.shape * windows.frames, dtype=np.complex128)
    measured = []
    for h in partials:
        demodulated *= back
        measured.append(_partial(windows, demodulated, h * fundamental_hz))
    frequency, variance, power = (np.stack(part, axis=1) for part in zip(*measured, strict=True))
    return _combined(frequency, variance, power, partials)


def _partial(
    windows: Windows,
    demodulated: Complex128Array,
    expected_hz: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return frequency, variance and power of a partial per window; infinite variance if too weak."""
    n, turns = windows.n, windows.rate_hz / (2 * np.pi)
    shift, peak = _newton_shift(demodulated, n)
    floor = _floor_at(windows, expected_hz)
    snr = peak / floor
    use = (snr >= _LEAST_SNR) & (np.abs(shift) < 2 * np.pi * REACH / len(n))
    use &= expected_hz <= BAND_HIGH_HZ
    variance = _line_variance(windows.shape, n) / np.maximum(snr, 1.0) * turns**2
    return expected_hz + shift * turns, np.where(use, variance, np.inf), np.where(use, peak - floor, 0.0)


def _floor_at(windows: Windows, frequency: FloatArray) -> FloatArray:
    bins = np.round(frequency * ZERO_PADDING * len(windows.shape) / windows.rate_hz).astype(np.intp)
    return np.asarray(windows.floor[np.arange(len(bins)), np.minimum(bins, windows.floor.shape[1] - 1)])


def _newton_shift(demodulated: Complex128Array, n: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Newton step from d = 0, rad per sample, to the maximum of |sum z exp(-j d n)|^2, and the maximum."""
    s0, s1, s2 = (demodulated @ np.stack([np.ones_like(n), n, n**2], axis=1)).T
    height = np.abs(s0) ** 2
    slope = 2.0 * (s0.conj() * s1).imag
    curvature = 2.0 * (np.abs(s1) ** 2 - (s0.conj() * s2).real)
    reach = 2 * np.pi * REACH / len(n)
    step = np.divide(-slope, curvature, out=np.sign(slope) * reach, where=curvature < 0)
    step = np.clip(step, -reach, reach)
    return step, np.maximum(height + slope * step + 0.5 * curvature * step**2, height)


def _line_variance(window: FloatArray, n: FloatArray) -> float:
    """Variance, (rad per sample)^2 at unit SNR, of the peak of a windowed periodogram."""
    spread = np.sum(window**2 * n**2) / np.sum(window * n**2) ** 2
    return float(0.5 * window.sum() ** 2 / np.sum(window**2) * spread)


def _combined(
    frequency: FloatArray, variance: FloatArray, power: FloatArray, partials: IndexArray
) -> Fundamental:
    """Combine all partials, (K, H), into one fundamental per window by their inverse variances."""
    weight = 1.0 / variance
    count = np.count_nonzero(weight, axis=1)
    information = np.maximum((weight * partials**2).sum(axis=1), np.finfo(float).tiny)
    fundamental = (weight * partials * frequency).sum(axis=1) / information
    squares = (weight * (frequency - np.outer(fundamental, partials)) ** 2).sum(axis=1)
    misfit = np.where(count > 1, squares / np.maximum(count - 1, 1), 0.0)
    return Fundamental(fundamental, np.maximum(misfit, 1.0) / information, count, misfit, power.sum(axis=1))
