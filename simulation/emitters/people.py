"""People: a talker, a glottal pulse train through the formants of vowels, and footsteps, heel and sole."""

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from worldstate.ground.typing import Complex128Array, FloatArray
from worldstate.simulation.scene.octave_bands import octave_masks

from .signals import Spans, add_ringing, drift, gate, octave_noise

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
PITCH_HZ = (105.0, 215.0)  # men's and women's mean pitch
HIGH_VOICE_HZ, SHORT_TRACT = 160.0, 1.15  # a shorter vocal tract has higher formants
# A syllable takes a quarter of a second: speech is modulated at 3 to 6 Hz most of all.
SYLLABLE_S, CLOSURE_S, PHRASE, PAUSE_S = (0.14, 0.24), (0.03, 0.07), (5, 12), (0.25, 0.6)
SYLLABLE_SPREAD_DB = 2.0
# The glottal flow falls with 12 dB an octave above its corner and the mouth radiates its derivative.
GLOTTAL_CORNER_HZ = 150.0
FRICATIVE_SHARE, FRICATIVE_S = 0.5, (0.05, 0.1)
FRICATIVE_DB, FRICATIVE_GAIN = (-40.0, -40.0, -40.0, -40.0, -12.0, -6.0, 0.0, 0.0), 0.1
# Octave levels of raised speech, ANSI S3.5-1997, summed from its third octaves; below 100 Hz nothing is said.
# Five formants alone leave too little above 2 kHz: the higher ones are missing.
RAISED_DB = np.array([0.0, 53.0, 60.5, 64.9, 62.7, 57.2, 51.2, 42.5])


def voice(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a talker and what is said, shape (samples,)."""
    pitch_hz = rng.uniform(*PITCH_HZ)
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
    """Spectrum of the pulse train through a vowel in every syllable, shape (n // 2 + 1,)."""
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
    """Gain that brings the octaves of a talker to those of `RAISED_DB`."""
    masks = octave_masks(frequency_hz)
    power = np.square(np.abs(spectrum) * masks).sum(axis=1) + np.finfo(float).tiny
    return np.asarray(np.sqrt(10.0 ** (RAISED_DB / 10.0) / power) @ masks)


def _syllables(end_s: float, rng: np.random.Generator) -> tuple[list[tuple[float, float]], list[float]]:
    """Spans of the syllables, and how high each one is in its phrase, which falls."""
    spans, heights, at = [], [], 0.0
    while at < end_s:
        count = int(rng.integers(*PHRASE))
        for height in np.linspace(1.15, 0.85, count).tolist():
            stop = at + rng.uniform(*SYLLABLE_S)
            spans.append((at, stop))
            heights.append(height)
            at = stop + rng.uniform(*CLOSURE_S)
        at += rng.uniform(*PAUSE_S)
    return spans, heights


def _pulses(pitch_hz: FloatArray, rate_hz: float) -> FloatArray:
    """One impulse a period, between two samples where it falls between them, shape (samples,)."""
    cycles = np.cumsum(pitch_hz) / rate_hz
    at = np.flatnonzero(np.diff(np.floor(cycles)))
    late = np.mod(cycles[at + 1], 1.0) / (pitch_hz[at + 1] / rate_hz)
    out = np.zeros(len(pitch_hz))
    out[at + 1] += (1.0 - late) * rate_hz
    out[at] += late * rate_hz
    return out


def _tract(frequency_hz: FloatArray, formants_hz: FloatArray) -> Complex128Array:
    r"""Glottal flow, vocal tract and radiation: a cascade of resonators of unit gain at 0 Hz.

    .. math:: H(f) = \frac{jf}{(1 + jf / f_g)^2} \prod_k \frac{f_k^2}{f_k^2 - f^2 + j f b_k}
    """
    f = frequency_hz
    out = 1j * f / (1.0 + 1j * f / GLOTTAL_CORNER_HZ) ** 2
    for formant, width in zip((*formants_hz, *HIGHER_HZ), BANDWIDTHS_HZ, strict=True):
        out = out * formant**2 / (formant**2 - f**2 + 1j * f * width)
    return np.asarray(out)


def _fricatives(samples: int, rate_hz: float, syllables: Spans, rng: np.random.Generator) -> FloatArray:
    """Noise of the teeth before some of the syllables, shape (samples,)."""
    spans = [
        (start - rng.uniform(*FRICATIVE_S), start) for start, _ in syllables if rng.random() < FRICATIVE_SHARE
    ]
    noise = octave_noise(FRICATIVE_DB, samples, rate_hz, rng)
    return noise * gate(samples, rate_hz, spans, 0.02)


# People walk at 1.5 to 2.3 steps a second, 1.9 in the mean (Bachmann and Ammann, "Vibrations in structures
# induced by man and machines", IABSE, 1987).
CADENCE_HZ = (1.7, 2.1)
UNEVEN_S, UNEVEN_DB = 0.015, 1.5
# Heel and sole as short damped modes of shoe and paving, and the broadband click of the contact (assumed).
HEEL = ((90.0, 1.0, 0.025), (240.0, 0.8, 0.012), (620.0, 0.5, 0.006), (1700.0, 0.3, 0.003))
SOLE_AFTER_S, SOLE = 0.14, ((160.0, 0.5, 0.015), (450.0, 0.3, 0.008))
CLICK_DB = (-20.0, -10.0, -5.0, 0.0, 2.0, 2.0, 0.0, -4.0)
CLICK_S, CLICK_GAIN = 0.02, 2000.0


def steps(samples: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a walker and what each step sounds like, shape (samples,)."""
    period_s = 1.0 / rng.uniform(*CADENCE_HZ)
    out = np.zeros(samples)
    at = np.arange(rng.uniform(0.0, period_s), samples / rate_hz, period_s)
    heels = np.maximum(at + UNEVEN_S * rng.standard_normal(len(at)), 0.0)
    clicks = gate(samples, rate_hz, [(heel, heel + CLICK_S) for heel in heels], 0.5 * CLICK_S)
    out += CLICK_GAIN * clicks * octave_noise(CLICK_DB, samples, rate_hz, rng)
    for heel in heels.tolist():
        strength = 10.0 ** (UNEVEN_DB * rng.standard_normal() / 20.0)
        add_ringing(out, heel, rate_hz, HEEL, strength)
        add_ringing(out, heel + SOLE_AFTER_S, rate_hz, SOLE, strength)
    return out
