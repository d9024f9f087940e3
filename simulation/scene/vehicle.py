"""Routes on the ground, the motion of the ego and of vehicles, and the sound power of each vehicle."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import check_ranges
from worldstate.ground.typing import Float32Array, FloatArray, IntArray

from .kinds import LIGHT, SILENT_DB, TYRE_M, VehicleKind
from .octave_bands import OCTAVES_HZ, REFERENCE_PA, octave_masks, split_octaves

FAR_M = 600.0  # Straight extension of a route at both ends


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A polyline parametrised by the distance driven; line of sight begins at 0."""

    driven_m: FloatArray  # shape (N,): Increasing
    points_m: FloatArray  # shape (N, 2): Positions there, x ahead and y left

    def at(self, driven_m: float | FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y after a driven distance, shape of `driven_m`."""
        along = np.asarray(driven_m)
        x, y = (np.interp(along, self.driven_m, column) for column in self.points_m.T)
        return np.asarray(x), np.asarray(y)


def along(points_m: ArrayLike, entry_m: float = 0.0) -> Route:
    """Return the route through `points_m` (N, 2), with 0 at `entry_m` after the first point.

    Examples
    --------
    >>> route = along([[6.0, 10.0], [6.0, -10.0]], entry_m=4.0)
    >>> [float(v) for v in route.at(2.0)]
    [6.0, 4.0]
    """
    points = np.asarray(points_m, dtype=np.float64)
    first, last = points[0] - points[1], points[-1] - points[-2]
    ahead = points[-1] + FAR_M * last / np.hypot(*last)
    behind = points[0] + FAR_M * first / np.hypot(*first)
    whole = np.concatenate([[behind], points, [ahead]])
    steps = np.hypot(*np.diff(whole, axis=0).T)
    return Route(np.r_[0.0, np.cumsum(steps)] - FAR_M - entry_m, whole)


BRAKING_MPS2 = 2.5
# Height of the origin of `base_link` above the road: the centre of the array on the roof
ARRAY_HEIGHT_M = 1.7


@dataclass(frozen=True, slots=True)
class EgoMotion:
    """An ego that drives along its street at constant speed, brakes and stops at the origin.

    Parameters
    ----------
    speed_mps : float
        Speed before braking; 0 for an ego at rest.
    stop_s : float
        Time at which it stops.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> ego = EgoMotion(5.0, 8.0)
    >>> ego.x_m(np.array([5.0, 7.0, 9.0])), ego.at_mps(np.array([5.0, 7.0, 9.0]))
    (array([-10.  ,  -1.25,   0.  ]), array([5. , 2.5, 0. ]))
    """

    speed_mps: float = 0.0
    stop_s: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(self, speed_mps=(0.0, 20.0), stop_s=(0.0, 120.0))

    @property
    def stands(self) -> bool:
        """Whether the ego is always at rest."""
        return self.speed_mps == 0.0

    def later(self, start_s: float) -> "EgoMotion":
        """Return the same motion on a clock that starts later; it is at rest if it has stopped by then.

        Examples
        --------
        >>> EgoMotion(5.0, 8.0).later(-2.0).stop_s, EgoMotion(5.0, 8.0).later(9.0).stands
        (10.0, True)
        """
        left_s = self.stop_s - start_s
        return replace(self, stop_s=left_s) if left_s > 0.0 else EgoMotion()

    def at_mps(self, time_s: FloatArray) -> FloatArray:
        """Return the speed at any time, shape of `time_s`."""
        return np.clip(BRAKING_MPS2 * (self.stop_s - time_s), 0.0, self.speed_mps)

    def x_m(self, time_s: FloatArray) -> FloatArray:
        """Return the position along the street, 0 at the stop, shape of `time_s`."""
        left = np.maximum(self.stop_s - time_s, 0.0)
        braking = np.minimum(left, self.speed_mps / BRAKING_MPS2)
        return np.asarray(0.0 - 0.5 * BRAKING_MPS2 * braking**2 - self.speed_mps * (left - braking))


LENGTH_M, WIDTH_M, HEIGHT_M = LIGHT.length_m, LIGHT.width_m, LIGHT.height_m
AXLES_BEHIND_FRONT_M = LIGHT.axles_m  # Each axle is a source; the engine is at the first
SOURCE_HEIGHT_M = 0.3

REFERENCE_KMH = 70.0
# Sound power to pressure at 1 m over hard ground: -11 dB of a free sphere, +3 dB of the ground's half-space.
POWER_TO_1M_DB = -8.0
FADE_KMH = 5.0  # A warning sound that ends at some speed has faded out this much above it
# Lower speeds are set to this: the law is fitted above 20 km/h, and the logarithm of 0 is infinite
SLOWEST_KMH = 10.0
CREEPING_MPS = 1.0  # Below this speed tyre noise fades: a vehicle at rest is an engine alone
HARMONIC_SHARE = 0.5  # Share of the propulsion power in harmonics; the rest is broadband
HARMONICS = 24
# Firing frequency of four cylinders over speed in gears 1 to 4, Hz per m/s; gears change at 2400 rpm, idle is
# 850 rpm.
GEARS_HZ_PER_MPS = (14.7, 8.0, 5.4, 4.0)
SHIFT_UP_HZ, IDLE_HZ = 80.0, 28.0
SHIFT_S = 0.4
WANDER, WANDER_STEP_S = 0.05, 0.5
# An engine under load is louder, and one that is driven by the wheels is quieter (source model of IMAGINE,
# light vehicles). Accelerations outside the second pair were not measured.
LOAD_DB_PER_MPS2, LOADS_MPS2 = 4.4, (-1.0, 2.0)
SILENCE_DB = 0.0  # An engine with every octave below this level is left out


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Motion along a route, or along the crossing street (y) in a fixed lane (x)."""

    time_s: FloatArray  # shape (T,): Increasing, evenly spaced
    front_y_m: FloatArray  # shape (T,): Lateral position of the front bumper
    speed_mps: FloatArray  # shape (T,): Speed, >= 0
    lane_x_m: float  # Middle of the lane, metres ahead of the origin
    heading: int  # +1 towards +y (comes from the right), -1 towards -y (comes from the left)
    kind: VehicleKind = LIGHT  # Kind of the vehicle
    route: Route | None = None  # Route, if it is not straight along the lane
    # shape (T,): Distance of the front along the route.
    driven_m: FloatArray = field(default_factory=lambda: np.zeros(0))

    def behind(self, distance_m: float) -> tuple[FloatArray, FloatArray]:
        """Return the position x, y at a distance behind the front, shape (T,) each."""
        if self.route is None:
            y = self.front_y_m - self.heading * distance_m
            return np.full_like(y, self.lane_x_m), y
        return self.route.at(self.driven_m - distance_m)

    def footprint_y_m(self) -> tuple[FloatArray, FloatArray]:
        """Return the lateral limits (right, left) of the whole vehicle, shape (T,) each."""
        ends = np.stack([self.front_y_m, self.behind(self.kind.length_m)[1]])
        if self.route is None:
            return ends.min(axis=0), ends.max(axis=0)
        wide = np.maximum(ends.max(axis=0) - ends.min(axis=0), self.kind.width_m)
        middle = ends.mean(axis=0)
        return middle - 0.5 * wide, middle + 0.5 * wide

    def at(self, time_s: FloatArray) -> "Trajectory":
        """Return the same motion at other times."""
        front = np.interp(time_s, self.time_s, self.front_y_m)
        speed = np.interp(time_s, self.time_s, self.speed_mps)
        driven = self.driven_m if self.route is None else np.interp(time_s, self.time_s, self.driven_m)
        return replace(self, time_s=time_s, front_y_m=front, speed_mps=speed, driven_m=driven)


def drive(
    time_s: FloatArray,
    *,
    entry_s: float,
    entry_y_m: float,
    lane_x_m: float,
    speed_mps: float,
    braking_mps2: float = 0.0,
    kind: VehicleKind = LIGHT,
) -> Trajectory:
    """Return a vehicle that passes `entry_y_m` at `entry_s` and brakes evenly in the two seconds before.

    Shapes: time_s (T,).
    """
    heading = -1 if entry_y_m > 0 else 1
    step = time_s[1] - time_s[0]
    # The motion is extended if it passes there before the first or after the last time.
    outside_s = time_s[0] - entry_s, entry_s - time_s[-1]
    before, after = (int(np.ceil(max(out_s, 0.0) / step)) for out_s in outside_s)
    earlier, later = step * np.arange(before, 0, -1), step * np.arange(1, after + 1)
    clock = np.r_[time_s[0] - earlier, time_s, time_s[-1] + later]
    slowed = braking_mps2 * np.clip(clock - (entry_s - 2.0), 0.0, 2.0)
    speed = np.maximum(speed_mps - slowed, 0.25 * speed_mps)
    driven = np.cumsum(np.r_[0.0, 0.5 * (speed[1:] + speed[:-1])]) * step
    front = entry_y_m + heading * (driven - np.interp(entry_s, clock, driven))
    asked = slice(before, before + len(time_s))
    return Trajectory(time_s, front[asked], speed[asked], lane_x_m, heading, kind)


def rolling_level_db(speed_mps: FloatArray, kind: VehicleKind = LIGHT) -> FloatArray:
    """Return the sound power level of the tyres, L = A + B log10(v / 70 km/h), shape (8, T)."""
    speed_kmh = np.maximum(3.6 * speed_mps, SLOWEST_KMH)
    return _octaves(kind.rolling_a_db) + _octaves(kind.rolling_b_db) * np.log10(speed_kmh / REFERENCE_KMH)


def propulsion_level_db(speed_mps: FloatArray, kind: VehicleKind = LIGHT) -> FloatArray:
    """Return the sound power level of the engine, L = A + B (v - 70) / 70, shape (8, T)."""
    speed_kmh = 3.6 * speed_mps
    fade_db = SILENT_DB * np.clip((speed_kmh - kind.propulsion_until_kmh) / FADE_KMH, 0.0, 1.0)
    relative = speed_kmh / REFERENCE_KMH - 1.0
    return _octaves(kind.propulsion_a_db) + _octaves(kind.propulsion_b_db) * relative + fade_db


def load_db(trajectory: Trajectory) -> FloatArray:
    """Return the level of the engine above that at constant speed, shape (T,)."""
    step = trajectory.time_s[1] - trajectory.time_s[0]
    acceleration = np.clip(np.gradient(trajectory.speed_mps, step), *LOADS_MPS2)
    return LOAD_DB_PER_MPS2 * _smooth(acceleration, trajectory.time_s)


def _octaves(levels_db: ArrayLike) -> FloatArray:
    return np.asarray(levels_db, dtype=np.float64)[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class SourceSignal:
    """One point source of a vehicle."""

    signal: Float32Array  # shape (n,): Pressure at 1 m, Pa
    behind_m: float  # Distance behind the front
    height_m: float  # Above the road


def emit(
    trajectory: Trajectory,
    samples: int,
    sample_rate_hz: float,
    level_offset_db: float,
    rng: np.random.Generator,
    engine_offset_db: float | FloatArray = 0.0,
) -> list[SourceSignal]:
    """Draw the signals of all tyres and of the engine; its level offset may differ by octave, (8, 1)."""
    # The tyres of the axles share the rolling noise but are uncorrelated, so that a vehicle in view is a wide
    # source. Engine noise, broadband and harmonics, is emitted at the first axle and higher up.
    kind = trajectory.kind
    time = trajectory.time_s[0] + np.arange(samples) / sample_rate_hz
    drawing = _Drawing(trajectory, time, sample_rate_hz, rng)
    rolling = _pressure(rolling_level_db(trajectory.speed_mps, kind) + level_offset_db)
    rolling *= np.clip(trajectory.speed_mps / CREEPING_MPS, 0.0, 1.0)
    tyres = rolling / np.sqrt(len(kind.axles_m))
    sources = [SourceSignal(drawing.noise(tyres), behind, TYRE_M) for behind in kind.axles_m]
    if max(kind.propulsion_a_db) > SILENCE_DB:
        engine_db = level_offset_db + engine_offset_db + load_db(trajectory)
        engine = _pressure(propulsion_level_db(trajectory.speed_mps, kind) + engine_db)
        sources.append(SourceSignal(drawing.engine(engine), kind.axles_m[0], kind.engine_m))
    return sources


@dataclass(frozen=True, slots=True, eq=False)
class _Drawing:
    """Motion, sample times and randomness of one vehicle's signals."""

    trajectory: Trajectory
    time: FloatArray
    sample_rate_hz: float
    rng: np.random.Generator

    def noise(self, octave_pressure: FloatArray, white: Float32Array | None = None) -> Float32Array:
        """Return noise, Gaussian or `white`, whose octave pressures (8, T) follow the motion."""
        if white is None:
            white = self.rng.standard_normal(len(self.time), dtype=np.float32)
        gains = octave_pressure / np.sqrt(_band_shares(self.sample_rate_hz))[:, None]
        signal = np.zeros(len(self.time), np.float32)
        for band, gain in zip(split_octaves(white, self.sample_rate_hz), gains, strict=True):
            signal += band * self._at_samples(gain)
        return signal

    def engine(self, octave_pressure: FloatArray) -> Float32Array:
        """Return noise and harmonics; an octave without a harmonic contains noise alone."""
        if self.trajectory.kind.turns_hz is not None:
            return self.noise(octave_pressure, exhaust_pulses(self.trajectory, self.time, self.rng))
        share = self.trajectory.kind.harmonic_share
        firing = firing_frequency_hz(self.trajectory, self.time, self.rng)
        octave, crowd = octaves_of_lines(firing)
        lines = np.where(crowd > 0, share, 0.0)[:, None]
        signal = self.noise(np.sqrt(1.0 - lines) * octave_pressure)
        if share > 0.0:
            shared = octave_pressure * np.sqrt(2.0 * lines / np.maximum(crowd, 1)[:, None])
            levels = [self._at_samples(row) for row in shared]
            cycles = np.cumsum(firing) / (len(self.time) / (self.time[-1] - self.time[0]))
            drawn = zip(octave, engine_lines(firing, cycles, self.sample_rate_hz, self.rng), strict=True)
            signal += sum(levels[band] * line for band, line in drawn)
        return signal

    def _at_samples(self, knots: FloatArray) -> Float32Array:
        return np.interp(self.time, self.trajectory.time_s, knots).astype(np.float32)


def _pressure(power_level_db: FloatArray) -> FloatArray:
    """Return the RMS pressure at 1 m in Pa."""
    return np.asarray(REFERENCE_PA * 10.0 ** ((power_level_db + POWER_TO_1M_DB) / 20.0))


@cache
def _band_shares(sample_rate_hz: float) -> FloatArray:
    """Return the power of white noise of unit variance per octave band; bands beyond Nyquist are empty."""
    masks = octave_masks(np.linspace(0.0, sample_rate_hz / 2.0, 4096))
    return np.asarray(np.maximum((masks**2).mean(axis=1), 1e-6))


def octaves_of_lines(firing_hz: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the octave of each multiple of a firing frequency, (24,), and the count per octave, (8,)."""
    orders = np.arange(1, HARMONICS + 1)
    octave = np.clip(np.round(np.log2(orders * firing_hz.mean() / OCTAVES_HZ[0])), 0, 7).astype(int)
    return octave, np.bincount(octave, minlength=8)


def engine_lines(
    firing_hz: FloatArray, cycles: FloatArray, sample_rate_hz: float, rng: np.random.Generator
) -> Iterator[Float32Array]:
    """Yield multiples 1, 2, ... of the firing frequency with amplitude 1; shapes (n,)."""
    for order in range(1, HARMONICS + 1):
        phase = 2.0 * np.pi * np.mod(order * cycles + rng.random(), 1.0)
        heard = order * firing_hz < 0.5 * sample_rate_hz  # Avoids aliasing
        yield np.cos(phase.astype(np.float32)) * heard


def firing_frequency_hz(trajectory: Trajectory, time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw the firing frequency in Hz: it follows the speed through the gears and fluctuates by 5 %."""
    shift_up = SHIFT_UP_HZ * rng.uniform(0.8, 1.2)
    speed = np.interp(time, trajectory.time_s, trajectory.speed_mps)
    choices = np.array(GEARS_HZ_PER_MPS)[:, None] * trajectory.speed_mps
    gear = np.minimum((choices > shift_up).sum(axis=0), len(GEARS_HZ_PER_MPS) - 1)
    ratio = np.interp(time, trajectory.time_s, _smooth(np.array(GEARS_HZ_PER_MPS)[gear], trajectory.time_s))
    knots = np.arange(time[0], time[-1] + WANDER_STEP_S, WANDER_STEP_S)
    wander = 1.0 + WANDER * np.clip(rng.standard_normal(len(knots)) / 2.0, -1.0, 1.0)
    return np.asarray(np.maximum(ratio * speed, IDLE_HZ) * np.interp(time, knots, wander))


# A motorcycle has one to four cylinders; a moped has one two-stroke cylinder, which fires at every turn. The
# cylinders fire unevenly and with different strength, which adds partials at half orders; the level of the
# exhaust noise follows them.
TWO_STROKES, CYLINDERS, UNEVEN_FIRING, WEAKEST = 0.25, (1, 2, 2, 3, 4), 0.5, 0.6
PULSE_SPREAD, PULSE_JITTER, MOST_NOISE, SHARPEST = (0.02, 0.3), (0.0, 0.02), 0.8, 6.0
# Turns per second at idle, 1,100 to 1,900 per minute; ratio of neighbouring gears; share with a belt drive,
# whose crank speed is nearly constant; share of vehicles at rest that rev up, and how far (all assumed).
IDLE_TURNS_HZ, GEAR_RATIO, BELTS, BELT, REVVED, MOST_REVS = (18.0, 32.0), (1.25, 1.7), 0.25, 0.3, 0.6, 4.0
TURNS_WANDER, LOUDER_BY_TURNS = 0.02, 1.5  # Amplitude over crank speed: 30 dB per decade (assumed)


def crank_turns_hz(trajectory: Trajectory, time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw the crank speed of a motorcycle in turns per second, shape of `time`."""
    knots = np.arange(time[0], time[-1] + WANDER_STEP_S, WANDER_STEP_S)
    wander = np.interp(time, knots, rng.standard_normal(len(knots)))
    speed, idle = trajectory.speed_mps, rng.uniform(*IDLE_TURNS_HZ)
    if speed.max() < CREEPING_MPS:
        revved = rng.uniform(0.0, MOST_REVS) * (rng.random() < REVVED)
        return np.asarray(idle * (1.0 + TURNS_WANDER * wander + revved * np.maximum(wander, 0.0)))
    ridden = np.exp(rng.uniform(*np.log(trajectory.kind.turns_hz or IDLE_TURNS_HZ)))
    in_gear = np.log(np.maximum(speed, CREEPING_MPS)) + rng.random()
    geared = np.exp(np.mod(in_gear, np.log(rng.uniform(*GEAR_RATIO))))
    if rng.random() < BELTS:
        geared = (speed / speed.max()) ** BELT
    turns = np.maximum(ridden * _smooth(geared, trajectory.time_s), idle)
    return np.asarray(np.interp(time, trajectory.time_s, turns) * (1.0 + TURNS_WANDER * wander))


def exhaust_pulses(trajectory: Trajectory, time: FloatArray, rng: np.random.Generator) -> Float32Array:
    """Draw the pulses of the cylinders and the noise that follows them, white and of unit power, (n,)."""
    rate_hz = (len(time) - 1) / (time[-1] - time[0])
    turns, is_moped = crank_turns_hz(trajectory, time, rng), rng.random() < TWO_STROKES
    cylinders = 1 if is_moped else int(rng.choice(CYLINDERS))
    steps = turns * (1.0 if is_moped else 0.5) / rate_hz  # Engine cycles per sample
    spread, jitter, sharp = rng.uniform(*PULSE_SPREAD), rng.uniform(*PULSE_JITTER), rng.uniform(0.0, SHARPEST)
    pulses, envelope, cycles = np.zeros(len(time)), np.zeros(len(time)), np.cumsum(steps)
    for number in range(cylinders):
        own = cycles - (number + UNEVEN_FIRING * rng.uniform(-0.5, 0.5)) / cylinders
        fires = np.flatnonzero(np.diff(np.floor(own)))
        late = 1.0 - np.mod(own[fires], 1.0) + jitter * rng.standard_normal(len(fires))
        first, share = np.divmod(np.clip(fires + late / steps[fires], 0.0, len(time) - 2.0), 1.0)
        strength = rng.uniform(WEAKEST, 1.0) * (1.0 + spread * rng.standard_normal(len(fires)))
        # Linear interpolation between two samples.
        np.add.at(pulses, first.astype(np.intp), (1.0 - share) * strength)
        np.add.at(pulses, first.astype(np.intp) + 1, share * strength)
        envelope += np.exp(sharp * (np.cos(2.0 * np.pi * own) - 1.0))
    noise, share = envelope * rng.standard_normal(len(time)), MOST_NOISE * rng.random() ** 2
    pulses /= pulses.std() + np.finfo(float).tiny
    whole = np.sqrt(1.0 - share) * pulses + np.sqrt(share) * noise / noise.std()
    return np.asarray(whole * (turns / turns.mean()) ** LOUDER_BY_TURNS, np.float32)


def _smooth(values: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return the running mean over the duration of a gear change."""
    length = max(int(SHIFT_S / (time_s[1] - time_s[0])), 1)
    padded = np.pad(values, (length, length), mode="edge")
    return np.convolve(padded, np.full(length, 1.0 / length), mode="same")[length:-length]
