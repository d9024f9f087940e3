"""Measured absence: degraded images, the health of a camera, files of miss rates, the command."""

import json
from dataclasses import asdict, astuple, replace
from types import SimpleNamespace

import numpy as np
import pytest
from camera_boxes import EMPTY, boxed, write_boxes, write_video
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from street_frames import HEIGHT, WIDTH, reference, street

from worldstate import Absent, PinholeCamera, Present, nanoseconds
from worldstate.adapters import DetectionLog, MotionDetector, VisionQuery, open_video
from worldstate.adapters.camera.camera_health import (
    FAMILIES,
    HealthMonitor,
    darkness_of,
    degrade,
    image_quality,
    learn_health,
    strength,
)
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates, load_miss_rates
from worldstate.adapters.camera.video import video_degradation
from worldstate.cli.main import main
from worldstate.ground.serialisation import decode
from worldstate.measurement.measurement import Bearing
from worldstate.operations import AbsenceSettings
from worldstate.operations.detectors import miss_rate_measurement
from worldstate.operations.detectors.miss_rate_measurement import LabelledVideo, measure_absence

GREY = next(street(1))


def degraded(frame, family, d, seed=0):
    return degrade(frame, family, d, np.random.default_rng(seed))


@pytest.mark.parametrize(("d", "sigma_px"), [(0.25, 2.0), (0.5, 4.0), (0.75, 8.0), (1.0, 16.0)])
def test_blur_equals_its_definition(d, sigma_px):
    expected = gaussian_filter(GREY.astype(float), sigma_px, mode="mirror", axes=(0, 1))
    apart = np.abs(degraded(GREY, "blur", d) - expected)
    # OpenCV rounds twice, once a direction.
    assert apart.max() <= 2.5 and apart.mean() <= 0.5


@given(st.floats(0.0, 1.0))
@settings(deadline=None, max_examples=25)
@example(2.9e-173)
@example(5e-324)
@example(0.01)
def test_any_strength_of_any_family_gives_an_image(d):
    for family in FAMILIES:
        image = degraded(GREY[:64, :96], family, d)
        assert image.shape == (64, 96, 3)
        np.testing.assert_array_equal(image, degraded(GREY[:64, :96], family, d))
    assert darkness_of(strength("darkness", d)) == pytest.approx(d, abs=1e-9)


def test_darkness_and_noise_equal_their_definition():
    rng = np.random.default_rng(0)
    assert np.array_equal(degrade(GREY, "darkness", 1.0, rng), np.round(GREY * 0.06).astype(np.uint8))
    noise = degrade(np.full((200, 200, 3), 128, dtype=np.uint8), "noise", 0.5, rng) - 128.0
    assert noise.std() == pytest.approx(25.0, rel=0.02)
    assert abs(noise.mean()) < 0.3
    assert degrade(GREY, "all", 0.0, rng) is GREY


@pytest.fixture(scope="module")
def health():
    return learn_health([*street(12, seed=3)][::5], np.random.default_rng(0))


@pytest.mark.long
@settings(deadline=None, max_examples=25)
@given(st.sampled_from(["blur", "darkness", "noise"]), st.floats(0.0, 1.0), st.integers(0, 3))
def test_degradation_is_estimated_from_another_image(health, family, d, seed):
    """The scale is learned in one street; blur depends on texture and is least certain in another."""
    frame = next(street(1, seed=3 if family == "blur" else seed))
    seen = health.estimate(image_quality(degraded(frame, family, d, seed)))
    assert asdict(seen)[family] == pytest.approx(d, abs=0.1)
    others = [level for name, level in asdict(seen).items() if name != family]
    assert max(others) <= 0.3


def test_the_reference_follows_dusk_but_not_a_dirty_lens(health):
    monitor, clean = HealthMonitor(health), image_quality(GREY)
    for i in range(600):
        dusk = replace(clean, brightness=clean.brightness * (1 - 0.25 * i / 600))
        assert monitor.update(i * 10**9, dusk).darkness < 0.15
    assert clean.brightness * 0.75 == pytest.approx(monitor.reference.brightness, rel=0.1)
    for i in range(1800):
        soiled = replace(clean, sharpness=clean.sharpness * 0.5 ** (i / 600))
        seen = monitor.update((600 + i) * 10**9, soiled)
    assert seen.blur > 0.25
    assert monitor.reference.sharpness[0] >= health.sharpness[0] / 1.5 - 1e-9


def synthetic_rates(beta=((0, 10, 30, 60, 99), (5, 20, 50, 80, 100)), clutter=(0, 1, 5, 20, 60)):
    counts = FamilyCounts(((100,) * 5,) * 2, beta, (100,) * 5, clutter)
    hardly = FamilyCounts(((100,) * 5,) * 2, ((0, 1, 2, 3, 10),) * 2, (100,) * 5, (0,) * 5)
    return MissRates((0.0, 15.0, 37.0), {"noise": counts, "blur": hardly}, {"detector": "x"})


def test_harmless_blur_is_a_weak_degradation(health):
    rates = synthetic_rates()
    blurred, noisy = (health.estimate(image_quality(degraded(GREY, one, 1.0))) for one in ("blur", "noise"))
    assert max(astuple(blurred)) > 0.9
    assert rates.level(blurred) < 0.3
    assert rates.level(noisy) > 0.9
    for seen in (blurred, noisy):
        expected = max(rates.tables.get(name, rates.table)(0.0, d) for name, d in asdict(seen).items())
        assert rates.table(0.0, rates.level(seen)) == pytest.approx(expected, abs=0.01)


