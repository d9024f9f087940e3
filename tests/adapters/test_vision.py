"""The vision query of one or several cameras: its results, its miss rate and mirror symmetry."""

import math
from dataclasses import replace

import numpy as np
import pytest
from camera_boxes import EMPTY, boxed, crossing
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.abduction.co_evidence import Absent, CoEvidence, MissRateTable, Present, Sector, Unqueried
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog, parked
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import SeveralCameras, VisionQuery
from worldstate.ground.values import NotUsable, nanoseconds, wrap_angle
from worldstate.measurement.measurement import Bearing

CENTRED = PinholeCamera.ovad(position_m=(-0.567, 0.0, -0.485))
TABLE = MissRateTable((0.0, 20.0, 40.0), (0.0, 1.0), ((0.04, 0.9), (0.1, 0.95), (0.3, 1.0)))
AZIMUTHS = st.floats(-math.pi, math.pi)
TEN_DEG, NOW, COARSE = math.radians(10.0), nanoseconds(2.0), NotUsable("coarse")
NOTHING = DetectionLog.at_rate([EMPTY] * 40, 10.0)


def bearing(azimuth_rad: float) -> Bearing:
    return Bearing(azimuth_rad, 0.05)


def query(log: DetectionLog | None, keep: DetectionFilter | None = None) -> VisionQuery:
    return VisionQuery(CENTRED, log, TABLE, keep=keep)


def test_unqueried_has_its_reason() -> None:
    assert query(None).ask(0, bearing(0.0)) == Unqueried("no detections file")
    assert query(NOTHING).ask(nanoseconds(9.0), bearing(0.0)) == Unqueried("no frame at 9.000 s")
    assert query(NOTHING).ask(-1_000_000_000, bearing(0.0)) == Unqueried("no frame at -1.000 s")
    assert query(NOTHING).ask(NOW, bearing(1.2)) == Unqueried("sector outside the field of view")
    assert isinstance(query(NOTHING).ask(NOW, bearing(0.0), ()), Unqueried), "no class that a camera sees"
    answer = query(NOTHING).ask(NOW, bearing(0.0))
    assert isinstance(answer, Absent) and answer.clutter_rate == 0.01


@given(first_px=st.floats(200.0, 500.0), step_px=st.floats(10.0, 30.0), hop=st.integers(10, 39))
@settings(deadline=None)
def test_a_moving_car_is_found_in_its_sector_and_nowhere_else(first_px, step_px, hop) -> None:
    asked, stamp_ns = query(crossing(first_px, step_px)), nanoseconds(hop / 10)
    (seen,) = asked.sightings(stamp_ns)
    assert seen.moving
    edge = TEN_DEG + seen.width_rad / 2
    for off, found in ((0.0, True), (edge - 0.001, True), (edge + 0.001, False)):
        for azimuth in (seen.azimuth_rad + off, seen.azimuth_rad - off):
            assert isinstance(asked.ask(stamp_ns, bearing(azimuth)), Present) is found


def test_only_the_expected_class_counts() -> None:
    keep = DetectionFilter(labels={"car", "bicycle"})
    asked = query(crossing(700.0, 20.0, label="bicycle"), keep=keep)
    (seen,) = asked.sightings(NOW)
    for labels, answer in (({"car"}, Absent), ({"bicycle"}, Present), (None, Present)):
        assert isinstance(asked.ask(NOW, bearing(seen.azimuth_rad), labels), answer)


@pytest.mark.parametrize("how", [{"score": 0.74}, {"label": "truck"}])
def test_a_filtered_box_is_unqueried(how: dict[str, object]) -> None:
    asked = query(crossing(700.0, 20.0, **how))
    assert asked.sightings(NOW) == ()
    assert isinstance(asked.ask(NOW, bearing(0.0)), Unqueried)
    counted = replace(asked.detections, frames=(boxed((700, 500, 900, 640)), *asked.detections.frames[1:]))
    assert isinstance(query(counted).ask(NOW, bearing(0.0)), Unqueried)
    assert isinstance(query(counted).ask(NOW, bearing(-0.5)), Absent)


def test_a_coarse_bearing_queries_the_whole_side() -> None:
    asked = query(crossing(300.0, 5.0))
    assert isinstance(asked.ask(NOW, bearing(-0.3), side="left"), Present)
    assert isinstance(asked.ask(NOW, bearing(0.3), side="right"), Absent)
    assert isinstance(asked.ask(NOW, COARSE), Present)


def mirrored(log: DetectionLog) -> DetectionLog:
    width, flip = CENTRED.width_px, np.array([-1.0, 1.0, -1.0, 1.0])
    shift = np.array([width, 0.0, width, 0.0])
    flipped = [replace(f, boxes_px=f.boxes_px[:, [2, 1, 0, 3]] * flip + shift) for f in log.frames]
    return replace(log, frames=tuple(flipped))


