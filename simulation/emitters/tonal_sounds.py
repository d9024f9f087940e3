"""Sounds of bells and music, birds, sirens and horns, saws, drills and steady tones."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import add_ringing, bursts, drift, gate, harmonics, octave_noise

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
CYCLE_HZ, RATTLE_S, RINGS, RINGS_REST_S = (1900.0, 2600.0), 0.09, (3, 7), (0.6, 1.8)


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
        at += rng.uniform(*RINGS_REST_S)
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
WHISTLE_OVERTONES = (1.0, 0.1)
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
        out[first : first + count] += envelope * harmonics(glide, WHISTLE_OVERTONES, rate_hz)


# The German emergency horn in town: 410 and 547 Hz, a fourth apart as DIN 14610 asks. How long each tone
# lasts is assumed. Its compressed-air horns carry their energy above 1 kHz: DIN 14610's technical rules ask
# for a harmonic of 104 dB there.
TWO_TONES_HZ, TONE_S, GLIDE_S = (410.0, 547.0), 0.75, 0.03
# The signs give the lowest peak, 4 dB over the rms where partials in step have 10: those are trains of clicks
# and clip at the microphones long before a tone does.
HORN_PARTIALS = (0.5, 0.7, -1.0, 1.0, 0.9, 0.7, 0.5, -0.35, -0.25, -0.18, 0.12, 0.08)
# An electronic siren's wail: 10 to 30 cycles a minute (13 CCR 1028); its span is assumed.
WAIL_HZ, WAILS_HZ = (600.0, 1400.0), (0.2, 0.35)
WAIL_PARTIALS = (1.0, 0.1, 0.35, 0.05, 0.2, 0.03, 0.1)  # nearly a square wave
# Two discs a third apart (assumed); UN Regulation No. 28 asks for 1.8 to 3.55 kHz to be the loudest part.
DISCS_HZ, DISC_SPREAD = (420.0, 505.0), 0.05
DISC_PARTIALS = (0.3, 0.3, 0.4, -0.6, -0.9, -1.0, 0.9, -0.7, -0.4, 0.25, -0.15, 0.1)
BLAST_S, PAUSE_S = (0.3, 1.2), (0.4, 2.0)
# One tone between 1 and 1.2 kHz, half of a second on and half off (assumed within SAE J994).
BEEP_HZ, BEEPS_HZ = (1000.0, 1200.0), (0.95, 1.05)
BEEP_PARTIALS = (1.0, 0.05, 0.1)


def siren(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Two tones in turn, shape (samples,)."""
    time = np.arange(samples) / rate_hz + rng.uniform(0.0, 2.0 * TONE_S)
    turn = np.mod(time, 2.0 * TONE_S)
    rising = np.clip(turn / GLIDE_S, 0.0, 1.0)
    falling = np.clip((turn - TONE_S) / GLIDE_S, 0.0, 1.0)
    low, high = TWO_TONES_HZ
    return harmonics(low + (high - low) * (rising - falling), HORN_PARTIALS, rate_hz)


