"""The camera as a user has it: its lens in a file, boxes in any form, and why boxes do not count."""

import json
import math
import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st

from worldstate.adapters.camera.detections import (
    DetectionFilter,
    DetectionFrame,
    DetectionLog,
    count_boxes,
    read_any_detections,
)
from worldstate.adapters.camera.detectors import MotionDetector
from worldstate.adapters.camera.pinhole import PinholeCamera, read_camera
from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.listener import Listener, listen
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.adapters.vehicle.car_file import read_camera_setup
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.errors import InputFileError, InvalidArgumentError

SIZE = {"width_px": 1000, "height_px": 600, "position_m": [0, 0, 0]}


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
     json.dumps(SIZE | {"fx": 500.0, "cx": -1.0}), json.dumps(SIZE | {"fx": "500"}),
     json.dumps({"width_px": 1000, "height_px": 600, "fx": 500.0})],
)  # fmt: skip
def test_bad_lenses(tmp_path, text):
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(InputFileError, match=r"camera\.json"):
        read_camera(tmp_path / "camera.json")


def test_a_key_that_means_nothing_is_refused_and_those_about_boxes_are_read(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(SIZE | {"fx": 500.0, "min_score": 0.4, "classes": ["tram"]}))
    camera, setup = read_camera_setup(path)
    assert camera == read_camera(path)
    assert setup.boxes == DetectionFilter(frozenset({"tram"}), 0.4)
    path.write_text(json.dumps(SIZE | {"fx": 500.0, "pitch": 3.0}))
    for read in (read_camera, read_camera_setup):
        with pytest.raises(
            InputFileError, match=r"camera: expected keys among .*'pitch_deg'.*got \['pitch'\]"
        ):
            read(path)


def test_every_box_is_put_down_to_one_reason():
    rows = [("car", 0.9, 200.0), ("car", 0.5, 200.0), ("car", 0.9, 50.0), ("dog", 0.9, 200.0)]
    boxes = np.array([[10.0, 20.0, 60.0, 20.0 + height] for *_, height in rows])
    frame = DetectionFrame(boxes, np.array([row[1] for row in rows]), tuple(row[0] for row in rows))
    counts = count_boxes(DetectionLog.at_rate([frame] * 20, 10.0), DetectionFilter())
    apart = {"other_class": 20, "low_score": 20, "too_small": 20, "parked": 10}
    assert counts == {"frames": 20, "empty": 0, "boxes": 80, "counted": 10} | apart


@pytest.fixture
def watched(tmp_path):
    """A recording folder whose video shows a square that crosses from left to right: 2 s at 10 Hz."""
    folder = tmp_path / "SA1" / "left" / "1_00_0002"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    soundfile.write(folder / "out_multi.wav", 0.01 * rng.standard_normal((2 * 48_000, 56)), 48_000)
    video = cv2.VideoWriter(str(folder / VIDEO_NAME), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (640, 402))
    street = rng.integers(90, 110, (402, 640, 3)).astype(np.uint8)
    for left in range(0, 500, 25):
        image = street.copy()
        image[150:300, left : left + 120] = 220
        video.write(image)
    video.release()
    return folder


def test_a_detector_looks_at_the_video_of_a_folder(watched):
    source = open_source(watched, detector=MotionDetector())
    assert len(source.detections) == 20 and source.detections.source.endswith(VIDEO_NAME)
    for number in range(10, 20):
        (box,) = source.detections.frames[number].boxes_px
        # A square without texture moves at its edges: its front is found, its middle is still.
        np.testing.assert_allclose(box[1:], [150, 25 * number + 120, 300], atol=12)
        assert 25 * number - 12 <= box[0] < box[2]
    states = list(listen(watched, detector=MotionDetector()))
    assert len(states) == 11


def test_a_detector_needs_a_folder_with_a_video_and_no_detections(watched):
    with pytest.raises(InvalidArgumentError, match="expected a recording folder with a video"):
        open_source(watched / "out_multi.wav", detector=MotionDetector())
    with pytest.raises(InvalidArgumentError, match="no detections"):
        open_source(watched, detector=MotionDetector(), detections=DetectionLog((), np.empty(0, np.int64)))
    (watched / VIDEO_NAME).unlink()
    with pytest.raises(InputFileError, match=VIDEO_NAME):
        open_source(watched, detector=MotionDetector())


