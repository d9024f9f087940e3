"""Interface of a detector, and what one reported frame by frame."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from worldstate.adapters.files.text_file import read_json, refused_as_file
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.serialisation import Count, Probability, decode
from worldstate.ground.typing import FloatArray, ImageArray, IntArray
from worldstate.ground.values import nanoseconds

MAX_BYTES = 64 << 20
MAX_FRAMES = 100_000
MAX_BOXES_A_FRAME = 1000
MAX_FRAME_RATE_HZ = 1000.0
# Decisions at 47,998 Hz fall up to half a sample (10 us) before the frame that they belong to.
STAMP_SLACK_NS = 1_000_000


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
        n class names, as the detector says them.

    Examples
    --------
    >>> frame = DetectionFrame(np.array([[10.0, 20.0, 60.0, 140.0]]), np.array([0.9]), ("car",))
    >>> len(frame), frame.select(DetectionFilter()), frame.select(DetectionFilter(min_height_px=200))
    (1, array([0]), array([], dtype=int64))
    """

    boxes_px: FloatArray
    scores: FloatArray
    labels: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.labels)

    def select(self, keep: "DetectionFilter") -> IntArray:
        """Return the indices of the boxes that `keep` lets through."""
        heights_px = self.boxes_px[:, 3] - self.boxes_px[:, 1]
        named = np.array([label in keep.labels for label in self.labels], dtype=bool)
        return np.flatnonzero(named & (self.scores >= keep.min_score) & (heights_px > keep.min_height_px))


@dataclass(frozen=True, slots=True)
class DetectionFilter:
    """Which boxes count; the defaults are those of the authors of OVAD.

    Parameters
    ----------
    labels : frozenset of str
        Classes that count as a road user.
    min_score : float
        Lowest score, in [0, 1].
    min_height_px : float
        Boxes must be higher than this, which leaves the far ones out.

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

    def __post_init__(self) -> None:
        in_range("min_score", self.min_score, 0.0, 1.0)
        in_range("min_height_px", self.min_height_px, 0.0, math.inf)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionLog:
    """Frames of one camera in the order of time.

    Parameters
    ----------
    frames : tuple of DetectionFrame
        One per image, empty ones included: an image without boxes was searched.
    stamps_ns : ndarray
        Shape (n,), int64, strictly increasing, nanoseconds on the stream's clock.
    source : str
        Where it comes from, for messages: the file's name.

    Raises
    ------
    InvalidArgumentError
        If the two do not fit or the stamps are not in order.

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
        frame_rate_hz: float,
        start_ns: int = 0,
        source: str = "detections",
    ) -> "DetectionLog":
        """Stamp frame i with start + i / rate, counted from the start of the recording.

        Raises
        ------
        InvalidArgumentError
            If the rate is not above 0 and at most 1000.
        """
        in_range("frame_rate_hz", frame_rate_hz, 0.0, MAX_FRAME_RATE_HZ, open_low=True)
        stamps = [start_ns + nanoseconds(i / frame_rate_hz) for i in range(len(frames))]
        return cls(tuple(frames), np.array(stamps, dtype=np.int64), source)

    def __len__(self) -> int:
        return len(self.frames)

    def shifted(self, offset_s: float) -> "DetectionLog":
        """Return the same frames with stamps that are later by so many seconds."""
        return DetectionLog(self.frames, self.stamps_ns + nanoseconds(offset_s), self.source)

    def latest(self, stamp_ns: int, max_age_ns: int) -> int | None:
        """Return the number of the last frame taken at or before `stamp_ns`, None if too old or not there."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns + STAMP_SLACK_NS, side="right")) - 1
        if index < 0 or stamp_ns - int(self.stamps_ns[index]) > max_age_ns:
            return None
        return index


class Detector(Protocol):
    """Detector of objects in images that are given in the order of time.

    A detector may have a state, as one of motion must; a new one is made for every video.

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
            Blue first.

        Returns
        -------
        DetectionFrame
            Boxes in pixels, scores in [0, 1], labels.
        """
        ...


def read_detections(path: str | Path, frame_rate_hz: float = 10.0) -> DetectionLog:
    """Read per-frame detections in OVAD's JSON.

    ``{"detections_per_frame": [{"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...]},
    ...]}`` with other keys ignored. A detector of your own may add ``"stamp_ns"`` to every frame; without it
    frame i shows the time i / `frame_rate_hz` from the start of the recording.

    Parameters
    ----------
    path : str or Path
        The file; at most 64 MiB, 100,000 frames, 1000 boxes a frame.
    frame_rate_hz : float
        Frames a second where the frames carry no stamp.

    Returns
    -------
    DetectionLog
        Every box, unfiltered.

    Raises
    ------
    InputFileError
        Names the file and the frame: missing, too large, no JSON, keys missing, other types, lengths that
        differ, numbers that are not finite, boxes turned inside out, scores outside [0, 1], stamps out of
        order.
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
    in_range("frame_rate_hz", frame_rate_hz, 0.0, MAX_FRAME_RATE_HZ, open_low=True)
    name = Path(path)
    document = read_json(name, "a detections file", MAX_BYTES)
    rows = document.get("detections_per_frame") if isinstance(document, dict) else None
    if not isinstance(rows, list) or len(rows) > MAX_FRAMES:
        problem = f"expected an object with a list of at most {MAX_FRAMES} frames in detections_per_frame"
        raise InputFileError(name, problem)
    frames: list[DetectionFrame] = []
    stamps: list[int | None] = []
    with refused_as_file(name):
        for number, row in enumerate(rows):
            read = decode(_OvadFrame, row, f"frame {number}")
            frames.append(read.frame())
            stamps.append(read.stamp_ns)
        if all(stamp is None for stamp in stamps):
            return DetectionLog.at_rate(frames, frame_rate_hz, source=str(name))
        if None in stamps:
            raise InvalidArgumentError(f"frame {stamps.index(None)}: expected stamp_ns, as in other frames")
        return DetectionLog(tuple(frames), np.array(stamps, dtype=np.int64), str(name))


@dataclass(frozen=True, slots=True)
class _OvadFrame:
    """What OVAD's file holds of one image."""

    boxes: tuple[tuple[float, float, float, float], ...]
    scores: tuple[Probability, ...]
    classes_str: tuple[str, ...]
    stamp_ns: Count | None = None

    def __post_init__(self) -> None:
        if not len(self.boxes) == len(self.scores) == len(self.classes_str) <= MAX_BOXES_A_FRAME:
            got = f"{len(self.boxes)} boxes, {len(self.scores)} scores, {len(self.classes_str)} classes_str"
            raise InvalidArgumentError(f"expected as many of each, at most {MAX_BOXES_A_FRAME}, got {got}")
        for left, top, right, bottom in self.boxes:
            if left > right or top > bottom:
                got = f"{left:g}, {top:g}, {right:g}, {bottom:g}"
                raise InvalidArgumentError(f"boxes: expected x1 <= x2 and y1 <= y2, got {got}")

    def frame(self) -> DetectionFrame:
        boxes_px = np.array(self.boxes, dtype=np.float64).reshape(-1, 4)
        return DetectionFrame(boxes_px, np.array(self.scores), self.classes_str)


def frame_of(record: object, where: str) -> DetectionFrame:
    """Return the boxes of one image from OVAD's record of it; `where` names it in messages."""
    return decode(_OvadFrame, record, where).frame()
