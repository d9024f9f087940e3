"""Steady tones: a fan, a transformer, a pump, a whistle, some of them on and off."""

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import bursts, drift, gate, harmonics

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
