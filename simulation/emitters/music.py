"""Music as it comes out of a window: beat, bass and chords in a drawn key."""

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import add_ringing, gate, harmonics, octave_noise

BEATS_PER_MINUTE, TONIC_HZ = (95.0, 130.0), (98.0, 156.0)
# Semitones over the tonic of four chords: I, V, vi, IV, the commonest loop of popular music.
CHORDS = ((0, 4, 7), (7, 11, 14), (9, 12, 16), (5, 9, 12))
BEATS_A_CHORD = 4
KICK = ((55.0, 6.0, 0.12), (110.0, 2.0, 0.05))
BASS = (2.0, 0.8, 0.4, 0.2)
STRING = (0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05)
HAT_DB = (-60.0, -60.0, -60.0, -50.0, -30.0, -10.0, -3.0, 0.0)
HAT_S, HAT_GAIN = 0.05, 12_000.0


def music(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a key and a tempo and play a loop of four chords, shape (samples,)."""
    beat_s, tonic = 60.0 / rng.uniform(*BEATS_PER_MINUTE), rng.uniform(*TONIC_HZ)
    time = np.arange(samples) / rate_hz
    chord = (time / (BEATS_A_CHORD * beat_s)).astype(int) % len(CHORDS)
    on_the_beat = np.arange(0.0, samples / rate_hz, beat_s)
    plucks = 0.3 + 0.7 * np.exp(-np.mod(time, beat_s) / (0.5 * beat_s))
    # An octave below the chord's root, and its three notes above.
    out = plucks * harmonics(tonic * _semitones(chord, 0) / 2.0, BASS, rate_hz)
    for note in range(3):
        out += plucks * harmonics(2.0 * tonic * _semitones(chord, note), STRING, rate_hz)
    for at in on_the_beat.tolist():
        add_ringing(out, at, rate_hz, KICK)
    hats = gate(samples, rate_hz, [(at, at + HAT_S) for at in on_the_beat + 0.5 * beat_s], 0.5 * HAT_S)
    return out + HAT_GAIN * hats * octave_noise(HAT_DB, samples, rate_hz, rng)


def _semitones(chord: np.ndarray[tuple[int], np.dtype[np.int64]], note: int) -> FloatArray:
    """Frequency ratio of one note of the chord at every sample."""
    return np.asarray(2.0 ** (np.array(CHORDS)[chord, note] / 12.0))
