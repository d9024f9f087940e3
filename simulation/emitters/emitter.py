"""Sounds of a kind at its level: pressure at 1 m, at any sample rate; synthesised or from recordings.

A folder of recordings has one folder per kind, named as in `SOUNDS`, with WAV or FLAC files of that kind.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import scipy
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from worldstate.adapters.audio.sound_file import open_audio
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.octave_bands import REFERENCE_PA, smooth_step
from worldstate.simulation.scene.settings import SoundKind

from . import syntheses
from .signals import gate

Synthesis = Callable[[int, float, np.random.Generator], FloatArray]

# Keys are the names of `SOUNDS`.
SYNTHESES: dict[str, Synthesis] = {
    one.__name__.replace("_", "-"): one
    for one in (
        *(syntheses.voice, syntheses.children, syntheses.steps, syntheses.bell, syntheses.saw),
        *(syntheses.drill, syntheses.music, syntheses.tune, syntheses.drums, syntheses.dog),
        *(syntheses.birds, syntheses.shots, syntheses.tone, syntheses.siren, syntheses.wail),
        *(syntheses.sweeps, syntheses.turns, syntheses.horn, syntheses.horns, syntheses.beeper),
        *(syntheses.bicycle_bell, syntheses.jackhammer),
    )
}
# Sounds are synthesised at an integer multiple of the requested rate, which is at least this rate, and then
# band-limited. So partials above a low Nyquist frequency do not alias, and the level is that of the full
# band.
LOWEST_RATE_HZ = 24_000.0
# A shorter piece is cut out of a sound of this length. If its own level were set, a pause between two words
# would become as loud as a shout.
LEVEL_FROM_S = 6.0
EDGE_S = 0.01
TRANSITION = 0.05  # Width of the low-pass transition, as a share of the Nyquist frequency
BLOCK_S, LOUD_DB = 0.125, 10.0


SUFFIXES, MOST_FILES = (".wav", ".flac"), 10_000
# Length of a recording that is read and over which its level is measured, so that a silent stretch between
# two barks does not become as loud as a bark.
READ_S = 60.0
FINEST = 1000  # Largest denominator of the ratio of two rates: the error is below a millionth


def emitted(
    kind: SoundKind, samples: int, sample_rate_hz: float, rng: np.random.Generator, sounds_folder: str = ""
) -> Float32Array:
    """Return a sound at its level: pressure in Pa at 1 m in front, in the free field, shape (samples,)."""
    factor = int(np.ceil(LOWEST_RATE_HZ / sample_rate_hz))
    rate, length = factor * sample_rate_hz, samples * factor
    pressure_pa = REFERENCE_PA * 10.0 ** (kind.level_db / 20.0)
    if files := sound_files(sounds_folder, kind.name):
        piece = pressure_pa * _recorded(files, length, rate, rng)
    else:
        piece = SYNTHESES[kind.name](max(samples, int(LEVEL_FROM_S * sample_rate_hz)) * factor, rate, rng)
        piece *= pressure_pa / loud_pressure(a_weighted(piece, rate), rate)
        piece = _with_edges(piece[:length], rate)
    return _band_limited(piece, factor).astype(np.float32)


def sound_files(folder: str, kind: str) -> list[Path]:
    """Return the recordings of a kind in a folder, in the order of their names."""
    found = Path(folder, kind).glob("*") if folder else ()
    return sorted(path for path in found if path.suffix.lower() in SUFFIXES)


def recorded_kinds(folder: str) -> tuple[str, ...]:
    """Return the kinds that a folder contains; refuse other names and unreadable files."""
    kinds = sorted(path.name for path in Path(folder).glob("[!.]*") if path.is_dir())
    for kind in kinds or ["none"]:
        files = sound_files(folder, kind)
        if kind not in SYNTHESES or not 1 <= len(files) <= MOST_FILES:
            told = f"expected folders of 1 to {MOST_FILES} WAV or FLAC files named {', '.join(SYNTHESES)}"
            raise InputFileError(folder, f"{told}, got {kind} with {len(files)}")
        for path in files:
            open_audio(path, strict=False, short=True).close()
    return tuple(kinds)


def _recorded(files: Sequence[Path], samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Return stretches of recordings, concatenated to the required length, at unit level."""
    pieces, missing = list[FloatArray](), samples
    while missing > 0:
        sound = _read(files[int(rng.integers(len(files)))], missing, rate_hz, rng)
        first = int(rng.integers(max(len(sound) - missing, 0) + 1))
        pieces.append(_with_edges(sound[first : first + missing], rate_hz))
        missing -= len(pieces[-1])
    return np.concatenate(pieces)


def _read(path: Path, samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Return the first channel of a recording, or a part of it, at unit level, shape (n,)."""
    with open_audio(path, strict=False, short=True) as source:
        own_hz = source.sample_rate_hz
        length = min(source.frames, round(max(READ_S, samples / rate_hz + 1.0) * own_hz))
        sound = source.span(int(rng.integers(source.frames - length + 1)), length)[:, 0]
    ratio = Fraction(rate_hz / own_hz).limit_denominator(FINEST)
    heard = scipy.signal.resample_poly(sound.astype(np.float64), ratio.numerator, ratio.denominator)
    return np.asarray(heard / (loud_pressure(a_weighted(heard, rate_hz), rate_hz) + np.finfo(float).tiny))


def _with_edges(piece: FloatArray, rate_hz: float) -> FloatArray:
    return piece * gate(len(piece), rate_hz, [(0.0, len(piece) / rate_hz)], EDGE_S)


def a_weight(frequency_hz: FloatArray) -> FloatArray:
    r"""Return the amplitude of the A-weighting of IEC 61672-1, shape of `frequency_hz`.

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
    """Return the RMS over all blocks of 1/8 s whose level is within 10 dB of the loudest block."""
    block = min(int(BLOCK_S * rate_hz), len(signal))
    power = np.square(signal[: len(signal) // block * block]).reshape(-1, block).mean(axis=1)
    return float(np.sqrt(power[power >= power.max() * 10.0 ** (-LOUD_DB / 10.0)].mean()))


def _band_limited(signal: FloatArray, factor: int) -> FloatArray:
    """Remove frequencies above the new Nyquist frequency and return every `factor`-th sample."""
    if factor == 1:
        return signal
    n = len(signal)
    relative = np.arange(n // factor // 2 + 1) / (n / factor / 2.0)
    spectrum = rfft(signal)[: len(relative)] * smooth_step((1.0 - relative) / TRANSITION)
    return np.asarray(irfft(spectrum, n // factor) / factor)
