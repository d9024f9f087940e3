"""The camera as a user has it: its lens in a file, boxes in any form, and why boxes do not count."""

import json
import math

import numpy as np
import pytest

from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import read_camera
from worldstate.adapters.camera.static_boxes import ParkedRule, count_boxes
from worldstate.ground.errors import InputFileError

SIZE = {"width_px": 1000, "height_px": 600}


def test_field_of_view_and_intrinsics_say_the_same(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(SIZE | {"horizontal_fov_deg": 90.0}))
    (tmp_path / "b.json").write_text(json.dumps(SIZE | {"fx": 500.0, "cx": 500.0}))
    wide, calibrated = (read_camera(tmp_path / name) for name in ("a.json", "b.json"))
    np.testing.assert_allclose(wide.azimuth([0, 250, 1000]), calibrated.azimuth([0, 250, 1000]))
    assert math.degrees(wide.azimuth(0.0)) == pytest.approx(45.0)


def test_an_axis_beside_the_middle_and_a_turned_camera(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(SIZE | {"fx": 500.0, "cx": 400.0, "yaw_deg": 30.0}))
    camera = read_camera(tmp_path / "a.json")
    assert math.degrees(camera.azimuth(400.0)) == pytest.approx(30.0)
    assert math.degrees(camera.azimuth(0.0)) == pytest.approx(30.0 + math.degrees(math.atan(0.8)))
    columns = np.array([1.0, 300.0, 999.0])
    np.testing.assert_allclose(camera.column(camera.azimuth(columns)), columns, atol=1e-6)
    assert camera.sees(camera.azimuth(columns)).all()
    assert not camera.sees(math.radians(70.0))


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", json.dumps(SIZE), json.dumps(SIZE | {"fx": 1.0, "horizontal_fov_deg": 9.0}),
     json.dumps(SIZE | {"fx": 0.0}), json.dumps(SIZE | {"horizontal_fov_deg": 180.0}),
     json.dumps(SIZE | {"fx": 500.0, "cx": -1.0}), json.dumps(SIZE | {"fx": "500"})],
)  # fmt: skip
def test_bad_lenses(tmp_path, text):
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(InputFileError, match=r"camera\.json"):
        read_camera(tmp_path / "camera.json")


def test_every_box_is_put_down_to_one_reason():
    rows = [("car", 0.9, 200.0), ("car", 0.5, 200.0), ("car", 0.9, 50.0), ("dog", 0.9, 200.0)]
    boxes = np.array([[10.0, 20.0, 60.0, 20.0 + height] for *_, height in rows])
    frame = DetectionFrame(boxes, np.array([row[1] for row in rows]), tuple(row[0] for row in rows))
    counts = count_boxes(DetectionLog.at_rate([frame] * 20, 10.0), DetectionFilter(), ParkedRule())
    assert (counts.boxes, counts.other_class, counts.low_score, counts.too_small) == (80, 20, 20, 20)
    assert (counts.counted, counts.parked) == (10, 10)