def test_run_says_how_many_boxes_count(watched, tmp_path, capsys):
    names = ("car", "dog", "car")
    boxes = [[10.0, 20.0, 60.0, 220.0], [10.0, 20.0, 60.0, 220.0], [300.0, 20.0, 350.0, 30.0]]
    frame = {"boxes": boxes, "scores": [0.9, 0.9, 0.9], "classes_str": names}
    (tmp_path / "d.json").write_text(json.dumps({"detections_per_frame": [frame] * 20}))
    words = ["run", str(watched), "--detections", str(tmp_path / "d.json")]
    assert main(words) == 0
    said = "20 images were looked at, 0 of them without a box; 10 of 60 boxes count; 20 of another class"
    told = capsys.readouterr()
    assert said in told.out and "each image has a box" not in told.err  # what is parked is not missed
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["detections"]["counted"] == 10


def test_images_without_time_stamps_have_the_rate_of_the_camera(tmp_path):
    rows = [{"image_id": 45, "category_id": 3, "bbox": [10, 20, 200, 150], "score": 0.9}]
    boxes = tmp_path / "boxes.json"
    boxes.write_text(json.dumps(rows))
    soundfile.write(tmp_path / "a.wav", np.random.default_rng(0).uniform(-0.01, 0.01, (240_000, 56)), 48_000)
    lens = {"width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90, "position_m": [0, 0, 0]}

    def reported(camera: dict) -> DetectionLog:
        (tmp_path / "camera.json").write_text(json.dumps(lens | camera))
        source = open_source(tmp_path / "a.wav", detections=boxes, camera=tmp_path / "camera.json")
        return source.detections

    assert reported({"image_rate_hz": 30}).stamps_ns[45] == 1_500_000_000
    assert reported({}).stamps_ns[45] == 4_500_000_000
    with pytest.raises(InputFileError, match=r"camera\.image_rate_hz"):
        reported({"image_rate_hz": 0})


def test_images_that_a_detector_found_empty_are_looks(tmp_path):
    boxes = [{"image_id": 2, "category_id": 3, "bbox": [10, 20, 200, 150], "score": 0.9}]
    images = [{"id": number, "file_name": f"{number}.jpg"} for number in (0, 2, 3)]
    (tmp_path / "results.json").write_text(json.dumps(boxes))
    (tmp_path / "coco.json").write_text(json.dumps({"images": images, "annotations": boxes}))
    # The results do not show that image 3 was searched.
    for n_images, found in ((None, [0, 0, 1]), (5, [0, 0, 1, 0, 0])):
        log = read_any_detections(tmp_path / "results.json", n_images=n_images)
        assert [len(frame) for frame in log.frames] == found
    listed = read_any_detections(tmp_path / "coco.json")
    assert ([len(frame) for frame in listed.frames], listed.stamps_ns.tolist()) == (
        [0, 1, 0],
        [0, 200_000_000, 300_000_000],
    )
    for path, more in ((tmp_path / "results.json", 2), (tmp_path / "coco.json", 5)):
        with pytest.raises(InputFileError, match="images"):
            read_any_detections(path, n_images=more)
    (tmp_path / "coco.json").write_text(json.dumps({"images": images[:1], "annotations": boxes}))
    with pytest.raises(InputFileError, match="images of all boxes listed, 2 is not"):
        read_any_detections(tmp_path / "coco.json")


def test_an_empty_list_of_results_is_looks_where_the_images_are_told(tmp_path):
    (tmp_path / "none.json").write_text("[]")
    assert len(read_any_detections(tmp_path / "none.json", n_images=30)) == 30
    assert len(read_any_detections(tmp_path / "none.json")) == 0


def test_images_of_a_camera_that_is_not_described_are_refused_beside_another_array(tmp_path):
    array = MicrophoneArray([[0.0, 0.2, 0.0], [0.1, 0.0, 0.0], [0.0, -0.3, 0.0]], "three")
    anything, empty = ListenSettings(uncalibrated=True), DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    seen = DetectionLog.at_rate([empty] * 3, 10.0)
    soundfile.write(tmp_path / "a.wav", np.zeros((48_000, 3)), 48_000)
    for beside in ({"detections": seen}, {"detections": seen, "camera": PinholeCamera.ovad()}):
        try:
            open_source(tmp_path / "a.wav", array=array, settings=anything, **beside)
            refused = False
        except InvalidArgumentError as error:
            refused = "its position" in str(error)
        assert refused == ("camera" not in beside)
    with pytest.raises(InvalidArgumentError, match="its position beside the array"):
        Listener(array, 48_000, settings=anything).look(0, empty)
    Listener(ovad_array(), 48_000).look(0, empty)


def test_boxes_may_be_lists_and_fit_their_labels():
    frame = DetectionFrame([[10, 20, 60, 140]], [0.9], ["car"])
    assert frame.select(DetectionFilter()).tolist() == [0] and frame.labels == ("car",)
    assert DetectionFrame([], [], ()).boxes_px.shape == (0, 4)
    for boxes, scores in (([], [0.9]), ([[1, 2, 3]], [0.9]), ([[1, 2, 3, 4]], [])):
        with pytest.raises(InvalidArgumentError):
            DetectionFrame(boxes, scores, ("car",))


def test_results_without_their_images_are_read_and_nothing_looked_at_is_told(tmp_path, capsys, watched):
    boxes = [{"image_id": 1, "category_id": 3, "bbox": [10, 20, 200, 150], "score": 0.9}]
    (tmp_path / "d.json").write_text(json.dumps({"annotations": boxes}))
    assert [len(frame) for frame in read_any_detections(tmp_path / "d.json").frames] == [0, 1]
    one = {"boxes": [[10.0, 20.0, 60.0, 220.0]], "scores": [0.9], "classes_str": ["car"]}
    moved = one | {"boxes": [[300.0, 20.0, 350.0, 220.0]]}
    (tmp_path / "d.json").write_text(json.dumps({"detections_per_frame": [one, moved] * 3}))
    assert main(["run", str(watched), "--detections", str(tmp_path / "d.json")]) == 0
    assert "each image has a box" in capsys.readouterr().err
    (tmp_path / "d.json").write_text("[]")
    assert main(["run", str(watched), "--detections", str(tmp_path / "d.json")]) == 0
    assert "searched no image" in capsys.readouterr().err


EDGES = st.tuples(*[st.floats(-300.0, 900.0)] * 2).map(sorted)


@given(across=st.lists(st.tuples(EDGES, EDGES), max_size=8))
def test_boxes_are_cut_at_the_image_and_those_outside_left_out(across):
    boxes = np.array([[left, top, right, bottom] for (left, right), (top, bottom) in across]).reshape(-1, 4)
    frame = DetectionFrame(boxes, np.linspace(0.0, 1.0, len(boxes)), tuple(map(str, range(len(boxes)))))
    found, beyond = frame.cut((640, 480))
    kept = [int(label) for label in found.labels]
    assert kept == sorted(kept)
    assert found.scores.tolist() == frame.scores[kept].tolist()
    within = np.clip(boxes, 0, [640, 480] * 2)
    moved = np.abs(boxes - within).max(axis=1, initial=0.0) > 1.0
    assert beyond == moved.sum()
    assert found.boxes_px.tolist() == np.where(moved[:, None], within, boxes)[kept].tolist()
    for left_out in {*range(len(boxes))} - {*kept}:
        left, top, right, bottom = boxes[left_out]
        assert right <= 0 or bottom <= 0 or left >= 640 or top >= 480
    assert beyond or found is frame


SMALL = PinholeCamera.ovad(width_px=640, height_px=402)
INSIDE, OUTSIDE = (100.0, 100.0, 300.0, 300.0), (700.0, 100.0, 900.0, 300.0)
# Boxes of a recording, by image; whether they are of this camera, and how many images were looked at.
OF_IMAGES = {
    "within": ([[INSIDE]] * 10, True, 10),
    "five pixels outside": ([[(500.0, 100.0, 645.0, 300.0)]] * 10, True, 10),
    "above and below": ([[(100.0, -5.0, 200.0, 405.0)]] * 10, True, 10),
    "leaves as a whole object": ([[(80 * i, 100, 300 + 80 * i, 300)] for i in range(8)], True, 8),
    "a tracker that goes on for two images": ([[INSIDE]] * 20 + [[OUTSIDE]] * 2, True, 20),
    "one of two": ([[INSIDE, OUTSIDE], *[[INSIDE]] * 12], True, 13),
    "larger images": ([[(3 * left, 300, 3 * left + 500, 900)] for left in range(0, 600, 50)], False, 0),
    "larger images, to the left": ([[(left, 500, left + 300, 900)] for left in range(0, 300, 50)], False, 0),
    "all outside": ([[OUTSIDE]] * 10, False, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", OF_IMAGES)
def test_boxes_of_larger_images_are_refused_and_others_are_cut(name, caplog):
    images, fit, looked = OF_IMAGES[name]
    frames = [
        DetectionFrame(np.array(rows), np.full(len(rows), 0.9), ("car",) * len(rows)) for rows in images
    ]
    log = DetectionLog.at_rate(frames, 10.0, "boxes.json")
    if not fit:
        with pytest.raises(
            InputFileError, match=r"boxes.json: frame \d+: expected boxes within .* 640 x 402 px"
        ):
            VisionQuery(SMALL, log)
        return
    seen = VisionQuery(SMALL, log).detections
    assert len(seen) == looked
    boxes_px = np.concatenate([frame.boxes_px for frame in seen.frames])
    assert boxes_px.min() >= 0.0 and (boxes_px <= [640, 402, 640, 402]).all()
    assert ("are cut at its border" in caplog.text) == (name != "within")


def test_of_a_running_camera_boxes_outside_are_counted_and_an_image_of_them_alone_is_refused():
    listener = Listener(ovad_array(), 48_000, camera=SMALL)
    score = np.array([0.9, 0.9])
    listener.look(0, DetectionFrame(np.array([INSIDE, OUTSIDE]), score, ("car", "car")))
    assert listener.world.state.delivery.refused == 1
    with pytest.raises(InputFileError, match="640 x 402 px, got a corner"):
        listener.look(10**8, DetectionFrame(np.array([OUTSIDE]), score[:1], ("car",)))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (
            {"horizontal_fov_deg": 181},
            r"camera.horizontal_fov_deg: expected a number in \(0.0, 180.0\), got 181",
        ),
        ({"horizontal_fov_deg": 0}, "camera.horizontal_fov_deg"),
        ({"pitch_deg": 90}, r"camera.pitch_deg: .* got 90"),
        ({"roll_deg": -95}, r"camera.roll_deg: .* got -95"),
        ({"horizontal_fov_deg": None, "fx": 500, "cx": 900}, r"camera.cx: .* got 900"),
        ({"horizontal_fov_deg": None, "fx": -1}, "camera.fx"),
        ({"position_m": [1200, 0, 0]}, r"camera.position_m: expected less than 10 m .*got \[1200"),
        ({"min_box_px": -1}, "camera.min_box_px"),
        ({"min_score": 75}, "camera.min_score"),
        ({"image_rate_hz": 0}, "camera.image_rate_hz"),
        ({"yaw_deg": 1e9}, r"camera.yaw_deg: .* got 1000000000"),
        ({"stamp_offset_s": 1e11}, "stamp_offset_s"),
        ({"width_px": 0}, "width_px"),
    ],
)
def test_a_wrong_number_of_a_camera_is_named_as_it_was_written(wrong, named, tmp_path):
    lens = {"width_px": 640, "height_px": 402, "horizontal_fov_deg": 70, "position_m": [0, 0, 0]} | wrong
    (tmp_path / "c.json").write_text(
        json.dumps({key: value for key, value in lens.items() if value is not None})
    )
    with pytest.raises(InputFileError, match=named) as refused:
        read_camera_setup(tmp_path / "c.json")
    assert not re.search("half_angle|_rad|principal|nominal|min_height", str(refused.value))


@pytest.mark.parametrize(
    ("yaw_deg", "wrapped_deg"), [(350.0, -10.0), (-190.0, 170.0), (180.0, 180.0), (725.0, 5.0)]
)
def test_the_yaw_of_a_camera_goes_round(yaw_deg, wrapped_deg, tmp_path):
    lens = {"width_px": 640, "height_px": 402, "horizontal_fov_deg": 70, "position_m": [0, 0, 0]}
    (tmp_path / "c.json").write_text(json.dumps(lens | {"yaw_deg": yaw_deg, "stamp_offset_s": -1.7e9}))
    camera, _ = read_camera_setup(tmp_path / "c.json")
    assert math.degrees(camera.yaw_rad) == pytest.approx(wrapped_deg)
    assert camera.stamp_offset_s == -1.7e9


class Tensor:
    """As torch's in the memory of an accelerator: numpy reads it only after `cpu`."""

    def __init__(self, values):
        self.values = np.asarray(values, np.float32)

    def cpu(self):
        return self.values


def of_ultralytics(boxes, scores, classes, names):
    found = SimpleNamespace(xyxy=Tensor(boxes), conf=Tensor(scores), cls=Tensor(classes))
    return SimpleNamespace(boxes=found, names=names, obb=None)


def of_supervision(boxes, scores, names):
    data = {"class_name": np.array(names)} if names else {}
    return SimpleNamespace(xyxy=np.array(boxes, np.float32).reshape(-1, 4), confidence=scores, data=data)


NO_SCORES = None
TWO, NAMES = [[*INSIDE], [300.0, 200.0, 340.0, 260.0]], {0: "person", 2: "car"}


@pytest.mark.parametrize(
    ("found", "labels", "scores"),
    [
        (of_ultralytics(TWO, [1.0, 0.75], [2, 0], NAMES), ("car", "person"), [1.0, 0.75]),
        ([of_ultralytics(TWO, [1.0, 0.75], [2, 0], NAMES)], ("car", "person"), [1.0, 0.75]),
        (of_ultralytics(np.empty((0, 4)), [], [], NAMES), (), []),
        (of_supervision(TWO, np.array([1.0, 0.75]), ["car", "bus"]), ("car", "bus"), [1.0, 0.75]),
        (of_supervision(TWO, NO_SCORES, ["car", "bus"]), ("car", "bus"), [1.0, 1.0]),
        (of_supervision([], np.empty(0), []), (), []),
    ],
)
def test_results_of_other_libraries_are_looks(found, labels, scores):
    frame = DetectionFrame.of(found)
    assert (frame.labels, frame.scores.tolist()) == (labels, scores)
    assert frame.boxes_px.tolist() == (TWO if labels else [])
    ours, theirs = (Listener(ovad_array(), 48_000, camera=SMALL) for _ in range(2))
    silence = np.zeros((48_000, 56), np.float32)
    for listener, look in ((ours, frame), (theirs, found)):
        listener.look(950_000_000, look)
        listener.push(silence)
    assert theirs.world.state == ours.world.state
    assert bool(theirs.world.state.entities) == bool(labels)


@pytest.mark.parametrize(
    ("found", "problem"),
    [
        (
            of_supervision(TWO, NO_SCORES, []),
            r"class_name.*: expected a name for each box, got 0 for 2",
        ),
        (SimpleNamespace(boxes=None, names=NAMES), "expected the result of a detection model"),
        (of_ultralytics(TWO, [0.5], [2, 0], NAMES), "scores: expected shape"),
        ([], "look: expected a DetectionFrame, or a result of supervision or ultralytics, got"),
    ],
)
def test_a_result_that_holds_no_boxes_is_refused(found, problem):
    with pytest.raises(InvalidArgumentError, match=problem):
        Listener(ovad_array(), 48_000, camera=SMALL).look(0, found)
