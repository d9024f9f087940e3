"""The passes of the degradation sweep over one recording, and the study over several."""

import json
from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from street_frames import street
from test_hazard_awareness import recording, staged
from worldstate_lab.degradation.beta_curves import absence_counts, counts_table
from worldstate_lab.degradation.conditions import (
    CLEAN,
    FAMILIES,
    OFF,
    RAIN_DB,
    READINGS,
    Condition,
    degradation_in,
    degrade_reduced,
    detections_in,
    health_of,
    level_rms,
    look,
    motion_detectors,
    rained,
)
from worldstate_lab.degradation.degradation_study import DegradationSettings, degradation_study
from worldstate_lab.degradation.staged_filter import Camera, by_condition, filter_in_conditions
from worldstate_lab.evaluation.report.degradation_section import degradation_record, sweep_tables

from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.camera.camera_health import degrade, learn_health
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog, read_detections
from worldstate.adapters.camera.detectors import MotionDetector
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import open_video, seen_in
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import open_source
from worldstate.core.filter import WorldFilter
from worldstate.operations.detectors.miss_rate_measurement import (
    AbsenceSettings,
    LabelledVideo,
    measure_absence,
)
from worldstate.operations.recordings.hop_table import HopTable, joined

WHOLE = PinholeCamera.ovad()
WIDTH, HEIGHT = 484, 304
MOTION = motion_detectors()[:1]
STAGED = (Condition(CLEAN), Condition("noise", 1), Condition("noise", 4), Condition("lens", 4))


