"""The vision query: its answers, its miss rate and mirror symmetry."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.abduction.co_evidence import Absent, CoEvidence, MissRateTable, Present, Sector, Unqueried
from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.ground.errors import InputFileError
from worldstate.ground.values import NotUsable, nanoseconds, wrap_angle
from worldstate.measurement.measurement import Bearing, CoEvidenceChannel

CENTRED = PinholeCamera.ovad(position_m=(-0.567, 0.0, -0.485))
TABLE = MissRateTable((0.0, 20.0, 40.0), (0.0, 1.0), ((0.04, 0.9), (0.1, 0.95), (0.3, 1.0)))
AZIMUTHS = st.floats(-math.pi, math.pi)
DEGREE = math.pi / 180


def frame(*boxes: tuple[float, ...], label: str = "car", score: float = 0.9) -> DetectionFrame:
    return DetectionFrame(np.array(boxes).reshape(-1, 4), np.full(len(boxes), score), (label,) * len(boxes))


def crossing(first_px: float, step_px: float, frames: int = 40, **how: object) -> DetectionLog:
    """Return a car that crosses the image, to the right for a positive step."""
    boxes = [(first_px + step_px * i, 500.0, first_px + step_px * i + 200.0, 640.0) for i in range(frames)]
    return DetectionLog.at_rate([frame(box, **how) for box in boxes], 10.0)  # type: ignore[arg-type]


def bearing(azimuth_rad: float) -> Bearing:
    return Bearing(azimuth_rad, 0.05)


def query(log: DetectionLog | None, keep: DetectionFilter | None = None) -> VisionQuery:
    return VisionQuery(CENTRED, log, TABLE, keep=keep)


EMPTY = DetectionLog.at_rate([frame()] * 40, 10.0)


def test_is_a_channel() -> None:
    channel: CoEvidenceChannel = query(None)
    assert channel.sightings(0) == ()


def test_unqueried_has_its_reason() -> None:
    assert query(None).ask(0, bearing(0.0)) == Unqueried("no detections file")
    assert query(EMPTY).ask(nanoseconds(9.0), bearing(0.0)) == Unqueried("no frame at 9.000 s")
    assert query(EMPTY).ask(-1_000_000_000, bearing(0.0)) == Unqueried("no frame at -1.000 s")
    assert query(EMPTY).ask(nanoseconds(2.0), bearing(1.2)) == Unqueried("sector outside the field of view")


def test_a_kind_without_camera_classes_is_unqueried() -> None:
    assert isinstance(query(EMPTY).ask(nanoseconds(2.0), bearing(0.0), ()), Unqueried)


def test_an_empty_frame_is_an_absence() -> None:
    answer = query(EMPTY).ask(nanoseconds(2.0), bearing(0.0))
    assert isinstance(answer, Absent)
    assert answer.clutter_rate == 0.01


@given(first_px=st.floats(200.0, 500.0), step_px=st.floats(10.0, 30.0), hop=st.integers(10, 39))
@settings(deadline=None)
def test_a_moving_car_is_found_in_its_sector_and_nowhere_else(
    first_px: float, step_px: float, hop: int
) -> None:
    asked = query(crossing(first_px, step_px))
    stamp_ns = nanoseconds(hop / 10)
    (seen,) = asked.sightings(stamp_ns)
    assert seen.moving
    assert isinstance(asked.ask(stamp_ns, bearing(seen.azimuth_rad)), Present)
    beyond = 10 * DEGREE + seen.width_rad / 2 + 0.001
    for away in (seen.azimuth_rad + beyond, seen.azimuth_rad - beyond):
        assert not isinstance(asked.ask(stamp_ns, bearing(away)), Present)
    reach = beyond - 0.002
    for at_its_edge in (seen.azimuth_rad + reach, seen.azimuth_rad - reach):
        assert isinstance(asked.ask(stamp_ns, bearing(at_its_edge)), Present)


def test_a_parked_car_is_a_sighting_and_an_absence() -> None:
    asked = query(crossing(900.0, 0.0))
    (seen,) = asked.sightings(nanoseconds(2.0))
    assert not seen.moving
    assert isinstance(asked.ask(nanoseconds(2.0), bearing(seen.azimuth_rad)), Absent)


def test_only_the_expected_class_counts() -> None:
    keep = DetectionFilter(labels={"car", "bicycle"})
    asked = query(crossing(700.0, 20.0, label="bicycle"), keep=keep)
    stamp_ns = nanoseconds(2.0)
    (seen,) = asked.sightings(stamp_ns)
    assert isinstance(asked.ask(stamp_ns, bearing(seen.azimuth_rad), {"car"}), Absent)
    assert isinstance(asked.ask(stamp_ns, bearing(seen.azimuth_rad), {"bicycle"}), Present)
    assert isinstance(asked.ask(stamp_ns, bearing(seen.azimuth_rad)), Present)


@pytest.mark.parametrize("how", [{"score": 0.74}, {"label": "truck"}])
def test_a_filtered_box_is_unqueried(how: dict[str, object]) -> None:
    asked = query(crossing(700.0, 20.0, **how))
    assert asked.sightings(nanoseconds(2.0)) == ()
    assert isinstance(asked.ask(nanoseconds(2.0), bearing(0.0)), Unqueried)
    counted = DetectionLog((crossing(700.0, 20.0).frames[0], *asked.detections.frames[1:]), EMPTY.stamps_ns)
    assert isinstance(query(counted).ask(nanoseconds(2.0), bearing(0.0)), Unqueried)
    assert isinstance(query(counted).ask(nanoseconds(2.0), bearing(-0.5)), Absent)


def test_a_coarse_bearing_queries_the_whole_side() -> None:
    asked = query(crossing(300.0, 5.0))
    stamp_ns = nanoseconds(2.0)
    assert isinstance(asked.ask(stamp_ns, bearing(-0.3), side="left"), Present)
    assert isinstance(asked.ask(stamp_ns, bearing(0.3), side="right"), Absent)
    assert isinstance(asked.ask(stamp_ns, NotUsable("flat")), Present)


@pytest.mark.long
@given(azimuth=AZIMUTHS, degradation=st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_the_miss_rate_is_the_expectation_over_the_sector(azimuth: float, degradation: float) -> None:
    answer = VisionQuery(CENTRED, EMPTY, TABLE, degradation).ask(nanoseconds(2.0), bearing(azimuth))
    across = azimuth + 10 * DEGREE * ((np.arange(4000) + 0.5) / 2000 - 1.0)
    angles, seen = CENTRED.off_axis(across), CENTRED.sees(across)
    betas = [TABLE(a, degradation) if s else 1.0 for a, s in zip(angles, seen, strict=True)]
    expected = np.mean(betas)
    if isinstance(answer, Unqueried):
        assert expected == pytest.approx(1.0, abs=1e-6)
    else:
        assert answer.miss_rate == pytest.approx(expected, abs=2e-3)


def test_degradation_may_change_with_time() -> None:
    fading = VisionQuery(CENTRED, EMPTY, TABLE, lambda stamp_ns: stamp_ns / 4e9)
    betas = [fading.ask(nanoseconds(t), bearing(0.0)).miss_rate for t in (0.0, 1.0, 2.0, 3.0)]  # type: ignore[union-attr]
    assert betas == sorted(betas)
    assert betas[-1] > 0.5


def mirrored(log: DetectionLog) -> DetectionLog:
    width = CENTRED.width_px
    flip = np.array([-1.0, 1.0, -1.0, 1.0])
    shift = np.array([width, 0.0, width, 0.0])
    flipped = [replace(f, boxes_px=f.boxes_px[:, [2, 1, 0, 3]] * flip + shift) for f in log.frames]
    return DetectionLog(tuple(flipped), log.stamps_ns)


def same(one: CoEvidence, other: CoEvidence) -> bool:
    return type(one) is type(other) and np.allclose(one.log_likelihoods(), other.log_likelihoods(), atol=1e-9)


@given(
    azimuth=st.floats(-1.5, 1.5),
    first_px=st.floats(0.0, 1700.0),
    step_px=st.floats(-20.0, 20.0),
    side=st.sampled_from([None, "left", "right"]),
)
@settings(deadline=None)
def test_the_mirrored_question_has_the_same_answer(
    azimuth: float, first_px: float, step_px: float, side: str | None
) -> None:
    step_px = float(np.clip(step_px, -first_px / 25, (1736 - first_px) / 25))
    log = crossing(first_px, step_px, frames=25)
    stamp_ns = nanoseconds(2.0)
    other_side = {"left": "right", "right": "left", None: None}[side]
    here = query(log).ask(stamp_ns, bearing(azimuth), side=side)  # type: ignore[arg-type]
    there = query(mirrored(log)).ask(stamp_ns, bearing(-azimuth), side=other_side)  # type: ignore[arg-type]
    assert same(here, there)
    (left,), (right,) = query(log).sightings(stamp_ns), query(mirrored(log)).sightings(stamp_ns)
    assert left.azimuth_rad == pytest.approx(-right.azimuth_rad, abs=1e-9)
    assert (left.moving, left.std_rad) == (right.moving, pytest.approx(right.std_rad))


@given(a=AZIMUTHS, b=AZIMUTHS, half_a=st.floats(0.01, 1.5), half_b=st.floats(0.01, 1.5), at=AZIMUTHS)
def test_the_overlap_is_the_intersection_of_sectors(
    a: float, b: float, half_a: float, half_b: float, at: float
) -> None:
    one, other = Sector(a, half_a), Sector(b, half_b)
    common = one.overlap(other)
    in_both = one.touches(at) and other.touches(at)
    margin = min(abs(abs(wrap_angle(at - s.centre_rad)) - s.half_width_rad) for s in (one, other))
    if margin > 1e-9:
        assert (common is not None and common.touches(at)) == in_both


@given(right=AZIMUTHS, width=st.floats(0.01, 6.2))
def test_a_sector_between_two_edges(right: float, width: float) -> None:
    sector = Sector.between(right, wrap_angle(right + width))
    assert sector.half_width_rad == pytest.approx(width / 2)
    assert abs(wrap_angle(sector.centre_rad - right - width / 2)) < 1e-9


def test_refuses_detections_of_another_camera() -> None:
    with pytest.raises(InputFileError, match=r"detections: frame 19: expected boxes within .* 1936 x 1216"):
        query(crossing(1700.0, 2.0))


def test_a_bearing_behind_an_occluder_queries_the_line_of_sight() -> None:
    sight = Sector(0.0, 0.5)
    query = VisionQuery(CENTRED, EMPTY, line_of_sight=sight)
    behind, anywhere = (query.ask(nanoseconds(1.0), asked) for asked in (bearing(0.9), NotUsable("coarse")))
    assert isinstance(behind, Absent)
    assert behind == anywhere
    assert behind.miss_rate < 0.2
