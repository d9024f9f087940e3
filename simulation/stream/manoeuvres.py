"""Manoeuvres of the vehicles of every flow at a junction: routes, speed limits, stops and ends."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.driving import entry_y_m
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.kinds import VehicleKind
from worldstate.simulation.scene.presets import Preset
from worldstate.simulation.scene.settings import BRAKING_MPS2, BRAKING_SHARE, SPEEDS_MPS, speeds_mps
from worldstate.simulation.scene.vehicle import (
    POWER_TO_1M_DB,
    Route,
    Trajectory,
    along,
    propulsion_level_db,
    rolling_level_db,
)
from worldstate.simulation.sound.static_field import LATE_DISTANCE_M, late_level_db

STEP_M = 0.05
ACCELERATION_MPS2, COMFORTABLE_MPS2 = 1.5, 2.0  # Comfortable values of drivers in towns


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """A maximum speed at one point of a route, and the length of a stop there."""

    at_m: float
    speed_mps: float = 0.0
    stands_s: float = 0.0
    braking_mps2: float = COMFORTABLE_MPS2


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Position of a vehicle on its own clock, which begins at 0."""

    route: Route
    time_s: FloatArray  # shape (N,): Not decreasing
    driven_m: FloatArray  # shape (N,): Distance of the front along the route
    speed_mps: FloatArray  # shape (N,)
    kind: VehicleKind
    heading: int  # Heading of the lane, as in `Trajectory`

    @property
    def duration_s(self) -> float:
        """Time at which the motion ends."""
        return float(self.time_s[-1])

    def reaches_s(self, driven_m: float) -> float:
        """Return when the front has driven a distance; at a stop, when the vehicle leaves."""
        return float(self.time_s[max(int(np.searchsorted(self.driven_m, driven_m, side="right")) - 1, 0)])

    def trajectory(self, time_s: FloatArray, heard: Route | None = None) -> Trajectory:
        """Return position and speed at some times, on the route or on the route of its sound."""
        route = heard or self.route
        driven = np.interp(time_s, self.time_s, self.driven_m)
        x, y = route.at(driven)
        speed = np.interp(time_s, self.time_s, self.speed_mps)
        lane = float(x[0]) if len(x) else 0.0
        return Trajectory(time_s, y, speed, lane, self.heading, self.kind, route, driven)


def confined(route: Route, near_m: float, far_m: float) -> Route:
    """Return the route with its distance ahead kept between two limits.

    The sound of a vehicle in another street comes from that street's mouth.
    """
    driven = np.arange(route.driven_m[0], route.driven_m[-1], 0.5)
    x, y = route.at(driven)
    return replace(route, driven_m=driven, points_m=np.column_stack([np.clip(x, near_m, far_m), y]))


TURN_RADIUS_M, TURN_MPS, ARC_STEPS = 3.5, 4.0, 16
TURN_M = 0.5 * np.pi * TURN_RADIUS_M
TURNING = SpeedLimit(0.0, TURN_MPS), SpeedLimit(TURN_M, TURN_MPS)  # Limits of a turn that begins at 0
OWN_LANE_M = 1.8  # Beside the ego, whose half width is 0.9 m, as far as a side wall allows
KERB_M = 0.95  # Half a vehicle and a hand's breadth
BESIDE_M, SHORTEST_M = 30.0, 10.0  # Distance over which a vehicle is followed into another street
# A vehicle is out of earshot if its level in the octaves of 125 Hz to 2 kHz is this far below the ambience,
# both round the corner (at least 12 dB lower in deep shadow) and in the late field, which has no direction.
# Wind masks lower octaves.
INAUDIBLE_DB, LATE_INAUDIBLE_DB, SHADOW_DB, HEARD_OCTAVES = 15.0, 6.0, 12.0, slice(1, 6)
EARSHOT_M = (15.0, 80.0)
LEFT, RIGHT = "left", "right"


@dataclass(frozen=True, slots=True, eq=False)
class Manoeuvre:
    """Motion of one vehicle, and the origin of its sound."""

    arm: str  # Hidden arm that it leaves, enters or stays in
    motion: Motion
    arrives_s: float  # Time of its clock that equals its flow's arrival time
    heard: Route | None = None  # Route of its sound, if it differs from its own
    gap_s: float = 0.0  # Delay behind the arrival to which it belongs


