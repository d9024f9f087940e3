"""A vehicle on the crossing street: where it is, and how loud it is by itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .bands import OCTAVES_HZ, REFERENCE_PA, octave_masks, split_octaves

LENGTH_M, WIDTH_M, HEIGHT_M = 4.3, 1.8, 1.5
AXLES_BEHIND_FRONT_M = (0.9, 3.5)  # each axle is a source of its own; the engine is at the first
SOURCE_HEIGHT_M = 0.3

# CNOSSOS-EU, Directive (EU) 2015/996 as amended by (EU) 2021/1226, table F-1, category 1 (light vehicles):
# sound power level in dB per octave 63 Hz .. 8 kHz at 70 km/h, and its slope with speed.
ROLLING_A_DB = np.array([83.1, 89.2, 87.7, 93.1, 100.1, 96.7, 86.8, 76.2])
ROLLING_B_DB = np.array([30.0, 41.5, 38.9, 25.7, 32.5, 37.2, 39.0, 40.0])
PROPULSION_A_DB = np.array([97.9, 92.5, 90.7, 87.2, 84.7, 88.0, 84.4, 77.1])
PROPULSION_B_DB = np.array([-1.3, 7.2, 7.7, 8.0, 8.0, 8.0, 8.0, 8.0])
REFERENCE_KMH = 70.0
# Sound power to pressure at 1 m over hard ground: -11 dB of a free sphere, +3 dB of the ground's half-space.
POWER_TO_1M_DB = -8.0
SLOWEST_KMH = 10.0  # the law is fitted above 20; a log of zero speed would be silence
HARMONIC_SHARE = 0.5  # of the propulsion power; the rest is broadband
HARMONICS = 24


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Motion of the front bumper along the crossing street (y), at a fixed lane (x).

    Parameters
    ----------
    time_s : ndarray, shape (T,)
        Increasing, evenly spaced.
    front_y_m : ndarray, shape (T,)
        Position of the front bumper.
    speed_mps : ndarray, shape (T,)
        Speed, >= 0.
    lane_x_m : float
        Middle of the lane, m ahead of the ego.
    heading : int
        +1 towards +y (comes from the right), -1 towards -y (comes from the left).
    """

    time_s: NDArray[np.float64]
    front_y_m: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    lane_x_m: float
    heading: int

    def axle_y_m(self, axle: int = 0) -> NDArray[np.float64]:
        """Lateral position of the front (0) or rear axle (1), shape (T,)."""
        return self.front_y_m - self.heading * AXLES_BEHIND_FRONT_M[axle]


def drive(
    time_s: NDArray[np.float64],
    *,
    entry_s: float,
    entry_y_m: float,
    lane_x_m: float,
    speed_mps: float,
    braking_mps2: float = 0.0,
) -> Trajectory:
    """Pass `entry_y_m` at `entry_s`, braking at a constant rate during the two seconds before.

    Parameters
    ----------
    time_s : ndarray, shape (T,)
        Evenly spaced times.
    entry_s, entry_y_m : float
        Where the front is when; the sign of `entry_y_m` says from which side it comes (left positive).
    lane_x_m : float
        Middle of the lane.
    speed_mps : float
        Speed before braking.
    braking_mps2 : float
        Deceleration >= 0; the vehicle never falls below a quarter of its speed.

    Examples
    --------
    >>> path = drive(np.linspace(0, 8, 801), entry_s=7, entry_y_m=4, lane_x_m=6, speed_mps=10)
    >>> round(float(np.interp(6, path.time_s, path.front_y_m)), 2)
    14.0
    """
    heading = -1 if entry_y_m > 0 else 1
    slowed = braking_mps2 * np.clip(time_s - (entry_s - 2.0), 0.0, 2.0)
    speed = np.maximum(speed_mps - slowed, 0.25 * speed_mps)
    mean = np.r_[0.0, 0.5 * (speed[1:] + speed[:-1])]
    driven = np.cumsum(mean) * (time_s[1] - time_s[0])
    front = entry_y_m + heading * (driven - np.interp(entry_s, time_s, driven))
    return Trajectory(time_s, front, speed, lane_x_m, heading)