counts = st.lists(st.integers(0, 40), min_size=5, max_size=5)


@given(counts, counts, st.floats(1.0, 5.0))
def test_miss_rates_are_monotone_and_read_back(first, second, repeats):
    looks = ((40,) * 5,) * 2
    family = FamilyCounts(looks, (tuple(first), tuple(second)), (40,) * 5, tuple(first))
    rates = MissRates((0.0, 10.0, 37.0), {"all": family}, {"a": "b"}, repeats=repeats)
    beta = family.miss_rates(repeats)
    assert (np.diff(beta, axis=0) >= 0).all()
    assert (np.diff(beta, axis=1) >= 0).all()
    assert 0.0 < beta.min() <= beta.max() < 1.0
    again = decode(MissRates, json.loads(json.dumps(rates.to_dict())), "file")
    assert again.table == rates.table
    assert again.to_dict() == rates.to_dict()


def test_the_query_uses_the_estimated_degradation(health):
    """The log is empty before and after the lens fails; only the images show it, and beta follows."""
    rates = replace(synthetic_rates(), health=health)
    images = enumerate(street(20, seed=3, car=False))
    frames = [degraded(image, "noise", float(i >= 10), i) for i, image in images]
    d = video_degradation(SimpleNamespace(frames=lambda: iter(frames), frame_rate_hz=10.0), rates)
    camera = PinholeCamera.ovad(width_px=WIDTH, height_px=HEIGHT)
    answers = []
    for shown in (EMPTY, boxed((300, 100, 340, 300))):
        log = DetectionLog.at_rate([shown] * 20, 10.0)
        query = VisionQuery(camera, log, rates.table, d, clutter=rates.clutter_rate)
        answers += [query.ask(nanoseconds(t), Bearing(0.0, 0.05)) for t in (0.5, 1.5)]
    before, after, found, doubtful = answers
    assert isinstance(before, Absent)
    assert before.miss_rate < 0.1 < 0.9 < after.miss_rate
    assert isinstance(found, Present)
    assert found.clutter_rate == pytest.approx(rates.clutter_rate(0.0), rel=0.2)
    assert doubtful.clutter_rate == pytest.approx(rates.clutter_rate(1.0), rel=0.1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("video")
    video = open_video(write_video(folder / "street.mp4", street(26, speed_px=16.0)))
    camera = PinholeCamera.ovad(width_px=WIDTH, height_px=HEIGHT)
    return LabelledVideo(video, reference(26, 16.0), camera)


@pytest.mark.long
def test_beta_rises_from_a_tenth_to_nine_tenths(scene, monkeypatch):
    monkeypatch.setattr(miss_rate_measurement, "REPEATS", 1.0)
    settings_ = AbsenceSettings(families=("noise",))
    rates = measure_absence([scene], MotionDetector, np.random.default_rng(0), settings_)
    assert rates.table(0.0, 0.0) <= 0.10
    assert rates.table(0.0, 1.0) >= 0.90
    assert rates.health is not None
    looks = np.array(rates.families["noise"].looks)
    there = sum(len(frame) for frame in scene.reference.frames[10:])
    assert (looks.sum(axis=0) == there).all()
    assert np.array(rates.families["noise"].sectors).min() > 0


@pytest.mark.long
def test_a_blind_detector_misses_all_and_a_random_one_is_clutter(scene, monkeypatch):
    class Blind:
        def detect(self, frame):
            return EMPTY

    class Raving:
        def detect(self, frame):
            return boxed(*((x, 0, x + 40, 60) for x in range(0, WIDTH - 40, 40)), score=1.0)

    frames = list(scene.video.frames())[-8:]
    video = SimpleNamespace(frames=lambda: iter(frames), frame_rate_hz=scene.video.frame_rate_hz)
    last = DetectionLog(scene.reference.frames[-8:], scene.reference.stamps_ns[:8])
    short = LabelledVideo(video, last, scene.camera)
    monkeypatch.setattr(miss_rate_measurement, "_WARM_UP", 2)
    chosen = AbsenceSettings(families=("darkness",))
    for make, clutter in ((Blind, 0.0), (Raving, 1.0)):
        rates = measure_absence([short], make, np.random.default_rng(0), chosen)
        family = rates.families["darkness"]
        assert np.array_equal(family.looks, family.misses)
        assert np.array(family.looks).sum() > 0
        assert np.array(family.clutter) == pytest.approx(clutter * np.array(family.sectors))


@pytest.mark.long
@pytest.mark.slow
def test_the_command_writes_table_and_figure(tmp_path, capsys):
    out, figure = tmp_path / "beta.json", tmp_path / "beta.png"
    video = write_video(tmp_path / "street.mp4", street(14, speed_px=16.0))
    boxes = write_boxes(tmp_path / "boxes.json", reference(14, 16.0).frames)
    arguments = ["model", "detector", str(video), "--reference", str(boxes), "--out", str(out)]
    assert main([*arguments, "--figure", str(figure), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    rates = load_miss_rates(out)
    assert set(rates.families) == set(FAMILIES)
    assert summary["beta_harshest_boresight"] == pytest.approx(rates.table(0.0, 1.0))
    assert rates.provenance["detector"] == "motion"
    assert figure.read_bytes()[:4] == b"\x89PNG"
