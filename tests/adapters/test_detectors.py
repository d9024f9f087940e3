"""Detectors behind one protocol: overlap of boxes, moving objects, models in ONNX files."""

import numpy as np
import pytest
from camera_boxes import write_onnx
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from street_frames import HEIGHT, WIDTH, reference, street

from worldstate.adapters import MotionDetector, OnnxDetector
from worldstate.adapters.camera import detectors
from worldstate.adapters.camera.box_linking import overlaps
from worldstate.adapters.camera.detectors import decode_yolo, open_onnx, outlined_share, suppress
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
    seen, found, looked, false = [detector.detect(frame) for frame in street(40)], 0, 0, 0
    for frame, there in zip(seen[8:], truth.frames[8:], strict=True):
        shared = overlaps(frame.boxes_px, there.boxes_px) >= 0.3
        looked, found = looked + len(there), found + shared.any(axis=0).sum()
        false += (~shared.any(axis=1)).sum()
    assert found >= 0.9 * looked > 0
    assert false <= 8


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
def test_an_edge_counts_up_to_the_blur_of_its_formula(sigma_px):
    """A step smeared by sigma rises by C / (sigma sqrt(2 pi)) a pixel."""
    step, region = np.zeros((300, 400), np.float32), np.zeros((300, 400), dtype=bool)
    step[80:220, 100:300], region[80:220, 100:300] = 80.0, True
    smeared = gaussian_filter(step, sigma_px)
    limit = sigma_px * np.sqrt(2.0 * np.pi)
    assert outlined_share(smeared, region, 1.15 * limit + 1.0) > 0.9
    assert outlined_share(smeared, region, 0.8 * limit) < 0.1


FORMS = {
    "a score a class": np.array(
        [[[16, 17, 8, 1], [16, 16, 24, 1], [8, 8, 4, 1], [8, 8, 4, 1], [0, 0, 0.7, 0], [0.9, 0.8, 0, 0.1]]]
    ),
    "objectness": np.array([[[16, 16, 8, 8, 0.9, 0.0, 1.0], [8, 24, 4, 4, 0.7, 1.0, 0.0]]]),
    "corners": np.array([[[12, 12, 20, 20, 0.9, 1], [6, 22, 10, 26, 0.7, 0], [0, 0, 0, 0, 0, 0]]]),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_model_file_is_run_and_its_boxes_are_those_of_the_frame(form, tmp_path):
    pytest.importorskip("onnxruntime")
    path = write_onnx(tmp_path / "fixed.onnx", FORMS[form])
    detector = open_onnx(path, ("bicycle", "car"))
    seen = detector.detect(np.zeros((48, 64, 3), dtype=np.uint8))
    assert seen.labels == ("car", "bicycle")
    assert seen.scores == pytest.approx([0.9, 0.7])
    assert seen.boxes_px.tolist() == [[24.0, 24.0, 40.0, 40.0], [12.0, 44.0, 20.0, 48.0]]


class Spy:
    """A session that keeps its input."""

    def __init__(self, shape=(1, 3, 32, 64), output=FORMS["objectness"]):
        self._shape, self._output, self.fed = shape, output, None

    def get_inputs(self):
        return [type("Input", (), {"name": "images", "shape": self._shape})()]

    def run(self, names, feed):
        self.fed = feed["images"]
        return [self._output]


def test_the_input_of_a_model_is_red_first_from_0_to_1_with_its_proportions_kept():
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


def test_a_missing_model_and_one_of_another_input_are_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    with pytest.raises(InputFileError, match=r"missing\.onnx"):
        open_onnx(tmp_path / "missing.onnx", ("car",))
    with pytest.raises(InvalidArgumentError, match="input"):
        OnnxDetector(Spy(shape=(1, 3)), ("car",))
