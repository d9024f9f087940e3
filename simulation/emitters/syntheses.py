"""Synthesis of speech, steps, bells, music, dogs, birds, shots, sirens, horns, tools and tones."""

from collections.abc import Sequence

import numpy as np
import scipy
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from worldstate.ground.typing import Complex128Array, FloatArray
from worldstate.simulation.scene.octave_bands import octave_masks

from .signals import INAUDIBLE_DECAYS, Spans, add_ringing, bursts, drift, gate, harmonics, octave_noise

# First three formants of adult men's vowels: Peterson and Barney, "Control methods used in a study of the
# vowels", J. Acoust. Soc. Am. 24 (1952), table II.
VOWELS_HZ = (
    (270.0, 2290.0, 3010.0),
    (390.0, 1990.0, 2550.0),
    (530.0, 1840.0, 2480.0),
    (660.0, 1720.0, 2410.0),
    (730.0, 1090.0, 2440.0),
    (570.0, 840.0, 2410.0),
    (440.0, 1020.0, 2240.0),
    (300.0, 870.0, 2240.0),
    (640.0, 1190.0, 2390.0),
)
HIGHER_HZ = (3500.0, 4500.0)
BANDWIDTHS_HZ = (80.0, 100.0, 140.0, 200.0, 250.0)
SPEECH_HZ = (105.0, 215.0)  # Mean pitch of men and women
CHILDREN_HZ, MOST_CHILDREN = (230.0, 480.0), 7  # Pitch of calling children (assumed)
HIGH_VOICE_HZ, SHORT_TRACT = 160.0, 1.15  # A shorter vocal tract has higher formants
# A syllable takes a quarter of a second: the modulation of speech is strongest at 3 to 6 Hz.
SYLLABLE_S, CLOSURE_S, PHRASE, SPEECH_PAUSE_S = (0.14, 0.24), (0.03, 0.07), (5, 12), (0.25, 0.6)
SYLLABLE_SPREAD_DB = 2.0
# The glottal flow falls by 12 dB per octave above its corner, and the mouth radiates its derivative.
GLOTTAL_CORNER_HZ = 150.0
FRICATIVE_SHARE, FRICATIVE_S = 0.5, (0.05, 0.1)
FRICATIVE_DB, FRICATIVE_GAIN = (-40.0, -40.0, -40.0, -40.0, -12.0, -6.0, 0.0, 0.0), 0.1
# Octave levels of raised speech, ANSI S3.5-1997, summed from its third octaves; there is no speech below 100
# Hz. Five formants alone have too little energy above 2 kHz, because the higher ones are missing.
RAISED_DB = np.array([0.0, 53.0, 60.5, 64.9, 62.7, 57.2, 51.2, 42.5])


