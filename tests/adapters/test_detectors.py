"""Detectors behind one protocol, and the files that others write."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from street_frames import HEIGHT, WIDTH, reference, street

from worldstate.adapters.camera import detectors
from worldstate.adapters.camera.box_linking import overlaps
from worldstate.adapters.camera.detections import (
    read_any_detections,
    read_mot_text,
    read_yolo_text,
)
from worldstate.adapters.camera.detectors import (
    MotionDetector,
    OnnxDetector,
    decode_yolo,
    open_onnx,
    outlined_share,
    suppress,
)
from worldstate.ground.errors import InputFileError, InvalidArgumentError

boxes = st.lists(
    st.tuples(*[st.integers(0, 30)] * 4).map(
        lambda b: (min(b[0], b[2]), min(b[1], b[3]), max(b[0], b[2]) + 1, max(b[1], b[3]) + 1)
    ),
    min_size=1,
    max_size=6,
)


def pixels(box):
    mask = np.zeros((32, 32), dtype=bool)
    mask[box[1] : box[3], box[0] : box[2]] = True
    return mask


@given(boxes, boxes)
def test_overlap_is_that_of_counted_pixels(ours, theirs):
    found = overlaps(np.array(ours, dtype=float), np.array(theirs, dtype=float))
    for i, a in enumerate(map(pixels, ours)):
        for j, b in enumerate(map(pixels, theirs)):
            assert found[i, j] == pytest.approx((a & b).sum() / (a | b).sum())


@given(boxes, st.floats(0.1, 0.9))
def test_suppression_keeps_no_two_that_overlap_and_drops_none_without_a_reason(rows, most):
    array, scores = np.array(rows, dtype=float), np.linspace(1.0, 0.1, len(rows))
    kept = suppress(array, scores, most)
    shared = overlaps(array[kept], array[kept]) - np.eye(len(kept))
    assert (shared <= most).all()
    for i in set(range(len(rows))) - set(kept.tolist()):
        better = [k for k in kept if scores[k] > scores[i]]
        assert overlaps(array[i : i + 1], array[better]).max() > most


@pytest.mark.long
@pytest.mark.parametrize("background", ["mog2", "knn"])
def test_motion_finds_the_car_and_little_else(background):
    detector, truth = MotionDetector(background), reference(40)
    found = looked = false = 0
    for number, frame in enumerate(street(40)):
        seen = detector.detect(frame)
        if number < 8:
            continue
        there = truth.frames[number].boxes_px
        shared = overlaps(seen.boxes_px, there)
        looked, found = looked + len(there), found + int((shared >= 0.3).any(axis=0).sum())
        false += int((~(shared >= 0.3).any(axis=1)).sum())
    assert found >= 0.9 * looked > 0
    assert false <= 8


@pytest.mark.parametrize("background", ["mog2", "knn"])
@pytest.mark.parametrize(("step", "seen"), [(7, False), (11, True)])
def test_both_backgrounds_have_the_same_smallest_contrast(background, step, seen):
    detector = MotionDetector(background)
    empty = np.full((64, 96, 3), 100, dtype=np.uint8)
    for _ in range(60):
        assert len(detector.detect(empty)) == 0
    there = empty.copy()
    there[20:44, 30:60] += step  # Euclidean over the colours: sqrt(3) times
    assert bool(len(detector.detect(there))) is seen


def test_motion_sees_nothing_in_an_empty_street():
    detector = MotionDetector()
    assert sum(len(detector.detect(frame)) for frame in street(15, car=False)) == 0


@pytest.mark.long
@pytest.mark.parametrize("background", ["mog2", "knn"])
def test_light_is_no_object_however_much_of_the_image_it_changes(background, monkeypatch):
    """The glow of lamps wanders over the street: motion without outlines would call it a car."""
    down, across = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    found = {0.0: 0, 0.25: 0}
    for outlined in found:
        monkeypatch.setattr(detectors, "OUTLINED", outlined)
        detector = MotionDetector(background)
        for number, frame in enumerate(street(25, car=False)):
            where = np.hypot((across - 40.0 * (number - 9)) / 60.0, (down - 250.0) / 40.0)
            glow = 90.0 * np.exp(-0.5 * where**2)[:, :, None] * (number >= 10)
            found[outlined] += len(detector.detect(np.clip(frame + glow, 0, 255).astype(np.uint8)))
    assert found[0.0] >= 12
    assert found[0.25] <= 1


@pytest.mark.parametrize("sigma_px", [0.5, 2.0, 4.0, 8.0, 16.0])
def test_an_edge_counts_up_to_the_blur_that_its_formula_says(sigma_px):
    """A step smeared by sigma rises by C / (sigma sqrt(2 pi)) a pixel."""
    step, region = np.zeros((300, 400), np.float32), np.zeros((300, 400), dtype=bool)
    step[80:220, 100:300], region[80:220, 100:300] = 80.0, True
    smeared = gaussian_filter(step, sigma_px)
    limit = sigma_px * np.sqrt(2.0 * np.pi)
    assert outlined_share(smeared, region, 1.15 * limit + 1.0) > 0.9
    assert outlined_share(smeared, region, 0.8 * limit) < 0.1


def model_file(path, output, size=32):
    """A model that looks at nothing and always gives `output`."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, size, size])
    result = helper.make_tensor_value_info("output0", TensorProto.FLOAT, list(output.shape))
    nothing = numpy_helper.from_array(np.zeros(1, dtype=np.float32), "nothing")
    fixed = numpy_helper.from_array(output.astype(np.float32), "fixed")
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "nothing"], ["zero"]),
        helper.make_node("Add", ["fixed", "zero"], ["output0"]),
    ]
    graph = helper.make_graph(nodes, "fixed", [image], [result], [nothing, fixed])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, path)
    return path


