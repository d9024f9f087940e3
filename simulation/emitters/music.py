"""Bells, inharmonic partials that ring down, and music: beat, bass and chords in a drawn key."""

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import add_ringing, gate, harmonics, octave_noise

# Partials of a tuned minor-third bell over its prime: hum, prime, tierce, quint, nominal, twelfth, upper
# octave; the hum rings longest. A. Lehr, "Partial groups in the bell sound", J. Acoust. Soc. Am. 79 (1986).
# Ratios are just, strengths and times are assumed.
CHURCH = (
    (0.5, 0.5, 6.0),
    (1.0, 0.6, 3.0),
    (1.2, 0.8, 2.5),
    (1.5, 0.3, 1.2),
    (2.0, 1.0, 1.5),
    (3.0, 0.6, 0.7),
    (4.0, 0.4, 0.4),
)
PRIME_HZ, SWING_S = (250.0, 500.0), (1.2, 1.8)
UNEVEN_DB = 1.0
# A cap of 60 mm: the ratios of the first modes of a shallow shell (assumed).
CYCLE = ((1.0, 1.0, 0.35), (2.4, 0.6, 0.2), (4.2, 0.25, 0.1))
CYCLE_HZ, RATTLE_S, RINGS, REST_S = (1900.0, 2600.0), 0.09, (3, 7), (0.6, 1.8)


def bell(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a church bell that swings, shape (samples,)."""
    prime, swing_s = rng.uniform(*PRIME_HZ), rng.uniform(*SWING_S)
    out = np.zeros(samples)
    for at in np.arange(rng.uniform(0.0, 0.5 * swing_s), samples / rate_hz, swing_s).tolist():
        strength = 10.0 ** (UNEVEN_DB * rng.standard_normal() / 20.0)
        add_ringing(out, at, rate_hz, [(prime * f, a, t) for f, a, t in CHURCH], strength)
    return out


def bicycle_bell(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a bicycle bell whose clapper is spun a few times, shape (samples,)."""
    pitch = rng.uniform(*CYCLE_HZ)
    partials = [(pitch * f, a, t) for f, a, t in CYCLE]
    out, at = np.zeros(samples), 0.0
    while at < samples / rate_hz:
        for _ in range(int(rng.integers(*RINGS))):
            add_ringing(out, at, rate_hz, partials, rng.uniform(0.7, 1.0))
            at += RATTLE_S * rng.uniform(0.9, 1.1)
        at += rng.uniform(*REST_S)
    return out


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
