"""The synthetic smoothing problem: bearing and looming while hidden, then range, for a standing ego."""

import math
from dataclasses import dataclass

import numpy as np

from worldstate.belief.kinematics import motion
from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.ground import wrap_angle
from worldstate.measurement import Approach, Bearing
from worldstate.smoothing import AngularHeight, FixedLagSmoother, Range, SmoothingSettings

HOP_S, HOP_NS, HOPS, HIDDEN_HOPS = 0.1, 100_000_000, 60, 35
PSD = 1.0  # Of the acceleration of vehicles, m^2/s^3
HIDDEN_STD_RAD, SEEN_STD_RAD, LOOMING_STD_HZ, RANGE_STD_M = math.radians(4.0), math.radians(1.0), 0.25, 0.5
PRIOR = MotionBelief.around((0.9, -0.1, -0.2, math.log(25.0)), (0.35, 0.15, 0.15, 0.5))


@dataclass(frozen=True, slots=True)
class Problem:
    """One vehicle drawn from the prior at a suitable distance, and its measurements."""

    places_m: np.ndarray
    observations: list


def heard_then_seen(rng: np.random.Generator) -> Problem:
    places, azimuth, rate = _drawn(rng)
    r = np.hypot(*places.T)
    observations = []
    for hop in range(HOPS):
        hidden = hop < HIDDEN_HOPS
        std = HIDDEN_STD_RAD if hidden else SEEN_STD_RAD
        seen = [Bearing(wrap_angle(azimuth[hop] + rng.normal(0.0, std)), std)]
        seen.append(Approach(rate[hop] + rng.normal(0.0, LOOMING_STD_HZ), LOOMING_STD_HZ))
        if not hidden:
            seen.append(Range(max(r[hop] + rng.normal(0.0, RANGE_STD_M), 1.0), RANGE_STD_M))
        observations.append(seen)
    return Problem(places, observations)


def _drawn(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = HOP_S
    flow = np.eye(4) + t * np.eye(4, k=2)
    jolt = np.linalg.cholesky(PSD * np.kron([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]], np.eye(2)))
    while True:
        theta, turning, closing, log_m = rng.normal(PRIOR.mean, np.sqrt(np.diag(PRIOR.covariance)))
        z = np.exp(log_m + 1j * theta)
        v = z * (closing + 1j * turning)
        states = [np.array([z.real, z.imag, v.real, v.imag])]
        for _ in range(HOPS - 1):
            states.append(flow @ states[-1] + jolt @ rng.standard_normal(4))
        x, y, vx, vy = np.array(states).T
        r = np.hypot(x, y)
        if r.min() > 4.0 and r.max() < 70.0:
            return np.stack([x, y], axis=1), np.arctan2(y, x), -(x * vx + y * vy) / r**2


def hidden_errors_m(seed: int) -> tuple[float, float]:
    """Return the rms error of hidden positions of filter and smoother."""
    problem = heard_then_seen(np.random.default_rng(seed))
    belief, filtered = PRIOR, []
    smoother = FixedLagSmoother(SmoothingSettings(acceleration_psd=PSD))
    smoother.begin("car", 0, belief)
    for hop, observed in enumerate(problem.observations):
        smoother.update(hop * HOP_NS, {"car": observed})
        if hop < HIDDEN_HOPS:
            belief = motion.predict(belief, HOP_S, PSD) if hop else belief
            bearing, approach = observed
            belief = motion.update(belief, motion.AZIMUTH, bearing.azimuth_rad, bearing.std_rad, 1.0)
            belief = motion.update(belief, motion.RADIAL_RATE, -approach.inverse_tta_hz, approach.std_hz, 1.0)
            filtered.append(np.exp(belief.mean[3] + 1j * belief.mean[0]))
    z = np.array(filtered)
    true = problem.places_m[:HIDDEN_HOPS]
    smoothed = smoother.track("car").states[:HIDDEN_HOPS, :2]
    return tuple(
        math.sqrt(((found - true) ** 2).sum(axis=1).mean())
        for found in (np.stack([z.real, z.imag], axis=1), smoothed)
    )


PASS_HOPS, ENTITIES = 160, 3


def slots_of_a_street(hops: int, rng: np.random.Generator) -> int:
    """Return the number of factor slots after a stream of three entities."""
    smoother = FixedLagSmoother()
    for hop in range(hops):
        seen = {}
        for number in range(ENTITIES):
            # Each returns after its pass with another name: 16 s, at first 24 m to 40 m away.
            after, passes = (hop + 53 * number) % PASS_HOPS, (hop + 53 * number) // PASS_HOPS
            seen[f"{number}-{passes}"] = crossing(after, number, rng)
        smoother.update(hop * HOP_NS, seen)
    return smoother.n_factor_slots


def crossing(hop: int, number: int, rng: np.random.Generator) -> list:
    """Return the measurements of one entity at a hop of its pass."""
    side = 1 if number % 2 == 0 else -1
    x, y, speed = 8.0 + number, side * (24.0 - 0.3 * hop), 3.0
    azimuth, r = math.atan2(y, x), math.hypot(x, y)
    inverse_tta = side * y * speed / r**2
    heard = [
        Bearing(wrap_angle(azimuth + rng.normal(0.0, 0.07)), 0.07),
        Approach(inverse_tta + rng.normal(0.0, 0.25), 0.25),
    ]
    hidden = side * y / x > 0.6
    if hop % 10 == 0:
        # Without any range one entity in some 300 gives gtsam's "indeterminate linear system".
        heard.append(Range(max(r + rng.normal(0.0, 2.0), 1.0), 2.0))
    if not hidden:
        heard[0] = Bearing(azimuth + rng.normal(0.0, 0.01), 0.01)
        heard.append(AngularHeight(1.5 / r * math.exp(rng.normal(0.0, 0.03)), 0.03))
    return heard
