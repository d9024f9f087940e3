"""What several detectors report of one video in every condition of the camera: the expensive part, kept."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import numpy as np

from worldstate.adapters.camera.camera_health import (
    LARGEST_PX,
    LEVELS,
    CameraHealth,
    DegradationLog,
    HealthMonitor,
    ImageQuality,
    health_scale,
    image_quality,
)
from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog, Detector
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.motion_detector import Background, MotionDetector
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import Video, any_motion
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import optional
from worldstate.ground.typing import FloatArray, ImageArray
from worldstate.ground.values import nanoseconds
from worldstate.operations.recordings.hop_table import HopTable

from .conditions import CLEAN, Condition, at_level, camera_conditions

# Changes whenever the same video would give other detections.
VERSION = 1
# What is staged does not change within a recording, and reading it costs as much as two detections.
HEALTH_PERIOD_S = 2.0
# Around the part of an image that its quality is read from: the widest blur, 16 px, ends at three of them.
_MARGIN_PX = 48
READINGS = "readings"
_BOX_COLUMNS = ("condition", "frame", "box_px", "score", "class_name")
_READING_COLUMNS = ("condition", "time_s", "brightness", "noise", "sharpness")


@dataclass(frozen=True, slots=True)
class StagedDetector:
    """A detector to be tried in every condition.

    Examples
    --------
    >>> [detector.name for detector in motion_detectors()]
    ['mog2', 'knn']
    """

    name: str  # In tables and files; with the name of its model
    make: Callable[[], Detector]  # A new one for every video and condition, in any process
    keep: DetectionFilter = field(default_factory=any_motion)  # Which of its boxes count


def motion_detectors() -> tuple[StagedDetector, ...]:
    """Return background subtraction by mixtures and by neighbours, which need no model."""
    kinds: tuple[Background, ...] = ("mog2", "knn")
    return tuple(StagedDetector(kind, partial(MotionDetector, kind)) for kind in kinds)


def look(
    video: Video,
    detectors: Sequence[StagedDetector],
    rng: np.random.Generator,
    width_px: int,
    conditions: Sequence[Condition] = camera_conditions(),
) -> dict[str, HopTable]:
    """Decode once, degrade once a condition, and ask every detector.

    One table a detector holds its boxes in pixels of OVAD's camera, and `READINGS` the quality of the images.
    """
    makers = {(one.name, state): one.make() for one in detectors for state in conditions}
    boxes: dict[str, list[tuple[object, ...]]] = {one.name: [] for one in detectors}
    readings: list[tuple[object, ...]] = []
    rate_hz, number = video.frame_rate_hz, -1
    period = max(round(HEALTH_PERIOD_S * rate_hz), 1)
    with _one_opencv_thread():
        for number, frame in enumerate(video.frames()):
            small = _reduced(frame, width_px)
            for state in conditions:
                staged = state.stage(small, rng, frame.shape[1] / small.shape[1])
                for name, rows in boxes.items():
                    found = makers[name, state].detect(staged)
                    rows += ((state.name, number, *box) for box in _reported(found, small))
                if number % period == 0:
                    quality = image_quality(state.stage(_centre(frame), rng))
                    readings.append((state.name, number / rate_hz, *_measures(quality)))
    about = {"frames": number + 1, "frame_rate_hz": rate_hz}
    tables = {name: HopTable.of_rows(_BOX_COLUMNS, rows).replace(about=about) for name, rows in boxes.items()}
    return {**tables, READINGS: HopTable.of_rows(_READING_COLUMNS, readings)}


def _reported(found: DetectionFrame, image: ImageArray) -> Iterator[tuple[FloatArray, float, str]]:
    """Yield the boxes in pixels of OVAD's camera, whatever the size of the image."""
    height, width = image.shape[:2]
    whole = PinholeCamera()
    scale = np.array([whole.width_px / width, whole.height_px / height] * 2)
    return zip(found.boxes_px * scale, found.scores.tolist(), found.labels, strict=True)


def _measures(quality: ImageQuality) -> tuple[float, float, float]:
    sharpness = np.nan if quality.sharpness is None else quality.sharpness
    return quality.brightness, quality.noise, sharpness


def detections_in(looks: HopTable, condition: str) -> DetectionLog:
    """Return what a detector reported in one condition, empty images included."""
    n = int(looks.about["frames"])
    chosen = looks.condition == condition
    # An empty column has no shape of its own, and no text in it.
    boxes, scores = looks.box_px[chosen].reshape(-1, 4), looks.score[chosen]
    labels = looks.class_name[chosen].tolist()
    edges = np.searchsorted(looks.frame[chosen], np.arange(n + 1)).tolist()
    frames = [DetectionFrame(boxes[a:b], scores[a:b], tuple(labels[a:b])) for a, b in pairwise(edges)]
    return DetectionLog.at_rate(frames, float(looks.about["frame_rate_hz"]), source=f"{condition} camera")


def health_of(readings: Sequence[HopTable]) -> CameraHealth:
    """Return the scale of d that the images of several recordings give."""
    levels = range(len(LEVELS))
    noise = [_measured(readings, at_level("noise", level), "noise") for level in levels]
    sharpness = [_measured(readings, at_level("blur", level), "sharpness") for level in levels]
    brightness = _measured(readings, Condition(CLEAN), "brightness")
    return health_scale(brightness, np.stack(sharpness, axis=1), np.stack(noise, axis=1))


def degradation_in(readings: HopTable, condition: str, rates: MissRates) -> DegradationLog:
    """Return d as the camera's own images show it, without what is staged."""
    if rates.health is None:
        raise InvalidArgumentError("rates: expected miss rates with the camera's scale of health")
    monitor, chosen = HealthMonitor(rates.health), readings.condition == condition
    stamps_ns = [nanoseconds(time_s) for time_s in readings.time_s[chosen].tolist()]
    columns = (readings.columns[name][chosen].tolist() for name in _READING_COLUMNS[2:])
    levels = [
        rates.level(monitor.update(stamp_ns, ImageQuality(bright, noise, None if np.isnan(sharp) else sharp)))
        for stamp_ns, bright, noise, sharp in zip(stamps_ns, *columns, strict=True)
    ]
    return DegradationLog(np.array(stamps_ns, dtype=np.int64), np.array(levels))


def _measured(readings: Sequence[HopTable], condition: Condition, name: str) -> FloatArray:
    return np.concatenate([one.columns[name][one.condition == condition.name] for one in readings])


def _reduced(frame: ImageArray, width_px: int) -> ImageArray:
    """Reduce an image as detectors do, once for all of them."""
    height, width = frame.shape[:2]
    if width <= width_px:
        return frame
    size = (width_px, max(round(height * width_px / width), 1))
    cv2 = optional("cv2")
    reduced: ImageArray = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
    return reduced


def _centre(frame: ImageArray) -> ImageArray:
    """Return the part of an image that its quality is read from, in the colour that it is read in."""
    side = LARGEST_PX + 2 * _MARGIN_PX
    top, left = (max((length - side) // 2, 0) for length in frame.shape[:2])
    return np.ascontiguousarray(frame[top : top + side, left : left + side, 1])


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    """Keep OpenCV on the calling thread: recordings are what is worked on side by side."""
    cv2 = optional("cv2")
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