def voice(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a talker and an utterance, shape (samples,)."""
    return _talker(samples, rate_hz, rng.uniform(*SPEECH_HZ), rng)


def children(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw one to seven calling children with breathy voices, shape (samples,)."""
    calls = [
        rng.uniform(0.3, 1.0) * _talker(samples, rate_hz, rng.uniform(*CHILDREN_HZ), rng)
        for _ in range(int(rng.integers(1, MOST_CHILDREN + 1)))
    ]
    together = np.sum(calls, axis=0)
    breath = octave_noise(FRICATIVE_DB, samples, rate_hz, rng) * np.abs(drift(samples, rate_hz, 0.1, rng))
    return np.asarray(together + rng.uniform(0.0, 0.6) * together.std() / breath.std() * breath)


def _talker(samples: int, rate_hz: float, pitch_hz: float, rng: np.random.Generator) -> FloatArray:
    syllables, declination = _syllables(samples / rate_hz, rng)
    starts = np.array([start for start, _ in syllables])
    intonation = np.interp(np.arange(samples) / rate_hz, starts, declination)
    intonation *= 1.0 + 0.03 * drift(samples, rate_hz, 0.12, rng)
    n = next_fast_len(samples, real=True)
    formants_hz = np.array(VOWELS_HZ) * (SHORT_TRACT if pitch_hz > HIGH_VOICE_HZ else 1.0)
    voiced = _vowels(_pulses(pitch_hz * intonation, rate_hz), formants_hz, n, rate_hz, syllables, rng)
    teeth = rfft(_fricatives(samples, rate_hz, syllables, rng), n)
    whole = voiced / np.sqrt(_power(voiced)) + FRICATIVE_GAIN * teeth / np.sqrt(_power(teeth))
    return np.asarray(irfft(whole * _equalised(whole, rfftfreq(n, 1.0 / rate_hz)), n)[:samples])


def _vowels(
    pulses: FloatArray,
    formants_hz: FloatArray,
    n: int,
    rate_hz: float,
    syllables: Spans,
    rng: np.random.Generator,
) -> Complex128Array:
    """Return the spectrum of the pulse train, filtered by one vowel per syllable, shape (n // 2 + 1,)."""
    frequency_hz = rfftfreq(n, 1.0 / rate_hz)
    strength = 10.0 ** (SYLLABLE_SPREAD_DB * rng.standard_normal(len(syllables)) / 20.0)
    vowel = rng.integers(len(formants_hz), size=len(syllables))
    out: Complex128Array = np.zeros(len(frequency_hz), np.complex128)
    for index, formants in enumerate(formants_hz):
        spans = [syllables[i] for i in np.flatnonzero(vowel == index).tolist()]
        envelope = gate(len(pulses), rate_hz, spans, 0.05, strength[vowel == index])
        out += rfft(pulses * envelope, n) * _tract(frequency_hz, formants)
    return out


def _power(spectrum: Complex128Array) -> float:
    return float(np.square(np.abs(spectrum)).sum()) + np.finfo(float).tiny


def _equalised(spectrum: Complex128Array, frequency_hz: FloatArray) -> FloatArray:
    """Return the gain that brings the octaves of a talker to those of `RAISED_DB`."""
    masks = octave_masks(frequency_hz)
    power = np.square(np.abs(spectrum) * masks).sum(axis=1) + np.finfo(float).tiny
    return np.asarray(np.sqrt(10.0 ** (RAISED_DB / 10.0) / power) @ masks)


def _syllables(end_s: float, rng: np.random.Generator) -> tuple[list[tuple[float, float]], list[float]]:
    """Return the spans of the syllables and their relative pitch in the falling phrase."""
    spans, heights, at = [], [], 0.0
    while at < end_s:
        count = int(rng.integers(*PHRASE))
        for height in np.linspace(1.15, 0.85, count).tolist():
            stop = at + rng.uniform(*SYLLABLE_S)
            spans.append((at, stop))
            heights.append(height)
            at = stop + rng.uniform(*CLOSURE_S)
        at += rng.uniform(*SPEECH_PAUSE_S)
    return spans, heights


def _pulses(pitch_hz: FloatArray, rate_hz: float) -> FloatArray:
    """Return one impulse per period, interpolated between samples, shape (samples,)."""
    cycles = np.cumsum(pitch_hz) / rate_hz
    at = np.flatnonzero(np.diff(np.floor(cycles)))
    late = np.mod(cycles[at + 1], 1.0) / (pitch_hz[at + 1] / rate_hz)
    out = np.zeros(len(pitch_hz))
    out[at + 1] += (1.0 - late) * rate_hz
    out[at] += late * rate_hz
    return out


def _tract(frequency_hz: FloatArray, formants_hz: FloatArray) -> Complex128Array:
    r"""Return glottal flow, vocal tract and radiation: a cascade of resonators of unit gain at 0 Hz.

    .. math:: H(f) = \frac{jf}{(1 + jf / f_g)^2} \prod_k \frac{f_k^2}{f_k^2 - f^2 + j f b_k}
    """
    f = frequency_hz
    out = 1j * f / (1.0 + 1j * f / GLOTTAL_CORNER_HZ) ** 2
    for formant, width in zip((*formants_hz, *HIGHER_HZ), BANDWIDTHS_HZ, strict=True):
        out = out * formant**2 / (formant**2 - f**2 + 1j * f * width)
    return np.asarray(out)


def _fricatives(samples: int, rate_hz: float, syllables: Spans, rng: np.random.Generator) -> FloatArray:
    """Return fricative noise before some of the syllables, shape (samples,)."""
    starts = (start for start, _ in syllables if rng.random() < FRICATIVE_SHARE)
    spans = [(start - rng.uniform(*FRICATIVE_S), start) for start in starts]
    return octave_noise(FRICATIVE_DB, samples, rate_hz, rng) * gate(samples, rate_hz, spans, 0.02)


# People walk at 1.5 to 2.3 steps per second, 1.9 on average (Bachmann and Ammann, "Vibrations in structures
# induced by man and machines", IABSE, 1987).
CADENCE_HZ = (1.7, 2.1)
UNEVEN_S, STEP_UNEVEN_DB = 0.015, 1.5
# Heel and sole as short damped modes of shoe and paving, and the broadband click of the contact (assumed).
HEEL = ((90.0, 1.0, 0.025), (240.0, 0.8, 0.012), (620.0, 0.5, 0.006), (1700.0, 0.3, 0.003))
SOLE_AFTER_S, SOLE = 0.14, ((160.0, 0.5, 0.015), (450.0, 0.3, 0.008))
CLICK_DB = (-20.0, -10.0, -5.0, 0.0, 2.0, 2.0, 0.0, -4.0)
CLICK_S, CLICK_GAIN = 0.02, 2000.0


def steps(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a walker and the sound of each step, shape (samples,)."""
    period_s = 1.0 / rng.uniform(*CADENCE_HZ)
    out = np.zeros(samples)
    at = np.arange(rng.uniform(0.0, period_s), samples / rate_hz, period_s)
    heels = np.maximum(at + UNEVEN_S * rng.standard_normal(len(at)), 0.0)
    clicks = gate(samples, rate_hz, [(heel, heel + CLICK_S) for heel in heels], 0.5 * CLICK_S)
    out += CLICK_GAIN * clicks * octave_noise(CLICK_DB, samples, rate_hz, rng)
    for heel in heels.tolist():
        strength = 10.0 ** (STEP_UNEVEN_DB * rng.standard_normal() / 20.0)
        add_ringing(out, heel, rate_hz, HEEL, strength)
        add_ringing(out, heel + SOLE_AFTER_S, rate_hz, SOLE, strength)
    return out


# Partials of a tuned minor-third bell relative to its prime: hum, prime, tierce, quint, nominal, twelfth,
# upper octave; the hum rings longest. A. Lehr, "Partial groups in the bell sound", J. Acoust. Soc. Am. 79
# (1986). Ratios are just; strengths and times are assumed.
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
    """Draw a swinging church bell, shape (samples,)."""
    prime, swing_s = rng.uniform(*PRIME_HZ), rng.uniform(*SWING_S)
    out = np.zeros(samples)
    for at in np.arange(rng.uniform(0.0, 0.5 * swing_s), samples / rate_hz, swing_s).tolist():
        strength = 10.0 ** (UNEVEN_DB * rng.standard_normal() / 20.0)
        add_ringing(out, at, rate_hz, [(prime * f, a, t) for f, a, t in CHURCH], strength)
    return out


def bicycle_bell(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a bicycle bell that rings a few times, shape (samples,)."""
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
# Semitones above the tonic of four chords: I, V, vi, IV, the commonest loop of popular music.
CHORDS = ((0, 4, 7), (7, 11, 14), (9, 12, 16), (5, 9, 12))
BEATS_A_CHORD = 4
KICK = ((55.0, 6.0, 0.12), (110.0, 2.0, 0.05))
BASS = (2.0, 0.8, 0.4, 0.2)
STRING = (0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05)
HAT_DB = (-60.0, -60.0, -60.0, -50.0, -30.0, -10.0, -3.0, 0.0)
HAT_S, HAT_GAIN = 0.05, 12_000.0


def music(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a key and a tempo for a loop of four chords, shape (samples,)."""
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
    """Return the frequency ratio of one note of the chord at every sample."""
    return np.asarray(2.0 ** (np.array(CHORDS)[chord, note] / 12.0))


# Notes of a major scale above a tonic, their lengths and decays (assumed), for any instrument.
SCALE, TUNE_TONIC_HZ = (0, 2, 4, 5, 7, 9, 11, 12), (150.0, 700.0)
NOTE_S, NOTE_DECAY_S = (0.12, 0.8), (0.3, 3.0)
VIBRATO, VIBRATO_HZ, MOST_PARTS = 0.006, 5.5, 4


def tune(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw up to four instruments that each play notes of their own scale, shape (samples,)."""
    out = np.zeros(samples)
    for _ in range(int(rng.integers(1, MOST_PARTS + 1))):
        tonic, note_s, decay_s = rng.uniform(*TUNE_TONIC_HZ), rng.uniform(*NOTE_S), rng.uniform(*NOTE_DECAY_S)
        overtones, at = _falling(rng.uniform(0.6, 2.0), 11), rng.uniform(0.0, 0.3)
        while at < samples / rate_hz:
            length_s = note_s * rng.choice((0.5, 1.0, 1.0, 2.0))
            time = _times(out, at, length_s, rate_hz)
            pitch = tonic * 2.0 ** (rng.choice(SCALE) / 12.0)
            vibrato = 1.0 + VIBRATO * np.sin(2.0 * np.pi * VIBRATO_HZ * time)
            wave = rng.uniform(0.5, 1.0) * harmonics(pitch * vibrato, overtones, rate_hz)
            edges = np.minimum(np.minimum(time, time[::-1]) / 0.01, 1.0)
            _add(out, at, rate_hz, wave * np.exp(-time / decay_s) * edges)
            at += length_s
    return out


# A deep and a high drum, and the hiss of sticks and cymbals (assumed).
DRUMS = (((85.0, 1.0, 0.15), (220.0, 0.5, 0.08)), ((290.0, 1.0, 0.1), (700.0, 0.6, 0.05)))
BEAT_S, HISS_SHARE, HISS_S = (0.2, 0.75), 0.6, (0.01, 0.08)


def drums(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a beat and its drums, shape (samples,)."""
    out, beat_s = np.zeros(samples), rng.uniform(*BEAT_S)
    for at in np.arange(rng.uniform(0.0, beat_s), samples / rate_hz, beat_s).tolist():
        add_ringing(out, at, rate_hz, DRUMS[rng.integers(len(DRUMS))], rng.uniform(0.3, 1.0))
        if rng.random() < HISS_SHARE:
            _add_blast(out, at, rate_hz, ((rng.uniform(0.05, 0.5), rng.uniform(*HISS_S)),), rng)
    return out


# A series of barks: harmonics whose pitch rises and falls by a third, with a share of noise (assumed, from a
# lapdog to a large dog).
BARK_HZ, BARK_S, BARK_RISE, ROUGH = (250.0, 900.0), (0.08, 0.35), 0.35, 0.8
BARKS_GAP_S, QUIET_SHARE, QUIET_S = (0.25, 1.5), 0.2, (1.0, 3.0)


def dog(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a dog and its barks, shape (samples,)."""
    out, at = np.zeros(samples), rng.uniform(0.0, 0.8)
    pitch, gap_s = rng.uniform(*BARK_HZ), rng.uniform(*BARKS_GAP_S)
    while at < samples / rate_hz:
        length_s = rng.uniform(*BARK_S)
        time = _times(out, at, length_s, rate_hz)
        arch = np.sin(np.pi * time / length_s)
        glide = pitch * rng.uniform(0.9, 1.1) * (1.0 + BARK_RISE * arch)
        wave = harmonics(glide, _falling(rng.uniform(0.5, 1.5), 14), rate_hz) if len(time) else time
        wave = wave + 2.0 * rng.uniform(0.0, ROUGH) * np.std(wave) * rng.standard_normal(len(time))
        _add(out, at, rate_hz, wave * np.sqrt(arch) * 10.0 ** (rng.standard_normal() / 10.0))
        at += rng.uniform(*QUIET_S) if rng.random() < QUIET_SHARE else gap_s * rng.uniform(0.7, 1.5)
    return out


# A shot is a blast with an echo; the shots of a burst are evenly spaced (assumed).
BLAST_DECAY_S, ECHO, ECHO_S = (0.005, 0.06), (0.02, 0.25), (0.1, 0.7)
BURST_S, SINGLE_S = (0.08, 0.6), (0.8, 4.0)


def shots(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw single shots or bursts, shape (samples,)."""
    out, at, pace_s = np.zeros(samples), rng.uniform(0.1, 2.0), rng.uniform(*BURST_S)
    in_bursts = rng.random() < 0.5
    while at < samples / rate_hz:
        parts = (1.0, rng.uniform(*BLAST_DECAY_S)), (rng.uniform(*ECHO), rng.uniform(*ECHO_S))
        _add_blast(out, at, rate_hz, parts, rng)
        at += pace_s * rng.uniform(0.9, 1.1) if in_bursts else rng.uniform(*SINGLE_S)
    return out


def _falling(slope: float, count: int) -> list[float]:
    """Return amplitudes of partials that fall by a power of their order."""
    return [order**-slope for order in range(1, count + 1)]


def _times(out: FloatArray, at_s: float, length_s: float, rate_hz: float) -> FloatArray:
    """Return the times since `at_s` of a note, cut at the end of the sound."""
    return np.arange(max(min(int(length_s * rate_hz), len(out) - int(at_s * rate_hz)), 0)) / rate_hz


def _add(out: FloatArray, at_s: float, rate_hz: float, wave: FloatArray) -> None:
    first = int(at_s * rate_hz)
    out[first : first + len(wave)] += wave


def _add_blast(
    out: FloatArray,
    at_s: float,
    rate_hz: float,
    parts: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> None:
    """Add decaying white noise: parts are an amplitude and a time constant in s."""
    time = _times(out, at_s, INAUDIBLE_DECAYS * max(decay_s for _, decay_s in parts), rate_hz)
    envelope = np.sum([amplitude * np.exp(-time / decay_s) for amplitude, decay_s in parts], axis=0)
    _add(out, at_s, rate_hz, envelope * rng.standard_normal(len(time)))


# A great tit's two notes, a house sparrow's chirps, a blackbird's whistles; pitches and lengths are assumed.
# Each is the notes of a phrase (start and end in Hz, length in s), the range of its repetitions, the pause
# between notes and the range of the rest after the phrases.
SONGS = (
    (((5500.0, 5200.0, 0.11), (3900.0, 3700.0, 0.15)), (4, 9), 0.05, (1.0, 3.0)),
    (((3200.0, 5200.0, 0.03), (5200.0, 3400.0, 0.06)), (1, 6), 0.25, (0.5, 1.5)),
    (((2300.0, 2500.0, 0.18), (2700.0, 2250.0, 0.15), (2450.0, 3000.0, 0.2)), (1, 3), 0.04, (1.5, 3.0)),
)
WHISTLE_OVERTONES = (1.0, 0.1)
TRANSPOSE = (0.95, 1.1)


def birds(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw consecutive phrases of several birds, shape (samples,)."""
    out, at = np.zeros(samples), rng.uniform(0.0, 0.5)
    while at < samples / rate_hz:
        notes, repeats, gap_s, rest_s = SONGS[rng.integers(len(SONGS))]
        pitch = rng.uniform(*TRANSPOSE)
        for _ in range(int(rng.integers(*repeats))):
            for low, high, length in notes:
                _add_note(out, at, rate_hz, pitch * low, pitch * high, length)
                at += length + gap_s
        at += rng.uniform(*rest_s)
    return out


def _add_note(out: FloatArray, at_s: float, rate_hz: float, begin: float, end: float, length: float) -> None:
    first = int(at_s * rate_hz)
    count = min(int(length * rate_hz), len(out) - first)
    if count > 0:
        glide = begin * (end / begin) ** (np.arange(count) / (length * rate_hz))
        envelope = gate(count, rate_hz, [(0.0, length)], 0.3 * length)
        out[first : first + count] += envelope * harmonics(glide, WHISTLE_OVERTONES, rate_hz)


# The German emergency horn in town: 410 and 547 Hz, a fourth apart as DIN 14610 requires; the length of each
# tone is assumed. Its compressed-air horns have most energy above 1 kHz: the technical rules of DIN 14610
# require a harmonic of 104 dB there.
TWO_TONES_HZ, TONE_S, GLIDE_S = (410.0, 547.0), 0.75, 0.03
# These signs give the lowest peak, 4 dB above the RMS. Partials in phase have 10 dB: they are trains of
# clicks, which clip at the microphones at a much lower level.
HORN_PARTIALS = (0.5, 0.7, -1.0, 1.0, 0.9, 0.7, 0.5, -0.35, -0.25, -0.18, 0.12, 0.08)
# Wail of an electronic siren: 10 to 30 cycles per minute (13 CCR 1028); its span is assumed.
WAIL_HZ, WAILS_HZ = (600.0, 1400.0), (0.2, 0.35)
WAIL_PARTIALS = (1.0, 0.1, 0.35, 0.05, 0.2, 0.03, 0.1)  # Nearly a square wave
# Two discs a third apart (assumed); UN Regulation No. 28 requires that 1.8 to 3.55 kHz is the loudest part.
DISCS_HZ, DISC_SPREAD = (420.0, 505.0), 0.05
DISC_PARTIALS = (0.3, 0.3, 0.4, -0.6, -0.9, -1.0, 0.9, -0.7, -0.4, 0.25, -0.15, 0.1)
BLAST_S, PAUSE_S = (0.3, 1.2), (0.4, 2.0)
# One tone between 1 and 1.2 kHz, on for half of each second and off for the other half (assumed within SAE
# J994).
BEEP_HZ, BEEPS_HZ = (1000.0, 1200.0), (0.95, 1.05)
BEEP_PARTIALS = (1.0, 0.05, 0.1)


def siren(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw two alternating tones, shape (samples,)."""
    time = np.arange(samples) / rate_hz + rng.uniform(0.0, 2.0 * TONE_S)
    turn = np.mod(time, 2.0 * TONE_S)
    rising = np.clip(turn / GLIDE_S, 0.0, 1.0)
    falling = np.clip((turn - TONE_S) / GLIDE_S, 0.0, 1.0)
    low, high = TWO_TONES_HZ
    return harmonics(low + (high - low) * (rising - falling), HORN_PARTIALS, rate_hz)


def wail(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw one tone that rises and falls, shape (samples,)."""
    low, high = WAIL_HZ
    cycles = rng.random() + rng.uniform(*WAILS_HZ) * np.arange(samples) / rate_hz
    return harmonics(low * (high / low) ** (0.5 - 0.5 * np.cos(2.0 * np.pi * cycles)), WAIL_PARTIALS, rate_hz)


def horn(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw blasts of a pair of disc horns, shape (samples,)."""
    tune = rng.uniform(1.0 - DISC_SPREAD, 1.0 + DISC_SPREAD)
    blasts = gate(samples, rate_hz, bursts(samples / rate_hz, BLAST_S, PAUSE_S, rng), 0.02)
    both = [harmonics(np.full(samples, tune * disc), DISC_PARTIALS, rate_hz) for disc in DISCS_HZ]
    return blasts * (both[0] + both[1])


# Common features of sirens and horns of any make: harmonics of one sweeping pitch, of two alternating
# pitches, or of one or two steady ones (spans assumed, wider than any regulation).
SWEEP_LOW_HZ, SWEEP_RATIO, SWEEPS_HZ = (350.0, 900.0), (1.3, 2.6), (0.1, 8.0)
TURN_LOW_HZ, TURN_RATIO, TURN_S, TURN_GLIDE_S = (350.0, 800.0), (1.15, 1.6), (0.25, 1.0), 0.02
HELD_HZ, HELD_S, HELD_PAUSE_S = (250.0, 650.0), (0.3, 8.0), (0.1, 2.0)
# Roughness of a diaphragm, fitted to the modulation of 24 real horns above 6 Hz, which steady tones lack.
DIAPHRAGM, DIAPHRAGM_S, HORN_FALLS = (0.0, 0.6), (0.01, 0.06), (0.0, 0.8)
SECOND_RATIO, SECOND_SHARE = (1.15, 1.35), 0.7


def sweeps(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a siren that rises and falls at any pace, smoothly or linearly, shape (samples,)."""
    low, ratio = rng.uniform(*SWEEP_LOW_HZ), rng.uniform(*SWEEP_RATIO)
    pace_hz = np.exp(rng.uniform(*np.log(SWEEPS_HZ)))
    cycles = rng.random() + pace_hz * np.arange(samples) / rate_hz
    is_round = rng.random() < 0.5
    height = 0.5 - 0.5 * np.cos(2.0 * np.pi * cycles) if is_round else 2.0 * np.abs(np.mod(cycles, 1.0) - 0.5)
    return harmonics(low * ratio**height, _falling(rng.uniform(0.5, 2.5), 9), rate_hz)


def turns(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a siren of any two alternating tones, shape (samples,)."""
    low, ratio, tone_s = rng.uniform(*TURN_LOW_HZ), rng.uniform(*TURN_RATIO), rng.uniform(*TURN_S)
    cycles = np.mod((np.arange(samples) / rate_hz + rng.uniform(0.0, 2.0 * tone_s)) / tone_s, 2.0)
    height = np.clip(0.5 + (np.abs(cycles - 1.0) - 0.5) * tone_s / TURN_GLIDE_S, 0.0, 1.0)
    return harmonics(low * ratio**height, _falling(rng.uniform(0.3, 1.5), 11), rate_hz)


def horns(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw blasts of one or two horns of any pitch, shape (samples,)."""
    pitches = [rng.uniform(*HELD_HZ)]
    if rng.random() < SECOND_SHARE:
        pitches.append(pitches[0] * rng.uniform(*SECOND_RATIO))
    longest_s = np.exp(rng.uniform(*np.log(HELD_S)))
    blasts = gate(samples, rate_hz, bursts(samples / rate_hz, (0.1, longest_s), HELD_PAUSE_S, rng), 0.01)
    amplitudes = rng.uniform(0.2, 1.0, 15) * np.arange(1.0, 16.0) ** -rng.uniform(*HORN_FALLS)
    held = [harmonics(np.full(samples, pitch), amplitudes.tolist(), rate_hz) for pitch in pitches]
    rough, every_s = rng.uniform(*DIAPHRAGM), rng.uniform(*DIAPHRAGM_S)
    together = [(1.0 + rough * drift(samples, rate_hz, every_s, rng)) * one for one in held]
    return np.asarray(blasts * np.sum(together, axis=0))


def beeper(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw an intermittent tone, shape (samples,)."""
    period_s = 1.0 / rng.uniform(*BEEPS_HZ)
    starts = np.arange(0.0, samples / rate_hz, period_s)
    beeps = gate(samples, rate_hz, [(at, at + 0.5 * period_s) for at in starts.tolist()], 0.01)
    return beeps * harmonics(np.full(samples, rng.uniform(*BEEP_HZ)), BEEP_PARTIALS, rate_hz)


# Hammer drills strike 25 to 80 times per second, breakers 9 to 30 times (manufacturers' data; 9 to 21 in the
# envelopes of seven real breakers). The blows are not quite even and are slower under load. Each blow excites
# modes of bit, body and ground, which ring for some cycles, and a burst of noise. Between blows the motor or
# the air is audible. Fitted to the features of real drilling and jackhammers
# (docs/evidence/foreign_sounds.md).
DRILL_BLOWS_HZ, BREAKER_BLOWS_HZ = (25.0, 80.0), (9.0, 30.0)
UNEVEN_BLOWS, BLOW_SPREAD_DB, BLOW_DRIFT = (0.002, 0.03), (0.5, 3.0), (0.01, 0.08)
MODES, MODE_HZ, MODE_CYCLES, LONGEST_MODE_S = (3, 10), (120.0, 5000.0), (2.0, 15.0), 0.04
IMPACT_S, IMPACT, BETWEEN, MOTOR = (0.003, 0.03), (0.1, 2.0), (0.05, 1.0), (0.3, 2.5)
BLOW_DB = (-8.0, -5.0, -3.0, 0.0, 0.0, -2.0, -5.0, -8.0)
DRILLED_S, BROKEN_S, REST_S = (0.4, 5.0), (3.0, 15.0), (0.2, 2.0)
# Circular saws, grinders, drills without blows: a motor or a blade of 50 to 500 turns per second, with teeth
# or gears that whine up to 5 kHz (manufacturers' data: 24 or 40 teeth at 55 to 75 turns, motors at 100 to
# 500). The speed rises at the start, drops under load and falls at the end.
MOTOR_HZ, GEARS_HZ, RUN_S = (50.0, 500.0), (50.0, 5000.0), (0.05, 0.8)
LOAD_S, LOADED_S, MOST_SAG, LOADED_DB = (0.2, 2.0), (0.1, 1.5), 0.35, (0.0, 12.0)
GRIND_DB = (-25.0, -20.0, -15.0, -10.0, -4.0, 0.0, 2.0, 0.0)
WHINE, GRIND, CHATTER_HZ, CHATTER_DB = (0.4, 2.5), (0.05, 1.0), (8.0, 80.0), (0.0, 4.0)


def drill(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a hammer drill that drills several holes, shape (samples,)."""
    runs = bursts(samples / rate_hz, DRILLED_S, REST_S, rng)
    motor = motor_sound(gate(samples, rate_hz, runs, 0.1), rate_hz, rng)
    return hammered(samples, rate_hz, runs, DRILL_BLOWS_HZ, rng) + rng.uniform(*MOTOR) * motor


def jackhammer(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a road breaker, shape (samples,)."""
    return hammered(samples, rate_hz, bursts(samples / rate_hz, BROKEN_S, REST_S, rng), BREAKER_BLOWS_HZ, rng)


def hammered(
    samples: int, rate_hz: float, runs: Spans, blows_hz: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Draw blows while the tool runs, their excited modes, and air between them, shape (samples,)."""
    running, pace_hz = gate(samples, rate_hz, runs, 0.1), np.exp(rng.uniform(*np.log(blows_hz)))
    cycles = np.cumsum(pace_hz * (1.0 + rng.uniform(*BLOW_DRIFT) * drift(samples, rate_hz, 0.4, rng)))
    at = np.flatnonzero(np.diff(np.floor(cycles / rate_hz)))
    late = rng.uniform(*UNEVEN_BLOWS) * rate_hz / pace_hz * rng.standard_normal(len(at))
    blows = np.zeros(samples)
    strength = 10.0 ** (rng.uniform(*BLOW_SPREAD_DB) * rng.standard_normal(len(at)) / 20.0)
    np.add.at(blows, np.clip(at + np.round(late).astype(int), 0, samples - 1), strength * running[at])
    response, impact_s = np.zeros(round(0.3 * rate_hz)), rng.uniform(*IMPACT_S)
    low, high = np.log(MODE_HZ)
    for mode_hz in np.exp(rng.uniform(low, high, int(rng.integers(*MODES)))).tolist():
        decay_s = min(rng.uniform(*MODE_CYCLES) / mode_hz, LONGEST_MODE_S)
        add_ringing(response, 0.0, rate_hz, [(mode_hz, rng.uniform(0.3, 1.0), decay_s)])
    decay = np.exp(-np.arange(len(response)) / rate_hz / impact_s)
    ringing, envelope = (scipy.signal.fftconvolve(blows, one)[:samples] for one in (response, decay))
    noise = octave_noise(BLOW_DB, samples, rate_hz, rng)
    air = rng.uniform(*BETWEEN) * running * _unit(noise)
    return np.asarray(_unit(ringing) + rng.uniform(*IMPACT) * _unit(noise * envelope) + air)


def saw(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a saw or another machine that runs up, works under load and runs out, shape (samples,)."""
    spans = bursts(samples / rate_hz, DRILLED_S, REST_S, rng)
    return motor_sound(gate(samples, rate_hz, spans, rng.uniform(*RUN_S)), rate_hz, rng)


def motor_sound(running: FloatArray, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw motor, gears and grinding at a speed 0..1 that drops under load, of unit power."""
    samples = len(running)
    load = gate(samples, rate_hz, bursts(samples / rate_hz, LOAD_S, LOADED_S, rng), 0.2)
    speed = running * (1.0 - rng.uniform(0.0, MOST_SAG) * load)
    speed *= 1.0 + 0.01 * drift(samples, rate_hz, 0.1, rng)
    fastest_hz, chatter_s = rng.uniform(*MOTOR_HZ), 1.0 / rng.uniform(*CHATTER_HZ)
    both_hz = fastest_hz, float(np.exp(rng.uniform(*np.log(GEARS_HZ))))
    whine = [harmonics(one * speed, rng.uniform(0.1, 1.0, 8).tolist(), rate_hz) for one in both_hz]
    grind = _unit(octave_noise(GRIND_DB, samples, rate_hz, rng) * (0.3 + 0.7 * load))
    worked = rng.uniform(*WHINE) * _unit(whine[0] + whine[1]) + rng.uniform(*GRIND) * grind
    level_db = rng.uniform(*LOADED_DB) * (load - 1.0)
    level_db += rng.uniform(*CHATTER_DB) * drift(samples, rate_hz, chatter_s, rng)
    return _unit(running * worked * 10.0 ** (level_db / 20.0))


def _unit(signal: FloatArray) -> FloatArray:
    return np.asarray(signal / (signal.std() + np.finfo(float).tiny))


# Pitches from the hum of a transformer to a whistle; number and strength of overtones are assumed.
PITCH_HZ, OVERTONES, STRONGEST = (120.0, 2200.0), (0, 5), 0.6
UNSTEADY = 0.002
OFF_SHARE, ON_S, OFF_S = 0.3, (0.5, 3.0), (0.3, 1.5)


def tone(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a steady pitch with overtones, shape (samples,)."""
    pitch = np.exp(rng.uniform(*np.log(PITCH_HZ))) * (1.0 + UNSTEADY * drift(samples, rate_hz, 0.5, rng))
    falls, count = rng.uniform(0.0, STRONGEST), int(rng.integers(*OVERTONES))
    out = harmonics(pitch, [falls**k for k in range(1 + count)], rate_hz)
    if rng.random() < OFF_SHARE:
        out *= gate(samples, rate_hz, bursts(samples / rate_hz, ON_S, OFF_S, rng), 0.02)
    return out
