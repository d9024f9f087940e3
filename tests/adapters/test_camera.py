"""The camera: OpenCV's projection, its lens in a file, boxes in any form, and why boxes do not count."""

import json
import math
import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
from camera_boxes import EMPTY, LENS, boxed, write_boxes, write_video
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from stand_ins import Results

from worldstate.adapters import MotionDetector, PinholeCamera, VisionQuery, read_camera
from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog
from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.listener import Listener, listen
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.adapters.vehicle.car_file import read_camera_setup
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.errors import InputFileError, InvalidArgumentError

CAMERAS = st.builds(
    PinholeCamera.ovad,
    half_angle_rad=st.floats(0.1, 1.3),
    position_m=st.tuples(st.floats(-3, 3), st.floats(-1, 1), st.floats(-1, 1)),
    yaw_rad=st.floats(-math.pi, math.pi),
    pitch_rad=st.floats(-0.4, 0.4),
    roll_rad=st.floats(-0.3, 0.3),
    nominal_range_m=st.floats(5.0, 100.0),
)


@given(camera=CAMERAS, share=st.floats(0.0, 1.0))
def test_a_column_has_one_azimuth(camera: PinholeCamera, share: float) -> None:
    azimuth = camera.azimuth(share * camera.width_px)
    assert -math.pi < azimuth <= math.pi
    assert float(camera.column(azimuth)) == pytest.approx(share * camera.width_px, abs=1e-6 * camera.width_px)


@given(camera=CAMERAS, inside=st.floats(0.001, 0.999), outside=st.floats(0.01, 0.5))
def test_a_camera_sees_between_its_edges(camera: PinholeCamera, inside: float, outside: float) -> None:
    width = camera.width_px
    assert camera.sees(camera.azimuth(inside * width))
    assert not camera.sees(camera.azimuth([-outside * width, (1 + outside) * width])).any()


@given(camera=CAMERAS, off_axis=st.floats(-1.2, 1.2))
def test_columns_agree_with_opencv(camera: PinholeCamera, off_axis: float) -> None:
    cv2 = pytest.importorskip("cv2")
    centre, bearing = np.array(camera.position_m), camera.yaw_rad + off_axis
    point = centre + camera.nominal_range_m * np.array([math.cos(bearing), math.sin(bearing), 0.0])
    focal = camera.width_px / 2 / math.tan(camera.half_angle_rad)
    matrix = np.array([[focal, 0, camera.width_px / 2], [0, focal, camera.height_px / 2], [0, 0, 1.0]])
    # Rows: right, down and forward. A positive roll raises the left side.
    angles_rad = camera.yaw_rad, -camera.pitch_rad, camera.roll_rad
    axes = Rotation.from_euler("ZYX", angles_rad).as_matrix()
    rotation = np.stack([-axes[:, 1], -axes[:, 2], axes[:, 0]])
    pixels, _ = cv2.projectPoints(
        point.reshape(1, 1, 3), cv2.Rodrigues(rotation)[0], -rotation @ centre, matrix, None
    )
    azimuth = math.atan2(point[1], point[0])
    assert float(camera.column(azimuth)) == pytest.approx(pixels[0, 0, 0], rel=1e-6, abs=1e-3)


def test_behind_the_camera_is_in_no_column() -> None:
    assert np.isnan(PinholeCamera.ovad().column([math.pi, 2.0, -2.0])).all()
    rear = PinholeCamera.ovad(yaw_rad=math.pi, position_m=(0.0, 0.0, 0.0))
    assert float(rear.column(math.pi)) == pytest.approx(968)


@given(left=st.floats(0.0, 1800.0), width=st.floats(1.0, 130.0))
def test_a_sighting_is_between_the_edges_of_its_box(left: float, width: float) -> None:
    camera = PinholeCamera.ovad()
    seen = camera.sighting((left, 400, left + width, 700), "car", 0.9)
    assert camera.azimuth(left + width) < seen.azimuth_rad < camera.azimuth(left)
    assert seen.width_rad == pytest.approx(float(camera.azimuth(left) - camera.azimuth(left + width)))
    assert seen.std_rad >= seen.width_rad / math.sqrt(12)


def test_an_unknown_range_widens_a_sighting() -> None:
    box = (100, 400, 200, 700)
    known, unknown = (PinholeCamera.ovad(range_spread=s).sighting(box, "car", 0.9) for s in (0.0, 1.0))
    assert known.std_rad == pytest.approx(known.width_rad / math.sqrt(12))
    shift = unknown.azimuth_rad - float(PinholeCamera.ovad().off_axis(unknown.azimuth_rad))
    assert unknown.std_rad == pytest.approx(math.hypot(known.std_rad, shift))