def wail(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """One tone that rises and falls, shape (samples,)."""
    low, high = WAIL_HZ
    cycles = rng.random() + rng.uniform(*WAILS_HZ) * np.arange(samples) / rate_hz
    return harmonics(low * (high / low) ** (0.5 - 0.5 * np.cos(2.0 * np.pi * cycles)), WAIL_PARTIALS, rate_hz)


def horn(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Blasts of a pair of disc horns, shape (samples,)."""
    tune = rng.uniform(1.0 - DISC_SPREAD, 1.0 + DISC_SPREAD)
    blasts = gate(samples, rate_hz, bursts(samples / rate_hz, BLAST_S, PAUSE_S, rng), 0.02)
    both = [harmonics(np.full(samples, tune * disc), DISC_PARTIALS, rate_hz) for disc in DISCS_HZ]
    return blasts * (both[0] + both[1])


def beeper(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """One tone, on and off, shape (samples,)."""
    period_s = 1.0 / rng.uniform(*BEEPS_HZ)
    starts = np.arange(0.0, samples / rate_hz, period_s)
    beeps = gate(samples, rate_hz, [(at, at + 0.5 * period_s) for at in starts.tolist()], 0.01)
    return beeps * harmonics(np.full(samples, rng.uniform(*BEEP_HZ)), BEEP_PARTIALS, rate_hz)


# A hand-held circular saw: 3000 to 5500 turns a minute, 24 or 40 teeth (makers' data).
SAW_HZ, TEETH = (55.0, 75.0), (24, 40)
CUT_S, IDLE_S = (1.5, 4.0), (0.8, 2.0)
SAG, CUTTING_DB = 0.15, 8.0  # the motor slows down in the wood, and is louder there (assumed)
SHAFT = (1.0, 0.6, 0.4, 0.3, 0.2, 0.15, 0.1)
BLADE = (3.0, 1.5, 0.8, 0.5, 0.3, 0.2)
SAW_DB = (-25.0, -20.0, -15.0, -10.0, -4.0, 0.0, 2.0, 0.0)
# A hammer drill: 45 to 55 blows and 13 to 18 turns a second (makers' data).
BLOWS_HZ, TURNS_HZ, GEAR_TEETH = (45.0, 55.0), (13.0, 18.0), 35
BORE_S, REST_S = (2.0, 5.0), (0.5, 2.0)
# Modes of bit and wall that every blow excites (assumed).
BLOW = ((420.0, 1.0, 0.006), (1150.0, 1.0, 0.004), (2400.0, 0.9, 0.003), (4100.0, 0.5, 0.002))
DRILL_DB = (-20.0, -15.0, -10.0, -5.0, 0.0, 0.0, -3.0, -6.0)
NOISE_GAIN = 30_000.0  # octave levels are dB re 20 uPa: brings 0 dB to the size of the partials


def saw_motion(samples: int, rate_hz: float, rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Draw a saw and its cuts: teeth a second, turns a second, and the load 0..1, shape (samples,) each."""
    cuts = bursts(samples / rate_hz, CUT_S, IDLE_S, rng)
    # The motor takes some tenths of a second to slow down and to recover: the ramps of the load.
    load = gate(samples, rate_hz, cuts, 0.4)
    hunting = 1.0 + 0.005 * drift(samples, rate_hz, 0.2, rng)
    turns = rng.uniform(*SAW_HZ) * (1.0 - SAG * load) * hunting
    return turns * rng.choice(TEETH), turns, load


def saw(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a circular saw that cuts board after board, shape (samples,)."""
    teeth, turns, load = saw_motion(samples, rate_hz, rng)
    tones = harmonics(turns, SHAFT, rate_hz) + harmonics(teeth, BLADE, rate_hz)
    noise = NOISE_GAIN * octave_noise(SAW_DB, samples, rate_hz, rng)
    rough = 1.0 + 0.2 * drift(samples, rate_hz, 0.05, rng)
    return (tones + noise * rough * (0.3 + 0.7 * load)) * 10.0 ** (CUTTING_DB * (load - 1.0) / 20.0)


def drill(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a hammer drill that bores hole after hole, shape (samples,)."""
    bores = bursts(samples / rate_hz, BORE_S, REST_S, rng)
    blows_hz, turns = rng.uniform(*BLOWS_HZ), np.full(samples, rng.uniform(*TURNS_HZ))
    out = np.zeros(samples)
    for start, end in bores:
        for at in np.arange(start, min(end, samples / rate_hz), 1.0 / blows_hz).tolist():
            add_ringing(out, at, rate_hz, BLOW, rng.uniform(0.8, 1.2))
    running = gate(samples, rate_hz, bores, 0.15)
    motor = harmonics(turns * GEAR_TEETH, (0.2, 0.1, 0.05), rate_hz)
    return out + running * (motor + 0.3 * NOISE_GAIN * octave_noise(DRILL_DB, samples, rate_hz, rng))


# Pitches from the hum of a transformer to a whistle; how many overtones and how strong is assumed.
PITCH_HZ, OVERTONES, STRONGEST = (120.0, 2200.0), (0, 5), 0.6
UNSTEADY = 0.002
OFF_SHARE, ON_S, OFF_S = 0.3, (0.5, 3.0), (0.3, 1.5)


def tone(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a pitch with its overtones and hold it, shape (samples,)."""
    pitch = np.exp(rng.uniform(*np.log(PITCH_HZ))) * (1.0 + UNSTEADY * drift(samples, rate_hz, 0.5, rng))
    falls, count = rng.uniform(0.0, STRONGEST), int(rng.integers(*OVERTONES))
    out = harmonics(pitch, [falls**k for k in range(1 + count)], rate_hz)
    if rng.random() < OFF_SHARE:
        out *= gate(samples, rate_hz, bursts(samples / rate_hz, ON_S, OFF_S, rng), 0.02)
    return out