FORMS = {
    "a score a class": np.array(
        [
            [
                [16, 16, 8, 8, 0.1, 0.9],
                [16.5, 16, 8, 8, 0.1, 0.8],
                [8, 24, 4, 4, 0.7, 0.1],
                [1, 1, 1, 1, 0.0, 0.1],
            ]
        ]
    ).transpose(0, 2, 1),
    "objectness": np.array([[[16, 16, 8, 8, 0.9, 0.0, 1.0], [8, 24, 4, 4, 0.7, 1.0, 0.0]]]),
    "corners": np.array([[[12, 12, 20, 20, 0.9, 1], [6, 22, 10, 26, 0.7, 0], [0, 0, 0, 0, 0, 0]]]),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_model_file_is_run_and_its_boxes_are_those_of_the_frame(form, tmp_path):
    pytest.importorskip("onnxruntime")
    path = model_file(tmp_path / "fixed.onnx", FORMS[form])
    detector = open_onnx(path, ("bicycle", "car"))
    seen = detector.detect(np.zeros((48, 64, 3), dtype=np.uint8))
    assert seen.labels == ("car", "bicycle")
    assert seen.scores == pytest.approx([0.9, 0.7])
    assert seen.boxes_px.tolist() == [[24.0, 24.0, 40.0, 40.0], [12.0, 44.0, 20.0, 48.0]]


class Spy:
    """A session that keeps what it was given."""

    def __init__(self, shape=(1, 3, 32, 64), output=FORMS["objectness"]):
        self._shape, self._output, self.fed = shape, output, None

    def get_inputs(self):
        return [type("Input", (), {"name": "images", "shape": self._shape})()]

    def run(self, names, feed):
        self.fed = feed["images"]
        return [self._output]


def test_the_model_is_given_red_first_in_0_to_1_with_its_proportions_kept():
    spy = Spy()
    frame = np.zeros((10, 40, 3), dtype=np.uint8)
    frame[:, :, 2] = 255
    OnnxDetector(spy, ("a", "b")).detect(frame)
    assert (spy.fed.shape, spy.fed.dtype) == ((1, 3, 32, 64), np.float32)
    assert spy.fed[0, :, 5, 5].tolist() == [1.0, 0.0, 0.0]
    assert spy.fed[0, :, 20, 5] == pytest.approx(114 / 255)


@pytest.mark.parametrize(
    "output",
    [np.zeros((1, 7, 9)), np.zeros((2, 6, 9)), np.full((1, 6, 4), np.nan), np.zeros((6, 4)),
     np.array([[[0, 0, 1, 1, 0.5, 7.0]]])],
)  # fmt: skip
def test_another_output_is_refused(output):
    with pytest.raises(InvalidArgumentError, match="output"):
        decode_yolo(output, classes=2)


def test_a_file_that_is_no_model_is_a_typed_error(tmp_path):
    pytest.importorskip("onnxruntime")
    for name, content in {"missing.onnx": None, "text.onnx": b"no model", "empty.onnx": b""}.items():
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InputFileError, match=name):
            open_onnx(path, ("car",))
    with pytest.raises(InvalidArgumentError, match="input"):
        OnnxDetector(Spy(shape=(1, 3)), ("car",))


