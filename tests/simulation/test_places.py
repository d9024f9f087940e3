"""Places other than junctions against a line of sight in small steps; arrays of 2 to 64 microphones."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import soundfile
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from simulated_sound import PAIR, QUIET, apart_deg, made, srp_spectrum

from worldstate.adapters.files.array_file import read_array
from worldstate.frontend.array.microphone_array import MicrophoneArray
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
from worldstate.simulation.scene.driving import CAMERA, trajectories
from worldstate.simulation.scene.junction import place_of

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
    sights = [line_of_sight(path, scene.site) for path in seen]
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


FS = 12_000.0
GRID = np.stack(np.meshgrid(*[np.arange(4.0)] * 2), axis=-1).reshape(-1, 2)
ZERO = np.zeros((16, 1))
CUBE = np.stack(np.meshgrid(*[np.arange(2.0)] * 3), axis=-1).reshape(-1, 3)
# In metres; the cube is on a mast.
ARRAYS = {
    "pair": [[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]],
    "line across": np.outer(np.arange(5.0), [0.0, 0.09, 0.0]),
    "line along": np.outer(np.arange(8.0), [0.08, 0.0, 0.0]),
    "upright": 0.1 * np.concatenate([ZERO, GRID], axis=1),
    "lying": 0.1 * np.concatenate([GRID, ZERO], axis=1),
    "cube": 0.2 * CUBE + [0.0, 0.0, 3.0],
    "ball": np.random.default_rng(4).uniform(-0.4, 0.4, (64, 3)),
}
FRONT_AS_BACK, LEFT_AS_RIGHT = ("pair", "line across", "upright"), ("line along",)
AZIMUTHS_DEG = np.arange(-180.0, 180.0, 2.0)
LEVEL = replace(QUIET, ambient_waves=8, vehicle_spread_db=0.0)


@lru_cache
def passing(azimuth_deg: float, name: str) -> np.ndarray:
    """Return the sound of a slow car 15 m away at an azimuth, in the open."""
    x, y = 15.0 * np.cos(np.radians(azimuth_deg)), 15.0 * np.sin(np.radians(azimuth_deg))
    # The axles are behind the front towards the array, so both have the same azimuth.
    way = ((2.0 * x, 2.0 * y), (x, y))
    scene = SimulationSettings(
        place("open-road").site, "left", 0.5, entry_s=0.3, speed_mps=1.0, sample_rate_hz=FS, route_m=way,
        preset=LEVEL,
    )  # fmt: skip
    return simulate_recording(scene, np.random.default_rng(1), MicrophoneArray(ARRAYS[name])).audio


@pytest.mark.parametrize("name", sorted(ARRAYS))
@pytest.mark.parametrize("azimuth_deg", [30.0, -124.0])
def test_bearings_are_right_up_to_the_symmetry_of_the_array(name, azimuth_deg):
    array = MicrophoneArray(ARRAYS[name])
    sound = passing(azimuth_deg, name)
    assert sound.shape == (6000, array.n_microphones)
    power = srp_spectrum(sound.T, array, FS, AZIMUTHS_DEG, (375.0, 1500.0))
    mirrored = 180.0 - azimuth_deg if name in FRONT_AS_BACK else -azimuth_deg
    here, there = (power[apart_deg(AZIMUTHS_DEG, at).argmin()] for at in (azimuth_deg, mirrored))
    found = AZIMUTHS_DEG[power.argmax()]
    if name in (*FRONT_AS_BACK, *LEFT_AS_RIGHT):
        assert min(apart_deg(found, azimuth_deg), apart_deg(found, mirrored)) <= 6.0
        assert there == pytest.approx(here, rel=0.02)
    else:
        assert apart_deg(found, azimuth_deg) <= 4.0
        assert there < 0.9 * here


def test_the_level_does_not_depend_on_the_array():
    levels = [10 * np.log10(np.mean(passing(30.0, name) ** 2)) for name in ARRAYS]
    assert np.ptp(levels) < 0.3


def test_the_data_set_keeps_the_array_with_its_heights(tmp_path, capsys):
    (tmp_path / "cube.json").write_text(json.dumps(np.array(ARRAYS["cube"]).tolist()))
    words = f"--static 1 --duration 0.5 --scene parked-van --array {tmp_path / 'cube.json'}"
    (folder,) = made(capsys, tmp_path / "d", words)["folders"]
    np.testing.assert_array_equal(read_array(tmp_path / "d" / "array.xml").positions_m, ARRAYS["cube"])
    assert soundfile.info(tmp_path / "d" / folder / "out_multi.wav").channels == 8
