"""Bells: inharmonic partials that ring down, struck again and again."""

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import add_ringing

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