@dataclass(frozen=True, slots=True, eq=False)
class Driver:
    """A vehicle and its street, for which manoeuvres are drawn."""

    site: Site
    kind: VehicleKind
    arm: str
    speed_mps: float
    braking_mps2: float  # Deceleration before the junction; 0 for none
    reach_m: float  # Distance beyond which the vehicle is inaudible

    @property
    def side(self) -> float:
        """Sign of y in its arm."""
        return 1.0 if self.arm == LEFT else -1.0

    def lane_m(self, into: bool = False) -> float:
        """Return the distance ahead of its lane when it leaves its arm, or enters it."""
        near, far = self.site.lanes_m
        return near if (self.arm == LEFT) is not into else far

    def reach_from(self, before_m: float) -> float:
        """Return the audible range, measured from a point that is `before_m` before line of sight."""
        return max(self.reach_m - before_m, SHORTEST_M)

    def entry_y_m(self) -> float:
        """Return the y on its lane at which it comes into line of sight."""
        return entry_y_m(self.site, self.lane_m(), self.arm)

    def motion(
        self, route: Route, span_m: tuple[float, float], limits: Sequence[SpeedLimit], into: bool = False
    ) -> Motion:
        r"""Drive from one distance to another as fast as the limits allow, `into` the arm or out of it.

        .. math:: v(s) = \min\Big(v_0, \sqrt{v_i^2 + 2 b_i (s_i - s)}\ (s < s_i),
                  \sqrt{v_i^2 + 2 a (s - s_i)}\ (s > s_i)\Big)
        """
        stops = sorted((one for one in limits if one.stands_s > 0.0), key=lambda one: one.at_m)
        edges = [span_m[0], *(one.at_m for one in stops), span_m[1]]
        # A stop is in the grid twice: between both points the distance is constant and time passes.
        counts = [max(round((high - low) / STEP_M), 1) + 1 for low, high in pairwise(edges)]
        driven = np.concatenate(list(map(np.linspace, edges, edges[1:], counts)))
        speed = np.full_like(driven, self.speed_mps)
        for one in limits:
            before = one.at_m - driven
            room = np.where(before > 0.0, 2.0 * one.braking_mps2 * before, -2.0 * ACCELERATION_MPS2 * before)
            speed = np.minimum(speed, np.sqrt(one.speed_mps**2 + room))
        # At constant acceleration a step takes its length over the mean of both speeds, exactly.
        step, twice = np.diff(driven), speed[1:] + speed[:-1]
        took = 2.0 * step / np.maximum(twice, 1e-6)
        took[np.cumsum(counts[:-1], dtype=int) - 1] = [one.stands_s for one in stops]
        heading = int(self.side) if into else -int(self.side)
        return Motion(route, np.r_[0.0, np.cumsum(took)], driven, speed, self.kind, heading)


def draw_driver(
    site: Site, kind: VehicleKind, preset: Preset, rng: np.random.Generator, arm: str | None = None
) -> Driver:
    """Draw an arm, a speed and whether the driver brakes before a blind junction."""
    speed = float(rng.uniform(*speeds_mps(site, kind, preset)))
    braking = float(rng.uniform(*BRAKING_MPS2)) if rng.random() < BRAKING_SHARE else 0.0
    chosen = LEFT if rng.random() < 0.5 else RIGHT
    return Driver(site, kind, arm or chosen, speed, braking, earshot_m(site, kind, speed, preset))


def earshot_m(site: Site, kind: VehicleKind, speed_mps: float, preset: Preset) -> float:
    """Return the distance beyond which ambience masks a vehicle in a hidden arm in all relevant octaves."""
    speed = np.array([speed_mps])
    power = [10.0 ** (law(speed, kind)[:, 0] / 10.0) for law in (rolling_level_db, propulsion_level_db)]
    level = 10.0 * np.log10(np.sum(power, axis=0)) + POWER_TO_1M_DB + preset.vehicles_db(site)
    above = level - preset.ambient_octaves_db
    bent = 10.0 ** ((above - SHADOW_DB + INAUDIBLE_DB)[HEARD_OCTAVES].max() / 20.0)
    late = 10.0 ** ((above + late_level_db(site, preset) + LATE_INAUDIBLE_DB)[HEARD_OCTAVES].max() / 20.0)
    return float(np.clip(max(bent, LATE_DISTANCE_M * (late - 1.0)), *EARSHOT_M))


