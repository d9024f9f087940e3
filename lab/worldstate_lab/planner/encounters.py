"""Encounters at a corner: the ego and its stopping law, states and vehicles of recorded streams."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.adapters.files.model_file import Model
from worldstate.commissioning.heard_stream import HeardStream, junction_named
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, IndexArray
from worldstate.operations.metrics.approach_table import StreamApproach
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate_lab.passes.followed_stream import passed_stream

GONE_M = -1e3
_SPEED_ROWS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """Motion of a vehicle from a hidden arm across the ego's axis, in steps of 0.1 s."""

    side: int
    entry_s: float
    length_m: float
    width_m: float
    time_s: FloatArray  # shape (r,)
    to_come_m: FloatArray  # shape (r,): Distance of its front to the axis, negative after crossing
    in_view: BoolArray  # shape (r,): Whether it is in view from the position at which the state was recorded

    def at(self, clock_s: FloatArray) -> FloatArray:
        """Return the distance to the axis at given times; before the first row its first speed is assumed."""
        last = min(_SPEED_ROWS, len(self.time_s) - 1)
        speed = (self.to_come_m[0] - self.to_come_m[last]) / max(self.time_s[last] - self.time_s[0], 0.1)
        early = np.maximum(self.time_s[0] - clock_s, 0.0)
        return np.asarray(np.interp(clock_s, self.time_s, self.to_come_m, right=GONE_M) + speed * early)

    def seen(self, clock_s: FloatArray) -> BoolArray:
        """Return whether it is in view at given times."""
        row = np.searchsorted(self.time_s, clock_s + 1e-6, side="right") - 1
        return np.asarray(self.in_view[np.maximum(row, 0)] & (row >= 0) & (clock_s <= self.time_s[-1]))


@dataclass(frozen=True, slots=True, eq=False)
class BelievedStream:
    """The chances in a stream's snapshots, and its vehicles; the two sides are left and right."""

    time_s: FloatArray  # shape (n,)
    within: Float32Array  # shape (n, 2, horizons): Probability to come into view within each horizon
    heard: HeardStream
    site: Site
    ways: tuple[Crossing, ...]  # Vehicles from a hidden arm
    others: IndexArray  # Numbers of all other vehicles


def believed_stream(path: Path, model: Model) -> BelievedStream:
    """Return a stream with its chances."""
    passed = passed_stream(path, model)
    return with_chances(passed.heard, passed.followed.time_s, passed.followed.within.astype(np.float32))


def with_chances(heard: HeardStream, time_s: FloatArray, within: Float32Array) -> BelievedStream:
    """Return a stream with published chances; a missing chance is set to one."""
    return BelievedStream(
        time_s=time_s,
        within=np.nan_to_num(within, nan=1.0),
        heard=heard,
        site=junction_named(heard.site),
        ways=tuple(_way(heard, i) for i in np.flatnonzero(heard.vehicles.hazard).tolist()),
        others=heard.vehicles.vehicle[~heard.vehicles.hazard],
    )


def _way(heard: HeardStream, i: int) -> Crossing:
    vehicles, rows = heard.vehicles, heard.rows
    mine, kind = rows.vehicle == vehicles.vehicle[i], vehicle_kind(str(vehicles.kind[i]))
    side = SIDES.index(vehicles.arm[i])
    return Crossing(
        side=side,
        entry_s=float(vehicles.entry_s[i]),
        length_m=kind.length_m,
        width_m=kind.width_m,
        time_s=rows.time_s[mine],
        # Rows contain the front axle, and left is positive.
        to_come_m=(1.0 - 2.0 * side) * rows.y_m[mine] - kind.axles_m[0],
        in_view=rows.in_view[mine].astype(np.bool_),
    )


