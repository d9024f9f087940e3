"""Who is in one lane with whom, in front of whom, and who will cross the path of the ego vehicle."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from snapshot_laws import broken_laws

from worldstate import Context, WorldFilter
from worldstate.measurement import Position, PositionScan, SearchedSector, Sector
from worldstate.state import Relation

ALL_ROUND = SearchedSector(Sector(0.0, math.pi), range_m=100.0, detection_probability=0.9)
STD = (0.4, 0.3, 0.3, 0.3)
SPREAD = tuple(map(tuple, np.diag(np.square(STD)).tolist()))


def seen(
    *rows: tuple[float, float, float, float], context: Context | None = None
) -> dict[tuple[str, str, str], float]:
    """Return the relations of vehicles that a radar has found, by their ends ("ego", "0", "1") and kind."""
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
def test_the_chance_to_be_in_the_lane_of_the_ego_vehicle_is_that_of_draws(x: float, y: float) -> None:
    told = seen((x, y, 5.0, 0.0))
    rng = np.random.default_rng(0)
    draws = rng.normal((x, y), STD[:2], (20_000, 2))
    lane = np.mean(np.abs(draws[:, 1]) <= 1.6)
    ahead = np.mean((np.abs(draws[:, 1]) <= 1.6) & (draws[:, 0] > 0.0))
    assert told.get(("0", "ego", "same_lane"), 0.0) == pytest.approx(lane, abs=0.06)
    assert told.get(("0", "ego", "in_front_of"), 0.0) == pytest.approx(ahead, abs=0.06)


def test_of_two_in_a_lane_one_is_in_front_and_oncoming_traffic_is_in_neither() -> None:
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
def test_who_crosses_the_path_within_five_seconds_conflicts_with_it(row, likely: bool) -> None:
    chance = seen(row).get(("0", "ego", "conflicts_with_ego_path"), 0.0)
    assert chance > 0.9 if likely else chance < 0.1


def test_an_ego_vehicle_that_drives_passes_before_who_crosses_behind_it() -> None:
    row = (20.0, 24.0, 0.0, -6.0)  # On the axis in four seconds, when an ego at 8 m/s is beyond
    standing, driving = (
        seen(row, context=Context(ego_speed_mps=speed)).get(("0", "ego", "conflicts_with_ego_path"), 0.0)
        for speed in (0.0, 8.0)
    )
    assert standing > 0.9 and driving < 0.1


def test_who_is_announced_behind_a_corner_approaches_from_its_arm() -> None:
    def arm(vy: float) -> float:
        there = Position((10.0, 14.0), SPREAD, (0.0, vy), 0.95)
        relations: tuple[Relation, ...] = (
            WorldFilter().update(PositionScan("v2x", 0, (there,))).state.relations
        )
        return next((r.probability for r in relations if r.kind == "approaching_from"), 0.0)

    assert arm(-6.0) > 0.9 and arm(6.0) < 0.1


def test_relations_name_only_what_the_snapshot_holds() -> None:
    """Over 2,000 steps in which vehicles of two lanes come and go, and of which some are hidden."""
    rng, world, ended, named = np.random.default_rng(3), WorldFilter(), 0, 0
    there = list[np.ndarray]()
    for step in range(1, 2001):
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
    assert named > 10_000 and ended > 1_000
