"""What vehicles warn with: siren, horn, reversing beeper."""

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import bursts, gate, harmonics

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
