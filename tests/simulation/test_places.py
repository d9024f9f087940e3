"""Places other than junctions: sight against a line of sight in small steps."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from simulated_sound import PAIR, QUIET

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.simulation import (
    PLACES,
    SITES,
    DatasetSettings,
    SimulationSettings,
    VehicleSettings,
    draw_settings,
    place,
    simulate_recording,
    site,
)
from worldstate.simulation.camera.simulated_detector import line_of_sight
from worldstate.simulation.dataset.recording import describe
from worldstate.simulation.scene.driving import trajectories
from worldstate.simulation.scene.junction import place_of

CAMERA = PinholeCamera.ovad()
TIME_S = np.arange(-2.0, 12.0, 0.05)
FRAMES_S = np.arange(0.0, 10.0, 0.1)


def pictured(x: float, y: float) -> bool:
    """Whether a point at the height of the camera is in its image."""
    depth = (x - CAMERA.position_m[0]) * np.cos(CAMERA.pitch_rad)
    focal = 0.5 * CAMERA.width_px / np.tan(CAMERA.half_angle_rad)
    return bool(depth > 0.0 and abs(focal * (y - CAMERA.position_m[1]) / depth) < 0.5 * CAMERA.width_px)


def seen_step_by_step(plan, x: float, y: float) -> bool:
    """Whether small steps from the camera to a point meet no body and no building beside the mouth."""
    share = np.linspace(0.0, 1.0, 1500)
    line = np.outer(1.0 - share, CAMERA.position_m[:2]) + np.outer(share, (x, y))
    for body in plan.occluders:
        outline = np.array(body.corners_m)
        if len(outline) == 2:  # a screen along x
            (low, wall), (high, _) = outline
            crossed = (np.diff(np.sign(line[:, 1] - wall)) != 0) & (line[1:, 0] > low) & (line[1:, 0] < high)
            if crossed.any():
                return False
        elif Outline(outline).contains_points(line).any():
            return False
    if not plan.is_open:
        first = np.argmax(line[:, 0] > plan.corner_ahead_m)
        if (
            line[first, 0] > plan.corner_ahead_m
            and not -plan.corner_right_m < line[first, 1] < plan.corner_left_m
        ):
            return False
    return pictured(x, y)


def told(scene: SimulationSettings) -> dict:
    """Return the truth of a recording without its sound."""
    seen = [path.at(FRAMES_S) for path in trajectories(scene, TIME_S)]
    sights = [line_of_sight(path, scene.site, CAMERA) for path in seen]
    return json.loads(json.dumps(describe(scene, FRAMES_S, seen, sights), allow_nan=False))


def check_sight(plan, frames: list[dict]) -> int:
    """Compare frames over 10 cm from the edge of a shadow; return how many were in view."""
    in_view = 0
    for frame in frames[::4]:
        x, y = frame["position_m"]
        near = {seen_step_by_step(plan, x + dx, y + dy) for dx in (-0.1, 0.1) for dy in (-0.1, 0.1)}
        if len(near) == 1:
            assert near == {frame["line_of_sight"]}, (x, y)
            in_view += frame["line_of_sight"]
    return in_view


@pytest.mark.parametrize("name", PLACES)
@settings(max_examples=2, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_truth_has_sight_and_time_to_visible(name, seed):
    there, rng = place(name), np.random.default_rng(seed)
    for approach in there.approaches:
        scene = draw_settings(there.site.name, approach, rng)
        frames = told(scene)["frames"]
        assert check_sight(there.site, frames)
        first = [frame["line_of_sight"] for frame in frames].index(True)
        assert abs(frames[first]["time_s"] - scene.entry_s) <= 0.2
        left_s = scene.entry_s - frames[first]["time_s"]
        assert frames[first]["time_to_visible_s"] == pytest.approx(left_s, abs=1e-5)
        assert frames[first]["position_m"][1] * (1.0 if approach == "left" else -1.0) > 0.0
    for way in (way for way in there.ways if way.approach == "none"):
        plain = VehicleSettings("left", rng.uniform(5.0, 7.0), rng.uniform(5.0, 12.0), route_m=way.route_m)
        truth = told(SimulationSettings(there.site, "none", others=(plain,)))
        (frames,) = truth["others"]
        assert (truth["frames"], truth["entry_s"]) == ([], None)
        if check_sight(there.site, frames):
            assert frames[0]["line_of_sight"]
            assert [f["time_to_visible_s"] for f in frames] == pytest.approx([-f["time_s"] for f in frames])
        else:
            assert {frame["time_to_visible_s"] for frame in frames} == {None}


@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from([*SITES, *(place(name).site.name for name in PLACES)]),
    st.lists(st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0)), min_size=2, max_size=4),
)
def test_sight_is_a_free_line_within_the_image(name, points):
    there = place_of(name)
    plan = site(name) if there is None else there.site
    assume(np.hypot(*np.diff(np.array(points), axis=0).T).min() >= 1.0)
    frames = told(SimulationSettings(plan, "left", route_m=tuple(points)))["frames"]
    street = plan.corner_ahead_m
    inside = [
        frame
        for frame in frames
        if plan.is_open or frame["position_m"][0] > street + 0.2 or abs(frame["position_m"][1]) < 2.0
    ]
    check_sight(plan, inside)


def test_a_data_set_of_all_places_has_every_approach_of_each():
    plans = DatasetSettings(n_static=4 * (len(SITES) + len(PLACES)), scene="all").plans()
    found = {(plan.environment, plan.approach) for plan in plans}
    wanted = {(name, side) for name in SITES for side in ("left", "none", "right")}
    wanted |= {(place(n).site.name, side) for n in PLACES for side in (*place(n).approaches, "none")}
    assert found == wanted


def test_half_of_the_hazard_free_recordings_have_a_vehicle():
    rng = np.random.default_rng(3)
    with_one = [len(draw_settings("SO1", "none", rng).traffic) for _ in range(200)]
    assert 70 <= sum(with_one) <= 130
    assert {len(draw_settings("SO1", side, rng).traffic) for side in ("left", "right")} == {1}


@pytest.mark.parametrize(("name", "has_late_sound"), [("open-road", False), ("wide-crossing", True)])
def test_late_sound_needs_walls(name, has_late_sound):
    scene = SimulationSettings(place(name).site, "left", 0.5, entry_s=0.4, sample_rate_hz=8e3, preset=QUIET)
    loud, none = (
        simulate_recording(
            replace(scene, preset=replace(QUIET, late_open_db=level)), np.random.default_rng(1), PAIR
        ).audio
        for level in (0.0, -90.0)
    )
    assert (loud.std() > 1.5 * none.std()) == has_late_sound
    assert np.array_equal(loud, none) != has_late_sound


def test_a_vehicle_behind_is_audible_and_never_in_view():
    scene = SimulationSettings(
        place("open-road").site, "none", 2.0, sample_rate_hz=8e3, preset=QUIET,
        others=(VehicleSettings("left", 1.0, route_m=((-12.0, 60.0), (-12.0, -60.0))),),
    )  # fmt: skip
    recording = simulate_recording(scene, np.random.default_rng(1), PAIR)
    alone = simulate_recording(replace(scene, others=()), np.random.default_rng(1), PAIR)
    assert recording.audio.std() > 10.0 * alone.audio.std()
    assert not any(recording.detections)
    assert recording.t0_frame == alone.t0_frame == 14