# The camera as a user has it.

SIZE = {"width_px": 1000, "height_px": 600, "position_m": [0, 0, 0]}


def lens(path, **keys):
    """Return the camera of a file with these keys."""
    path.write_text(json.dumps(keys))
    return read_camera(path)


def test_field_of_view_and_intrinsics_are_equivalent(tmp_path):
    wide = lens(tmp_path / "a.json", **SIZE, horizontal_fov_deg=90.0)
    calibrated = lens(tmp_path / "b.json", **SIZE, fx=500.0, cx=500.0)
    np.testing.assert_allclose(wide.azimuth([0, 250, 1000]), calibrated.azimuth([0, 250, 1000]))
    assert math.degrees(wide.azimuth(0.0)) == pytest.approx(45.0)


def test_an_axis_beside_the_middle_and_a_turned_camera(tmp_path):
    camera, columns = lens(tmp_path / "a.json", **SIZE, fx=500.0, cx=400.0, yaw_deg=30.0), [1.0, 300.0, 999.0]
    assert math.degrees(camera.azimuth(400.0)) == pytest.approx(30.0)
    assert math.degrees(camera.azimuth(0.0)) == pytest.approx(30.0 + math.degrees(math.atan(0.8)))
    np.testing.assert_allclose(camera.column(camera.azimuth(columns)), columns, atol=1e-6)
    assert camera.sees(camera.azimuth(columns)).all() and not camera.sees(math.radians(70.0))
    tilted = lens(tmp_path / "b.json", **SIZE, fx=500.0, pitch_deg=20.0, roll_deg=-3.0)
    assert (tilted.pitch_rad, tilted.roll_rad) == pytest.approx((math.radians(20.0), math.radians(-3.0)))


def test_an_unknown_key_is_refused_and_those_about_boxes_are_read(tmp_path):
    path, keys = tmp_path / "camera.json", SIZE | {"fx": 500.0}
    camera = lens(path, **keys, min_score=0.4, classes=["tram"])
    known, setup = read_camera_setup(path)
    assert camera == known and setup.boxes == DetectionFilter(frozenset({"tram"}), 0.4)
    path.write_text(json.dumps(keys | {"pitch": 3.0}))
    for read in (read_camera, read_camera_setup):
        with pytest.raises(InputFileError, match=r"camera: expected keys among .*'pitch_deg'.*\['pitch'\]"):
            read(path)


@pytest.fixture
def watched(tmp_path):
    """Return a recording folder; its video shows a square that crosses from left to right: 2 s at 10 Hz."""
    folder, rng = tmp_path / "SA1" / "left" / "1_00_0002", np.random.default_rng(0)
    folder.mkdir(parents=True)
    soundfile.write(folder / "out_multi.wav", 0.01 * rng.standard_normal((2 * 48_000, 56)), 48_000)
    images = np.tile(rng.integers(90, 110, (402, 640, 3)).astype(np.uint8), (20, 1, 1, 1))
    for number, image in enumerate(images):
        image[150:300, 25 * number : 25 * number + 120] = 220
    write_video(folder / VIDEO_NAME, images)
    return folder


def test_a_detector_searches_the_video_of_a_folder(watched):
    source = open_source(watched, detector=MotionDetector())
    assert len(source.detections) == 20 and source.detections.source.endswith(VIDEO_NAME)
    for number in range(10, 20):
        (box,) = source.detections.frames[number].boxes_px
        # A square without texture moves at its edges: its front is found, its middle is still.
        np.testing.assert_allclose(box[1:], [150, 25 * number + 120, 300], atol=12)
        assert 25 * number - 12 <= box[0] < box[2]
    assert len(list(listen(watched, detector="motion"))) == 11


def test_a_detector_needs_a_folder_with_a_video_and_no_detections(watched):
    nothing = DetectionLog((), np.empty(0, np.int64))
    with pytest.raises(InvalidArgumentError, match="expected a recording folder with a video"):
        open_source(watched / "out_multi.wav", detector=MotionDetector())
    with pytest.raises(InvalidArgumentError, match="no detections"):
        open_source(watched, detector=MotionDetector(), detections=nothing)
    (watched / VIDEO_NAME).write_text("no video")
    with pytest.raises(InputFileError, match=f"{VIDEO_NAME}.* cannot be opened"):
        open_source(watched, detector="knn")
    (watched / VIDEO_NAME).unlink()
    with pytest.raises(InputFileError, match=f"{VIDEO_NAME}.* does not exist"):
        open_source(watched, detector=MotionDetector())


