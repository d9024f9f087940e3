"""Data beside the sound must be on its clock; otherwise an error gives the remedy."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile
from camera_boxes import EMPTY, LENS, boxed, write_boxes
from made_up_sound import THREE
from numpy.typing import ArrayLike

from worldstate import Absent, Listener, nanoseconds
from worldstate.adapters import ListenSettings, PinholeCamera, Source, open_source
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog, read_any_detections
from worldstate.adapters.files.odometry_file import OdometryLog, read_odometry
from worldstate.adapters.listener import listened
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground import InputFileError, seconds
from worldstate.measurement import Bearing, Odometry

ANYTHING, LENGTH_S = ListenSettings(uncalibrated=True), 20.0
STARTS_S = (0.0, 60.0, 1.7e9)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "noise.wav"
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, (round(8000 * LENGTH_S), 3))
    soundfile.write(path, noise, 8000)
    return path


def heard(sound: Path, start_s: float = 0.0, offset_s: float = 0.0, **beside: object) -> Source:
    """Return a source whose clocks were checked."""
    camera = PinholeCamera.ovad(stamp_offset_s=offset_s)
    source = open_source(sound, array=THREE, settings=ANYTHING, camera=camera, start_s=start_s, **beside)  # type: ignore[arg-type]
    next(listened(source))
    return source


def empty_at(times_s: ArrayLike) -> DetectionLog:
    """Return empty images at these times."""
    stamps_ns = [nanoseconds(float(at_s)) for at_s in np.asarray(times_s)]
    return DetectionLog((EMPTY,) * len(stamps_ns), np.array(stamps_ns), "boxes.json")


@pytest.mark.parametrize("start_s", STARTS_S)
def test_images_without_stamps_count_from_the_first_sample(sound: Path, start_s: float) -> None:
    log = DetectionLog.at_rate([EMPTY] * 200, 10.0)
    query = heard(sound, start_s, detections=log).camera_channel()
    for at_s in (0.0, 7.0, 19.95):
        assert isinstance(query.ask(nanoseconds(start_s + at_s), Bearing(0.0, 0.05)), Absent)


def test_an_offset_that_leads_images_without_stamps_away_is_refused(sound: Path) -> None:
    log = DetectionLog.at_rate([EMPTY] * 200, 10.0)
    heard(sound, offset_s=-0.3, detections=log)
    with pytest.raises(InputFileError, match=r'"stamp_offset_s": 0\.0'):
        heard(sound, offset_s=1.7e9, detections=log)


# Offsets between clocks: epoch, TAI, GPS, an hour, a day, a minute.
OFF_S = (1.7e9, 37.0, -37.0, 18.0, 19.0, 3600.0, -86_400.0, 60.0)


@pytest.mark.parametrize("off_s", OFF_S)
@pytest.mark.parametrize("start_s", STARTS_S)
def test_stamps_on_another_clock_are_refused_and_the_offset_brings_them_back(sound, off_s, start_s) -> None:
    log = empty_at(start_s + off_s + 0.1 * np.arange(200))
    with pytest.raises(InputFileError, match=r"boxes\.json: .*\"stamp_offset_s\": ") as refused:
        heard(sound, start_s, detections=log)
    named = float(str(refused.value).split('"stamp_offset_s": ')[1].split()[0])
    assert named == pytest.approx(-off_s, abs=0.1)
    assert len(heard(sound, start_s, offset_s=named, detections=log).detections or ()) == 200
    told = OdometryLog(tuple(Odometry("wheels", stamp_ns, 0.1) for stamp_ns in log.stamps_ns.tolist()))
    with pytest.raises(
        InputFileError, match=rf"wheels: expected stamps on the clock .* {-off_s:.1f} s more .*--start"
    ):
        heard(sound, start_s, odometry=told)
    if start_s + off_s > 0.0:
        heard(sound, start_s + off_s, odometry=told)


# One second in other units.
UNITS = {"microseconds": 1e-3, "milliseconds": 1e-6, "seconds": 1e-9}


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("first_s", [0.0, 1.7e9])
def test_stamps_in_another_unit_are_refused(sound: Path, unit: str, first_s: float) -> None:
    log = empty_at(np.unique(np.round(1e9 * (first_s + 0.1 * np.arange(200)) * UNITS[unit])) / 1e9)
    with pytest.raises(InputFileError, match=r"boxes\.json: .*stamps in nanoseconds|clock of the sound"):
        heard(sound, detections=log)


@pytest.mark.parametrize(
    ("first_s", "last_s", "told"),
    [(0.0, 20.0, ""), (-3.0, 22.0, ""), (4.0, 19.0, ""), (15.0, 35.0, "cover 5.0 of its 20.0 s"),
     (0.0, 6.0, "60 of 60 stamps"), (-30.0, 60.0, "of 900 stamps lie within the sound"),
     (-37.0, 57.0, "of 940 stamps"), (19.0, 400.0, "cover 1.0 of"), (3.0, 4.0, "10 of 10 stamps")],
)  # fmt: skip
def test_a_small_overlap_with_the_sound_logs_a_warning(sound, first_s, last_s, told, caplog) -> None:
    log = empty_at(np.arange(first_s, last_s, 0.1))
    heard(sound, detections=log)
    assert told in caplog.text and bool(told) == bool(caplog.text)
    caplog.clear()
    heard(sound, odometry=OdometryLog(tuple(Odometry("wheels", int(ns), 0.1) for ns in log.stamps_ns)))
    assert told in caplog.text and bool(told) == bool(caplog.text)


def test_one_measurement_is_enough_and_none_logs_a_warning(sound, caplog) -> None:
    heard(sound, others=[(Odometry("wheels", 0, 0.1),).__iter__])
    assert "has no measurement" not in caplog.text
    heard(sound, others=[partial(lambda path, name: iter(()), "r.csv", name="radar")])
    assert "radar: has no measurement" in caplog.text


@pytest.mark.parametrize("rate_hz", [8.0, 9.0, 9.5, 10.4])
def test_a_rate_near_the_assumed_one_logs_a_warning(sound, rate_hz, caplog) -> None:
    heard(sound, detections=DetectionLog.at_rate([EMPTY] * round(rate_hz * LENGTH_S), None))
    assert "stamps lie within the sound" in caplog.text
    caplog.clear()
    heard(sound, detections=DetectionLog.at_rate([EMPTY] * round(rate_hz * LENGTH_S), rate_hz))
    assert not caplog.text


# Odometry of a drive at 10 m/s around a curve, and the same in other units.
DRIVE = {
    "as it is": ({}, ""),
    "yaw of many turns": ({"yaw_rad": 12.0}, ""),
    "yaw in degrees": ({"yaw_rad": 187.0}, "yaw_rad has numbers like those in degrees"),
    "yaw rate in degrees": ({"yaw_rate_rad_s": 5.7}, "yaw_rate_rad_s has numbers like those in degrees"),
    "km/h": ({"speed_mps": 36.0}, "speed_mps has numbers like those in km/h"),
}


@pytest.mark.parametrize("name", DRIVE)
def test_odometry_in_other_units_logs_a_warning(tmp_path, name, caplog) -> None:
    other, told = DRIVE[name]
    lines = ["time_s, speed_mps, yaw_rate_rad_s, x_m, y_m, yaw_rad"]
    for i in range(100):
        turned = 0.1 * 0.1 * i
        row = {"time_s": 0.1 * i, "speed_mps": 10.0, "yaw_rate_rad_s": 0.1}
        row |= {"x_m": 100.0 * np.sin(turned), "y_m": 100.0 * (1.0 - np.cos(turned)), "yaw_rad": turned}
        lines.append(",".join(str(value) for value in (row | other).values()))
    (tmp_path / "o.csv").write_text("\n".join(lines))
    assert len(read_odometry(tmp_path / "o.csv").told) == 100
    assert told in caplog.text and bool(told) == bool(caplog.text)


def ovad_json(folder: Path, images: int) -> Path:
    shown = [boxed((100, 200, 300, 400)) if 60 <= i < 70 else EMPTY for i in range(images)]
    return write_boxes(folder / "ovad.json", shown)


def coco_json(folder: Path, images: int) -> Path:
    boxes = [{"image_id": i, "category_id": 3, "bbox": [100, 200, 200, 200], "score": 0.9} for i in range(9)]
    listed = {"images": [{"id": i} for i in range(images)], "annotations": boxes}
    (folder / "coco.json").write_text(json.dumps(listed))
    return folder / "coco.json"


def yolo_text(folder: Path, images: int) -> Path:
    for i in range(images):
        (folder / f"street_{i:06d}.txt").write_text("2 0.5 0.5 0.1 0.2 0.9\n" if i == 9 else "")
    return folder


def mot_text(folder: Path, images: int) -> Path:
    rows = (f"{i},-1,100,200,200,200,0.9,-1,-1,-1\n" for i in (1, 2, images))
    (folder / "mot.txt").write_text("".join(rows))
    return folder / "mot.txt"


TEN_HZ = 9.5, 10.0, 10.25, 6.5  # The last one is a shorter video
OTHER_HZ = 12.5, 15.0, 20.0, 24.0, 25.0, 30.0, 60.0, 7.5, 5.0, 1.0


@pytest.mark.parametrize("written", [ovad_json, coco_json, yolo_text, mot_text])
@pytest.mark.parametrize("rate_hz", [*TEN_HZ, *OTHER_HZ])
def test_an_assumed_rate_must_fit_the_sound(sound, tmp_path, written, rate_hz) -> None:
    images = round(rate_hz * LENGTH_S)
    path = written(tmp_path, images)
    if rate_hz in TEN_HZ or (written is mot_text and rate_hz < 10.0):  # Lines do not end with the images
        assert len(heard(sound, 60.0, detections=path).detections or ()) == images
        return
    with pytest.raises(InputFileError, match="image_rate_hz of the camera"):
        heard(sound, detections=path)
    log = read_any_detections(path, rate_hz, (1936, 1216))
    last_s = seconds(int((heard(sound, detections=log).detections or log).stamps_ns[-1]))
    assert last_s == pytest.approx(LENGTH_S, abs=1.01 / rate_hz)


def test_the_rate_is_a_key_of_the_camera(sound: Path, tmp_path: Path) -> None:
    path = ovad_json(tmp_path, 60)

    def read(**keys: object) -> tuple[float | None, bool, int]:
        (tmp_path / "c.json").write_text(json.dumps(LENS | keys))
        camera = tmp_path / "c.json"
        log = open_source(sound, THREE, detections=path, camera=camera, uncalibrated=True).detections
        assert log is not None
        return log.counted_hz, log.assumed, int(log.stamps_ns[45])

    assert read() == (10.0, True, 4_500_000_000)
    assert read(image_rate_hz=15) == (15.0, False, 3_000_000_000)
    written = json.loads(path.read_text())
    for i, row in enumerate(written["detections_per_frame"]):
        row["stamp_ns"] = 10**8 * i
    path.write_text(json.dumps(written))
    assert read(image_rate_hz=15) == (None, False, 4_500_000_000)


NOISE = np.random.default_rng(0).uniform(-0.01, 0.01, (4800, 56))


@pytest.mark.parametrize("off_s", [1.7e9, 3600.0, 2.5, -2.5, -3600.0, 1.9, -1.9])
def test_a_look_far_from_the_sound_is_counted_as_refused(off_s: float) -> None:
    listener = Listener(ovad_array(), 48_000)
    for k in range(16):
        if k == 12:
            listener.look(nanoseconds(max(0.1 * k, 0.0) + off_s), EMPTY)
            listener.add(Odometry("wheels", nanoseconds(0.1 * k + off_s), 0.0))
        listener.look(nanoseconds(0.1 * k), EMPTY)
        states = listener.push(NOISE)
    state = states[-1]
    assert state.delivery.refused == (2 if abs(off_s) > 2.0 else 0)
    assert {one.sensor: one.condition for one in state.sensors}["camera"] == "working"
    assert max(view.stamp_ns for view in state.searched) == nanoseconds(1.5)


def test_start_and_skip_shift_the_clock_of_looks() -> None:
    listener = Listener(ovad_array(), 48_000, start_s=1000.0)
    listener.push(NOISE)
    listener.skip(nanoseconds(500.0))
    for at_s in (1000.1, 1500.1):
        listener.look(nanoseconds(at_s), EMPTY)
    assert listener.world.state.delivery.refused == 1


def three() -> Listener:
    return Listener(THREE, 8_000, camera=PinholeCamera.ovad(), settings=ANYTHING)


def boxes(number: int, left: float = 300.0) -> DetectionFrame:
    return boxed(*[(left, 200.0, left + 80.0, 360.0)] * number)


def test_looks_before_a_long_block_take_effect_at_their_time() -> None:
    sound = np.random.default_rng(1).normal(0.0, 0.01, (20 * 8_000, 3))
    told = [(nanoseconds(0.1 * k + 0.05), boxes(int(k % 3 == 0))) for k in range(200)]
    at_once, hop_by_hop = three(), three()
    for look in told:
        at_once.look(*look)
    states = at_once.push(sound)
    expected = iter(states)
    for look, block in zip(told, np.split(sound, 200), strict=True):
        hop_by_hop.look(*look)
        for state in hop_by_hop.push(block):
            assert state == next(expected)
    assert states[-1].delivery.refused == 0


def test_an_unreadable_early_look_is_counted_alone() -> None:
    listener = three()
    for at_s in (2.5, 2.6, 2.7):
        listener.look(nanoseconds(at_s), boxes(1, left=9_000.0 if at_s == 2.6 else 300.0))
    states = listener.push(np.random.default_rng(1).normal(0.0, 0.01, (3 * 8_000, 3)))
    assert len(states) == 20
    assert states[-1].delivery.refused == 1
    assert max(view.stamp_ns for view in states[-1].searched) == nanoseconds(2.7)


@pytest.mark.parametrize(
    ("at_s", "told", "tries", "refused"),
    [
        (1.0, Odometry("wheels", 0, 1.0), 200, 100),
        (3.0, Odometry("wheels", 0, 1.0), 200, 100),
        (3.0, boxes(0), 200, 100),
        (3.0, boxes(1), 200, 100),
        (3.0, boxes(100_000), 50, 31),  # Each has 3.5 MB, and 64 MiB are the limit
        (3.0, replace(boxes(1), labels=("x" * 1_000_000,)), 100, 33),
        (1.0, boxes(100_000), 50, 0),  # Near images are kept for a second, with 64 boxes each
    ],
)
def test_waiting_looks_and_odometry_are_bounded(at_s, told, tries, refused, monkeypatch) -> None:
    monkeypatch.setattr("worldstate.adapters.listener.MOST_AHEAD", 100)
    listener = three()
    for k in range(tries):
        stamp_ns = nanoseconds(at_s) + 10 * k
        if isinstance(told, Odometry):
            listener.add(replace(told, stamp_ns=stamp_ns))
        else:
            listener.look(stamp_ns, told)
    assert listener.push(np.zeros((9_000, 3)))[0].delivery.refused == refused