def same(one: CoEvidence, other: CoEvidence) -> bool:
    return type(one) is type(other) and np.allclose(one.log_likelihoods(), other.log_likelihoods(), atol=1e-9)


@given(
    azimuth=st.floats(-1.5, 1.5),
    first_px=st.floats(0.0, 1700.0),
    step_px=st.floats(-20.0, 20.0),
    sides=st.sampled_from([(None, None), ("left", "right"), ("right", "left")]),
)
@settings(deadline=None)
def test_the_mirrored_question_has_the_same_answer(azimuth, first_px, step_px, sides) -> None:
    step_px = float(np.clip(step_px, -first_px / 25, (1736 - first_px) / 25))
    log = crossing(first_px, step_px, images=25)
    here = query(log).ask(NOW, bearing(azimuth), side=sides[0])
    assert same(here, query(mirrored(log)).ask(NOW, bearing(-azimuth), side=sides[1]))
    (left,), (right,) = query(log).sightings(NOW), query(mirrored(log)).sightings(NOW)
    assert left.azimuth_rad == pytest.approx(-right.azimuth_rad, abs=1e-9)
    assert (left.moving, left.std_rad) == (right.moving, pytest.approx(right.std_rad))


@given(a=AZIMUTHS, b=AZIMUTHS, half_a=st.floats(0.01, 1.5), half_b=st.floats(0.01, 1.5), at=AZIMUTHS)
def test_the_overlap_is_the_intersection_of_sectors(a, b, half_a, half_b, at) -> None:
    one, other = Sector(a, half_a), Sector(b, half_b)
    common = one.overlap(other)
    margin = min(abs(abs(wrap_angle(at - s.centre_rad)) - s.half_width_rad) for s in (one, other))
    if margin > 1e-9:
        assert (common is not None and common.touches(at)) == (one.touches(at) and other.touches(at))


@given(right=AZIMUTHS, width=st.floats(0.01, 6.2))
def test_a_sector_between_two_edges_has_their_width(right: float, width: float) -> None:
    sector = Sector.between(right, wrap_angle(right + width))
    assert sector.half_width_rad == pytest.approx(width / 2)
    assert abs(wrap_angle(sector.centre_rad - right - width / 2)) < 1e-9


def test_a_bearing_behind_an_occluder_queries_the_line_of_sight() -> None:
    asked = VisionQuery(CENTRED, NOTHING, line_of_sight=Sector(0.0, 0.5))
    behind, anywhere = (asked.ask(NOW, one) for one in (bearing(0.9), COARSE))
    assert isinstance(behind, Absent) and behind == anywhere and behind.miss_rate < 0.2


# Several cameras: the joint miss rate against a sum over azimuths.


def camera(yaw_deg: float, car: bool = False) -> VisionQuery:
    lens = PinholeCamera(640, 480, math.pi / 4, (0.0, 0.0, 0.0), math.radians(yaw_deg), 0.0)
    log = DetectionLog((boxed((300, 100, 340, 300)) if car else EMPTY,), np.array([NOW]))
    return VisionQuery(lens, log)


def fine_miss_rate(cameras: list[VisionQuery], azimuth_rad: float, degradation: float) -> float:
    """Return the mean over a fine grid of a sector of the product of the miss rates."""
    grid = azimuth_rad + TEN_DEG * ((np.arange(4000) + 0.5) / 2000 - 1.0)
    missed = np.ones_like(grid)
    for one in cameras:
        angles, seen = one.camera.off_axis(grid), one.camera.sees(grid)
        missed *= np.where(seen, one.miss_rate.over(angles, degradation, "car"), 1.0)
    return float(missed.mean())


@pytest.mark.long
@given(
    yaws_deg=st.lists(st.floats(-120, 120), min_size=1, max_size=4),
    azimuth=AZIMUTHS,
    degradation=st.floats(0.0, 1.0),
)
@settings(max_examples=100, deadline=None)
def test_the_miss_rate_is_the_expectation_over_the_sector(yaws_deg, azimuth, degradation) -> None:
    lenses = [replace(CENTRED, yaw_rad=math.radians(yaw)) for yaw in yaws_deg]
    cameras = [VisionQuery(one, NOTHING, TABLE, degradation) for one in lenses]
    answer = SeveralCameras(dict(enumerate(cameras))).ask(NOW, bearing(azimuth))
    expected = fine_miss_rate(cameras, azimuth, degradation)
    missed = 1.0 if isinstance(answer, Unqueried) else answer.miss_rate
    assert missed == pytest.approx(expected, abs=1e-6 if isinstance(answer, Unqueried) else 2e-3)


