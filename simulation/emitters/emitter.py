"""Sounds of a kind at its level: pressure at 1 m, at any sample rate."""

from collections.abc import Callable

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.octave_bands import REFERENCE_PA, smooth_step
from worldstate.simulation.scene.settings import SoundKind

from . import syntheses
from .signals import gate

Synthesis = Callable[[int, float, np.random.Generator], FloatArray]

SYNTHESES: dict[str, Synthesis] = {
    "voice": syntheses.voice,
    "children": syntheses.children,
    "steps": syntheses.steps,
    "bell": syntheses.bell,
    "saw": syntheses.saw,
    "drill": syntheses.drill,
    "music": syntheses.music,
    "tune": syntheses.tune,
    "drums": syntheses.drums,
    "dog": syntheses.dog,
    "birds": syntheses.birds,
    "shots": syntheses.shots,
    "tone": syntheses.tone,
    "siren": syntheses.siren,
    "wail": syntheses.wail,
    "sweeps": syntheses.sweeps,
    "turns": syntheses.turns,
    "horn": syntheses.horn,
    "horns": syntheses.horns,
    "beeper": syntheses.beeper,
    "bicycle-bell": syntheses.bicycle_bell,
}
# Everything is drawn at a whole multiple of the rate asked, of at least this, and then band-limited: partials
# above a low Nyquist frequency are left out, not folded, and the level is that of the whole sound.
LOWEST_RATE_HZ = 24_000.0
LEVEL_FROM_S = 6.0  # a shorter piece is cut out of so long a one: a pause between two words is no shout
EDGE_S = 0.01
TRANSITION = 0.05  # of the Nyquist frequency, below it
BLOCK_S, LOUD_DB = 0.125, 10.0


def emitted(kind: SoundKind, samples: int, sample_rate_hz: float, rng: np.random.Generator) -> Float32Array:
    """Draw a sound at its level: pressure in Pa at 1 m in front, in the free field, shape (samples,)."""
    factor = int(np.ceil(LOWEST_RATE_HZ / sample_rate_hz))
    rate = factor * sample_rate_hz
    drawn = SYNTHESES[kind.name](max(samples, int(LEVEL_FROM_S * sample_rate_hz)) * factor, rate, rng)
    drawn *= REFERENCE_PA * 10.0 ** (kind.level_db / 20.0) / loud_pressure(a_weighted(drawn, rate), rate)
    piece = drawn[: samples * factor]
    piece = piece * gate(len(piece), rate, [(0.0, len(piece) / rate)], EDGE_S)
    return _band_limited(piece, factor).astype(np.float32)


def a_weight(frequency_hz: FloatArray) -> FloatArray:
    r"""Amplitude of the A-weighting of IEC 61672-1, shape of `frequency_hz`.

    .. math:: R_A(f) = \frac{12194^2 f^4}{(f^2 + 20.6^2) \sqrt{(f^2 + 107.7^2)(f^2 + 737.9^2)}
              (f^2 + 12194^2)}, \qquad A(f) = R_A(f) / R_A(1000)
    """
    f2 = np.square(frequency_hz)
    root = np.sqrt((f2 + 107.7**2) * (f2 + 737.9**2))
    weight = 12194.0**2 * f2**2 / ((f2 + 20.6**2) * root * (f2 + 12194.0**2))
    return np.asarray(weight * 10.0 ** (2.0 / 20.0))


def a_weighted(signal: FloatArray, rate_hz: float) -> FloatArray:
    """Apply the A-weighting without delay, shape of `signal`."""
    n = next_fast_len(len(signal), real=True)
    return np.asarray(irfft(rfft(signal, n) * a_weight(rfftfreq(n, 1.0 / rate_hz)), n)[: len(signal)])


def loud_pressure(signal: FloatArray, rate_hz: float) -> float:
    """RMS over the eighths of a second that are within 10 dB of the loudest."""
    block = int(BLOCK_S * rate_hz)
    power = np.square(signal[: len(signal) // block * block]).reshape(-1, block).mean(axis=1)
    return float(np.sqrt(power[power >= power.max() * 10.0 ** (-LOUD_DB / 10.0)].mean()))


def _band_limited(signal: FloatArray, factor: int) -> FloatArray:
    """Every `factor`-th sample of what lies below the Nyquist frequency that is left."""
    if factor == 1:
        return signal
    n = len(signal)
    relative = np.arange(n // factor // 2 + 1) / (n / factor / 2.0)
    spectrum = rfft(signal)[: len(relative)] * smooth_step((1.0 - relative) / TRANSITION)
    return np.asarray(irfft(spectrum, n // factor) / factor)