def test_the_same_boxes_from_four_kinds_of_file(tmp_path):
    rows = [[], [[10.0, 20.0, 60.0, 140.0]], [[0.0, 0.0, 64.0, 40.0], [320.0, 200.0, 640.0, 400.0]]]
    frames = [{"boxes": r, "scores": [0.5] * len(r), "classes_str": ["car"] * len(r)} for r in rows]
    (tmp_path / "ovad.json").write_text(json.dumps({"detections_per_frame": frames}))
    coco = [
        {"image_id": i, "category_id": 3, "bbox": [b[0], b[1], b[2] - b[0], b[3] - b[1]], "score": 0.5}
        for i, row in enumerate(rows)
        for b in row
    ]
    (tmp_path / "coco.json").write_text(" \n" + json.dumps(coco))
    (tmp_path / "yolo").mkdir()
    for i, row in enumerate(rows):
        lines = [
            f"2 {(b[0] + b[2]) / 2 / WIDTH} {(b[1] + b[3]) / 2 / HEIGHT} "
            f"{(b[2] - b[0]) / WIDTH} {(b[3] - b[1]) / HEIGHT} 0.5"
            for b in row
        ]
        if lines:
            (tmp_path / "yolo" / f"street_{i:05d}.txt").write_text("\n".join(lines))
    corners = [(i, *b) for i, row in enumerate(rows, 1) for b in row]
    mot = [f"{i},-1,{x},{y},{right - x},{bottom - y},0.5,-1,-1,-1" for i, x, y, right, bottom in corners]
    (tmp_path / "mot.txt").write_text("\n".join(mot))
    for name in ("ovad.json", "coco.json", "yolo", "mot.txt"):
        log = read_any_detections(tmp_path / name, 10.0, (WIDTH, HEIGHT))
        assert log.stamps_ns.tolist() == [0, 100_000_000, 200_000_000]
        for frame, row in zip(log.frames, rows, strict=True):
            assert frame.boxes_px.reshape(-1, 4) == pytest.approx(np.array(row).reshape(-1, 4))
            assert set(frame.labels) <= {"car"}


@pytest.mark.parametrize(
    "text",
    ["", "{", "[1]", '[{"image_id": 0}]',
     '[{"image_id": -1, "category_id": 3, "bbox": [0,0,1,1], "score": 1}]',
     '[{"image_id": 0, "category_id": 3, "bbox": [0,0,-1,1], "score": 1}]',
     '[{"image_id": 0, "category_id": 3, "bbox": [0,0,1,NaN], "score": 1}]',
     '[{"image_id": 0, "category_id": 3, "bbox": [0,0,1,1], "score": 2}]',
     '[{"image_id": true, "category_id": 3, "bbox": [0,0,1,1], "score": 1}]',
     '[{"image_id": 999999999, "category_id": 3, "bbox": [0,0,1,1], "score": 1}]'],
)  # fmt: skip
def test_damaged_coco_results_are_a_typed_error(text, tmp_path):
    path = tmp_path / "results.json"
    path.write_text(text)
    with pytest.raises(InputFileError, match=r"results\.json"):
        read_any_detections(path)


@pytest.mark.parametrize(
    "line",
    ["car 0 0 1 1", "2 0 0 1", "2 0 0 1 nan", "2 0 nan 1 1", "2 0 0 -1 1", "2 0 0 1 1 1.5", "2 0 0 1 1 1 1"],
)
def test_damaged_yolo_text_is_a_typed_error(line, tmp_path):
    (tmp_path / "a_0.txt").write_text(line)
    with pytest.raises(InputFileError, match=r"a_0\.txt"):
        read_yolo_text(tmp_path, (64, 48))
    with pytest.raises(InputFileError, match="size"):
        read_any_detections(tmp_path)


tracks = st.dictionaries(
    st.tuples(st.integers(1, 20), st.integers(1, 5)),  # a frame has an id once
    st.tuples(*[st.floats(-1e4, 1e4)] * 2, *[st.floats(0.0, 1e4)] * 2, st.floats(0.0, 1.0)),
    max_size=20,
)


