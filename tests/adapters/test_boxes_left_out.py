"""An ignored box is no absence: class names of data sets, box sizes and unknown classes."""

import json
import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from camera_boxes import LENS, boxed, crossing
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate import DetectionFrame, NotUsable, PinholeCamera, WorldFilter, nanoseconds
from worldstate.abduction import Absent, Present, SignatureEvidence, Unqueried
from worldstate.adapters.acoustic import asked_again
from worldstate.adapters.camera.class_names import class_name, may_be
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog
from worldstate.adapters.camera.vision_query import NONE_COUNTS, VisionQuery
from worldstate.adapters.vehicle.car_file import read_camera_setup
from worldstate.ground.errors import InputFileError
from worldstate.measurement.measurement import Bearing, Measurement

# Names per data set: car, motorcycle, bus, truck, train, bicycle, person, none of these.
NAMES = {
    "coco": ("car", "motorcycle", "bus", "truck", "train", "bicycle", "person", "traffic light"),
    "kitti": ("Car Van", "", "", "Truck", "Tram", "Cyclist", "Pedestrian Person_sitting", ""),
    "bdd100k": ("car", "motorcycle motor", "bus", "truck", "train", "bike", "pedestrian", "traffic sign"),
    "nuscenes": (
        "vehicle.car", "vehicle.motorcycle", "vehicle.bus.bendy vehicle.bus.rigid", "vehicle.truck", "",
        "vehicle.bicycle", "human.pedestrian.adult pedestrian", "movable_object.trafficcone barrier",
    ),
    "open images": ("Car Taxi Ambulance", "Motorcycle", "Bus", "Truck", "Train", "Bicycle", "Girl", "Tree"),
    "argoverse": (
        "VEHICLE REGULAR_VEHICLE EMERGENCY_VEHICLE", "MOTORCYCLE MOPED MOTORCYCLIST", "BUS SCHOOL_BUS",
        "LARGE_VEHICLE BOX_TRUCK TRUCK_CAB", "RAILED_VEHICLE", "BICYCLE BICYCLIST", "PEDESTRIAN", "SIGN",
    ),
    "ultralytics": ("2 2.0", "3 3.0", "5", "7", "6", "", "", ""),
    "machine ids": ("/m/0k4j", "/m/04_sv", "/m/01bjv", "/m/07r04", "/m/07jdr", "/m/0199g", "/m/01g317", ""),
    "waymo": ("TYPE_VEHICLE", "", "", "", "", "TYPE_CYCLIST", "TYPE_PEDESTRIAN", "TYPE_SIGN"),
    "visdrone": ("cars vans", "motors", "", "trucks HGV", "", "bicycles", "people", ""),
    "voc": ("", "motorbike", "", "", "", "", "", "aeroplane tvmonitor"),
}  # fmt: skip
CLASSES = ("car", "motorcycle", "bus", "truck", "train", "bicycle", "person", None)
NAMED = [
    (source, name, one)
    for source, row in NAMES.items()
    for names, one in zip(row, CLASSES, strict=True)
    for name in names.replace("traffic ", "traffic-").split()
]
# Names that may be a motor vehicle but are no class of the library.
UNKNOWN = (
    *("Misc", "DontCare", "rider", "other vehicle", "TRAILER", "vehicle.construction"),
    *("Land vehicle", "0", "91", "Milk Float"),
)
CAMERA, AT_NS, AHEAD = PinholeCamera.ovad(), nanoseconds(2.0), Bearing(0.0, 0.05)


def moving(label: str, score: float = 0.9, height_px: float = 200.0) -> DetectionLog:
    """Return a box that crosses the middle of the image after two seconds."""
    return crossing(700.0, 10.0, height_px, label=label, score=score)


def answers(
    log: DetectionLog, keep: DetectionFilter | None = None, camera: PinholeCamera = CAMERA
) -> list[object]:
    asked = VisionQuery(camera, log, keep=keep)
    look = asked.last_look(AT_NS)
    assert look is not None
    return [asked.ask(AT_NS, AHEAD), asked.sightings(AT_NS), look]


@pytest.mark.parametrize(("source", "name", "expected"), NAMED)
def test_names_of_every_data_set_are_known(source: str, name: str, expected: str | None) -> None:
    joined = "".join(word.capitalize() for word in name.split("_"))
    assert source == "machine ids" or "_" not in name or class_name(joined) == class_name(name)
    unseen = expected in {"bicycle", "person", None}
    for spelt in (name, name.upper(), name.lower(), name.replace("_", " "), name.replace("_", "-")):
        assert expected is None or class_name(spelt) == expected
        assert may_be(class_name(spelt), {"car"}) is not unseen
    kind = type(answers(moving(name))[0])
    assert kind is (Present if expected in {"car", "motorcycle"} else Absent if unseen else Unqueried)


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_unknown_class_is_no_absence(name: str) -> None:
    said, boxes, look = answers(moving(name))
    assert isinstance(said, Unqueried) and boxes == ()
    assert isinstance(look.answer, Unqueried) and look.fault == NONE_COUNTS  # type: ignore[attr-defined]
    assert isinstance(answers(moving(name), DetectionFilter({name.upper()}))[0], Present)


def scaled(log: DetectionLog, by: float) -> DetectionLog:
    return replace(log, frames=tuple(replace(one, boxes_px=one.boxes_px * by) for one in log.frames))


