"""The late, diffuse part of a vehicle's sound: its energy without its direction.

Every direction gets a tail of its own. One common tail on all microphones would be a source at broadside.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from .static_field import add_static, plane_wave_delays

Array = NDArray[np.float64]
Signal = NDArray[np.float32]

DIRECTIONS = 48
TAIL_DECAYS = 1.0  # length of a tail in reverberation times (60 dB)


def sphere(count: int) -> Array:
    """Evenly spread unit vectors on a Fibonacci spiral, shape (count, 3).

    Examples
    --------
    >>> sphere(100).mean(axis=0).round(3) + 0.0
    array([0., 0., 0.])
    """
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * index
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def add_late_field(
    out: Signal,
    dry: Signal,
    decay_s: float,
    positions_m: Array,
    sample_rate_hz: float,
    rng: np.random.Generator,
) -> None:
    r"""Add a diffuse tail of a dry signal; two microphones d apart hear it with coherence sinc(2 f d / c).

    Parameters
    ----------
    out : ndarray, shape (M, n)
        Pa, added to in place.
    dry : ndarray, shape (pre + n,)
        What feeds the field; it begins ``pre`` samples before the first heard one.
    decay_s : float
        Reverberation time (60 dB).
    positions_m : ndarray, shape (M, 3)
        Microphones.
    sample_rate_hz : float
        Rate in Hz.
    rng : numpy.random.Generator
        Source of randomness.
    """
    tail = max(int(TAIL_DECAYS * decay_s * sample_rate_hz), 1)
    n = next_fast_len(len(dry) + tail, real=True)
    spectrum = rfft(dry, n)
    envelope = 10.0 ** (-3.0 * np.arange(tail) / tail * TAIL_DECAYS)
    envelope /= np.sqrt(DIRECTIONS * (envelope**2).sum())
    waves = np.empty((DIRECTIONS, out.shape[1]), np.float32)
    for wave in waves:
        response = (envelope * rng.standard_normal(tail)).astype(np.float32)
        wave[:] = irfft(spectrum * rfft(response, n), n)[len(dry) - out.shape[1] : len(dry)]
    offsets = positions_m - positions_m.mean(axis=0)
    add_static(out, waves, plane_wave_delays(sphere(DIRECTIONS), offsets), sample_rate_hz)
