"""Eight octave bands that sum to the whole signal."""

from functools import lru_cache

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from worldstate.ground.typing import Float32Array, FloatArray

OCTAVES_HZ = 62.5 * 2.0 ** np.arange(8)  # 62.5 Hz .. 8 kHz
TRANSITION_OCTAVES = 0.5
REFERENCE_PA = 20e-6


def octave_masks(frequencies_hz: FloatArray) -> FloatArray:
    """Return the amplitude weights of the octave bands, a partition of unity over frequency.

    Shapes: frequencies_hz (F,).
    """
    edges = OCTAVES_HZ[:-1] * np.sqrt(2.0)
    octaves_above = np.log2(np.maximum(frequencies_hz, 1e-3)[None, :] / edges[:, None])
    lowpass = 1.0 - smooth_step(octaves_above / TRANSITION_OCTAVES + 0.5)
    ends = np.zeros((1, len(frequencies_hz)))
    return np.diff(np.concatenate([ends, lowpass, ends + 1.0]), axis=0)


def smooth_step(x: FloatArray) -> FloatArray:
    """Return a raised cosine from 0 at x <= 0 to 1 at x >= 1.

    Examples
    --------
    >>> smooth_step(np.array([-1.0, 0.5, 2.0]))
    array([0. , 0.5, 1. ])
    """
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(x, 0.0, 1.0))


def split_octaves(signal: Float32Array, sample_rate_hz: float, oversampling: int = 1) -> Float32Array:
    """Split a signal into octave bands without phase shift; the bands sum to the signal.

    Shapes: signal (n,).
    """
    n = len(signal)
    # The length of a vehicle's signal may be a prime number, whose transform takes five times as long.
    whole = next_fast_len(n, real=True)
    spectrum = rfft(signal, whole)
    bands = np.zeros((len(OCTAVES_HZ), n * oversampling), np.float32)
    for band, mask in zip(bands, _masks_for(whole, sample_rate_hz), strict=True):
        # The band is empty above half the sample rate.
        if mask.any():
            wave = irfft(spectrum * (mask * np.float32(oversampling)), whole * oversampling)
            band[:] = wave[: n * oversampling]
    return bands


# One entry serves all seven sources of a vehicle, which have the same length.
@lru_cache(maxsize=2)
def _masks_for(samples: int, sample_rate_hz: float) -> Float32Array:
    return octave_masks(rfftfreq(samples, 1.0 / sample_rate_hz)).astype(np.float32)


def resample_whole(signal: Float32Array, oversampling: int) -> Float32Array:
    """Interpolate a signal, band-limited, by an integer factor; the signal is treated as periodic.

    Examples
    --------
    >>> x = np.sin(np.arange(64) * np.pi / 8).astype(np.float32)
    >>> bool(np.allclose(resample_whole(x, 4)[::4], x, atol=1e-5))
    True
    """
    return np.asarray(irfft(rfft(signal) * np.float32(oversampling), len(signal) * oversampling), np.float32)


def level_curve(octave_levels_db: FloatArray, frequencies_hz: FloatArray) -> FloatArray:
    """Return the power spectral density in Pa^2/Hz of octave-band levels (dB re 20 uPa), log-interpolated.

    Shapes: octave_levels_db (8,), frequencies_hz (F,).

    Examples
    --------
    >>> flat = level_curve(np.full(8, 94.0), np.array([1000.0]))
    >>> round(float(flat[0] * 1000 / np.sqrt(2)), 1)
    1.0
    """
    density_db = octave_levels_db - 10.0 * np.log10(OCTAVES_HZ / np.sqrt(2.0))
    curve_db = np.interp(np.log2(np.maximum(frequencies_hz, 1.0)), np.log2(OCTAVES_HZ), density_db)
    return np.asarray(REFERENCE_PA**2 * 10.0 ** (curve_db / 10.0))
