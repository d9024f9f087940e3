"""Elements of the synthesised signals: noise, partials, bursts, slow drift.

Amplitudes are relative: `emitter.emitted` sets the level. The sample rate is at least 24 kHz.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft, next_fast_len, rfftfreq

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.octave_bands import level_curve, smooth_step

# (start, end) of each sounding span, s.
Spans = Sequence[tuple[float, float]]

INAUDIBLE_DECAYS = 7.0  # A ringing partial is 60 dB down after 6.9 time constants


def octave_noise(octaves_db: ArrayLike, samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw Gaussian noise of given octave levels, 62.5 Hz to 8 kHz, dB re 20 uPa, shape (samples,)."""
    n = next_fast_len(samples, real=True)
    density = level_curve(np.asarray(octaves_db, np.float64), rfftfreq(n, 1.0 / rate_hz))
    # The transform of white noise is white noise.
    white = rng.standard_normal(2 * len(density)).view(np.complex128)
    return np.asarray(irfft(white * np.sqrt(density * rate_hz * n / 4.0), n)[:samples])


def harmonics(frequency_hz: FloatArray, amplitudes: Sequence[float], rate_hz: float) -> FloatArray:
    r"""Return multiples of a changing frequency, :math:`\sum_k a_k \sin k\phi(t)`, below Nyquist."""
    phase = 2.0 * np.pi * np.mod(np.cumsum(frequency_hz) / rate_hz, 1.0)
    # sin (k + 1) p = 2 cos p sin k p - sin (k - 1) p: all partials together need one sine.
    twice_cosine, before, now = 2.0 * np.cos(phase), np.zeros_like(phase), np.sin(phase)
    out = np.zeros_like(phase)
    audible = max(int(0.5 * rate_hz / float(frequency_hz.max())), 1)
    for amplitude in amplitudes[:audible]:
        out += amplitude * now
        before, now = now, twice_cosine * now - before
    return out


def add_ringing(
    out: FloatArray,
    at_s: float,
    rate_hz: float,
    partials: Sequence[tuple[float, float, float]],
    strength: float = 1.0,
) -> None:
    """Add the partials (frequency in Hz, amplitude, time constant in s) that a blow excites at `at_s`."""
    first = int(np.ceil(at_s * rate_hz))
    for frequency_hz, amplitude, decay_s in partials:
        last = min(first + int(INAUDIBLE_DECAYS * decay_s * rate_hz) + 1, len(out))
        if frequency_hz < 0.5 * rate_hz and first < last:
            time = np.arange(first, last) / rate_hz - at_s
            swing = np.sin(2.0 * np.pi * frequency_hz * time)
            out[first:last] += strength * amplitude * np.exp(-time / decay_s) * swing


def gate(samples: int, rate_hz: float, spans: Spans, ramp_s: float, heights: ArrayLike = 1.0) -> FloatArray:
    """Return 1, or the height, within the spans and 0 outside, with raised-cosine ramps at the ends."""
    out = np.zeros(samples)
    for (start_s, end_s), height in zip(spans, np.broadcast_to(heights, len(spans)).tolist(), strict=True):
        first, last = max(int(start_s * rate_hz), 0), min(int(end_s * rate_hz) + 1, samples)
        time = np.arange(first, last) / rate_hz
        ends = np.minimum(time - start_s, end_s - time) / min(ramp_s, 0.5 * (end_s - start_s))
        out[first:last] = np.maximum(out[first:last], height * smooth_step(ends))
    return out


def drift(samples: int, rate_hz: float, step_s: float, rng: np.random.Generator) -> FloatArray:
    """Interpolate linearly between standard normal numbers `step_s` apart, shape (samples,)."""
    knots = np.arange(0.0, samples / rate_hz + 2.0 * step_s, step_s)
    return np.interp(np.arange(samples) / rate_hz, knots, rng.standard_normal(len(knots)))


def bursts(
    end_s: float, sounding_s: tuple[float, float], pause_s: tuple[float, float], rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Draw spans of random lengths with random pauses between them, from 0 to `end_s`."""
    spans, at = [], 0.0
    while at < end_s:
        stop = at + rng.uniform(*sounding_s)
        spans.append((at, stop))
        at = stop + rng.uniform(*pause_s)
    return spans