def test_a_side_that_two_cameras_share_is_searched_by_both() -> None:
    front, left = camera(0.0), camera(80.0)
    both = SeveralCameras({"front": front, "left": left})
    alone = [one.ask(NOW, COARSE, None, "left").miss_rate for one in (front, left)]  # type: ignore[union-attr]
    assert both.ask(NOW, COARSE, None, "left").miss_rate < 0.5 * min(alone)  # type: ignore[union-attr]
    # The right side is outside the view of the left camera.
    assert both.ask(NOW, COARSE, None, "right") == front.ask(NOW, COARSE, None, "right")


def test_a_detection_of_one_camera_is_present() -> None:
    both = SeveralCameras({"front": camera(0.0), "left": camera(60.0, car=True)})
    beside = both.ask(NOW, bearing(0.7))
    assert isinstance(beside, Absent) and beside.clutter_rate == pytest.approx(1.0 - 0.99**2)
    assert isinstance(both.ask(NOW, bearing(1.05)), Present)
    looks = both.looks(NOW)
    assert [(one.look.sensor, len(one.sightings)) for one in looks] == [("front", 0), ("left", 1)]
    assert looks[1].look.sector_rad == pytest.approx((math.radians(15.0), math.radians(105.0)))
    assert looks[1].sightings[0].azimuth_rad == pytest.approx(math.radians(60.0))


def test_a_camera_without_an_image_does_not_block_others() -> None:
    blind = VisionQuery(PinholeCamera.ovad(), DetectionLog((EMPTY,), np.array([0])))
    both = SeveralCameras({"front": blind, "left": camera(60.0, car=True)})
    look = both.last_look(NOW)
    assert look is not None and look.sensor == "left" and len(both.sightings(NOW)) == 1
    assert isinstance(SeveralCameras({"front": blind}).ask(NOW, COARSE), Unqueried)


# The choice of boxes and images: the filter of the authors, the latest image, parked cars.


def test_the_filter_is_that_of_the_authors() -> None:
    frame = boxed(*([0, 0, 50, height] for height in (101, 100, 200, 200, 200)))
    labels, scores = ("car", "car", "motorcycle", "truck", "car"), np.array([0.75, 0.9, 0.8, 0.99, 0.74])
    frame = replace(frame, labels=labels, scores=scores)
    assert frame.select(DetectionFilter()).tolist() == [0, 2]
    assert frame.select(DetectionFilter(labels={"truck"}, min_score=0.0, min_height_px=0.0)).tolist() == [3]


@given(
    rate_hz=st.sampled_from([5.0, 10.0, 29.97, 30.0]),
    time_s=st.floats(0.0, 12.0),
    max_age_s=st.floats(0.01, 1.0),
)
def test_the_latest_frame_is_not_from_the_future_nor_too_old(rate_hz, time_s, max_age_s) -> None:
    log, times = DetectionLog.at_rate([EMPTY] * 80, rate_hz), np.arange(80) / rate_hz
    index = log.latest(nanoseconds(time_s), nanoseconds(max_age_s))
    shown = [i for i in range(80) if times[i] <= time_s + 0.001]
    expected = shown[-1] if shown and time_s - times[shown[-1]] <= max_age_s else None
    if min(abs(times - time_s - 0.001)) > 1e-8 and abs(time_s - times[shown[-1]] - max_age_s) > 1e-8:
        assert index == expected


def test_every_decision_at_47998_hz_finds_the_frame_of_its_hop() -> None:
    log = DetectionLog.at_rate([EMPTY] * 200, 10.0)
    stamps_ns = [nanoseconds(round(hop * 47_998 / 10) / 47_998) for hop in range(10, 200)]
    assert [log.latest(one, nanoseconds(0.15)) for one in stamps_ns] == [*range(10, 200)]


STILL = [900.0, 500.0, 1100.0, 650.0]


def moving_log(step_px: float, missed: tuple[int, ...] = ()) -> DetectionLog:
    """Return a car that moves `step_px` per image beside a parked one."""
    moving = [[10.0 + step_px * i, 500.0, 150.0 + step_px * i, 620.0] for i in range(30)]
    frames = [boxed(box) if i in missed else boxed(box, STILL) for i, box in enumerate(moving)]
    return DetectionLog.at_rate(frames, 10.0)


@given(step_px=st.floats(1.0, 60.0), frame=st.integers(0, 29))
def test_only_a_box_that_stood_for_a_second_is_parked(step_px: float, frame: int) -> None:
    log = moving_log(step_px)
    known = DetectionLog(log.frames[: frame + 1], log.stamps_ns[: frame + 1])
    for one in (log, known):  # Later images do not matter
        assert parked(one, frame, log.frames[frame].boxes_px).tolist() == [False, frame >= 10]


def test_two_misses_in_a_second_do_not_unpark() -> None:
    assert parked(moving_log(20.0, (14, 17)), 20, np.array([STILL]))
    assert not parked(moving_log(20.0, (12, 14, 17)), 20, np.array([STILL]))