def emerges(driver: Driver, rng: np.random.Generator) -> Manoeuvre:
    """Drive out of the arm, cross the view and continue into the other arm."""
    slowest = max(driver.speed_mps - 2.0 * driver.braking_mps2, 0.25 * driver.speed_mps)
    limits = [SpeedLimit(0.0, slowest, braking_mps2=driver.braking_mps2)] if driver.braking_mps2 else []
    return _through(driver, limits)


def waits(driver: Driver, rng: np.random.Generator, stands_s: tuple[float, float] = (4.0, 25.0)) -> Manoeuvre:
    """Stop before the corner for some time, then drive out."""
    return _through(driver, [SpeedLimit(-rng.uniform(1.0, 6.0), 0.0, rng.uniform(*stands_s))])


def turns_away(driver: Driver, rng: np.random.Generator) -> Manoeuvre:
    """Turn into a side street before the corner."""
    lane, before = driver.lane_m(), rng.uniform(8.0, 35.0)
    turn_y = driver.entry_y_m() + driver.side * before
    corner = _arc((lane, turn_y), (0.0, -driver.side), (-1.0, 0.0))
    points = np.concatenate([[[lane, turn_y + driver.side]], corner, corner[-1:] - [[BESIDE_M, 0.0]]])
    return _beside(driver, along(points, 1.0), (-driver.reach_from(before), BESIDE_M), TURNING)


def stands(driver: Driver, rng: np.random.Generator) -> Manoeuvre:
    """Stop behind the corner with the engine running, then turn into a side street."""
    away = turns_away(driver, rng)
    stop = SpeedLimit(-rng.uniform(1.0, 8.0), 0.0, rng.uniform(8.0, 40.0))
    span = float(away.motion.driven_m[0]), float(away.motion.driven_m[-1])
    motion = driver.motion(away.motion.route, span, [stop, *TURNING])
    return replace(away, motion=motion, arrives_s=motion.reaches_s(stop.at_m))


def drives_off(driver: Driver, rng: np.random.Generator) -> Manoeuvre:
    """Pull out from the kerb behind the corner and drive away from the junction."""
    y = _hidden_y_m(driver, rng.uniform(6.0, 30.0))
    return _pulls_out(driver, y, max(driver.reach_m - abs(y), SHORTEST_M), rng.uniform(1.0, 6.0))


def joins(driver: Driver, rng: np.random.Generator) -> Manoeuvre:
    """Leave a side street behind the corner, turn into the arm and drive away."""
    turn = driver.lane_m(into=True) - TURN_RADIUS_M, _hidden_y_m(driver, rng.uniform(8.0, 35.0))
    driven = _turn_into(replace(driver, reach_m=BESIDE_M), turn, (1.0, 0.0))
    near, far = driver.site.lanes_m
    return replace(driven, heard=confined(driven.motion.route, near, far))


def _hidden_y_m(driver: Driver, before_m: float) -> float:
    """Return the y in the arm at a distance before the line of sight of the lane that leads into it."""
    return entry_y_m(driver.site, driver.lane_m(into=True), driver.arm) + driver.side * before_m


def parks(driver: Driver, rng: np.random.Generator) -> Manoeuvre:
    """Stop at the kerb of the arm and switch the engine off."""
    lane, before = driver.lane_m(), rng.uniform(8.0, 30.0)
    stop_y = driver.entry_y_m() + driver.side * before
    route = along([[lane, stop_y + driver.side], [lane, stop_y]], 1.0)
    limits = [SpeedLimit(0.0, 0.0, rng.uniform(1.0, 5.0))]
    motion = driver.motion(route, (-driver.reach_from(before), 0.0), limits)
    return Manoeuvre(driver.arm, motion, motion.reaches_s(-0.1))


def passes_far(
    driver: Driver, rng: np.random.Generator, away_m: tuple[float, float] = (40.0, 80.0)
) -> Manoeuvre:
    """Cross the arm on another street, far from the corner."""
    y, heading = driver.side * rng.uniform(*away_m), 1.0 if rng.random() < 0.5 else -1.0
    middle = driver.site.corner_ahead_m + 0.5 * driver.site.street_width_m
    route = along([[middle - heading, y], [middle + heading, y]], 1.0)
    elsewhere = replace(driver, speed_mps=float(rng.uniform(*SPEEDS_MPS)))
    return _beside(elsewhere, route, (-BESIDE_M, BESIDE_M), [])


