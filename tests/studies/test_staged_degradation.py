"""End to end: a simulated approach is heard, its camera is degraded frame by frame, and nobody is told."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from worldstate.abduction.co_evidence import Absent
from worldstate.adapters.camera.camera_channel import Watcher, any_motion
from worldstate.adapters.camera.camera_health import learn_health
from worldstate.adapters.camera.degradation import degrade
from worldstate.adapters.camera.detections import read_detections
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates, save_miss_rates
from worldstate.adapters.camera.motion_detector import MotionDetector
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.adapters.camera.vision_query import VisionSettings
from worldstate.adapters.datasets.ovad import Recording
from worldstate.adapters.listen import measure_steps, open_source
from worldstate.core.filter import WorldFilter
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.studies.degradation.degraded_detections import CameraState, Staging, detect_in_states
from worldstate.studies.degradation.detections_file import load_staged_detections, save_staged_detections
from worldstate.studies.degradation.staged_degradation import filter_in_states

CAMERA = PinholeCamera()
WIDTH, HEIGHT = 484, 304
SMALL = PinholeCamera(width_px=WIDTH, height_px=HEIGHT)


def render(log):
    """A textured street with the reference boxes drawn as textured cars."""
    rng = np.random.default_rng(0)
    scene = 110.0 + 25.0 * gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 1.2) / 0.2
    body = 200.0 + 60.0 * gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 3.0) / 0.1
    scale = np.array([WIDTH / CAMERA.width_px, HEIGHT / CAMERA.height_px] * 2)
    for frame in log.frames:
        image = scene.copy()
        for left, top, right, bottom in (frame.boxes_px * scale).astype(int):
            image[top:bottom, left:right] = body[: bottom - top, : right - left]
        image = image[:, :, None] + rng.normal(0.0, 2.0, (HEIGHT, WIDTH, 3))
        yield np.clip(image, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def video(approach, tmp_path_factory):
    path = tmp_path_factory.mktemp("staged") / "street.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (WIDTH, HEIGHT))
    for frame in render(read_detections(approach.detections_path)):
        writer.write(frame)
    writer.release()
    return open_video(path)


@pytest.fixture(scope="module")
def rates(video):
    health = learn_health([next(video.frames())], np.random.default_rng(0))
    rising = FamilyCounts(((100,) * 5,), ((2, 10, 90, 98, 100),), (100,) * 5, (0, 0, 1, 1, 1))
    return MissRates((0.0, 37.0), {"noise": rising}, health=health)


@pytest.mark.xdist_group("approach")
def test_the_camera_fails_and_beta_knows_while_the_sound_stays(approach, video, rates):
    source, recording = open_source(approach.folder), Recording.open(approach.folder)
    staging = Staging(MotionDetector, rates, SMALL, VisionSettings(keep=any_motion()))
    states = (CameraState("all", 0.0), CameraState("noise", 1.0))
    detections = detect_in_states(video, staging, states, np.random.default_rng(0))
    staged = filter_in_states(source, detections, staging, name="a", label=recording.label)
    assert list(staged) == ["clean", "noise 1", "off"]
    clean, blind, off = staged.values()
    after = clean.after_sight()
    assert after.any()
    assert not after[clean.time_s < source.t0_s].any()
    assert clean.seen[after].mean() > 0.7
    assert blind.seen[after].mean() <= 0.05
    assert clean.found[after].mean() > 0.7
    assert not (clean.found & ~(clean.seen & clean.there)).any()
    assert not off.found.any()
    assert (off.answer == 0).all()
    asked = (clean.answer > 0) & (blind.answer > 0)
    assert asked.mean() > 0.5
    assert np.median(clean.miss_rate[asked]) < 0.4
    assert np.median(blind.miss_rate[asked]) > 0.9
    assert [np.median(one.degradation) for one in staged.values()] == pytest.approx([0.0, 1.0, 1.0], abs=0.1)
    assert_the_sound_says_the_same(source, staged)


@pytest.mark.xdist_group("approach")
def test_what_was_seen_comes_back_for_its_origin_alone_and_damage_is_named(video, rates, tmp_path):
    staging = Staging(MotionDetector, rates, SMALL, VisionSettings(keep=any_motion()))
    states = (CameraState("all", 0.0), CameraState("noise", 1.0))
    detections = detect_in_states(video, staging, states, np.random.default_rng(0))
    assert sum(map(len, detections["clean"].detections.frames)) > 10
    path = tmp_path / "r.npz"
    save_staged_detections(path, detections, "one")
    back = load_staged_detections(path, "one")
    assert list(back) == list(detections)
    for one, other in zip(back.values(), detections.values(), strict=True):
        assert np.array_equal(one.degradation.degradation, other.degradation.degradation)
        assert np.array_equal(one.detections.stamps_ns, other.detections.stamps_ns)
        for frame, same in zip(one.detections.frames, other.detections.frames, strict=True):
            assert np.array_equal(frame.boxes_px, same.boxes_px)
            assert (frame.labels, frame.scores.tolist()) == (same.labels, same.scores.tolist())
    assert load_staged_detections(path, "another") is None
    assert load_staged_detections(tmp_path / "nothing.npz", "one") is None
    whole = path.read_bytes()
    for size in range(0, len(whole) - 1, len(whole) // 15):
        path.write_bytes(whole[:size])
        with pytest.raises(InputFileError, match=r"r\.npz"):
            load_staged_detections(path, "one")


def assert_the_sound_says_the_same(source, staged):
    """Against the filter itself, on the sound as it was measured and with no camera."""
    world, presence = WorldFilter(context=source.context, policy=source.policy), []
    said = []
    for _, measurement in measure_steps(replace(source, detections=None)):
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        presence.append(1.0 - world.explanation.none)
        said.append(measurement.signature.log_likelihoods)
    assert staged["off"].log_likelihoods == pytest.approx(np.array(said))
    assert staged["off"].presence == pytest.approx(np.array(presence))


@pytest.mark.xdist_group("approach")
def test_the_chain_reads_the_cameras_health_from_the_video_beside_the_sound(approach, video, rates, tmp_path):
    folder = tmp_path / "recording"
    shutil.copytree(approach.folder, folder)
    writer = cv2.VideoWriter(str(folder / VIDEO_NAME), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (WIDTH, HEIGHT))
    for number, frame in enumerate(video.frames()):
        writer.write(degrade(frame, "darkness", 1.0 if number >= 50 else 0.0, np.random.default_rng(0)))
    writer.release()
    save_miss_rates(tmp_path / "beta.json", with_darkness := darkening(rates))
    source = open_source(folder, miss_rates=tmp_path / "beta.json")
    assert source.miss_rates.table == with_darkness.table
    assert source.degradation(2_000_000_000) < 0.1 < 0.9 < source.degradation(8_000_000_000)
    betas = {
        m.stamp_ns: m.co_evidence.miss_rate
        for _, m in measure_steps(source)
        if isinstance(m.co_evidence, Absent)
    }
    assert np.median([b for t, b in betas.items() if t < 4_500_000_000]) < 0.4
    assert np.median([b for t, b in betas.items() if t > 5_500_000_000]) > 0.9


def darkening(rates):
    return replace(rates, families={"darkness": rates.families["noise"]})


def test_without_a_scale_of_health_nothing_is_watched(rates):
    with pytest.raises(InvalidArgumentError, match="health"):
        Watcher(MotionDetector(), MissRates(rates.azimuth_deg, rates.families))
