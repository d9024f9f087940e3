"""Boxes of a detector on staged videos: each recording is decoded once and searched in every camera state.

The files `OUT/DETECTOR-FAMILY-LEVEL/ID.json` have the format of `boxes/ID.json` and serve as the cache:
existing files are not computed again. An image is null if it was not searched and empty if nothing was found.
"""

import importlib.util
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.camera.detections import DetectionFrame, Detector
from worldstate.adapters.camera.detectors import MotionDetector, reduced_to
from worldstate.adapters.camera.video import open_video
from worldstate.adapters.files.file_io import write_json
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import ImageArray
from worldstate_lab.degradation.conditions import Condition, camera_conditions, one_opencv_thread

from .recordings import CornerRecording

# Half of the camera's 1936 pixels: crops of 832 pixels become the network's 416, and staging takes a quarter
# of the time.
WIDTH_PX, REDUCED = 968, 2.0
# The crops begin in an odd row: without its first and last row, an image is halved along the edges of the
# crops.
_LEFT_OUT_ROWS = 1
MODEL = Path("detector", "nanodet_m.onnx")
# Searching every second image halves an hour of inference; a motion detector needs every image.
EVERY = {"nanodet": 2, "motion": 1}
_EXAMPLE = Path(__file__).resolve().parents[3] / "docs" / "examples" / "nanodet.py"


@dataclass(frozen=True, slots=True)
class Staging:
    """A detector, the recordings that it searches, and the folder of its boxes.

    Examples
    --------
    >>> staging = Staging(Path("out"), "motion", MotionDetector)
    >>> staging.path(Condition("blur", 2), "1_00_0002").as_posix()
    'out/motion-blur-2/1_00_0002.json'
    """

    out: Path
    detector: str
    make: Callable[[], Detector]  # Returns a new detector for every recording and state
    every: int = 1
    states: tuple[Condition, ...] = camera_conditions()
    seed: int = 0

    def folder(self, state: Condition) -> Path:
        """Return the folder of a state."""
        return self.out / "-".join([self.detector, state.family, *([str(state.level)] * bool(state.level))])

    def path(self, state: Condition, name: str) -> Path:
        """Return the file of a recording in a state."""
        return self.folder(state) / f"{name}.json"

    def missing(self, recording: CornerRecording) -> tuple[Condition, ...]:
        """Return the states in which a recording was not searched yet."""
        return tuple(one for one in self.states if not self.path(one, recording.name).exists())


def staging_of(detector: str, folder: Path, out: Path, seed: int = 0) -> Staging:
    """Return the staging of a named detector on the recordings of a folder."""
    make: Callable[[], Detector] = MotionDetector
    if detector == "nanodet":
        make = partial(opened_nanodet, folder / MODEL)
        make()  # Reports errors of the model before the work begins
    return Staging(out, detector, make, EVERY[detector], seed=seed)


@cache
def opened_nanodet(model: Path) -> Detector:
    """Open NanoDet for reduced images, once per process: it has no state.

    The decoder is a plug-in among the examples that belongs to no package.
    """
    spec = importlib.util.spec_from_file_location("nanodet", _EXAMPLE)
    if spec is None or spec.loader is None or not _EXAMPLE.is_file():
        raise InputFileError(_EXAMPLE, "expected the example of a detector; it is part of the repository")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    crops = [
        (left / REDUCED, (top - _LEFT_OUT_ROWS) / REDUCED, side / REDUCED)
        for left, top, side in example.OVAD_CROPS
    ]
    opened: Detector = example.open_nanodet(model, crops)
    return opened


def stage_recording(staging: Staging, recording: CornerRecording) -> int:
    """Search a recording in the missing states; return the number of searches."""
    states = staging.missing(recording)
    if not states:
        return 0
    video = open_video(recording.video)
    detectors = [staging.make() for _ in states]
    rows: list[list[Any]] = [[] for _ in states]
    with one_opencv_thread():
        for at, image in enumerate(video.frames()):
            small = _small(image)
            reduced = image.shape[1] / small.shape[1]
            for state, detector, into in zip(states, detectors, rows, strict=True):
                if at % staging.every:
                    into.append(None)
                    continue
                # The staging depends on no other image and on no detector.
                mark = zlib.crc32(f"{recording.name} {state.name}".encode())
                rng = np.random.default_rng([staging.seed, mark, at])
                into.append(_boxes(detector.detect(state.stage(small, rng, reduced)), reduced))
    about = {"size": (video.width_px, video.height_px), "fps": round(video.frame_rate_hz, 3)}
    for state, into in zip(states, rows, strict=True):
        staging.folder(state).mkdir(parents=True, exist_ok=True)
        write_json(staging.path(state, recording.name), {"frames": into, **about})
    return sum(row is not None for into in rows for row in into)


def _small(image: ImageArray) -> ImageArray:
    return reduced_to(image[_LEFT_OUT_ROWS:-_LEFT_OUT_ROWS], WIDTH_PX)


def _boxes(found: DetectionFrame, reduced: float) -> list[list[Any]]:
    """Return boxes in pixels of the camera, in the format of the files."""
    boxes = found.boxes_px * reduced + [0.0, _LEFT_OUT_ROWS] * 2
    edges = np.round(boxes, 1).tolist()
    scores = np.round(found.scores, 3).tolist()
    return [[*box, score, label] for box, score, label in zip(edges, scores, found.labels, strict=True)]


def milliseconds_a_search(staging: Staging, recording: CornerRecording) -> float:
    """Return the duration of one clean search, the second of two: the first one initialises the detector."""
    small = _small(next(open_video(recording.video).frames()))
    detector = staging.make()
    detector.detect(small)
    began = time.perf_counter()
    detector.detect(small)
    return 1e3 * (time.perf_counter() - began)