def from_behind(driver: Driver, rng: np.random.Generator) -> Manoeuvre:
    """Overtake the standing ego in its own street and turn into the arm."""
    own = min(OWN_LANE_M, driver.site.side_wall_left_m - KERB_M)
    return _turn_into(driver, (driver.lane_m(into=True) - TURN_RADIUS_M, own), (1.0, 0.0))


def from_ahead(driver: Driver, rng: np.random.Generator) -> Manoeuvre:
    """Approach the ego and turn into the arm; with a wall opposite, pull out from the kerb in view."""
    if driver.site.opposite_wall_m is None:
        return _turn_into(driver, (driver.lane_m(into=True) + TURN_RADIUS_M, 1.2), (-1.0, 0.0))
    return _pulls_out(driver, -driver.side, driver.reach_m, rng.uniform(1.0, 4.0))


MANOEUVRES: dict[str, Callable[[Driver, np.random.Generator], Manoeuvre]] = {
    "left": emerges,
    "right": emerges,
    "both": emerges,
    "waits": waits,
    "turns_away": turns_away,
    "parks": parks,
    "far": passes_far,
    "from_behind": from_behind,
    "from_ahead": from_ahead,
    "queue": emerges,
    "stands": stands,
    "leaves": drives_off,
    "joins": joins,
    # New flows come last, because a flow's generator depends on its number.
    "stops": partial(waits, stands_s=(2.0, 10.0)),
    "distant": partial(passes_far, away_m=(60.0, 120.0)),
}


def _pulls_out(driver: Driver, y_m: float, reach_m: float, stands_s: float) -> Manoeuvre:
    """Stand at the kerb of the lane into the arm, pull out and drive on for a distance."""
    lane = driver.lane_m(into=True)
    route, stop = along([[lane, y_m], [lane, y_m + driver.side]]), SpeedLimit(0.0, 0.0, stands_s)
    motion = driver.motion(route, (0.0, reach_m), [stop], into=True)
    return Manoeuvre(driver.arm, motion, motion.reaches_s(0.0))


def _through(driver: Driver, limits: Sequence[SpeedLimit]) -> Manoeuvre:
    """Drive along the crossing street; the arrival is the time of line of sight."""
    lane, entry = driver.lane_m(), driver.entry_y_m()
    route = along([[lane, entry], [lane, entry - driver.side]])
    motion = driver.motion(route, (-driver.reach_m, 2.0 * abs(entry) + driver.reach_m), limits)
    return Manoeuvre(driver.arm, motion, motion.reaches_s(0.0))


def _turn_into(driver: Driver, turn_m: tuple[float, float], towards: tuple[float, float]) -> Manoeuvre:
    """Drive straight to a point in view or beside the ego, turn there into the arm and leave by it."""
    corner = _arc(turn_m, towards, (0.0, driver.side))
    before = np.array(turn_m) - towards
    points = np.concatenate([[before], corner, corner[-1:] + np.array([0.0, driver.side])])
    motion = driver.motion(along(points, 1.0), (-driver.reach_m, TURN_M + driver.reach_m), TURNING, into=True)
    return Manoeuvre(driver.arm, motion, motion.reaches_s(0.0))


def _beside(
    driver: Driver, route: Route, span_m: tuple[float, float], limits: Sequence[SpeedLimit]
) -> Manoeuvre:
    """Drive in another street, whose mouth alone emits the sound."""
    near, far = driver.site.lanes_m
    motion = driver.motion(route, span_m, limits)
    return Manoeuvre(driver.arm, motion, motion.reaches_s(0.0), confined(route, near, far))


def _arc(start_m: tuple[float, float], towards: tuple[float, float], then: tuple[float, float]) -> FloatArray:
    """Return a quarter circle from a point, shape (ARC_STEPS, 2)."""
    angle = np.linspace(0.0, 0.5 * np.pi, ARC_STEPS)[:, None]
    turned = np.sin(angle) * np.array(towards) + (1.0 - np.cos(angle)) * np.array(then)
    return np.asarray(np.array(start_m) + TURN_RADIUS_M * turned)


def behind(leader: Manoeuvre, headway_s: float, kind: VehicleKind) -> Manoeuvre:
    """Return a follower, which drives like its leader."""
    return replace(leader, motion=replace(leader.motion, kind=kind), gap_s=leader.gap_s + headway_s)
