"""Detections by image: the interface of a detector; OVAD, COCO, YOLO and MOTChallenge files."""

import logging
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np

from worldstate.adapters.files.file_io import in_order, read_text, refused_as_file
from worldstate.ground import InputFileError, InvalidArgumentError, in_range, nanoseconds
from worldstate.ground.checks import check_shape
from worldstate.ground.serialisation import Check, Count, Probability, Via, decode, decode_items, decode_json
from worldstate.ground.typing import BoolArray, FloatArray, ImageArray, IntArray

from .class_names import COCO_CATEGORIES, ROAD_USERS, YOLO_NAMES, class_name

_LOG = logging.getLogger(__name__)
MAX_BYTES = 64 << 20
MAX_FRAMES, MAX_BOXES = 250_000, 1_000_000  # Two hours at 30 images per second
MAX_BOXES_A_FRAME = 1000
MAX_FRAME_RATE_HZ = 1000.0
# Detectors round boxes outwards: boxes this far beyond the border are not clipped.
BORDER_PX = 1.0
# Images per second if neither their stamps nor the user give it: OVAD's rate.
IMAGE_RATE_HZ = 10.0
# At 47,998 Hz a decision is up to half a sample (10 us) before the frame that it belongs to.
STAMP_SLACK_NS = 1_000_000
# The road users among the eighty classes of YOLO text.
YOLO_CLASSES: Mapping[int, str] = {i: name for i, name in enumerate(YOLO_NAMES) if name in ROAD_USERS}
# Classes of MOTChallenge's ground truth; -1 marks a missing value.
MOT_CLASSES: Mapping[float, str] = {
    -1: "car", 1: "person", 2: "rider", 3: "car", 4: "bicycle", 5: "motorcycle", 6: "cart without a motor",
    7: "person",
}  # fmt: skip
MAX_TEXT_BYTES = 1 << 20  # Limit for one frame in YOLO text
# Roboflow appends a hash of the image to its name.
_HASH = re.compile(r"(_(jpe?g|png|bmp|webp|tiff?|gif))?\.rf\.\w+$", re.IGNORECASE)
_NUMBERED = re.compile(r"(?!-\d+$)(.*?)(\d{1,19})", re.ASCII)
# Files that exporters write beside labels.
_NO_LABELS = frozenset({"classes.txt", "README.txt", "README.dataset.txt", "README.roboflow.txt"})
# Other names for the time of an image.
_TIMES = {f"{name}{unit}" for name in ("stamp", "timestamp", "time") for unit in ("", "_s", "_ms", "_us")}
_PER_FRAME = re.compile(r'"detections_per_frame"\s*:\s*\[')
_FORMS = "`worldstate run --help` lists the forms that detections may have"
# Car and bus if categories start at 0 as in YOLO, bicycle and airplane if they start at 1 as in COCO.
_UNSURE = frozenset({"2", "5"})
# Fewer numbers than these may have a common step by chance.
_LEAST_NUMBERS = 3

# A box is parked if a box had the same edges, within these pixels, in this share of the images of these
# seconds; the share is below 1 because detectors miss some images.
PARKED_S, PARKED_PX, PARKED_SHARE = 1.0, 5.0, 0.8
# Image height for which the minimum height of a box and these pixels were chosen.
OVAD_HEIGHT_PX = 1216.0
Row = tuple[tuple[float, float, float, float], float, str]
# Beyond any image; the sum of two such numbers is finite.
MAX_NUMBER = 1e9
Place = Annotated[float, Check("a number below 1e9", lambda value: abs(value) < MAX_NUMBER)]
Extent = Annotated[float, Check("a number in [0, 1e9)", lambda value: 0.0 <= value < MAX_NUMBER)]


def _name(value: object) -> str:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"expected a name or a number, got {value!r:.40}")
    return f"{value:g}" if isinstance(value, float) else str(value)


def _array(values: Any) -> FloatArray:
    """Return numbers as an array, also from a tensor in the memory of an accelerator."""
    return np.asarray(values.cpu() if hasattr(values, "cpu") else values, dtype=np.float64)


# Name of a class, category or image; some files use numbers as names.
Name = Annotated[str, Via(object, _name, _name)]