def rolling_level_db(speed_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sound power level of the tyres, L = A + B log10(v / 70 km/h), shape (8, T).

    Examples
    --------
    >>> rolling_level_db(np.array([70 / 3.6]))[4].round(1)
    array([100.1])
    """
    speed_kmh = np.maximum(3.6 * speed_mps, SLOWEST_KMH)
    return np.asarray(ROLLING_A_DB[:, None] + ROLLING_B_DB[:, None] * np.log10(speed_kmh / REFERENCE_KMH))


def propulsion_level_db(speed_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sound power level of the engine, L = A + B (v - 70) / 70, shape (8, T).

    Examples
    --------
    >>> propulsion_level_db(np.array([70 / 3.6]))[0].round(1)
    array([97.9])
    """
    relative = 3.6 * speed_mps / REFERENCE_KMH - 1.0
    return PROPULSION_A_DB[:, None] + PROPULSION_B_DB[:, None] * relative


def emit(
    trajectory: Trajectory,
    samples: int,
    sample_rate_hz: float,
    level_offset_db: float,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Draw the pressure that each axle emits, at 1 m, in Pa.

    The tyres of the two axles share the rolling noise and know nothing of each other, which makes a vehicle
    in view a wide source; engine noise, broadband and harmonics, comes from the front axle.

    Parameters
    ----------
    trajectory : Trajectory
        Its speeds set the levels; its first time is that of the first sample.
    samples : int
        Number of samples n.
    sample_rate_hz : float
        Rate in Hz.
    level_offset_db : float
        This vehicle against the fleet's mean.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    ndarray, shape (2, n)
        Front and rear axle.
    """
    time = trajectory.time_s[0] + np.arange(samples) / sample_rate_hz
    rolling = _pressure(rolling_level_db(trajectory.speed_mps) + level_offset_db)
    engine = _pressure(propulsion_level_db(trajectory.speed_mps) + level_offset_db)
    front = np.sqrt(0.5 * rolling**2 + (1.0 - HARMONIC_SHARE) * engine**2)
    axles = np.stack(
        [
            _noise(trajectory, time, pressure, sample_rate_hz, rng)
            for pressure in (front, np.sqrt(0.5) * rolling)
        ]
    )
    axles[0] += _harmonics(trajectory, time, np.sqrt(HARMONIC_SHARE) * engine, rng)
    return axles


def _noise(
    trajectory: Trajectory,
    time: NDArray[np.float64],
    octave_pressure: NDArray[np.float64],
    sample_rate_hz: float,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Gaussian noise whose octave pressures (8, T) follow the drive."""
    bands = split_octaves(rng.standard_normal(len(time), dtype=np.float32), sample_rate_hz)
    gains = octave_pressure / np.sqrt(_band_shares(sample_rate_hz))[:, None]
    signal = np.zeros(len(time), np.float32)
    for band, gain in zip(bands, gains, strict=True):
        signal += band * np.interp(time, trajectory.time_s, gain).astype(np.float32)
    return signal


def _pressure(power_level_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """RMS pressure at 1 m in Pa."""
    return np.asarray(REFERENCE_PA * 10.0 ** ((power_level_db + POWER_TO_1M_DB) / 20.0))


def _band_shares(sample_rate_hz: float) -> NDArray[np.float64]:
    """Power of white noise of unit variance in every octave band; bands beyond Nyquist stay empty."""
    masks = octave_masks(np.linspace(0.0, sample_rate_hz / 2.0, 4096))
    return np.asarray(np.maximum((masks**2).mean(axis=1), 1e-6))


def _harmonics(
    trajectory: Trajectory,
    time: NDArray[np.float64],
    octave_pressure: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Multiples of a wandering firing frequency, sharing each octave's pressure."""
    firing = _firing_frequency(trajectory, time, rng)
    cycles = np.cumsum(firing) / (len(time) / (time[-1] - time[0]))
    orders = np.arange(1, HARMONICS + 1)
    octave = np.clip(np.round(np.log2(orders * firing.mean() / OCTAVES_HZ[0])), 0, 7).astype(int)
    crowd = np.bincount(octave, minlength=8)
    signal = np.zeros(len(time), np.float32)
    for order, band in zip(orders, octave, strict=True):
        amplitude = octave_pressure[band].mean() * np.sqrt(2.0 / crowd[band])
        phase = 2.0 * np.pi * np.mod(order * cycles + rng.random(), 1.0)
        signal += np.float32(amplitude) * np.cos(phase.astype(np.float32))
    return signal


def _firing_frequency(
    trajectory: Trajectory, time: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw the firing frequency of four cylinders in Hz: follows the speed in one gear, wanders by 5 %."""
    mean_speed = trajectory.speed_mps.mean()
    idle_to_cruise = rng.uniform(45.0, 75.0)
    geared = idle_to_cruise * np.interp(time, trajectory.time_s, trajectory.speed_mps) / mean_speed
    knots = np.arange(time[0], time[-1] + 0.5, 0.5)
    wander = 1.0 + 0.05 * np.clip(rng.standard_normal(len(knots)) / 2.0, -1.0, 1.0)
    return np.asarray(np.clip(geared, 25.0, 200.0) * np.interp(time, knots, wander))
