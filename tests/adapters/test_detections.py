"""Detections: the filter of the authors, the choice of the image, and parked cars."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from worldstate.adapters.camera.detections import (
    DetectionFilter,
    DetectionFrame,
    DetectionLog,
    parked,
    read_detections,
)
from worldstate.ground.values import nanoseconds

EMPTY = DetectionFrame(np.empty((0, 4)), np.empty(0), ())


def row(boxes: list[Any], scores: list[Any], labels: list[Any], **more: Any) -> dict[str, Any]:
    return {"boxes": boxes, "scores": scores, "classes_str": labels, **more}


def write(path: Path, rows: list[dict[str, Any]]) -> Path:
    path.write_text(json.dumps({"detections_per_frame": rows, "model": "some detector"}))
    return path


def test_detections_read_back_as_written(tmp_path: Path) -> None:
    rows = [row([[1, 2, 30.5, 140]], [0.9], ["car"]), row([], [], [], classes=[])]
    log = read_detections(write(tmp_path / "d.json", rows))
    assert len(log) == 2
    np.testing.assert_array_equal(log.frames[0].boxes_px, [[1, 2, 30.5, 140]])
    assert log.frames[0].labels == ("car",)
    assert len(log.frames[1]) == 0
    assert log.stamps_ns.tolist() == [0, 100_000_000]


def test_the_authors_filter() -> None:
    boxes = [[0, 0, 50, 101], [0, 0, 50, 100], [0, 0, 50, 200], [0, 0, 50, 200], [0, 0, 50, 200]]
    labels = ("car", "car", "motorcycle", "truck", "car")
    frame = DetectionFrame(np.array(boxes, float), np.array([0.75, 0.9, 0.8, 0.99, 0.74]), labels)
    assert frame.select(DetectionFilter()).tolist() == [0, 2]
    assert frame.select(DetectionFilter(labels={"truck"}, min_score=0.0, min_height_px=0.0)).tolist() == [3]


@given(
    rate_hz=st.sampled_from([5.0, 10.0, 29.97, 30.0]),
    time_s=st.floats(0.0, 12.0),
    max_age_s=st.floats(0.01, 1.0),
)
def test_the_latest_frame_is_not_from_the_future_nor_too_old(
    rate_hz: float, time_s: float, max_age_s: float
) -> None:
    log = DetectionLog.at_rate([EMPTY] * 80, rate_hz)
    index = log.latest(nanoseconds(time_s), nanoseconds(max_age_s))
    times = np.arange(80) / rate_hz
    shown = [i for i in range(80) if times[i] <= time_s + 0.001]
    expected = shown[-1] if shown and time_s - times[shown[-1]] <= max_age_s else None
    if min(abs(times - time_s - 0.001)) > 1e-8 and abs(time_s - times[shown[-1]] - max_age_s) > 1e-8:
        assert index == expected


def test_every_decision_at_47998_hz_finds_the_frame_of_its_hop() -> None:
    log = DetectionLog.at_rate([EMPTY] * 200, 10.0)
    for hop in range(10, 200):
        stamp_ns = nanoseconds(round(hop * 47_998 / 10) / 47_998)
        assert log.latest(stamp_ns, nanoseconds(0.15)) == hop


def test_frames_may_carry_their_own_stamps(tmp_path: Path) -> None:
    rows = [row([], [], [], stamp_ns=stamp) for stamp in (5, 1_000_000_000, 4_000_000_000)]
    assert read_detections(write(tmp_path / "d.json", rows)).stamps_ns.tolist() == [5, 10**9, 4 * 10**9]


def moving_log(step_px: float, missed: frozenset[int] = frozenset()) -> DetectionLog:
    """Return a car that moves `step_px` per image beside a parked one."""
    still = [900.0, 500.0, 1100.0, 650.0]
    frames = []
    for i in range(30):
        moving = [10.0 + step_px * i, 500.0, 150.0 + step_px * i, 620.0]
        boxes = [moving] if i in missed else [moving, still]
        frames.append(DetectionFrame(np.array(boxes), np.full(len(boxes), 0.9), ("car",) * len(boxes)))
    return DetectionLog.at_rate(frames, 10.0)


@given(step_px=st.floats(1.0, 60.0), frame=st.integers(10, 29))
def test_only_a_standing_box_is_parked(step_px: float, frame: int) -> None:
    log = moving_log(step_px)
    assert parked(log, frame, log.frames[frame].boxes_px).tolist() == [False, True]


def test_two_misses_in_a_second_do_not_unpark() -> None:
    still = np.array([[900.0, 500.0, 1100.0, 650.0]])
    assert parked(moving_log(20.0, frozenset({14, 17})), 20, still)
    assert not parked(moving_log(20.0, frozenset({12, 14, 17})), 20, still)


@given(frame=st.integers(0, 29))
def test_parking_uses_the_past_only(frame: int) -> None:
    log = moving_log(20.0)
    known = DetectionLog(log.frames[: frame + 1], log.stamps_ns[: frame + 1])
    boxes_px = log.frames[frame].boxes_px
    verdicts = [parked(some, frame, boxes_px).tolist() for some in (log, known)]
    assert verdicts[0] == verdicts[1]


def test_no_box_is_parked_before_a_full_second() -> None:
    log = moving_log(20.0)
    verdicts = [parked(log, i, log.frames[i].boxes_px[1:]).item() for i in (0, 5, 9, 10)]
    assert verdicts == [False, False, False, True]