@dataclass(frozen=True, slots=True, eq=False)
class DetectionFrame:
    """All boxes of one image.

    Parameters
    ----------
    boxes_px : ndarray
        Shape (n, 4): left, top, right, bottom; pixels from the upper left corner.
    scores : ndarray
        Shape (n,), in [0, 1].
    labels : tuple of str
        n class names of the detector.

    Raises
    ------
    InvalidArgumentError
        If a shape is wrong, a box is inverted, a score is out of range, or a number is NaN.

    Examples
    --------
    >>> frame = DetectionFrame(np.array([[10.0, 20.0, 60.0, 140.0]]), np.array([0.9]), ("car",))
    >>> len(frame), frame.select(DetectionFilter()), frame.select(DetectionFilter(min_height_px=200))
    (1, array([0]), array([], dtype=int64))
    """

    boxes_px: FloatArray
    scores: FloatArray
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.labels)
        for name, shape in (("boxes_px", (n, 4)), ("scores", (n,))):
            numbers = np.asarray(getattr(self, name), dtype=np.float64)
            numbers = numbers if n or numbers.size else numbers.reshape(shape)
            check_shape(name, numbers.shape, shape)
            object.__setattr__(self, name, numbers)
        object.__setattr__(self, "labels", tuple(self.labels))
        left, top, right, bottom = self.boxes_px.T
        # This form refuses NaN, for which every comparison is false.
        fit = (left <= right) & (top <= bottom) & (self.scores >= 0.0) & (self.scores <= 1.0)
        if not fit.all():
            first = int(np.argmin(fit))
            got = f"{self.boxes_px[first].tolist()} with {self.scores[first]:g}"
            problem = "expected x1 <= x2, y1 <= y2 (corners, no width and height) and scores in [0, 1]"
            raise InvalidArgumentError(f"boxes[{first}]: {problem}, got {got}")

    @classmethod
    def of(cls, found: Any) -> "DetectionFrame | None":
        """Return the boxes of one image from the result of a detector; None for an unknown type.

        Known types are `DetectionFrame`, supervision's `Detections` and ultralytics' `Results`, which are
        recognised by their attributes, and a list of one of them, as a model of ultralytics returns. Boxes
        without scores get the score 1.

        Raises
        ------
        InvalidArgumentError
            If boxes have no class names or are invalid.

        Examples
        --------
        >>> from types import SimpleNamespace
        >>> boxes, scores = np.array([[10.0, 20.0, 60.0, 140.0]]), np.array([0.9])
        >>> of_supervision = SimpleNamespace(xyxy=boxes, confidence=scores, data={"class_name": ["car"]})
        >>> DetectionFrame.of(of_supervision).labels
        ('car',)
        """
        if isinstance(found, list) and len(found) == 1:
            found = found[0]
        if isinstance(found, cls):
            return found
        if hasattr(found, "boxes") and hasattr(found, "names"):
            if found.boxes is None:
                raise InvalidArgumentError("boxes: expected the result of a detection model, got none")
            corners, scores, numbers = map(_array, (found.boxes.xyxy, found.boxes.conf, found.boxes.cls))
            labels = [str(found.names[int(number)]) for number in numbers]
        elif hasattr(found, "xyxy") and hasattr(found, "confidence"):
            corners, scores = _array(found.xyxy), found.confidence
            scores = np.ones(len(corners)) if scores is None else _array(scores)
            labels = [str(label) for label in getattr(found, "data", {}).get("class_name", ())]
            if len(labels) != len(corners):
                got = f"{len(labels)} for {len(corners)} boxes"
                raise InvalidArgumentError(f'data["class_name"]: expected a name for each box, got {got}')
        else:
            return None
        return cls(corners, scores, tuple(labels))

    def __len__(self) -> int:
        return len(self.labels)

    def cut(self, size_px: tuple[int, int]) -> tuple["DetectionFrame", int]:
        """Return the boxes clipped to an image, and the number of boxes that extend beyond it or are outside.

        Examples
        --------
        >>> boxes = np.array([[500.0, 20.0, 645.0, 140.0], [700.0, 20.0, 760.0, 140.0]])
        >>> frame, beyond = DetectionFrame(boxes, np.array([0.9, 0.8]), ("car", "car")).cut((640, 480))
        >>> frame.boxes_px.tolist(), beyond
        ([[500.0, 20.0, 640.0, 140.0]], 2)
        """
        within: FloatArray = np.clip(self.boxes_px, 0.0, np.tile(size_px, 2))
        beyond: BoolArray = np.any(np.abs(self.boxes_px - within) > BORDER_PX, axis=1)
        if not beyond.any():
            return self, 0
        there = (self.boxes_px[:, 2:] > 0.0) & (self.boxes_px[:, :2] < size_px)
        kept = np.flatnonzero(~beyond | there.all(axis=1))
        boxes = np.where(beyond[:, None], within, self.boxes_px)[kept]
        frame = DetectionFrame(boxes, self.scores[kept], tuple(self.labels[i] for i in kept))
        return frame, int(beyond.sum())

    def select(self, keep: "DetectionFilter") -> IntArray:
        """Return the indices of the boxes that pass the filter `keep`."""
        heights_px = self.boxes_px[:, 3] - self.boxes_px[:, 1]
        named = np.array([class_name(label) in keep.labels for label in self.labels], dtype=bool)
        high = heights_px > keep.min_height_px * keep.scale
        return np.flatnonzero(named & (self.scores >= keep.min_score) & high)


