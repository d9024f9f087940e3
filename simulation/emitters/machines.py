"""Machines: a saw, a drill, and the steady tones of a fan, a transformer, a pump or a whistle."""

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import add_ringing, bursts, drift, gate, harmonics, octave_noise

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