@given(tracks=tracks, looks=st.integers(20, 25))
def test_what_a_tracker_writes_is_read_frame_by_frame(tracks, looks, tmp_path_factory):
    """Frames count from 1 and stand in order, ids are of no use here, and frames without a line are looks."""
    path = tmp_path_factory.getbasetemp() / "sequence.txt"
    lines = [", ".join(map(repr, (*key, *box, -1, -1, -1))) for key, box in sorted(tracks.items())]
    path.write_text("".join(line + "\r\n" for line in lines))
    log = read_any_detections(path, 30.0, n_images=looks)
    assert len(log) == looks
    assert log.stamps_ns[[0, 15]].tolist() == [0, 500_000_000]
    for number, frame in enumerate(log.frames, 1):
        expected = [box for (at, _), box in sorted(tracks.items()) if at == number]
        assert frame.boxes_px.tolist() == [[x, y, x + w, y + h] for x, y, w, h, _ in expected]
        assert frame.scores.tolist() == [score for *_, score in expected]
    told = max((number for number, _ in tracks), default=0)
    named = sorted({number - 1 for number, _ in tracks})
    step = math.gcd(*np.diff(named).tolist()) if len(named) > 2 else 1
    seen = read_any_detections(path, 10.0).stamps_ns // 10**8
    # Numbers that rise by more than one are those of every so many-th image.
    assert seen.tolist() == [*range(named[0] % step if named else 0, told, step)]
    if step > 1:
        with pytest.raises(InputFileError, match=rf"rise by {step}.*image_rate_hz"):
            read_any_detections(path)
    with pytest.raises(InputFileError, match=r"images by its boxes"):
        read_any_detections(path, n_images=told - 1)


def test_ground_truth_in_mot_text_has_classes_and_vehicles_that_nobody_sees(tmp_path):
    rows = ["1,1,0,0,9,9,1,3,0.5", "1,2,0,0,9,9,1,1,1", "1,3,0,0,9,9,0,3,1", "1,4,0,0,9,9,1,3,0"]
    (tmp_path / "gt.txt").write_text("\n".join([*rows, "1,5,0,0,9,9,1,8,1", "1,6,0,0,9,9,-1,-1,-1,-1"]))
    frame = read_mot_text(tmp_path / "gt.txt").frames[0]
    assert frame.labels == ("car", "person", "car", "car", "8", "car")
    # The third one is not to be considered, the fourth one is hidden, and the last line states no confidence.
    assert frame.scores.tolist() == [1.0, 1.0, 0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize(
    "line",
    ["0,1,0,0,9,9,1,-1,-1,-1", "1.5,1,0,0,9,9,1,-1,-1,-1", "250001,1,0,0,9,9,1,-1,-1,-1",
     "nan,1,0,0,9,9,1,-1,-1,-1", "1,1,nan,0,9,9,1,-1,-1,-1", "1,1,0,inf,9,9,1,-1,-1,-1",
     "1,1,0,0,-9,9,1,-1,-1,-1", "1,1,0,0,9,9,67.5,-1,-1,-1", "1,1,0,0,9,9,1,nan,-1,-1", "1,1,0,0,9,9",
     "1,1,0,0,9,9,1,-1,-1,-1,5", "frame,id,x,y,w,h,conf", "1 1 0 0 9 9 1 -1 -1 -1", "2 0.5 0.5 0.1 0.2 0.9"],
)  # fmt: skip
def test_damaged_mot_text_is_a_typed_error_that_names_the_line(line, tmp_path):
    (tmp_path / "det.txt").write_text("1,1,0,0,9,9,1,-1,-1,-1\n" + line)
    with pytest.raises(InputFileError, match=r"det\.txt.*line 2: expected frame, id, .* got '"):
        read_any_detections(tmp_path / "det.txt")


def test_mot_text_is_bounded(tmp_path):
    (tmp_path / "a.txt").write_text("\n" * 1_000_001)
    with pytest.raises(InputFileError, match="at most 1000000 lines"):
        read_mot_text(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_text("1,1,0,0,9,9,1\n" * 1001)
    with pytest.raises(InputFileError, match="at most 1000 boxes a frame"):
        read_mot_text(tmp_path / "a.txt")


def test_a_folder_without_frames_and_a_missing_file_are_refused(tmp_path):
    with pytest.raises(InputFileError):
        read_yolo_text(tmp_path, (64, 48))
    with pytest.raises(InputFileError, match="nothing"):
        read_any_detections(tmp_path / "nothing.json")