def render(log):
    """Return a textured street with the reference boxes drawn as textured cars."""
    rng = np.random.default_rng(0)
    scene = 110.0 + 25.0 * gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 1.2) / 0.2
    body = 200.0 + 60.0 * gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 3.0) / 0.1
    scale = np.array([WIDTH / WHOLE.width_px, HEIGHT / WHOLE.height_px] * 2)
    for frame in log.frames:
        image = scene.copy()
        for left, top, right, bottom in (frame.boxes_px * scale).astype(int):
            image[top:bottom, left:right] = body[: bottom - top, : right - left]
        image = image[:, :, None] + rng.normal(0.0, 2.0, (HEIGHT, WIDTH, 3))
        yield np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("reduced", [3.025, 4.0])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_degraded_reduced_frame_equals_a_reduced_degraded_frame(family, reduced):
    """Mean and spread of dark and bright patches, in which clipping changes both."""
    grey, rng = next(street(1)), np.random.default_rng(2)
    height, width = grey.shape[:2]
    size = (round(width / reduced), round(height / reduced))
    shift = np.where(np.arange(width) < width // 2, -100.0, 130.0)[:, None]
    patches = np.clip(grey + shift, 0, 255).astype(np.uint8)
    for d in (0.25, 1.0):
        after = cv2.resize(degrade(patches, family, d, rng), size, interpolation=cv2.INTER_AREA)
        small = cv2.resize(patches, size, interpolation=cv2.INTER_AREA)
        before = degrade_reduced(small, family, d, rng, width / size[0])
        for columns in (slice(0, size[0] // 2 - 20), slice(size[0] // 2 + 20, None)):
            one, other = after[:, columns].astype(float), before[:, columns].astype(float)
            assert other.mean() == pytest.approx(one.mean(), abs=1.5)
            assert other.std() == pytest.approx(one.std(), rel=0.04, abs=0.3)


@pytest.fixture(scope="module")
def video(approach, tmp_path_factory):
    path = tmp_path_factory.mktemp("staged") / "street.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (WIDTH, HEIGHT))
    for frame in render(read_detections(approach.detections_path)):
        writer.write(frame)
    writer.release()
    return open_video(path)


@pytest.fixture(scope="module")
def looks(video):
    return look(video, MOTION, np.random.default_rng(0), 640, STAGED)


@pytest.fixture(scope="module")
def rates(video):
    rising = FamilyCounts(((100,) * 5,), ((2, 10, 90, 98, 100),), (100,) * 5, (0, 0, 1, 1, 1))
    return MissRates(
        (0.0, 37.0), {"noise": rising}, health=learn_health([next(video.frames())], np.random.default_rng(0))
    )


@pytest.mark.long
def test_the_clean_camera_reports_what_the_detector_and_the_health_estimation_do(video, looks, rates):
    detector, scale = MotionDetector(), np.array([WHOLE.width_px / WIDTH, WHOLE.height_px / HEIGHT] * 2)
    kept = detections_in(looks["mog2"], CLEAN)
    assert sum(map(len, kept.frames)) > 10
    for image, frame in zip(video.frames(), kept.frames, strict=True):
        found = detector.detect(image)
        assert frame.boxes_px == pytest.approx(found.boxes_px * scale)
        assert frame.labels == found.labels
        assert frame.scores == pytest.approx(found.scores)
    assert kept.stamps_ns[:3].tolist() == [0, 100_000_000, 200_000_000]
    first = part(video, 0, 90)
    first.path = "first"
    found, d = seen_in(first, MotionDetector(), rates)
    assert [len(frame) for frame in found.frames] == [len(frame) for frame in kept.frames[:90]]
    read = degradation_in(looks[READINGS], CLEAN, rates)
    assert np.median(d.degradation) == pytest.approx(np.median(read.degradation), abs=0.05)
    assert seen_in(first, MotionDetector(), replace(rates, health=None))[1](0) == 0.0


def part(video, first, last):
    """Return some frames of a video as a separate video."""
    return SimpleNamespace(frames=lambda: islice(video.frames(), first, last), frame_rate_hz=10.0)


def test_the_scale_of_d_is_that_of_the_same_images(video):
    staged = [Condition(family, i) for family in ("blur", "noise") for i in range(1, 5)]
    tables = look(part(video, 0, 1), MOTION, np.random.default_rng(0), 640, (Condition(CLEAN), *staged))
    mine = health_of([tables[READINGS]])
    theirs = learn_health([next(video.frames())], np.random.default_rng(1))
    assert mine.brightness == pytest.approx(theirs.brightness)
    assert mine.noise == pytest.approx(theirs.noise, rel=0.03)
    assert mine.sharpness == pytest.approx(theirs.sharpness, rel=0.05)


@pytest.mark.long
def test_counts_are_those_of_measure_absence(approach, video):
    """On clean frames, which have no random degradation."""
    whole, (first, last) = read_detections(approach.detections_path), (60, 100)
    reference = DetectionLog(whole.frames[first:last], whole.stamps_ns[first:last])
    small = np.array([WIDTH / WHOLE.width_px, HEIGHT / WHOLE.height_px] * 2)
    frames = [DetectionFrame(one.boxes_px * small, one.scores, one.labels) for one in reference.frames]
    camera = PinholeCamera.ovad(width_px=WIDTH, height_px=HEIGHT)
    scene = LabelledVideo(part(video, first, last), replace(reference, frames=tuple(frames)), camera)
    # The minimum height of a reference box is converted to pixels of the video.
    keep = replace(AbsenceSettings().keep, min_height_px=40.0 * HEIGHT / WHOLE.height_px)
    settings = AbsenceSettings(families=("blur",), keep=keep)
    measured = measure_absence([scene], MotionDetector, np.random.default_rng(0), settings).families["blur"]
    looks = look(part(video, first, last), MOTION, np.random.default_rng(0), 640, [Condition(CLEAN)])
    counted = absence_counts(reference, looks["mog2"])["blur"]
    for name in ("looks", "misses", "sectors", "clutter"):
        mine, theirs = (np.array(getattr(one, name))[..., 0] for one in (counted, measured))
        assert mine == pytest.approx(theirs), name
    assert np.array(counted.looks)[:, 0].sum() > 10


@pytest.mark.long
def test_beta_rises_with_a_failing_camera_while_the_sound_is_unchanged(approach, looks, rates):
    source = open_source(approach.folder)
    behind = [Camera(MOTION[0], rates, looks["mog2"], looks[READINGS])]
    loud = Condition("lens", 4), Condition("roof", 3), Condition("rain", 4)
    conditions = (Condition(CLEAN), Condition("noise", 4), *loud, Condition(OFF))
    staged = by_condition(filter_in_conditions(source, behind, (0, 1), conditions)["mog2"])
    assert list(staged) == ["clean", "noise 1", "lens 1", "roof 0.75", "rain 1", "off"]
    clean, blind, lens, roof, rain, off = staged.values()
    after = clean.replace(label="left", t0_s=source.t0_s).after_sight()
    assert clean.found[after].mean() > 0.7 and blind.seen[after].mean() <= 0.05
    assert not (clean.found & ~(clean.seen & clean.there)).any()
    assert not off.found.any() and (off.answer == 0).all()
    asked = (clean.answer > 0) & (blind.answer > 0)
    assert asked.mean() > 0.5
    assert np.median(clean.miss_rate[asked]) < 0.4 and np.median(blind.miss_rate[asked]) > 0.9
    assert np.array_equal(roof.found, clean.found)
    assert np.array_equal(rain.found, lens.found)
    assert np.array_equal(lens.log_likelihoods, clean.log_likelihoods)
    assert not np.allclose(roof.log_likelihoods, clean.log_likelihoods)
    # Without a camera, sound and belief are those of the filter itself.
    world, absence, said = WorldFilter(context=source.context, policy=source.policy), [], []
    for _, measurement in measure_steps(replace(source, detections=None)):
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        moving = (one for one in world.state.entities if one.moving)
        absence.append(np.prod([1.0 - one.existence_probability for one in moving]))
        said.append(measurement.signature.log_likelihoods)
    assert off.log_likelihoods == pytest.approx(np.array(said))
    assert off.presence == pytest.approx(1.0 - np.array(absence))


@pytest.mark.long
def test_rain_on_the_roof_is_white_and_independent_at_every_microphone(approach):
    source = open_source(approach.folder)
    with open_sound(source.sound) as audio:
        dry = np.concatenate(list(audio.blocks()))
    with open_sound(rained(source, 3, level_rms(source), np.random.default_rng(3)).sound, 56) as audio:
        drops = np.concatenate(list(audio.blocks(1 << 14))) - dry
    db = 20.0 * np.log10(drops.std(axis=0) / np.sqrt(np.mean(dry.astype(float).var(axis=0))))
    assert db == pytest.approx(RAIN_DB[3], abs=0.1)
    apart = np.corrcoef(drops[::4].T) - np.eye(56)
    assert np.abs(apart).max() < 6.0 / np.sqrt(len(drops) / 4)
    assert abs(np.corrcoef(drops[1:, 0], drops[:-1, 0])[0, 1]) < 6.0 / np.sqrt(len(drops))


def readings():
    """Return qualities of images with the staged blur and noise."""
    rows = [(CLEAN, 0.0, 100.0, 2.0, 5.0)]
    rows += [(Condition("blur", i).name, 0.0, 100.0, 2.0, 5.0 / (1 + i)) for i in range(1, 5)]
    rows += [(Condition("noise", i).name, 0.0, 100.0, 2.0 + 20.0 * i, np.nan) for i in range(1, 5)]
    return HopTable.of_rows(("condition", "time_s", "brightness", "noise", "sharpness"), rows)


def believed(number, approach):
    """Return the beliefs of `staged` in every condition, as the pass over a recording returns them."""
    tables = staged(number, approach, np.random.default_rng(number))
    clean = tables[CLEAN]
    every = joined(one.replace(condition=np.full(len(one), name)) for name, one in tables.items())
    return every.replace(label=clean.label, t0_s=clean.t0_s)


def test_miss_rates_of_a_recording_come_from_the_others(tmp_path):
    """Each recording has a power of two as number of looks, so that the sum shows which ones it contains."""
    sides = ("left",) * 4 + ("none",) * 4
    recordings = [recording(tmp_path, f"SA{i % 2}", side, i) for i, side in enumerate(sides)]
    used = {}

    def kept(name, key, make):
        number = int((key if name == "degraded-looks" else key[1])[1][-1])
        if name == "degraded-looks":
            looks = ((2.0**number,) * 5,) * 4
            misses = ((0.0, 0.0, 0.0, 2.0**number, 2.0**number),) * 4
            counts = dict.fromkeys(FAMILIES, FamilyCounts(looks, misses, (9.0,) * 5, (0.0,) * 5))
            return {"mog2 misses": counts_table(counts), READINGS: readings()}
        used[number] = key[2]["mog2"]["families"]["blur"]["looks"][0][0]
        return {"mog2": believed(number, number < 4)}

    settings = DegradationSettings(detectors=MOTION, approaches=4, hazard_free=4)
    study = degradation_study(recordings, settings, keep=kept, fingerprint=lambda path: path.name)
    for number, looks in used.items():
        assert not int(looks) & 1 << number
        assert int(looks).bit_count() == 6  # Two recordings in each of four folds
    (sweep,) = study.sweeps
    assert sweep.beta.overall.value[0].tolist() == [0.0, 0.0, 0.0, 1.0, 1.0]
    assert sweep.least_vision.vision.value == 0.0 < sweep.least_awareness.awareness.value
    assert [row.condition.level for row in sweep.family("noise")] == [0, 1, 2, 3, 4]
    values = json.loads(json.dumps(degradation_record(study), allow_nan=False))
    assert values["detectors"]["mog2"]["rows"][0]["awareness"] == list(sweep.awareness.rows[0].awareness)
    assert any(line.startswith("noise 0.75") for table in sweep_tables(study) for line in table.lines())
