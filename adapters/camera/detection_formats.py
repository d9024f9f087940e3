"""Detections as other tools write them: COCO results and YOLO text, beside OVAD's JSON."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from worldstate.adapters.files.text_file import read_json, read_text, refused_as_file
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.serialisation import Check, Probability, decode

from .detections import (
    MAX_BOXES_A_FRAME,
    MAX_BYTES,
    MAX_FRAMES,
    DetectionFrame,
    DetectionLog,
    read_detections,
)

# The road users among COCO's categories, by the number that results files carry, and by their place in the
# list of eighty names that YOLO text counts through.
COCO_CATEGORIES: Mapping[int, str] = {
    1: "person", 2: "bicycle", 3: "car", 4: "motorcycle", 6: "bus", 7: "train", 8: "truck",
}  # fmt: skip
YOLO_CLASSES: Mapping[int, str] = {
    0: "person", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 6: "train", 7: "truck",
}  # fmt: skip
MAX_TEXT_BYTES = 1 << 20  # of one frame in YOLO text
_FRAME_NUMBER = re.compile(r"(\d{1,9})\.txt$", re.ASCII)

Row = tuple[tuple[float, float, float, float], float, str]
# Beyond any image, and a sum of two is still a number.
MAX_NUMBER = 1e9
Place = Annotated[float, Check("a number below 1e9", lambda value: abs(value) < MAX_NUMBER)]
Extent = Annotated[float, Check("a number in [0, 1e9)", lambda value: 0.0 <= value < MAX_NUMBER)]


@dataclass(frozen=True, slots=True)
class _CocoResult:
    """One box of a COCO results file."""

    image_id: int
    category_id: int
    bbox: tuple[Place, Place, Extent, Extent]
    score: Probability


def read_any_detections(
    path: str | Path, frame_rate_hz: float = 10.0, size_px: tuple[int, int] | None = None
) -> DetectionLog:
    """Read detections of whichever form stands at `path`.

    A folder holds YOLO text, a JSON list COCO results, a JSON object OVAD's detections per frame.

    Parameters
    ----------
    path : str or Path
        File or folder.
    frame_rate_hz : float
        Frames a second, where the frames carry no stamp.
    size_px : tuple of int, optional
        Width and height of the image, which YOLO text is relative to.

    Returns
    -------
    DetectionLog
        In the order of time.

    Raises
    ------
    InputFileError
        As the reader of that form, or if YOLO text is read without a size.

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
        return read_yolo_text(name, size_px, frame_rate_hz)
    try:
        with name.open("rb") as file:
            first = file.read(64).lstrip()[:1]
    except OSError as error:
        raise InputFileError(name, f"expected a detections file ({error.strerror})") from error
    reader = read_coco_results if first == b"[" else read_detections
    return reader(name, frame_rate_hz)


def read_coco_results(path: str | Path, frame_rate_hz: float = 10.0) -> DetectionLog:
    """Read a COCO results file: ``[{"image_id", "category_id", "bbox": [x, y, w, h], "score"}, ...]``."""
    name = Path(path)
    found = read_json(name, "a detections file", MAX_BYTES)
    if not isinstance(found, list) or len(found) > MAX_FRAMES * 10:
        raise InputFileError(name, "expected a list of COCO results")
    rows: dict[int, list[Row]] = {}
    with refused_as_file(name):
        for i, item in enumerate(found):
            result = decode(_CocoResult, item, f"result {i}")
            left, top, width, height = result.bbox
            label = COCO_CATEGORIES.get(result.category_id, str(result.category_id))
            row = (left, top, left + width, top + height), result.score, label
            rows.setdefault(result.image_id, []).append(row)
    return _log(name, rows, frame_rate_hz)


def read_yolo_text(path: str | Path, size_px: tuple[int, int], frame_rate_hz: float = 10.0) -> DetectionLog:
    """Read a folder of YOLO text: ``street_17.txt`` lines ``class x y w h [score]`` in parts of the image."""
    folder = Path(path)
    numbered = [(file, match) for file in folder.glob("*.txt") if (match := _FRAME_NUMBER.search(file.name))]
    if not numbered or len(numbered) > MAX_FRAMES:
        problem = f"expected 1 to {MAX_FRAMES} files that end in a frame number and .txt, got {len(numbered)}"
        raise InputFileError(folder, problem)
    rows: dict[int, list[Row]] = {}
    for file, match in numbered:
        number = int(match.group(1))
        if number in rows:
            raise InputFileError(file, "expected every frame once, another file has the same number")
        with refused_as_file(file):
            lines = read_text(file, "a text file", MAX_TEXT_BYTES).splitlines()
            rows[number] = [_yolo_row(line, size_px) for line in lines if line.strip()]
    return _log(folder, rows, frame_rate_hz)


def _yolo_row(line: str, size_px: tuple[int, int]) -> Row:
    name, *numbers = line.split()
    expected = "class x y w h [score] with w, h >= 0 and the score in [0, 1]"
    problem = f"expected {expected}, got {line!r:.60}"
    try:
        x, y, width, height, score = map(float, numbers if len(numbers) == 5 else [*numbers, "1"])
    except ValueError as error:
        raise InvalidArgumentError(problem) from error
    sizes_fit = max(abs(x), abs(y)) < MAX_NUMBER and 0.0 <= width < MAX_NUMBER and 0.0 <= height < MAX_NUMBER
    if not (sizes_fit and 0.0 <= score <= 1.0 and name.isascii() and name.isdecimal() and len(name) < 6):
        raise InvalidArgumentError(problem)
    centre, half = (x * size_px[0], y * size_px[1]), (width * size_px[0] / 2, height * size_px[1] / 2)
    box = (centre[0] - half[0], centre[1] - half[1], centre[0] + half[0], centre[1] + half[1])
    return box, score, YOLO_CLASSES.get(int(name), name)


def _log(path: Path, rows: Mapping[int, list[Row]], frame_rate_hz: float) -> DetectionLog:
    count = max(rows, default=-1) + 1
    if count > MAX_FRAMES or any(not 0 <= number < count for number in rows):
        raise InputFileError(path, f"expected frame numbers from 0 to {min(count, MAX_FRAMES) - 1}")
    if max(map(len, rows.values()), default=0) > MAX_BOXES_A_FRAME:
        raise InputFileError(path, f"expected at most {MAX_BOXES_A_FRAME} boxes a frame")
    found = [_frame(rows.get(number, [])) for number in range(count)]
    return DetectionLog.at_rate(found, frame_rate_hz, source=str(path))


def _frame(rows: list[Row]) -> DetectionFrame:
    boxes = np.array([row[0] for row in rows], dtype=np.float64).reshape(-1, 4)
    return DetectionFrame(boxes, np.array([row[1] for row in rows]), tuple(row[2] for row in rows))
