"""Planners at blind corners: collisions, braking, and the limits of the car."""

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from hop_tables import heard_stream
from hypothesis import given, settings
from hypothesis import strategies as st
from worldstate_lab.planner.encounters import FROM_STANDING, STEP_S, BelievedStream, EgoVehicle, with_chances
from worldstate_lab.planner.planner_exam import (
    CHANCE,
    FULL,
    MEMORY,
    PHANTOM,
    UNAWARE,
    draw_corners,
    drive_through,
    every_planner,
    planner_figures,
    safe_threshold,
    unseen_from_m,
)

from worldstate.simulation.scene.junction import site

PACE_MPS, ENTRY_Y_M, ENTRIES_S = 4.5, 4.0, (40.0, 80.0, 120.0, 160.0)


def stream(name: str = "SB2", entries_s: tuple[float, ...] = ENTRIES_S, known: bool = True) -> BelievedStream:
    """Return vehicles alternately from the left and the right, with a chance of one in the 3 s before each
    T0."""
    told, rows, lanes_m = [], [], site(name).lanes_m
    time_s = np.round(np.arange(1.0, 220.0, 0.1), 1)
    chances = np.zeros((len(time_s), 2, 4), np.float32)
    for number, entry_s in enumerate(entries_s):
        side, kind = number % 2, "bicycle" if number == 3 else "light"
        told.append((number, "left", kind, ("left", "right")[side], entry_s, True))
        for moment_s in np.round(np.arange(entry_s - 8.0, entry_s + 5.0, 0.1), 1):
            way_m = ENTRY_Y_M - PACE_MPS * (moment_s - entry_s)
            in_view = abs(way_m) <= ENTRY_Y_M
            rows.append((number, moment_s, lanes_m[side], (1 - 2 * side) * way_m, in_view, 60.0))
        chances[(time_s > entry_s - 3.0) & (time_s < entry_s), side] = known
    return with_chances(heard_stream(told, rows, {"time_s": time_s}, site=name), time_s, chances)


EVERY = (stream(), stream("SA1"), stream(entries_s=()))


@pytest.mark.long
@pytest.mark.parametrize("ego", [EgoVehicle(), FROM_STANDING])
def test_an_informed_planner_brakes_only_for_vehicles_and_an_uninformed_one_collides(ego: EgoVehicle) -> None:
    corners = draw_corners(EVERY, 40, ego, np.random.default_rng(1))
    planners = every_planner(corners, 0.5, 0.5, ego)
    figures = planner_figures(corners, planners, np.random.default_rng(2))
    nobody, phantom, full, chance = (figures[name] for name in (UNAWARE, PHANTOM, FULL, CHANCE))
    assert nobody["loud_collisions"] > 0 and nobody["empty_needless_s"] == 0.0
    assert [one["loud_collisions"] + one["quiet_collisions"] for one in (phantom, full, chance)] == [0, 0, 0]
    assert chance["empty_needless_s"] == 0.0 < full["empty_needless_s"] < phantom["empty_needless_s"]
    assert chance["empty_took_s"] == nobody["empty_took_s"] < phantom["empty_took_s"]
    assert chance["loud_recorded"] == 6 and chance["quiet_recorded"] == 2
    assert 0.9 < chance["less_at_0.05_low"] <= chance["less_at_0.05"] <= chance["less_at_0.05_high"] <= 1.0
    assert phantom["less_at_0.2"] == 0.0
    # Sight only grows as the car approaches: a vehicle just beyond its edge may come from farther behind.
    for remembered, assumed in zip(planners[MEMORY], planners[PHANTOM], strict=True):
        np.testing.assert_array_equal(remembered.front_m, assumed.front_m)


@settings(deadline=None)
@given(st.integers(1, 40), st.floats(0.1, 10.0), st.integers(0, 2**32 - 1))
def test_no_unseen_vehicle_within_the_limit_is_nearer_than_memory_allows(
    steps: int, limit_m: float, seed: int
) -> None:
    rng, step = np.random.default_rng(seed), np.arange(steps)
    sight_m = rng.uniform(1.0, 200.0, steps)
    nearest = np.array([*accumulate(sight_m, lambda before, now: unseen_from_m(before, now, limit_m))])
    assert (nearest >= sight_m).all()  # never nearer than the plain phantom
    driven = np.cumsum(rng.uniform(0.0, limit_m, steps))
    unseen = (sight_m + driven).max() - driven  # the smallest distance without having been seen
    assert (unseen >= nearest - 1e-9).all()
    # And the bound is tight: a vehicle at the speed limit ends at this distance and was always beyond the
    # edge.
    tight = nearest[-1] + limit_m * (step[-1] - step)
    assert (tight >= sight_m - 1e-9).all()


def test_an_uninformative_chance_is_not_used() -> None:
    ego, rng = EgoVehicle(), np.random.default_rng(3)
    knowing = draw_corners(EVERY, 20, ego, rng)
    unheard = draw_corners([stream(known=False), EVERY[2]], 20, ego, rng)
    assert safe_threshold([knowing.quiet], ego) == 0.0453
    assert safe_threshold([unheard.loud], ego) == 0.0


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
def test_no_car_brakes_or_accelerates_beyond_its_limits(seed: int, threshold: float) -> None:
    ego, rng = EgoVehicle(), np.random.default_rng(seed)
    corners = draw_corners(EVERY, 8, ego, rng)
    told = replace(corners.loud, within=rng.random((8, corners.loud.within.shape[1], 2, 4)))
    driven = drive_through(told, threshold, ego)
    speed = np.diff(driven.front_m, axis=1) / STEP_S
    moving = np.diff(driven.front_m[:, 1:], axis=1) > 0.0
    change = np.diff(speed, axis=1)[moving] / STEP_S
    assert speed.min() >= 0.0 and speed.max() <= ego.limit_mps + 1e-6
    assert change.min() >= -ego.full_mps2 - 1e-6 and change.max() <= ego.acceleration_mps2 + 1e-6
    always = drive_through(told, 0.0, ego)
    np.testing.assert_array_equal(always.front_m, drive_through(corners.loud, 0.0, ego).front_m)
