"""Rendered streets: projection, occlusion and times."""

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_sound import PAIR

from worldstate.adapters.camera.detections import read_detections
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.ground.errors import InputFileError, InvalidArgumentError, MissingExtraError
from worldstate.simulation import (
    SITES,
    SimulationSettings,
    simulate_recording,
    site,
    write_recording,
)
from worldstate.simulation.camera.simulated_detector import park
from worldstate.simulation.camera.street_view import (
    ROAD_Z_M,
    View,
    cast_solid,
    paint_street,
)
from worldstate.simulation.camera.vehicle_view import Car, add_car
from worldstate.simulation.dataset.dataset import camera_frames, parked_lane_m, parked_middle_m, write_video
from worldstate.simulation.scene.vehicle import HEIGHT_M, LENGTH_M, WIDTH_M

SMALL = PinholeCamera.ovad(width_px=320, height_px=201)
MIDDLE = PinholeCamera.ovad(width_px=640, height_px=402)


def scene(name="SA1", approach="left", **changes):
    given = {"duration_s": 4.0, "entry_s": 2.0, "speed_mps": 8.0, "sample_rate_hz": 8_000.0} | changes
    return SimulationSettings(site(name), approach, **given)


def filmed(plan, seed=3, camera=SMALL):
    rng = np.random.default_rng(seed)
    recording = simulate_recording(plan, rng, PAIR)
    return recording, list(camera_frames(plan, recording, np.random.default_rng(seed), camera))


def changed(frame, other, by=25):
    """Return the pixels whose difference between two frames is much larger than the sensor noise."""
    return np.abs(frame.astype(int) - other.astype(int)).max(axis=2) > by


def opencv_pixels(camera, points):
    """Project by the pinhole model of OpenCV, (n, 3) to (n, 2)."""
    pitch = camera.pitch_rad
    rows = [[0, -1, 0], [np.sin(pitch), 0, -np.cos(pitch)], [np.cos(pitch), 0, np.sin(pitch)]]
    turn = np.array(rows, float)
    focal = 0.5 * camera.width_px / np.tan(camera.half_angle_rad)
    lens = np.array([[focal, 0, camera.width_px / 2], [0, focal, camera.height_px / 2], [0, 0, 1]])
    shift = -turn @ np.array(camera.position_m)
    return cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, lens, None)[0][:, 0]


def test_rays_equal_those_of_opencv():
    view = View(SMALL)
    rays = view.rays(view.whole)
    chosen = np.random.default_rng(0).integers(0, (402, 640), (50, 2))
    points = np.array(SMALL.position_m) + 7.0 * rays[chosen[:, 0], chosen[:, 1]].astype(float)
    pixels = opencv_pixels(SMALL, points)
    assert np.abs(2 * pixels - 0.5 - chosen[:, ::-1]).max() < 1e-2


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_intersections_equal_those_by_sampling(seed):
    """As an oracle, small steps along each ray find the first point within all half-spaces."""
    rng = np.random.default_rng(seed)
    normals = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(3, 3))])
    offsets = rng.uniform(0.4, 1.0, 9)
    eye = np.array([-4.0, 0.3, 0.2])
    rays = np.stack([np.ones((4, 6)), *rng.uniform(-0.4, 0.4, (2, 4, 6))], axis=-1).astype(np.float32)
    reach, face = cast_solid(rays, eye, normals, offsets)
    steps = np.arange(0.0, 8.0, 2e-3)
    places = eye + steps[:, None, None, None] * rays
    inside = (places @ normals.T <= offsets).all(axis=-1)
    first = np.where(inside.any(axis=0), steps[inside.argmax(axis=0)], np.inf)
    both = np.isfinite(first)
    assert np.all(np.isfinite(reach) | ~both)
    assert np.abs(reach[both] - first[both]).max(initial=0.0) < 3e-3
    grazed = np.isfinite(reach) & ~both
    assert grazed.mean() < 0.1
    met = eye + reach[both][:, None] * rays[both]
    assert np.abs((met * normals[face[both]]).sum(axis=1) - offsets[face[both]]).max(initial=0.0) < 1e-4


def test_a_car_fills_the_projection_of_its_cuboid():
    """The bounding box of its colour agrees with the corners that OpenCV projects."""
    street = paint_street(site("SB1"), View(MIDDLE))
    still = street.pixels()
    image = still.copy()
    car = Car(8.0, 2.2, 1, (180.0, 20.0, 20.0))
    add_car(street, car, image)
    # Paint and lamps without the shadow: red, or brighter than the road can be.
    body = (np.abs(image - still).max(axis=2) > 30.0) & (image.max(axis=2) > image.min(axis=2) + 60.0)
    body |= (image.min(axis=2) > 215.0) & (still.min(axis=2) < 150.0)
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    x = 8.0 + 0.5 * WIDTH_M * np.array([-1.0, 1.0])
    y, z = [2.2 - LENGTH_M, 2.2], ROAD_Z_M + np.array([0.0, HEIGHT_M])
    pixels = opencv_pixels(MIDDLE, np.array(np.meshgrid(x, y, z)).reshape(3, -1).T)
    # The ends lean in by 16 cm above the skirt, some 5 pixels here.
    assert 0 <= columns[0] - pixels[:, 0].min() < 6
    assert 0 <= pixels[:, 0].max() - columns[-1] < 6
    assert rows[0] == pytest.approx(opencv_pixels(MIDDLE, np.array([[7.4, 0.0, z[1]]]))[0, 1], abs=2)
    skirt = opencv_pixels(MIDDLE, np.array([[8.0 - 0.5 * WIDTH_M, 0.0, ROAD_Z_M + 0.26]]))[0, 1]
    assert rows[-1] == pytest.approx(skirt, abs=2)


