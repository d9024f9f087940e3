"""NanoDet as a plug-in: its decoder against a computed box, and the real model on recordings."""

import importlib.util
import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from worldstate.adapters.camera.box_linking import overlaps
from worldstate.adapters.camera.detections import Detector
from worldstate.adapters.camera.video import open_video
from worldstate.adapters.own_parts import OwnDetector
from worldstate.ground.errors import InputFileError

ROOT = Path(__file__).resolve().parents[2]
RECORDINGS = Path(os.environ.get("OVAD_SEQUENCES", ROOT.parent / "shared" / "ovad-sequences"))
CAR = 2


@pytest.fixture(scope="module")
def nanodet():
    spec = importlib.util.spec_from_file_location("nanodet", ROOT / "docs" / "examples" / "nanodet.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class OneBox:
    """A session with one detection in every crop, in a cell of stride 16."""

    def __init__(self, row, column, bins, score=0.9):
        sizes = [(416 // stride) ** 2 for stride in (8, 16, 32)]
        self.scores = [np.zeros((1, n, 80), np.float32) for n in sizes]
        self.logits = [np.zeros((1, n, 32), np.float32) for n in sizes]
        cell = row * 26 + column
        self.scores[1][0, cell, CAR] = score
        self.logits[1][0, cell] = np.array(bins, np.float32).reshape(32)

    def get_inputs(self):
        return [SimpleNamespace(name="image")]

    def run(self, names, feed):
        (self.seen,) = feed.values()
        return [*self.scores, *self.logits]


def certain(*bins):
    """Return logits with each side at a given bin; a half is shared by two bins."""
    rows = np.full((4, 8), -100.0)
    for row, value in zip(rows, bins, strict=True):
        row[[int(np.floor(value)), int(np.ceil(value))]] = 0.0
    return rows


def test_a_box_is_decoded_as_computed(nanodet):
    # The cell's middle is 16 (5, 3) + 7.5 = (87.5, 55.5); its sides are 32, 8, 16 and 48 px away. The crop
    # begins at (100, 50) and is twice the size of the input.
    session = OneBox(3, 5, certain(2, 0.5, 1, 3))
    detector: Detector = nanodet.NanoDet(session, [(100.0, 50.0, 832.0)])
    found = detector.detect(np.full((1216, 1936, 3), 128, np.uint8))
    assert found.labels == ("car",)
    np.testing.assert_allclose(found.boxes_px, [[211.0, 145.0, 307.0, 257.0]], atol=1e-3)
    np.testing.assert_allclose(found.scores, [0.9], rtol=1e-6)
    assert session.seen.shape == (1, 3, 416, 416)
    np.testing.assert_allclose(session.seen[0, 0], (128 - 103.53) / 57.375, rtol=1e-5)


def test_a_cut_box_has_a_lower_score_and_is_suppressed(nanodet):
    # In the input from 1.5 to 103.5 px: cut by the left edge of every crop but the first.
    session = OneBox(3, 5, certain(5.375, 0.5, 1, 3))
    session.logits[1][0, 3 * 26 + 5, :8] = -100.0
    session.logits[1][0, 3 * 26 + 5, 5:7] = np.log([0.625, 0.375])
    image = np.zeros((1216, 1936, 3), np.uint8)
    alone, both = (nanodet.NanoDet(session, crops) for crops in (((100, 0, 832),), ((0, 0, 832),)))
    assert alone.detect(image).scores[0] == pytest.approx(0.72)
    assert both.detect(image).scores[0] == pytest.approx(0.9)
    better, part = [0.0, 0.0, 100.0, 50.0], [60.0, 0.0, 100.0, 50.0]
    assert nanodet._within_better(np.array([better, part, [90.0, 0.0, 190.0, 50.0]])).tolist() == [
        False,
        True,
        False,
    ]


def test_a_model_that_is_not_there_is_named(nanodet, tmp_path):
    with pytest.raises(InputFileError, match="expected an ONNX model"):
        nanodet.open_nanodet(tmp_path / "none.onnx")


@pytest.mark.skipif(
    not (RECORDINGS / "detector").is_dir(),
    reason="no ovad-sequences, neither where OVAD_SEQUENCES points nor in ../shared",
)
def test_boxes_are_those_that_come_with_the_recordings(nanodet, monkeypatch):
    # As `worldstate run --detector nanodet` opens it.
    monkeypatch.setenv("NANODET_ONNX", str(RECORDINGS / "detector" / "nanodet_m.onnx"))
    detector = OwnDetector.of("nanodet", nanodet.open_nanodet)
    given = json.loads((RECORDINGS / "boxes" / "1_04_0018.json").read_text())["frames"]
    shared = []
    for number, image in enumerate(open_video(RECORDINGS / "video" / "1_04_0018.mp4").frames()):
        if number in (40, 75, 85):
            boxes = np.array([row[:4] for row in given[number]])
            shared += overlaps(boxes, detector.detect(image).boxes_px).max(axis=1).tolist()
    assert len(shared) > 10
    assert np.mean(np.array(shared) > 0.9) > 0.9
