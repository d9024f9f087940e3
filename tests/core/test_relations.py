"""Relations: same lane, in front of, conflict with the path of the ego vehicle, occlusion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from snapshot_laws import broken_laws

from worldstate import Context, Measurement, NotUsable, Sighting, SignatureEvidence, WorldFilter
from worldstate.abduction.co_evidence import Absent, Present
from worldstate.measurement import Odometry, Position, PositionScan, SearchedSector, Sector
from worldstate.state import Relation
from worldstate.state.context import corner_at

ALL_ROUND = SearchedSector(Sector(0.0, math.pi), range_m=100.0, detection_probability=0.9)
STD = (0.4, 0.3, 0.3, 0.3)
SPREAD = tuple(map(tuple, np.diag(np.square(STD)).tolist()))
SILENT, NEUTRAL = NotUsable("not scripted"), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)


def seen(
    *rows: tuple[float, float, float, float], context: Context | None = None
) -> dict[tuple[str, str, str], float]:
    """Return relations of radar detections by their ends ("ego", "0", "1") and kind."""
    positions = [Position(row[:2], SPREAD, row[2:], 0.9) for row in rows]
    state = (
        WorldFilter(context or Context()).update(PositionScan("radar", 0, tuple(positions), ALL_ROUND)).state
    )
    at = {
        one.id: str(min(range(len(rows)), key=lambda i: math.dist(one.position_m[:2], rows[i][:2])))
        for one in state.entities
    }
    return {
        (at.get(one.src, one.src), at.get(one.dst, one.dst), one.kind): one.probability
        for one in state.relations
    }


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
    ("row", "likely"),
    [
        ((10.0, 12.0, 0.0, -6.0), True),  # Crosses ahead in two seconds
        ((10.0, 12.0, 0.0, 6.0), False),  # Drives away
        ((10.0, 60.0, 0.0, -6.0), False),  # Ten seconds away
        ((-10.0, 12.0, 0.0, -6.0), False),  # Crosses behind
        ((10.0, 12.0, 0.0, 0.0), False),  # Stands
    ],
)
def test_a_crossing_within_five_seconds_is_a_conflict(row, likely: bool) -> None:
    chance = seen(row).get(("0", "ego", "conflicts_with_ego_path"), 0.0)
    assert chance > 0.9 if likely else chance < 0.1


def test_a_crossing_behind_a_driving_ego_vehicle_is_no_conflict() -> None:
    row = (20.0, 24.0, 0.0, -6.0)  # On the axis in four seconds, when an ego at 8 m/s is beyond
    standing, driving = (
        seen(row, context=Context(ego_speed_mps=speed)).get(("0", "ego", "conflicts_with_ego_path"), 0.0)
        for speed in (0.0, 8.0)
    )
    assert standing > 0.9 and driving < 0.1


def test_a_message_behind_a_corner_approaches_from_its_arm() -> None:
    def arm(vy: float) -> float:
        there = Position((10.0, 14.0), SPREAD, (0.0, vy), 0.95)
        relations: tuple[Relation, ...] = (
            WorldFilter().update(PositionScan("v2x", 0, (there,))).state.relations
        )
        return next((r.probability for r in relations if r.kind == "approaching_from"), 0.0)

    assert arm(-6.0) > 0.9 and arm(6.0) < 0.1


def test_relations_refer_only_to_entities_of_the_snapshot() -> None:
    """In 500 steps vehicles of two lanes appear and leave, some of them hidden."""
    rng, world, ended, named = np.random.default_rng(3), WorldFilter(), 0, 0
    there = list[np.ndarray]()
    for step in range(1, 501):
        there = [one + 0.1 * np.append(one[2:], (0.0, 0.0)) for one in there if rng.random() < 0.97]
        if len(there) < 5 and rng.random() < 0.3:
            lane = (10.0, rng.uniform(5.0, 25.0), 0.0, -6.0), (rng.uniform(5.0, 40.0), 0.5, 5.0, 0.0)
            there.append(np.array(lane[int(rng.integers(2))]))
        found = [Position(tuple(one[:2]), SPREAD, tuple(one[2:]), 0.9) for one in there if rng.random() < 0.9]
        scan = PositionScan("radar", step * 10**8, tuple(found), ALL_ROUND)
        world = world.update(scan if rng.random() < 0.8 else replace(scan, source="v2x", searched=None))
        state = (world if rng.random() < 0.8 else world.predict(rng.uniform(0.0, 1.0))).state
        assert not broken_laws(state), step
        ended += sum(one.until_ns is not None for one in state.relations)
        named += len(state.relations)
    assert named > 2_500 and ended > 250


# Law 17: an occluder hides an object behind it, whichever sensor found it.


def driven_behind(way, speed_mps, sensor, returns, rng):
    """Yield the states 0.3 to 1.5 s after a car has passed a known corner, by radar or boxes at 10 Hz."""
    corners = corner_at("left", (8.0, 5.0), 14.0), corner_at("right", (8.0, -5.0), 14.0)
    world = WorldFilter(Context(occluders=corners, view_half_angle_rad=0.9))
    edge = 0.625
    searched = SearchedSector(Sector(0.0, 1.3), 70.0, 0.9)
    for hop in range(1, 60):
        y, stamp_ns = -4.0 + speed_mps * hop / 10, round((1.0 + hop / 10) * 1e9)
        since_s = (y - 14.0 * edge) / speed_mps
        found = (since_s < 0.0 or returns) and rng.random() < 0.9
        if sensor == "radar":
            x, y, vy = np.array([14.0, y, speed_mps]) + rng.normal(0.0, 0.3, 3)
            car = Position((x, way * y), tuple(map(tuple, 0.09 * np.eye(4))), (0.0, way * vy))
            world = world.update(PositionScan("radar", stamp_ns, (car,) if found else (), searched))
        else:
            # The visible part of the car
            ends = math.atan2(y - 2.2, 14.0), min(math.atan2(y + 2.2, 14.0), math.atan(edge))
            width_rad = ends[1] - ends[0]
            seen = since_s < 0.0 and width_rad > 0.0 and rng.random() < 0.9
            box = Sighting(way * 0.5 * sum(ends), 0.004, "car", 0.9, max(width_rad, 0.0))
            answer = Present(0.1, 0.02) if seen else Absent(0.1, 0.02)
            look = Measurement(stamp_ns, NEUTRAL, answer, SILENT, SILENT, (box,) if seen else ())
            world = world.update(look)
        if 0.3 <= since_s <= 1.5:
            yield world.state


@given(
    st.sampled_from([1.0, -1.0]),
    st.floats(3.0, 12.0),
    st.sampled_from([("radar", False), ("radar", True), ("camera", False)]),
    st.integers(0, 2**32 - 1),
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
    corners = corner_at("left", (8.0, 5.0), 14.0), corner_at("right", (8.0, -5.0), 14.0)
    world, azimuth = WorldFilter(Context(occluders=corners)), way * (math.atan2(5.0, 8.0) + beyond_rad)
    place = range_m * math.cos(azimuth), range_m * math.sin(azimuth)
    ghost = Position(place, tuple(map(tuple, 0.2 * np.eye(4))), (0.0, -3.0 * way))
    for hop in range(1, 30):
        searched = SearchedSector(Sector(0.0, 1.5), 70.0, 0.9)
        world = world.update(PositionScan("radar", hop * 10**8, (ghost,), searched))
        assert all(one.existence_probability < 0.2 for one in world.state.entities)


@given(st.sampled_from([1.0, -1.0]), st.floats(0.18, 0.3), st.floats(-0.1, 0.1))
@settings(max_examples=15, deadline=None)
def test_a_car_that_passes_behind_a_reported_van_keeps_its_identity(way, rate, van_rad):
    world, ids = WorldFilter(), {}
    van = Sighting(van_rad, 0.003, "truck", 0.9, 0.4, moving=False)
    for hop in range(60):
        azimuth = -0.5 + rate * hop / 10
        covered = abs(azimuth - way * van_rad) < 0.2 - 0.2 * 0.25
        boxes = (van,) if covered else (van, Sighting(way * azimuth, 0.003, "car", 0.9, 0.25))
        look = Measurement(10**9 + hop * 10**8, NEUTRAL, Present(0.08, 0.02), SILENT, SILENT, boxes)
        world = world.update(look)
        if hop > 2 and azimuth < 0.5:
            cars = [one for one in world.state.entities if one.moving and one.existence_probability > 0.3]
            ids.setdefault(covered, set()).add(tuple(one.id for one in cars))
            names = {one.id for one in world.state.entities} | {"corner_left", "corner_right", "ego"}
            assert all({one.src, one.dst} <= names for one in world.state.relations)
            if covered and cars[0].status == "hidden":
                (by,) = (one.dst for one in world.state.relations if one.probability > 0.5)
                assert by == next(one.id for one in world.state.entities if not one.moving)
                ids["hidden"] = True
    assert ids.pop("hidden") and len(set.union(*ids.values())) == 1


@given(st.floats(0.8, 1.3), st.sampled_from([1.0, -1.0]), st.floats(2.0, 4.5))
@settings(max_examples=10, deadline=None)
def test_an_object_in_front_of_the_wall_is_visible(azimuth, way, beside_m):
    """It is beyond the azimuth of the corner but nearer than the wall."""
    corners = corner_at("left", (8.0, 5.0), 14.0), corner_at("right", (8.0, -5.0), 14.0)
    world, place = WorldFilter(Context(occluders=corners)), (beside_m / math.tan(azimuth), way * beside_m)
    walks = Position(place, tuple(map(tuple, 0.1 * np.eye(4))), (0.0, 0.0))
    for hop in range(1, 6):
        searched = SearchedSector(Sector(0.0, 1.5), 70.0, 0.9)
        world = world.update(PositionScan("radar", hop * 10**8, (walks,), searched))
    (one,) = world.state.entities
    assert one.status == "visible" and one.existence_probability > 0.9


@given(st.sampled_from([1.0, -1.0]), st.floats(0.15, 0.5), st.integers(1, 4))
@settings(max_examples=10, deadline=None)
def test_empty_messages_leave_the_hidden_probability_unchanged(way, rate, between):
    """Law 9: a car approaches an assumed corner; empty odometry comes between the looks."""
    alone = crowded = WorldFilter()
    for hop in range(40):
        stamp_ns, azimuth = 10**9 + hop * 10**8, way * (0.2 + rate * hop / 10)
        boxes = (Sighting(azimuth, 0.01, "car", 0.9, 0.1),) if abs(azimuth) < 0.55 else ()
        answer = Present(0.1, 0.02) if boxes else Absent(0.1, 0.02)
        look = Measurement(stamp_ns, NEUTRAL, answer, SILENT, SILENT, boxes)
        alone = alone.update(look)
        for number in range(between):
            early_ns = (between - number) * 2 * 10**7
            crowded = crowded.update(Odometry("wheels", stamp_ns - early_ns, 0.0, 0.0))
        crowded = crowded.update(look)
        for one, other in zip(alone.state.entities, crowded.state.entities, strict=True):
            assert one.hidden_probability == pytest.approx(other.hidden_probability, abs=0.05)