@pytest.mark.long
@pytest.mark.parametrize("name", SITES)
@pytest.mark.parametrize("approach", ["left", "right"])
def test_images_change_only_from_line_of_sight(name, approach):
    plan = scene(name, approach, duration_s=3.0)
    recording, frames = filmed(plan)
    t0 = recording.t0_frame
    differ = [changed(frame, frames[0]).mean() for frame in frames]
    assert max(differ[: t0 - 2]) < 1e-4
    assert max(differ[t0 + 1 : t0 + 10]) > 0.02
    assert differ[t0 + 1] > 2e-4
    columns = np.flatnonzero(changed(frames[t0 + 2], frames[0]).any(axis=0))
    assert (columns.mean() < 160) == (approach == "left")


def test_images_of_an_empty_street_differ_only_by_noise_of_the_seed():
    plan = scene(approach="none", duration_s=0.6)
    (recording, frames), (_, other) = (filmed(plan, seed) for seed in (3, 4))
    assert (recording.truth["frames"], recording.t0_frame) == ([], 4)  # OVAD's 70 % of the length
    difference = frames[0].astype(float) - frames[5]
    assert 1.5 < difference.std() / np.sqrt(2) < 1.9
    assert frames[0].mean() == pytest.approx(np.mean([frame.mean() for frame in frames]), abs=0.1)
    assert not np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], other[0])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(SITES))
def test_the_position_of_the_parked_car_follows_from_its_boxes(seed, name):
    plan, rng = site(name), np.random.default_rng(seed)
    right, left = plan.sight_m(parked_lane_m(plan), PinholeCamera.ovad().position_m[:2])
    middle = np.random.default_rng(seed).uniform(0.6 * right, 0.6 * left)
    found = parked_middle_m(park(plan, 20, rng), plan)
    # If the line of sight cuts off a car, its box has one true end, which is in the image.
    assert found == pytest.approx(middle, abs=0.25)


def test_the_parked_car_is_drawn_in_its_box():
    plan = scene("SB1", "none", duration_s=1.0, parked_car=True)
    rng = np.random.default_rng(4)
    recording = simulate_recording(plan, rng, PAIR)
    plain = replace(plan, parked_car=False)
    with_car, without = (
        next(camera_frames(one, recording, np.random.default_rng(1), MIDDLE)) for one in (plan, plain)
    )
    rows, columns = (np.flatnonzero(changed(with_car, without, 8).any(axis=i)) for i in (1, 0))
    left, top, right, bottom = np.array(recording.detections[0][0].box_px) * 640 / 1936
    # The shadow extends half a metre beside and below, 25 pixels.
    assert -25 < columns[0] - left < 3
    assert -3 < columns[-1] - right < 25
    assert rows[0] == pytest.approx(top, abs=4)
    assert -3 < rows[-1] - bottom < 15


def test_video_without_frames_folder_or_opencv_raises_an_error(tmp_path, monkeypatch):
    with pytest.raises(InvalidArgumentError, match="frames"):
        write_video(tmp_path / "v.mp4", [])
    image = np.zeros((16, 16, 3), np.uint8)
    with pytest.raises(InputFileError, match="nowhere"):
        write_video(tmp_path / "nowhere" / "v.mp4", [image])
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"worldstate\[vision\]"):
        write_video(tmp_path / "v.mp4", [image])


def test_the_video_is_written_beside_the_sound_reproducibly(tmp_path):
    plan = scene(duration_s=0.5, entry_s=0.3)
    recording = simulate_recording(plan, np.random.default_rng(3), PAIR)
    for name in "abc":
        (tmp_path / name).mkdir()
        frames = camera_frames(plan, recording, np.random.default_rng(3), MIDDLE)
        write_recording(tmp_path / name, recording, 0, None if name == "c" else frames)
    first, again, silent = (tmp_path / name / "SA1/left/1_00_0000" for name in "abc")
    files = {path.name for path in first.iterdir()}
    assert files - {path.name for path in silent.iterdir()} == {VIDEO_NAME}
    assert all((again / name).read_bytes() == (first / name).read_bytes() for name in files)
    video = open_video(first / VIDEO_NAME)
    back, drawn = list(video.frames()), list(camera_frames(plan, recording, np.random.default_rng(3), MIDDLE))
    assert (video.width_px, video.height_px, video.frame_rate_hz, len(back)) == (640, 402, 10.0, 5)
    assert np.abs(back[3].astype(float) - drawn[3]).mean() < 4.0
    assert len(read_detections(first / "camera_baseline_results.json")) == 5
