"""Relations: same lane, in front of, conflict with the path of the ego vehicle, occlusion."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from snapshot_laws import broken_laws
from street_measurements import SEEDS, after, car, diagonal, hop, run

from worldstate import Context, Sighting, WorldFilter
from worldstate.abduction.co_evidence import Absent, Present
from worldstate.measurement import Odometry, Position, PositionScan, SearchedSector, Sector
from worldstate.state.context import corner_at

ALL_ROUND = SearchedSector(Sector(0.0, math.pi), range_m=100.0, detection_probability=0.9)
STD = (0.4, 0.3, 0.3, 0.3)
SPREAD, QUIET = diagonal(*STD), (0.0, 0.0, 0.0, 0.0)
CORNERS = Context(
    occluders=(corner_at("left", (8.0, 5.0), 14.0), corner_at("right", (8.0, -5.0), 14.0)),
    view_half_angle_rad=0.9,
)


def boxed(number: int, *boxes: Sighting, miss: float = 0.1):
    return hop(number, QUIET, *boxes, answer=(Present if boxes else Absent)(miss, 0.02))


def searched(number: int, *positions: Position, half_rad: float = 1.5) -> PositionScan:
    return PositionScan("radar", number * 10**8, positions, SearchedSector(Sector(0.0, half_rad), 70.0, 0.9))


def seen(*rows: tuple[float, ...], context: Context | None = None) -> dict[tuple[str, str, str], float]:
    """Return relations of radar detections by their ends ("ego", "0", "1") and kind."""
    positions = tuple(Position(row[:2], SPREAD, row[2:], 0.9) for row in rows)
    scan = PositionScan("radar", 0, positions, ALL_ROUND)
    state = WorldFilter(context or Context()).update(scan).state
    at = {
        one.id: str(min(range(len(rows)), key=lambda i: math.dist(one.position_m[:2], rows[i][:2])))
        for one in state.entities
    }
    pairs = (((one.src, one.dst), one) for one in state.relations)
    return {(*(at.get(end, end) for end in ends), one.kind): one.probability for ends, one in pairs}


@given(st.floats(4.0, 40.0), st.floats(-6.0, 6.0))
def test_the_probability_of_the_own_lane_equals_the_share_of_draws(x: float, y: float) -> None:
    told = seen((x, y, 5.0, 0.0))
    rng = np.random.default_rng(0)
    draws = rng.normal((x, y), STD[:2], (20_000, 2))
    lane = np.mean(np.abs(draws[:, 1]) <= 1.6)
    ahead = np.mean((np.abs(draws[:, 1]) <= 1.6) & (draws[:, 0] > 0.0))
    assert told.get(("0", "ego", "same_lane"), 0.0) == pytest.approx(lane, abs=0.06)
    assert told.get(("0", "ego", "in_front_of"), 0.0) == pytest.approx(ahead, abs=0.06)


def test_two_vehicles_in_a_lane_are_ordered_without_oncoming_traffic() -> None:
    told = seen((10.0, 20.0, 0.0, -8.0), (10.0, 30.0, 0.0, -8.0), (13.5, 25.0, 0.0, 8.0))
    assert told["0", "1", "in_front_of"] > 0.95 and told["0", "1", "same_lane"] > 0.95
    assert ("1", "0", "in_front_of") not in told
    assert not any("2" in key[:2] for key in told if key[2] in ("same_lane", "in_front_of"))


@pytest.mark.parametrize(
    ("row", "ego_mps", "likely"),
    [
        ((10.0, 12.0, 0.0, -6.0), None, True),  # Crosses ahead in two seconds
        ((10.0, 12.0, 0.0, 6.0), None, False),  # Drives away
        ((10.0, 60.0, 0.0, -6.0), None, False),  # Ten seconds away
        ((-10.0, 12.0, 0.0, -6.0), None, False),  # Crosses behind
        ((10.0, 12.0, 0.0, 0.0), None, False),  # Stands
        ((20.0, 24.0, 0.0, -6.0), 0.0, True),  # On the axis in four seconds
        ((20.0, 24.0, 0.0, -6.0), 8.0, False),  # When the ego vehicle is beyond
    ],
)
def test_a_crossing_within_five_seconds_is_a_conflict(row, ego_mps, likely: bool) -> None:
    told = seen(row, context=Context(ego_speed_mps=ego_mps))
    chance = told.get(("0", "ego", "conflicts_with_ego_path"), 0.0)
    assert chance > 0.9 if likely else chance < 0.1


def test_a_message_behind_a_corner_approaches_from_its_arm() -> None:
    def arm(vy: float) -> float:
        there = Position((10.0, 14.0), SPREAD, (0.0, vy), 0.95)
        relations = after(PositionScan("v2x", 0, (there,))).state.relations
        return next((r.probability for r in relations if r.kind == "approaching_from"), 0.0)

    assert arm(-6.0) > 0.9 and arm(6.0) < 0.1


# Law 17: an occluder hides an object behind it, whichever sensor found it.


def driven_behind(way, speed_mps, sensor, returns, rng):
    """Yield the states 0.3 to 1.5 s after a car has passed a known corner, by radar or boxes at 10 Hz."""
    world, edge = WorldFilter(CORNERS), 0.625
    for number in range(1, 60):
        y = -4.0 + speed_mps * number / 10
        since_s = (y - 14.0 * edge) / speed_mps
        if sensor == "radar":
            found = (since_s < 0.0 or returns) and rng.random() < 0.9
            x, y, vy = np.array([14.0, y, speed_mps]) + rng.normal(0.0, 0.3, 3)
            there = Position((x, way * y), diagonal(*[0.3] * 4), (0.0, way * vy))
            told = searched(10 + number, *[there] * found, half_rad=1.3)
        else:
            # The visible part of the car
            ends = math.atan2(y - 2.2, 14.0), min(math.atan2(y + 2.2, 14.0), math.atan(edge))
            width_rad = ends[1] - ends[0]
            found = since_s < 0.0 and width_rad > 0.0 and rng.random() < 0.9
            box = car(way * 0.5 * sum(ends), 0.004, width_rad=max(width_rad, 0.0))
            told = boxed(10 + number, *[box] * found)
        world = world.update(told)
        if 0.3 <= since_s <= 1.5:
            yield world.state


@given(
    st.sampled_from([1.0, -1.0]),
    st.floats(3.0, 12.0),
    st.sampled_from([("radar", False), ("radar", True), ("camera", False)]),
    SEEDS,
)
@settings(max_examples=15, deadline=None)
def test_a_car_behind_a_known_corner_is_hidden_within_0_3_s(way, speed, by, seed):
    states = list(driven_behind(way, speed, *by, np.random.default_rng(seed)))
    assert states
    for state in states:
        (car,) = (one for one in state.entities if one.existence_probability > 0.5)
        (hidden_by,) = (one for one in state.relations if (one.src, one.kind) == (car.id, "occluded_by"))
        assert (car.status, car.direction) == ("hidden", "left" if way > 0.0 else "right")
        assert hidden_by.dst == f"corner_{car.direction}" and hidden_by.probability > 0.5


@given(st.floats(0.35, 0.8), st.sampled_from([1.0, -1.0]), st.floats(15.0, 40.0))
@settings(max_examples=15, deadline=None)
def test_a_radar_return_behind_the_wall_is_clutter(beyond_rad, way, range_m):
    azimuth = way * (math.atan2(5.0, 8.0) + beyond_rad)
    place = range_m * math.cos(azimuth), range_m * math.sin(azimuth)
    ghost = Position(place, diagonal(*[math.sqrt(0.2)] * 4), (0.0, -3.0 * way))
    for world in run(WorldFilter(CORNERS), (searched(number, ghost) for number in range(1, 30))):
        assert all(one.existence_probability < 0.2 for one in world.state.entities)


@given(st.sampled_from([1.0, -1.0]), st.floats(0.18, 0.3), st.floats(-0.1, 0.1))
@settings(max_examples=15, deadline=None)
def test_a_car_that_passes_behind_a_reported_van_keeps_its_identity(way, rate, van_rad):
    world, ids = WorldFilter(), {}
    van = Sighting(van_rad, 0.003, "truck", 0.9, 0.4, moving=False)
    for number in range(60):
        azimuth = -0.5 + rate * number / 10
        covered = abs(azimuth - way * van_rad) < 0.2 - 0.2 * 0.25
        boxes = (van,) if covered else (van, car(way * azimuth, 0.003, width_rad=0.25))
        world = world.update(boxed(10 + number, *boxes, miss=0.08))
        if number > 2 and azimuth < 0.5:
            cars = [one for one in world.state.entities if one.moving and one.existence_probability > 0.3]
            ids.setdefault(covered, set()).add(tuple(one.id for one in cars))
            assert not broken_laws(world.state)
            if covered and cars[0].status == "hidden":
                (by,) = (one.dst for one in world.state.relations if one.probability > 0.5)
                assert by == next(one.id for one in world.state.entities if not one.moving)
                ids["hidden"] = True
    assert ids.pop("hidden") and len(set.union(*ids.values())) == 1


@given(st.floats(0.8, 1.3), st.sampled_from([1.0, -1.0]), st.floats(2.0, 4.5))
@settings(max_examples=10, deadline=None)
def test_an_object_in_front_of_the_wall_is_visible(azimuth, way, beside_m):
    """It is beyond the azimuth of the corner but nearer than the wall."""
    place = beside_m / math.tan(azimuth), way * beside_m
    walks = Position(place, diagonal(*[math.sqrt(0.1)] * 4), (0.0, 0.0))
    world = after(*(searched(number, walks) for number in range(1, 6)), world=WorldFilter(CORNERS))
    (one,) = world.state.entities
    assert one.status == "visible" and one.existence_probability > 0.9


@given(st.sampled_from([1.0, -1.0]), st.floats(0.15, 0.5), st.integers(1, 4))
@settings(max_examples=10, deadline=None)
def test_empty_messages_leave_the_hidden_probability_unchanged(way, rate, between):
    """Law 9: a car approaches an assumed corner; empty odometry comes between the looks."""
    alone = crowded = WorldFilter()
    for number in range(10, 50):
        azimuth = way * (0.2 + rate * (number - 10) / 10)
        look = boxed(number, *[car(azimuth, 0.01, width_rad=0.1)] * (abs(azimuth) < 0.55))
        early_ns = [look.stamp_ns - (between - one) * 2 * 10**7 for one in range(between)]
        alone = alone.update(look)
        crowded = after(*(Odometry("wheels", at_ns, 0.0) for at_ns in early_ns), look, world=crowded)
        for one, other in zip(alone.state.entities, crowded.state.entities, strict=True):
            assert one.hidden_probability == pytest.approx(other.hidden_probability, abs=0.05)