def test_run_prints_the_number_of_boxes_that_count(watched, tmp_path, capsys):
    parked, moved, low = ([left, 20.0, left + 50.0, top] for left, top in ((10, 220), (300, 220), (300, 30)))
    labels, scores = ("car", "dog", "car", "car"), [0.9, 0.9, 0.9, 0.5]
    words = ["run", str(watched), "--detections", str(tmp_path / "d.json")]

    def said(*frames):
        write_boxes(tmp_path / "d.json", frames)
        assert main(words) == 0
        return capsys.readouterr()

    told = said(*[DetectionFrame([parked, parked, low, moved], scores, labels)] * 20)
    looked = "20 images were looked at, 0 of them without a box; 10 of 80 boxes count; 20 of another class"
    assert looked in told.out and "each image has a box" not in told.err  # what is parked is not missed
    assert main([*words, "--json"]) == 0
    counts = {"frames": 20, "empty": 0, "boxes": 80, "counted": 10, "parked": 10}
    counts |= dict.fromkeys(("other_class", "low_score", "too_small"), 20)
    assert json.loads(capsys.readouterr().out)["detections"] == counts
    assert "none counts" in said(boxed(moved, label="dog")).out
    assert "each image has a box" in said(*[boxed(parked), boxed(moved)] * 3).err
    assert "searched no image" in said().err


def test_an_undescribed_camera_is_refused_beside_another_array(tmp_path):
    array = MicrophoneArray([[0.0, 0.2, 0.0], [0.1, 0.0, 0.0], [0.0, -0.3, 0.0]], "three")
    anything, seen = ListenSettings(uncalibrated=True), DetectionLog.at_rate([EMPTY] * 3, 10.0)
    soundfile.write(tmp_path / "a.wav", np.zeros((48_000, 3)), 48_000)
    with pytest.raises(InvalidArgumentError, match="its position"):
        open_source(tmp_path / "a.wav", array=array, settings=anything, detections=seen)
    beside = {"detections": seen, "camera": PinholeCamera.ovad()}
    open_source(tmp_path / "a.wav", array=array, settings=anything, **beside)
    with pytest.raises(InvalidArgumentError, match="its position beside the array"):
        Listener(array, 48_000, settings=anything).look(0, EMPTY)
    Listener(ovad_array(), 48_000).look(0, EMPTY)


def test_boxes_may_be_lists_and_fit_their_labels():
    frame = DetectionFrame([[10, 20, 60, 140]], [0.9], ["car"])
    assert frame.select(DetectionFilter()).tolist() == [0] and frame.labels == ("car",)
    assert DetectionFrame([], [], ()).boxes_px.shape == (0, 4)
    for boxes, scores in (([], [0.9]), ([[1, 2, 3]], [0.9]), ([[1, 2, 3, 4]], [])):
        with pytest.raises(InvalidArgumentError):
            DetectionFrame(boxes, scores, ("car",))


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
    for left, top, right, bottom in np.delete(boxes, kept, axis=0):
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
    log = DetectionLog.at_rate([boxed(*rows) for rows in images], 10.0, "boxes.json")
    if not fit:
        expected = r"boxes.json: frame \d+: expected boxes within .* 640 x 402 px"
        with pytest.raises(InputFileError, match=expected):
            VisionQuery(SMALL, log)
        return
    seen = VisionQuery(SMALL, log).detections
    assert len(seen) == looked
    boxes_px = np.concatenate([frame.boxes_px for frame in seen.frames])
    assert boxes_px.min() >= 0.0 and (boxes_px <= [640, 402, 640, 402]).all()
    assert ("are cut at its border" in caplog.text) == (name != "within")


def test_boxes_outside_are_counted_and_an_image_of_them_alone_is_refused():
    listener = Listener(ovad_array(), 48_000, camera=SMALL)
    listener.look(0, boxed(INSIDE, OUTSIDE))
    assert listener.world.state.delivery.refused == 1
    with pytest.raises(InputFileError, match="640 x 402 px, got a corner"):
        listener.look(10**8, boxed(OUTSIDE))