@given(
    by=st.sampled_from([0.25, 0.5, 2.0]),  # Exact factors, so no box crosses the minimum height
    height_px=st.floats(50.0, 150.0),
    step_px=st.floats(0.0, 2.0),
    keep=st.sampled_from([DetectionFilter(), DetectionFilter(min_height_px=60.0)]),
)
@settings(deadline=None)
def test_image_and_boxes_scaled_together_change_nothing(by, height_px, step_px, keep) -> None:
    frames = [boxed((900.0 + step_px * k, 500.0, 1000.0, 500.0 + height_px)) for k in range(40)]
    log = DetectionLog.at_rate(frames, 10.0)
    width_px, height = round(by * CAMERA.width_px), round(by * CAMERA.height_px)
    small = replace(CAMERA, width_px=width_px, height_px=height)
    (said, seen, look), (other, also, again) = answers(log, keep), answers(scaled(log, by), keep, small)
    assert said == other and look == again
    assert [one.moving for one in seen] == [one.moving for one in also]  # type: ignore[attr-defined]


def test_a_stated_least_height_is_of_the_cameras_own_images(tmp_path) -> None:
    for more, least_px in (({}, 100 * 480 / 1216), ({"min_box_px": 50}, 50.0)):
        (tmp_path / "camera.json").write_text(json.dumps(LENS | more))
        camera, setup = read_camera_setup(tmp_path / "camera.json")
        keep = VisionQuery(camera, None, keep=setup.boxes).keep
        assert keep.min_height_px * keep.scale == pytest.approx(least_px)


HEARD = SignatureEvidence(("left", "right"), hidden=(2.0, -1.0), visible=1.0, none=-2.0)


def heard_at(stamp_ns: int) -> Measurement:
    return Measurement(stamp_ns, HEARD, Unqueried("no camera"), AHEAD, NotUsable("not measured"))


def in_view(log: DetectionLog | None, hops: Sequence[int]) -> list[tuple[float, ...]]:
    """Return P(visible) and the existence of visible entities after each hop."""
    vision, world, told = None if log is None else VisionQuery(CAMERA, log), WorldFilter(), []
    for hop in hops:
        world = world.update(asked_again(heard_at(nanoseconds(hop / 10)), vision))
        seen = [one.existence_probability for one in world.state.entities if one.status == "visible"]
        told.append((world.state.cues[0].hypotheses.visible, *seen))
    return told


@given(st.floats(0.01, 1.0), st.floats(1.0, 300.0), st.sampled_from(["car", "truck", *UNKNOWN[1::8]]))
@settings(deadline=None, max_examples=25)
def test_an_ignored_box_never_lowers_the_visible_hypothesis(score, height_px, label) -> None:
    hops = range(12, 24)
    seen, alone = (in_view(log, hops) for log in (moving(label, score, height_px), None))
    assert all(a[0] >= b[0] - 1e-9 for a, b in zip(seen, alone, strict=True))


@given(score=st.floats(0.01, 0.74), label=st.sampled_from(["car", "truck", "Milk Float"]))
@settings(deadline=None, max_examples=25)
def test_an_ignored_box_is_no_miss(score: float, label: str) -> None:
    counted, left = moving("car"), moving(label, score)
    beside = boxed((100.0, 500.0, 200.0, 700.0))
    frames = (*counted.frames[:17], *(joined(one, beside) for one in left.frames[17:]))
    unseen = DetectionLog(frames[:17], counted.stamps_ns[:17])
    seen, alone = (in_view(log, range(12, 22)) for log in (replace(counted, frames=frames), unseen))
    assert seen[-1][1] == pytest.approx(alone[-1][1])  # The belief is predicted as without an image


def joined(one: DetectionFrame, other: DetectionFrame) -> DetectionFrame:
    boxes, scores = np.vstack([one.boxes_px, other.boxes_px]), np.concatenate([one.scores, other.scores])
    return DetectionFrame(boxes, scores, one.labels + other.labels)


def test_boxes_of_another_scale_are_no_absence() -> None:
    for most in (0.57, 1.0, 1.004):  # a detector's boxes may reach beyond the image
        parts = scaled(moving("car"), most / 1290.0)
        with pytest.raises(InputFileError, match="expected boxes in pixels"):
            VisionQuery(CAMERA, parts)
        with pytest.raises(InputFileError, match="expected boxes in pixels"):
            VisionQuery(CAMERA, None).see(AT_NS, parts.frames[20])
    # In images of a quarter of the size the box is at another position.
    assert isinstance(answers(scaled(moving("car"), 0.25))[0], Unqueried)


@pytest.mark.parametrize("label", ["car", "truck"])
def test_a_parked_ignored_box_is_an_absence(label: str) -> None:
    log = DetectionLog.at_rate([boxed((900.0, 500.0, 1000.0, 550.0), label=label)] * 40, 10.0)
    assert isinstance(answers(log)[0], Absent)


def test_a_camera_without_usable_boxes_is_impaired(caplog) -> None:
    log = moving("truck")
    later = replace(log, frames=(*log.frames[:25], *moving("car").frames[25:]))
    with caplog.at_level(logging.WARNING):
        VisionQuery(CAMERA, later)
        assert not caplog.records
        vision = VisionQuery(CAMERA, log)
    assert NONE_COUNTS in caplog.text and "truck" in caplog.text
    asked = VisionQuery(CAMERA, later)
    faults = [asked.last_look(nanoseconds(t)).fault for t in (2.4, 2.5)]  # type: ignore[union-attr]
    assert faults == [NONE_COUNTS, None]
    live = VisionQuery(CAMERA, None)
    live.see(AT_NS, log.frames[20])
    assert live.last_look(AT_NS) == vision.last_look(AT_NS)
    caplog.clear()
    for k in range(120):
        live.see(nanoseconds(2.1 + 0.1 * k), log.frames[k % 40])
    assert caplog.text.count(NONE_COUNTS) == 1
    state = WorldFilter().update(asked_again(heard_at(AT_NS), vision)).state
    camera = next(one for one in state.sensors if one.sensor == "camera")
    assert (camera.condition, camera.reason) == ("impaired", NONE_COUNTS)