@dataclass(frozen=True, slots=True)
class EgoVehicle:
    """A car with its limits; it reacts to everything after `reaction_s`."""

    length_m: float = 4.3
    width_m: float = 1.8
    # Cameras in the corners of the bumper, as for parking aids: from behind a windscreen, two metres back, no
    # camera sees into these streets before the bumper has entered them.
    eye_m: float = 0.5  # Distance of the camera behind the bumper
    # Speed limit of both streets; the fastest vehicle of the streams drives at 22 km/h
    limit_mps: float = 25.0 / 3.6
    acceleration_mps2: float = 2.0
    comfortable_mps2: float = 2.0  # Deceleration for a possible vehicle
    full_mps2: float = 6.0  # Deceleration for a vehicle in view
    reaction_s: float = 0.3
    begins_m: float = 30.0  # Start of the drive before the line at which it would stop
    begins_mps: float = 25.0 / 3.6
    gap_m: float = 0.25  # Distance between the stopped bumper and a passing vehicle
    gap_s: float = 0.3  # Time between one vehicle leaving and another entering the conflict zone

    def stopping_speed_mps(self, room_m: FloatArray, reaction_s: float) -> FloatArray:
        r"""Return the highest speed from which it stops within d metres after the reaction time tau.

        .. math:: v(d) = -b \tau + \sqrt{b^2 \tau^2 + 2 b d}

        Examples
        --------
        >>> EgoVehicle().stopping_speed_mps(np.array([0.0, 1.6]), reaction_s=0.3)
        array([0., 2.])
        """
        lost = self.comfortable_mps2 * reaction_s
        return -lost + np.sqrt(lost**2 + 2.0 * self.comfortable_mps2 * np.maximum(room_m, 0.0))

    def soonest_s(self, way_m: FloatArray, speed_mps: FloatArray) -> FloatArray:
        """Return the time to drive a distance with acceleration up to the limit.

        Examples
        --------
        >>> EgoVehicle(limit_mps=4.0).soonest_s(np.array([-1.0, 1.0, 8.0]), np.array([0.0, 0.0, 0.0]))
        array([0., 1., 3.])
        """
        way, a = np.maximum(way_m, 0.0), self.acceleration_mps2
        until_m = (self.limit_mps**2 - speed_mps**2) / (2.0 * a)
        rising = (np.sqrt(speed_mps**2 + 2.0 * a * np.minimum(way, until_m)) - speed_mps) / a
        return np.asarray(rising + np.maximum(way - until_m, 0.0) / self.limit_mps)


# The drive starts where the states were recorded: at about this distance before the line, the bumper is two
# metres ahead of the array.
FROM_STANDING = EgoVehicle(begins_m=3.5, begins_mps=0.0)


STEP_S, HOP_STEPS = 0.05, 2
LASTS_S = 25.0
STEPS = round(LASTS_S / STEP_S)
# Largest time difference in the conflict zone between a vehicle and an ego that never brakes
MEETS_WITHIN_S = 3.0
MOST_VEHICLES = 6
_NEAR_M, _BEFORE_S, _AFTER_S, _PASSED_S = 12.0, 1.0, 15.0, 8.0
# Half the width of the widest lorry: the margin of a planner if it sees no vehicle.
HALF_LANE_M = 1.25
_ROUNDS, _MINUTES = 200, 10_000


@dataclass(frozen=True, slots=True, eq=False)
class Encounters:
    """Replays, one per row, with K vehicles; missing ones have already passed, and lanes are left, right."""

    recorded: IndexArray  # shape (n,): Number of the approach, or of a minute without vehicles
    corner_ahead_m: FloatArray  # shape (n,)
    corner_m: FloatArray  # shape (n, 2): Distance of the corners from the ego's axis
    # shape (n, 2): Distance ahead of the lanes of vehicles from the left and from the right
    lane_m: FloatArray
    within: Float32Array  # shape (n, STEPS / HOP_STEPS, 2, horizons)
    # shape (n, STEPS, K): Distance of the front to the ego's axis, negative after crossing
    to_come_m: FloatArray
    # shape (n, STEPS, K): Whether it is in view from the position at which the state was recorded
    in_view: BoolArray
    side: IndexArray  # shape (n, K)
    length_m: FloatArray  # shape (n, K)
    width_m: FloatArray  # shape (n, K)

    def __len__(self) -> int:
        return len(self.recorded)

    @property
    def line_m(self) -> FloatArray:
        """Distance ahead of the start of the nearer lane, shape (n,)."""
        return np.asarray(self.lane_m[:, 0] - HALF_LANE_M)

    @property
    def paths_m(self) -> tuple[FloatArray, FloatArray]:
        """Distances ahead of the start and the end of every vehicle's path, shape (n, K) each."""
        lane, half = np.take_along_axis(self.lane_m, self.side, axis=1), 0.5 * self.width_m
        return lane - half, lane + half


def joined_encounters(parts: Sequence[Encounters]) -> Encounters:
    """Return the encounters of several streams."""
    names = [one.name for one in fields(Encounters)]
    return Encounters(**{name: np.concatenate([getattr(one, name) for one in parts]) for name in names})