WRONG = [
    ({"horizontal_fov_deg": 181}, r"camera.horizontal_fov_deg: expected a number in \(0.0, 180.0\), got 181"),
    ({"horizontal_fov_deg": None}, "expected either horizontal_fov_deg or fx"),
    ({"fx": 1.0}, "expected either horizontal_fov_deg or fx"),
    ({"roll_deg": -95}, r"camera.roll_deg: .* got -95"),
    ({"horizontal_fov_deg": None, "fx": 500, "cx": 900}, r"camera.cx: .* got 900"),
    ({"horizontal_fov_deg": None, "fx": "500"}, "fx"),
    ({"position_m": [1200, 0, 0]}, r"camera.position_m: expected less than 10 m .*got \[1200"),
    ({"position_m": None}, "camera.position_m: expected its position"),
    ({"min_score": 75}, "camera.min_score"),
    ({"image_rate_hz": 0}, "camera.image_rate_hz"),
    ({"stamp_offset_s": 1e11}, "stamp_offset_s"),
    ({"width_px": None}, "width_px"),
]


@pytest.mark.parametrize(("wrong", "named"), WRONG)
def test_a_wrong_number_of_a_camera_is_named_as_it_was_written(wrong, named, tmp_path):
    keys = {key: value for key, value in (LENS | wrong).items() if value is not None}
    (tmp_path / "c.json").write_text(json.dumps(keys))
    with pytest.raises(InputFileError, match=named) as refused:
        read_camera_setup(tmp_path / "c.json")
    assert str(refused.value).startswith(f"{tmp_path / 'c.json'}: ")
    assert not re.search("half_angle|_rad|principal|nominal|min_height", str(refused.value))


@pytest.mark.parametrize(
    ("yaw_deg", "wrapped_deg"), [(350.0, -10.0), (-190.0, 170.0), (180.0, 180.0), (725.0, 5.0)]
)
def test_the_yaw_of_a_camera_is_wrapped(yaw_deg, wrapped_deg, tmp_path):
    camera = lens(tmp_path / "c.json", **LENS, yaw_deg=yaw_deg, stamp_offset_s=-1.7e9)
    assert math.degrees(camera.yaw_rad) == pytest.approx(wrapped_deg)
    assert camera.stamp_offset_s == -1.7e9


def of_supervision(boxes, scores, names):
    data = {"class_name": np.array(names)} if names else {}
    return SimpleNamespace(xyxy=np.array(boxes, np.float32).reshape(-1, 4), confidence=scores, data=data)


TWO = [[*INSIDE], [300.0, 200.0, 340.0, 260.0]]
FOUND = DetectionFrame(TWO, [1.0, 0.75], ("car", "person"))
of_ultralytics = partial(Results, names=("person", "bus", "car"))


@pytest.mark.parametrize(
    ("found", "labels", "scores"),
    [
        (of_ultralytics(FOUND), ("car", "person"), [1.0, 0.75]),
        ([of_ultralytics(FOUND)], ("car", "person"), [1.0, 0.75]),
        (of_ultralytics(EMPTY), (), []),
        (of_supervision(TWO, np.array([1.0, 0.75]), ["car", "bus"]), ("car", "bus"), [1.0, 0.75]),
        (of_supervision(TWO, None, ["car", "bus"]), ("car", "bus"), [1.0, 1.0]),
        (of_supervision([], np.empty(0), []), (), []),
    ],
)
def test_results_of_other_libraries_are_looks(found, labels, scores):
    frame = DetectionFrame.of(found)
    assert (frame.labels, frame.scores.tolist()) == (labels, scores)
    assert frame.boxes_px.tolist() == (TWO if labels else [])
    ours, theirs = (Listener(ovad_array(), 48_000, camera=SMALL) for _ in range(2))
    for listener, look in ((ours, frame), (theirs, found)):
        listener.look(950_000_000, look)
        listener.push(np.zeros((48_000, 56), np.float32))
    assert theirs.world.state == ours.world.state
    assert bool(theirs.world.state.entities) == bool(labels)


@pytest.mark.parametrize(
    ("found", "problem"),
    [
        (of_supervision(TWO, None, []), r"class_name.*: expected a name for each box, got 0 for 2"),
        (SimpleNamespace(boxes=None, names={}), "expected the result of a detection model"),
        ([], "look: expected a DetectionFrame, or a result of supervision or ultralytics, got"),
    ],
)
def test_a_result_without_boxes_is_refused(found, problem):
    with pytest.raises(InvalidArgumentError, match=problem):
        Listener(ovad_array(), 48_000, camera=SMALL).look(0, found)
