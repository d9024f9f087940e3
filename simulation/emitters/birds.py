"""Songbirds: phrases of chirps whose pitch glides."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import gate, harmonics


@dataclass(frozen=True, slots=True)
class _Song:
    """Notes of a phrase (start and end in Hz, length in s), how often they come, and the rest after it."""

    notes: tuple[tuple[float, float, float], ...]
    repeats: tuple[int, int]
    gap_s: float
    rest_s: tuple[float, float]


# A great tit's two notes, a house sparrow's chirps, a blackbird's whistles; pitches and lengths are assumed.
SONGS = (
    _Song(((5500.0, 5200.0, 0.11), (3900.0, 3700.0, 0.15)), (4, 9), 0.05, (1.0, 3.0)),
    _Song(((3200.0, 5200.0, 0.03), (5200.0, 3400.0, 0.06)), (1, 6), 0.25, (0.5, 1.5)),
    _Song(((2300.0, 2500.0, 0.18), (2700.0, 2250.0, 0.15), (2450.0, 3000.0, 0.2)), (1, 3), 0.04, (1.5, 3.0)),
)
OVERTONES = (1.0, 0.1)
TRANSPOSE = (0.95, 1.1)


def birds(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw phrases of several birds one after the other, shape (samples,)."""
    out, at = np.zeros(samples), rng.uniform(0.0, 0.5)
    while at < samples / rate_hz:
        song, pitch = SONGS[rng.integers(len(SONGS))], rng.uniform(*TRANSPOSE)
        for _ in range(int(rng.integers(*song.repeats))):
            for low, high, length in song.notes:
                _add_note(out, at, rate_hz, (pitch * low, pitch * high, length))
                at += length + song.gap_s
        at += rng.uniform(*song.rest_s)
    return out


def _add_note(out: FloatArray, at_s: float, rate_hz: float, note: tuple[float, float, float]) -> None:
    begin, end, length = note
    first = int(at_s * rate_hz)
    count = min(int(length * rate_hz), len(out) - first)
    if count > 0:
        glide = begin * (end / begin) ** (np.arange(count) / (length * rate_hz))
        envelope = gate(count, rate_hz, [(0.0, length)], 0.3 * length)
        out[first : first + count] += envelope * harmonics(glide, OVERTONES, rate_hz)