def approach_encounters(
    recorded: Sequence[tuple[BelievedStream, StreamApproach]],
    count: int,
    ego: EgoVehicle,
    rng: np.random.Generator,
) -> Encounters:
    """Draw replays: each recorded approach equally often, the ego's timing uniform within 3 s of a meeting.

    If a vehicle drives in the ego's own street, the replay is drawn again.
    """
    found: list[Encounters] = []
    for _ in range(_ROUNDS if recorded else 0):
        for number in rng.permutation(len(recorded))[: count - len(found)].tolist():
            stream, one = recorded[number]
            start_s = _meets_s(stream, one, ego) + rng.uniform(-MEETS_WITHIN_S, MEETS_WITHIN_S)
            if _usable(stream, start_s):
                found.append(_encounter(stream, start_s, number))
    if len(found) < count:
        raise InvalidArgumentError(f"streams: expected {count} replays of approaches, found {len(found)}")
    return joined_encounters(found)


def empty_encounters(streams: Sequence[BelievedStream], count: int, rng: np.random.Generator) -> Encounters:
    """Draw times of hazard-free streams without a vehicle in view or in the ego's own street."""
    found: list[Encounters] = []
    for _ in range(_ROUNDS * count):
        number = len(found) % max(len(streams), 1)
        if len(found) == count or not streams:
            break
        first_s, last_s = streams[number].time_s[[0, -1]]
        start_s = rng.uniform(first_s + _BEFORE_S, last_s - LASTS_S)
        if _usable(streams[number], start_s):
            # Times within one minute share the same vehicles, so they count as one in intervals.
            minute = number * _MINUTES + int(start_s // 60.0)
            found.append(_encounter(streams[number], start_s, minute))
    if len(found) < count:
        raise InvalidArgumentError(f"streams: expected {count} times without vehicles, found {len(found)}")
    return joined_encounters(found)


def _meets_s(stream: BelievedStream, one: StreamApproach, ego: EgoVehicle) -> float:
    """Return the start time at which an ego that never brakes meets the first vehicle of an approach."""
    first = min(stream.ways, key=lambda way: abs(way.entry_s - one.entries_s[0]))
    middle_s = float(np.interp(0.0, -first.to_come_m - 0.5 * first.length_m, first.time_s))
    near_m, lane_m = stream.site.lanes_m[0], stream.site.lanes_m[first.side]
    way_m = np.array([ego.begins_m + HALF_LANE_M + lane_m - near_m + 0.5 * ego.length_m])
    return middle_s - float(ego.soonest_s(way_m, np.array([ego.begins_mps]))[0])


def _usable(stream: BelievedStream, start_s: float) -> bool:
    if not stream.time_s[0] + _BEFORE_S <= start_s <= stream.time_s[-1] - LASTS_S:
        return False
    rows = stream.heard.rows
    # Other vehicles have few rows, so the rows in the window are selected first.
    during = np.flatnonzero((rows.time_s > start_s - _BEFORE_S) & (rows.time_s < start_s + _AFTER_S))
    near = rows.in_view[during] | (np.hypot(rows.x_m[during], rows.y_m[during]) < _NEAR_M)
    return not np.isin(rows.vehicle[during[near]], stream.others).any()


def _encounter(stream: BelievedStream, start_s: float, number: int) -> Encounters:
    site, clock_s = stream.site, np.asarray(start_s + np.arange(STEPS) * STEP_S, np.float64)
    hop = np.searchsorted(stream.time_s, clock_s[::HOP_STEPS] + 1e-6, side="right") - 1
    there = [way for way in stream.ways if start_s - _PASSED_S < way.entry_s < clock_s[-1]]
    empty = MOST_VEHICLES - len(there)
    to_come = [*(way.at(clock_s) for way in there), *[np.full(STEPS, GONE_M)] * empty]
    in_view = [*(way.seen(clock_s) for way in there), *[np.zeros(STEPS, bool)] * empty]
    one = {
        "recorded": number,
        "corner_ahead_m": site.corner_ahead_m,
        "corner_m": [site.corner_left_m, site.corner_right_m],
        "lane_m": site.lanes_m,
        "within": stream.within[hop],
        "to_come_m": np.stack(to_come, axis=1),
        "in_view": np.stack(in_view, axis=1),
        "side": [*(way.side for way in there), *[0] * empty],
        "length_m": [*(way.length_m for way in there), *[0.0] * empty],
        "width_m": [*(way.width_m for way in there), *[0.0] * empty],
    }
    return Encounters(**{name: np.asarray(value)[None] for name, value in one.items()})
