"""Footsteps: the heel's blow, then the sole's."""

import numpy as np

from worldstate.ground.typing import FloatArray

from .signals import add_ringing, gate, octave_noise

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