@dataclass(frozen=True, slots=True)
class DetectionFilter:
    """Filter for the boxes that are used; the defaults are those of the authors of OVAD.

    Parameters
    ----------
    labels : collection of str
        Classes of road users, in the words of any data set (`class_name`).
    min_score : float
        Lowest score, in [0, 1].
    min_height_px : float
        Boxes must be higher than this in an image of OVAD's height, 1216 pixels, which excludes distant ones;
        it scales with the image.
    image_height_px : float
        Height of the images of the boxes.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> sorted(DetectionFilter().labels)
    ['car', 'motorcycle']
    """

    labels: Collection[str] = frozenset({"car", "motorcycle"})
    min_score: float = 0.75
    min_height_px: float = 100.0
    image_height_px: float = OVAD_HEIGHT_PX

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", frozenset(map(class_name, self.labels)))
        in_range("image_height_px", self.image_height_px, 0.0, math.inf, open_low=True)
        in_range("min_score", self.min_score, 0.0, 1.0)
        in_range("min_height_px", self.min_height_px, 0.0, math.inf)

    @property
    def scale(self) -> float:
        """Height of the images relative to OVAD's."""
        return self.image_height_px / OVAD_HEIGHT_PX


@dataclass(frozen=True, slots=True, eq=False)
class DetectionLog:
    """Frames of one camera in order of time.

    Parameters
    ----------
    frames : tuple of DetectionFrame
        One per image, empty ones included: an image without boxes was searched.
    stamps_ns : ndarray
        Shape (n,), int64, strictly increasing, nanoseconds on the stream's clock.
    source : str
        Origin for messages: the name of the file.
    counted_hz : float or None
        Images per second, if they carry no stamp and are numbered from the first sample of the sound.
    assumed : bool
        Whether that rate is a default.

    Raises
    ------
    InvalidArgumentError
        If the lengths differ or the stamps are not in order.

    Examples
    --------
    >>> empty = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    >>> log = DetectionLog.at_rate([empty] * 30, frame_rate_hz=10.0)
    >>> log.latest(1_040_000_000, max_age_ns=150_000_000), log.latest(9_000_000_000, max_age_ns=150_000_000)
    (10, None)
    """

    frames: tuple[DetectionFrame, ...]
    stamps_ns: IntArray
    source: str = "detections"
    counted_hz: float | None = None
    assumed: bool = False

    def __post_init__(self) -> None:
        if len(self.frames) != len(self.stamps_ns):
            got = f"{len(self.stamps_ns)} stamps for {len(self.frames)} frames"
            raise InvalidArgumentError(f"stamps_ns: expected one per frame, got {got}")
        backward = np.flatnonzero(np.diff(self.stamps_ns) <= 0)
        if backward.size:
            where = f"frame {backward[0] + 1} is not later than frame {backward[0]}"
            raise InvalidArgumentError(f"stamps_ns: expected increasing time stamps, {where}")

    @classmethod
    def at_rate(
        cls,
        frames: Collection[DetectionFrame],
        frame_rate_hz: float | None,
        source: str = "detections",
        numbers: Sequence[int] | None = None,
    ) -> "DetectionLog":
        """Stamp frame i with i / rate, or its number / rate, from the start of the recording.

        Without a rate it is 10, which is then compared with the length of the sound.

        Raises
        ------
        InvalidArgumentError
            If the rate is not above 0 and at most 1000.
        """
        rate_hz = _rate_hz(frame_rate_hz)
        stamps = [nanoseconds(i / rate_hz) for i in (range(len(frames)) if numbers is None else numbers)]
        return cls(tuple(frames), np.array(stamps, dtype=np.int64), source, rate_hz, frame_rate_hz is None)

    @classmethod
    def in_order(
        cls, frames: Sequence[DetectionFrame], stamps_ns: Sequence[int], source: str = "detections"
    ) -> "DetectionLog":
        """Sort images by stamp; of several with one stamp the last is used, with a warning.

        Examples
        --------
        >>> empty = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
        >>> DetectionLog.in_order([empty] * 3, [200, 100, 200]).stamps_ns.tolist()
        [100, 200]
        """
        places = in_order(stamps_ns, source)
        stamps = np.array([stamps_ns[i] for i in places], dtype=np.int64)
        return cls(tuple(frames[i] for i in places), stamps, source)

    def __len__(self) -> int:
        return len(self.frames)

    def shifted(self, offset_s: float) -> "DetectionLog":
        """Return the same frames with stamps later by an offset, seconds."""
        return replace(self, stamps_ns=self.stamps_ns + nanoseconds(offset_s))

    def on_clock(self, start_ns: int, offset_s: float) -> "DetectionLog":
        """Return the log on the clock of a sound with this start: stamps are shifted by the camera's offset.

        Examples
        --------
        >>> empty = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
        >>> DetectionLog.at_rate([empty] * 2, 10.0).on_clock(7_000_000_000, 0.5).stamps_ns.tolist()
        [7500000000, 7600000000]
        """
        counted_from_ns = 0 if self.counted_hz is None else start_ns
        return replace(self, stamps_ns=self.stamps_ns + counted_from_ns).shifted(offset_s)

    def latest(self, stamp_ns: int, max_age_ns: int) -> int | None:
        """Return the number of the last frame at or before `stamp_ns`, None if it is too old or missing."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns + STAMP_SLACK_NS, side="right")) - 1
        return None if index < 0 or stamp_ns - int(self.stamps_ns[index]) > max_age_ns else index

    def left_out(self, frame: int, keep: DetectionFilter) -> IntArray:
        """Return the indices of the moving boxes of an image that are unused; score 0 does not count.

        Examples
        --------
        >>> low = DetectionFrame(np.array([[10.0, 20.0, 60.0, 140.0]]), np.array([0.5]), ("car",))
        >>> DetectionLog.at_rate([low], 10.0).left_out(0, DetectionFilter())
        array([0])
        """
        here = self.frames[frame]
        others = np.setdiff1d(np.flatnonzero(here.scores > 0.0), here.select(keep))
        return others[~parked(self, frame, here.boxes_px[others], keep.scale)]


def _rate_hz(stated: float | None) -> float:
    rate_hz = IMAGE_RATE_HZ if stated is None else stated
    return in_range("frame_rate_hz", rate_hz, 0.0, MAX_FRAME_RATE_HZ, open_low=True)


def parked(log: DetectionLog, frame: int, boxes_px: FloatArray, scale: float = 1.0) -> BoolArray:
    """Return which boxes (n, 4) of an image are parked, from that image and earlier ones, shape (n,).

    The camera must stand: in images of a moving camera every box moves, and none is parked. `scale` is the
    height of the images relative to OVAD's.
    """
    since_ns = int(log.stamps_ns[frame]) - nanoseconds(PARKED_S)
    past = log.frames[int(np.searchsorted(log.stamps_ns, since_ns - STAMP_SLACK_NS)) : frame]
    # Most images of a hidden approach are empty, and this runs several times per hop.
    if not past or not len(boxes_px) or log.stamps_ns[0] > since_ns + STAMP_SLACK_NS:
        return np.zeros(len(boxes_px), dtype=bool)
    apart_px = (np.abs(boxes_px[:, None] - earlier.boxes_px[None]).max(axis=2) for earlier in past)
    present = [(apart <= PARKED_PX * scale).any(axis=1) for apart in apart_px]
    return np.asarray(np.mean(present, axis=0) >= PARKED_SHARE)


def kept_and_parked(log: DetectionLog, frame: int, keep: DetectionFilter) -> tuple[IntArray, BoolArray]:
    """Return the indices of the boxes of an image that are used, and which of those are parked."""
    here = log.frames[frame]
    kept = here.select(keep)
    return kept, parked(log, frame, here.boxes_px[kept], keep.scale)


COUNTS_TOLD = (
    "{frames} images were looked at, {empty} of them without a box; {counted} of {boxes} boxes count; "
    "{other_class} of another class, {low_score} below the score, {too_small} too small, {parked} parked"
)


def told_counts(counts: Mapping[str, int]) -> str:
    """Return the numbers of boxes in words."""
    none = counts["boxes"] and not counts["counted"] + counts["parked"]
    return COUNTS_TOLD.format(**counts) + ("; none counts: the camera is impaired" if none else "")


def count_boxes(log: DetectionLog, keep: DetectionFilter) -> dict[str, int]:
    """Count the boxes of a log by the first reason that applies to each."""
    looser = replace(keep, min_score=0.0, min_height_px=0.0), replace(keep, min_height_px=0.0), keep
    named, scored, high = (sum(len(frame.select(one)) for frame in log.frames) for one in looser)
    boxes = sum(map(len, log.frames))
    still = sum(int(kept_and_parked(log, i, keep)[1].sum()) for i in range(len(log)))
    apart = {"other_class": boxes - named, "low_score": named - scored, "too_small": scored - high}
    looks = {"frames": len(log), "empty": sum(not len(frame) for frame in log.frames)}
    return looks | {"boxes": boxes, "counted": high - still, **apart, "parked": still}


class Detector(Protocol):
    """Detector of objects in images in order of time.

    A detector may have a state, such as the background of a motion detector; each video needs a new one.

    Examples
    --------
    >>> class Blind:
    ...     def detect(self, frame): return DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    >>> detector: Detector = Blind()
    >>> len(detector.detect(np.zeros((4, 4, 3), dtype=np.uint8)))
    0
    """

    def detect(self, frame: ImageArray, /) -> DetectionFrame:
        """Return the detections in one image.

        Parameters
        ----------
        frame : ndarray of uint8, shape (height, width, 3)
            Image in the order blue, green, red.

        Returns
        -------
        DetectionFrame
            Boxes in pixels, scores in [0, 1], labels.
        """


def read_detections(path: str | Path, frame_rate_hz: float | None = None) -> DetectionLog:
    """Read per-frame detections in OVAD's JSON.

    ``{"detections_per_frame": [{"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...]},
    ...]}``; other keys are ignored. A detector of your own may add ``"stamp_ns"`` to every frame; without it
    frame i has the time i / `frame_rate_hz` from the start of the recording.

    Parameters
    ----------
    path : str or Path
        The file; at most 64 MiB, 250,000 frames, 1000 boxes per frame.
    frame_rate_hz : float, optional
        Frames per second if the frames carry no stamp; 10 by default.

    Returns
    -------
    DetectionLog
        Every box, unfiltered.

    Raises
    ------
    InputFileError
        If the file is missing, too large or not JSON, if keys are missing or types wrong, if lengths differ,
        if numbers are not finite, boxes inverted or scores outside [0, 1]; the message gives file and frame.
    InvalidArgumentError
        If the rate is not above 0 and at most 1000.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "camera_baseline_results.json"
    ...     frame = '{"boxes": [[10, 20, 60, 140]], "scores": [0.9], "classes_str": ["car"]}'
    ...     _ = name.write_text('{"detections_per_frame": [' + frame + "]}")
    ...     read_detections(name).frames[0].labels
    ('car',)
    """
    name = Path(path)
    _rate_hz(frame_rate_hz)  # Before a long file is read
    return _ovad_log(name, read_text(name, "a detections file", MAX_BYTES), frame_rate_hz)


def _ovad_log(name: Path, text: str, frame_rate_hz: float | None) -> DetectionLog:
    frames, stamps = list[DetectionFrame](), list[int | None]()

    def take(row: object) -> None:
        if not frames and isinstance(row, dict) and "stamp_ns" not in row and _TIMES & {*row}:
            expected = 'expected times as "stamp_ns", whole nanoseconds'
            raise InvalidArgumentError(f"frame 0: {expected}, got {sorted(_TIMES & {*row})}")
        read = decode(_OvadFrame, row, f"frame {len(frames)}")
        frames.append(read.frame())
        stamps.append(read.stamp_ns)

    with refused_as_file(name):
        found, end = _PER_FRAME.search(text), 0
        if found is not None:
            end = decode_items(text, found.end() - 1, take, "frame")
            text = f"{text[: found.end()]}{text[end - 1 :]}"
        document = decode_json(text, "a detections file")
        rows = document.get("detections_per_frame") if isinstance(document, dict) else None
        if not isinstance(rows, list) or len(frames) > MAX_FRAMES:
            problem = f"expected an object with a list of at most {MAX_FRAMES} frames in detections_per_frame"
            raise InvalidArgumentError(f"{problem}; {_FORMS}")
    stamped = [stamp for stamp in stamps if stamp is not None]
    if not stamped:
        return DetectionLog.at_rate(frames, frame_rate_hz, source=str(name))
    if len(stamped) < len(stamps):
        raise InputFileError(name, f"frame {stamps.index(None)}: expected stamp_ns, as in other frames")
    return DetectionLog.in_order(frames, stamped, str(name))


@dataclass(frozen=True, slots=True)
class _OvadFrame:
    """Record of one image in OVAD's file."""

    boxes: FloatArray
    scores: FloatArray
    classes_str: tuple[str, ...]
    stamp_ns: Count | None = None

    def __post_init__(self) -> None:
        if not len(self.boxes) == len(self.scores) == len(self.classes_str) <= MAX_BOXES_A_FRAME:
            got = f"{len(self.boxes)} boxes, {len(self.scores)} scores, {len(self.classes_str)} classes_str"
            raise InvalidArgumentError(f"expected as many of each, at most {MAX_BOXES_A_FRAME}, got {got}")
        self.frame()  # Refuses invalid boxes

    def frame(self) -> DetectionFrame:
        return DetectionFrame(self.boxes, self.scores, self.classes_str)


def frame_of(record: object, where: str) -> DetectionFrame:
    """Return the boxes of one image from OVAD's record; `where` is its place for messages."""
    return decode(_OvadFrame, record, where).frame()


@dataclass(frozen=True, slots=True)
class _CocoResult:
    """One box of a COCO results file."""

    image_id: Name
    category_id: Name
    bbox: tuple[Place, Place, Extent, Extent]
    score: Probability | None = None  # Labels have no score


@dataclass(frozen=True, slots=True)
class _CocoId:
    """An image, or a category with its name."""

    id: Name
    name: str | None = None
    file_name: str | None = None
    width: int | None = None
    height: int | None = None


@dataclass(frozen=True, slots=True)
class _CocoFile:
    """Results, and the searched images."""

    annotations: tuple[_CocoResult, ...]
    images: tuple[_CocoId, ...] | None = None
    categories: tuple[_CocoId, ...] | None = None

    def __post_init__(self) -> None:
        boxes, images = len(self.annotations), len(self.images or ())
        if boxes > MAX_BOXES or images > MAX_FRAMES:
            problem = f"expected at most {MAX_BOXES} boxes and {MAX_FRAMES} images"
            raise InvalidArgumentError(f"{problem}, got {boxes} and {images}")


def read_any_detections(
    path: str | Path,
    frame_rate_hz: float | None = None,
    size_px: tuple[int, int] | None = None,
    n_images: int | None = None,
) -> DetectionLog:
    """Read detections in any supported form.

    A folder contains YOLO text; a ``.txt`` file is MOTChallenge text; a JSON list is COCO results; a JSON
    object with ``"images"`` is COCO results with the searched images; another object has OVAD's detections
    per frame. An image without a box was searched and is empty. COCO results and text do not list the images
    after the last box.

    Parameters
    ----------
    path : str or Path
        File or folder.
    frame_rate_hz : float, optional
        Frames per second if the frames carry no stamp; 10 by default.
    size_px : tuple of int, optional
        Width and height of the image; coordinates in YOLO text are shares of them.
    n_images : int, optional
        Number of searched images, if COCO results or text do not list them.

    Returns
    -------
    DetectionLog
        In order of time.

    Raises
    ------
    InputFileError
        As the reader of that form; if YOLO text is read without a size, or if `n_images` is given for a file
        that lists its images.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, "000000.txt").write_text("2 0.5 0.5 0.1 0.2 0.9")
    ...     log = read_any_detections(folder, size_px=(640, 480))
    >>> log.frames[0].labels, log.frames[0].boxes_px.tolist()
    (('car',), [[288.0, 192.0, 352.0, 288.0]])
    """
    name = Path(path)
    if name.is_dir():
        if size_px is None:
            raise InputFileError(name, "expected the size of the image beside YOLO text")
        return read_yolo_text(name, size_px, frame_rate_hz, n_images)
    if name.suffix.lower() == ".txt":
        return read_mot_text(name, frame_rate_hz, n_images)
    text = read_text(name, "a detections file", MAX_BYTES)
    if _PER_FRAME.search(text) is not None:
        if n_images is not None:
            raise InputFileError(name, "expected no number of images (n_images): the file has every image")
        return _ovad_log(name, text, frame_rate_hz)
    try:
        with refused_as_file(name):
            of_list = text.lstrip().startswith("[")
            read = _results(text) if of_list else decode(_CocoFile, decode_json(text, "a file"), "COCO")
            return _coco_log(name, read, frame_rate_hz, n_images, size_px)
    except InputFileError as error:
        raise InputFileError(error.path, f"{error.problem}; {_FORMS}") from error


def _results(text: str) -> "_CocoFile":
    """Return the content of a list of COCO results, read one by one."""
    found = list[_CocoResult]()

    def take(item: object) -> None:
        found.append(decode(_CocoResult, item, f"COCO.annotations[{len(found)}]"))
        if len(found) > MAX_BOXES:
            raise InvalidArgumentError(f"expected at most {MAX_BOXES} boxes")

    if rest := text[decode_items(text, text.index("["), take, "COCO.annotations") :].strip():
        raise InvalidArgumentError(f"expected JSON, got {rest:.20} behind a list")
    return _CocoFile(tuple(found))


def _coco_log(
    path: Path,
    read: _CocoFile,
    frame_rate_hz: float | None,
    n_images: int | None,
    size_px: tuple[int, int] | None,
) -> DetectionLog:
    """Return the log of COCO results, or of an object of ``"images"`` and results as ``"annotations"``.

    A result is ``{"image_id", "category_id", "bbox": [x, y, w, h], "score"}``; image i has the time i / rate
    from the start, and a missing score is 1. Images whose ids start at 1, are arbitrary or are names are
    ordered by the numbers at the end of their ``"file_name"`` or id; a listed size must equal `size_px`.
    Categories without names are COCO's, which start at 1, or YOLO's if one is 0.
    """
    listed, images = read.images is not None, read.images
    if images is None:
        images = tuple(map(_CocoId, {one.image_id: 0 for one in read.annotations}))
    for one in images:
        if size_px is not None and (one.width or size_px[0], one.height or size_px[1]) != size_px:
            expected = f"expected images of the camera's {size_px[0]} x {size_px[1]} px"
            way_on = "width_px and height_px of the camera are those of its images"
            raise InvalidArgumentError(f"{expected}, got {one.width} x {one.height}: {way_on}")
    numbers, names = _image_numbers(images, listed=listed), _category_names(read)
    rows: dict[int, list[Row]] = {number: [] for number in numbers.values()} if listed else {}
    for result in read.annotations:
        if result.image_id not in numbers:
            raise InvalidArgumentError(f"expected the images of all boxes listed, {result.image_id} is not")
        left, top, width, height = result.bbox
        label = names.get(result.category_id, result.category_id)
        row = (left, top, left + width, top + height), 1.0 if result.score is None else result.score, label
        rows.setdefault(numbers[result.image_id], []).append(row)
    if unscored := sum(one.score is None for one in read.annotations):
        _LOG.warning("%s: %d boxes without a score count with 1.0", path, unscored)
    if listed and n_images is not None:
        raise InputFileError(path, "expected no number of images (n_images): the file lists its images")
    return _log(path, rows, frame_rate_hz, sorted(rows) if listed else n_images)


def _category_names(read: _CocoFile) -> dict[str, str]:
    """Return the names of categories by their ids: as listed, else COCO's, or YOLO's if one id is 0."""
    if read.categories is not None:
        return {one.id: one.name for one in read.categories if one.name is not None}
    used = {one.category_id for one in read.annotations}
    if "0" in used:
        return {str(i): name for i, name in enumerate(YOLO_NAMES)}
    # Without a car the two numberings cannot be separated.
    unsure = {} if "3" in used else {one: f"category {one}" for one in _UNSURE}
    return {str(i): name for i, name in COCO_CATEGORIES.items()} | unsure


def _image_numbers(images: Sequence[_CocoId], *, listed: bool) -> dict[str, int]:
    """Return the image number of each id, from the start."""
    if not images:
        return {}
    ids = image_numbers([one.id for one in images])
    numbers = image_numbers([one.file_name or one.id for one in images])
    if ids is not None and (numbers is None or 0 in ids or numbers == ids):
        first = _first(ids) if listed else 0
        return {one.id: number - first for one, number in zip(images, ids, strict=True)}
    if numbers is None:
        some = ", ".join(one.id for one in images[:2])
        expected = 'expected different ids that end in a number, or "images" with such a "file_name"'
        raise InvalidArgumentError(f"{expected}, got {some:.80}")
    places = {number: place for place, number in enumerate(sorted(numbers))}
    # A list with gaps contains only some images of a video; its numbers are those of the images in the video,
    # or times.
    whole = len(_between(numbers)) == len(images) or max(numbers) >= MAX_FRAMES
    return {one.id: places[n] if whole else n for one, n in zip(images, numbers, strict=True)}


def _first(numbers: Collection[int]) -> int:
    """Return the number of the first image: 1 if all are listed and start at 1, as in COCO."""
    return int(sorted(numbers) == [*range(1, len(numbers) + 1)])


def image_numbers(names: Sequence[str]) -> list[int] | None:
    """Return the numbers at the end of image names; None if they form no sequence.

    In a sequence one name precedes all numbers, and no number is repeated. Suffixes of Roboflow are ignored.

    Examples
    --------
    >>> image_numbers(["cam_0002_jpg.rf.4f1e77aa0b3c.jpg", "cam_0010_jpg.rf.08c5d2219e7f.jpg"])
    [2, 10]
    >>> image_numbers(["4f1e77aa0b3c.txt", "08c5d2219e71.txt"]) is None
    True
    """
    matches = [_NUMBERED.fullmatch(_HASH.sub("", Path(name).stem)) for name in names]
    found = [(match[1], int(match[2])) for match in matches if match is not None]
    sequence = len(set(found)) == len(names) and len({before for before, _ in found}) == 1
    return [number for _, number in found] if sequence else None


def _between(numbers: Collection[int]) -> range:
    """Return the numbers from the first to the last in the largest steps that reach all of them."""
    first, last = min(numbers), max(numbers)
    return range(first, last + 1, math.gcd(*(number - first for number in numbers)) or 1)


def read_yolo_text(
    path: str | Path,
    size_px: tuple[int, int],
    frame_rate_hz: float | None = None,
    n_images: int | None = None,
) -> DetectionLog:
    """Read a folder of YOLO text: ``street_17.txt`` has lines ``class x y w h [score]`` in image units."""
    folder = Path(path)
    files = sorted(file for file in folder.glob("*.txt") if file.name not in _NO_LABELS)
    # The classes of the numbers: those listed beside the text, else COCO's.
    listed = folder / "classes.txt"
    known = read_text(listed, "a text file", MAX_TEXT_BYTES).split("\n") if listed.exists() else YOLO_NAMES
    names, numbers = dict(enumerate(known)), image_numbers([file.name for file in files[: MAX_FRAMES + 1]])
    if numbers is None or len(files) > MAX_FRAMES:
        some = ", ".join(file.name for file in files[:2]) or "none"
        expected = f"1 to {MAX_FRAMES} files of one name with the number of their image behind it"
        way_on = 'name them so, or list "images" with "file_name" in a COCO object'
        raise InputFileError(folder, f"expected {expected} (street_000017.txt), got {some:.120}: {way_on}")
    rows: dict[int, list[Row]] = {}
    for file, number in zip(files, numbers, strict=True):
        with refused_as_file(file):
            lines = read_text(file, "a text file", MAX_TEXT_BYTES).splitlines()
            rows[number] = [_yolo_row(line, size_px, names) for line in lines if line.strip()]
    # If some files are empty, or the names are those of an exported data set, a file was written for every
    # searched image. Images without a file were then not searched.
    if n_images is None and (not all(rows.values()) or any(_HASH.search(file.stem) for file in files)):
        first = _first(rows)
        rows = {number - first: found for number, found in rows.items()}
        return _log(folder, rows, frame_rate_hz, sorted(rows))
    return _log(folder, rows, frame_rate_hz, n_images)


def _yolo_row(line: str, size_px: tuple[int, int], names: Mapping[int, str]) -> Row:
    name, *numbers = line.split()
    expected = "class x y w h [score] with w, h >= 0 and the score in [0, 1]"
    problem = f"expected {expected}, got {line!r:.60}"
    try:
        x, y, width, height, score = map(float, numbers if len(numbers) == 5 else [*numbers, "1"])
    except ValueError as error:
        raise InvalidArgumentError(problem) from error
    named = name.isascii() and name.isdecimal() and len(name) < 6
    if not (named and _in_bounds(x, y, width, height, score)):
        raise InvalidArgumentError(problem)
    centre, half = (x * size_px[0], y * size_px[1]), (width * size_px[0] / 2, height * size_px[1] / 2)
    box = (centre[0] - half[0], centre[1] - half[1], centre[0] + half[0], centre[1] + half[1])
    return box, score, names.get(int(name), name)


def _in_bounds(x: float, y: float, width: float, height: float, score: float) -> bool:
    small = all(abs(value) < MAX_NUMBER for value in (x, y, width, height))
    return small and min(width, height) >= 0.0 and 0.0 <= score <= 1.0


def read_mot_text(
    path: str | Path, frame_rate_hz: float | None = None, n_images: int | None = None
) -> DetectionLog:
    """Read MOTChallenge text: lines ``frame, id, left, top, width, height, conf, x, y, z``, frames from 1.

    The values after `conf` are optional; `id`, x, y, z are not used. A `conf` of -1 is a missing score, which
    is 1. A line of nine values is ground truth, with class and visibility after `conf`, and a box of
    visibility 0 gets the score 0. Other boxes are cars.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, "det.txt").write_text("2,-1,10,20,50,120,0.9,-1,-1,-1")
    ...     log = read_mot_text(Path(folder, "det.txt"), n_images=3)
    >>> [len(frame) for frame in log.frames], log.frames[1].boxes_px.tolist()
    ([0, 1, 0], [[10.0, 20.0, 60.0, 140.0]])
    """
    name = Path(path)
    text = read_text(name, "MOTChallenge text", MAX_BYTES)
    if text.count("\n") > MAX_BOXES:
        raise InputFileError(name, f"expected at most {MAX_BOXES} lines")
    rows: dict[int, list[Row]] = {}
    with refused_as_file(name):
        for number, line in enumerate(text.split("\n"), 1):
            if line.strip():
                frame, row = _mot_row(line, f"line {number}")
                rows.setdefault(frame - 1, []).append(row)
    return _log(name, rows, frame_rate_hz, n_images)


def _mot_row(line: str, where: str) -> tuple[int, Row]:
    expected = f"frame, id, left, top, width, height, conf with frames 1 to {MAX_FRAMES} and conf in [0, 1]"
    problem = f"{where}: expected {expected}, got {line[:60]!r}"
    try:
        # Pixels start at 1 in the challenge and at 0 in most trackers; the difference is smaller than the
        # jitter of boxes.
        frame, _, left, top, width, height, conf, *more = map(float, line.split(",", 10))
    except ValueError as error:
        raise InvalidArgumentError(problem) from error
    score, numbers = 1.0 if conf == -1 else conf, all(abs(value) < MAX_NUMBER for value in more)
    numbered = 1 <= frame <= MAX_FRAMES and frame.is_integer() and len(more) <= 3
    if not (numbered and numbers and _in_bounds(left, top, width, height, score)):
        raise InvalidArgumentError(problem)
    kind, visibility = more if len(more) == 2 else (-1.0, -1.0)
    box = left, top, left + width, top + height
    return int(frame), (box, score if visibility else 0.0, MOT_CLASSES.get(kind, f"{kind:g}"))


def _log(
    path: Path, rows: Mapping[int, list[Row]], rate_hz: float | None, looked: Sequence[int] | int | None
) -> DetectionLog:
    """Stamp the searched images: those with the given numbers, the first n, or all up to the last box."""
    count = max(rows, default=-1) + 1
    if count > MAX_FRAMES or min(rows, default=0) < 0:
        got = count - 1 if count > MAX_FRAMES else min(rows)
        way_on = 'times belong in "stamp_ns" of detections_per_frame'
        raise InputFileError(path, f"expected frame numbers from 0 to {MAX_FRAMES - 1}, got {got}: {way_on}")
    if isinstance(looked, int) and not count <= looked <= MAX_FRAMES:
        raise InputFileError(path, f"expected {count} to {MAX_FRAMES} images by its boxes, got {looked}")
    numbers = looked if isinstance(looked, Sequence) else range(looked or 0)
    if looked is None and rows:
        numbers = _numbers_up_to_the_last(path, rows, stated=rate_hz is not None)
    if max(map(len, rows.values()), default=0) > MAX_BOXES_A_FRAME:
        raise InputFileError(path, f"expected at most {MAX_BOXES_A_FRAME} boxes a frame")
    found = tuple(frame_of_rows(rows.get(number, [])) for number in numbers)
    return DetectionLog.at_rate(found, rate_hz, str(path), numbers)


def _numbers_up_to_the_last(path: Path, named: Collection[int], *, stated: bool) -> range:
    """Return the images up to the last listed one; refuse numbers in steps if no rate is given."""
    steps = _between(named)
    if len(named) < _LEAST_NUMBERS or steps.step == 1:
        return range(steps.stop)
    if not stated:
        problem = f"expected images that are numbered by ones, these rise by {steps.step}, as times do"
        way_on = "state how many of these numbers a second has (image_rate_hz of the camera, frame_rate_hz)"
        raise InputFileError(path, f"{problem}: {way_on}, or the number of images (n_images)")
    return range(steps.start % steps.step, steps.stop, steps.step)


def frame_of_rows(rows: Sequence[Row]) -> DetectionFrame:
    """Return the boxes of one image, one per row."""
    boxes = np.array([row[0] for row in rows], dtype=np.float64).reshape(-1, 4)
    return DetectionFrame(boxes, np.array([row[1] for row in rows]), tuple(row[2] for row in rows))
