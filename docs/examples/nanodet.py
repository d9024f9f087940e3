"""Your own detector: NanoDet-m on crops of an image, with OpenCV and ONNX Runtime.

The input of the network has 416 pixels per side. Scaled down from a whole image of 1936 pixels, a car of 60
pixels would be 13 pixels high. The detector therefore uses three crops of 832 pixels that overlap by a third.
In Python:

    open_source("recording", detector=open_nanodet("nanodet_m.onnx"))

For `worldstate run --detector nanodet`, a package registers it as `own_parts` does. The environment variable
NANODET_ONNX is then the path of the model:

    [project.entry-points."worldstate.detectors"]
    nanodet = "nanodet:open_nanodet"
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldstate import DetectionFrame
from worldstate.adapters.camera.detections import YOLO_CLASSES
from worldstate.adapters.camera.detectors import suppress
from worldstate.ground.errors import InputFileError
from worldstate.ground.extras import optional
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, ImageArray

# Pixels per side of the input of the network, and its normalisation: blue, green, red.
SIDE_PX = 416
MEAN = np.array([103.53, 116.28, 123.675], np.float32)
DEVIATION = np.array([57.375, 57.12, 58.395], np.float32)
STRIDES_PX = (8, 16, 32)
# The distance to each side of a box is the expected value over so many bins, in strides.
BINS = 8
MIN_SCORE = 0.3
# If two boxes overlap by more, the better one is kept, whatever its class: one vehicle may look like two.
MOST_OVERLAP = 0.5
# An inner edge of a crop cuts vehicles in two. The score of such a part is reduced, because another crop
# contains the whole vehicle, and the part is dropped if this share of it is inside a better box.
CUT_PX, CUT_SCORE, MOST_WITHIN = 6.0, 0.8, 0.7
# Indices of road users among the eighty classes of COCO, which the network uses.
CLASSES = tuple(YOLO_CLASSES)

Crop = tuple[float, float, float]  # Left, top, side; pixels of the image
# Three crops across an image of 1936 x 1216 pixels that contain the street and not the sky.
OVAD_CROPS: tuple[Crop, ...] = ((0.0, 337.0, 832.0), (552.0, 337.0, 832.0), (1104.0, 337.0, 832.0))


class NanoDet:
    """NanoDet-m on crops of an image; non-maximum suppression joins their boxes.

    Parameters
    ----------
    session : onnxruntime.InferenceSession
        The open model: scores (n, 80) and 32 logits (n, 32) for each of the strides 8, 16 and 32.
    crops : sequence of (left, top, side)
        Squares of the image, pixels.
    """

    def __init__(self, session: Any, crops: Sequence[Crop] = OVAD_CROPS) -> None:
        self._session, self._crops = session, tuple(crops)
        self._input = str(session.get_inputs()[0].name)

    def detect(self, frame: ImageArray, /) -> DetectionFrame:
        """Return road users in an image (height, width, 3), blue first."""
        width, height = frame.shape[1], frame.shape[0]
        found = [self._in_crop(frame, crop) for crop in self._crops]
        boxes, scores = (np.concatenate(parts) for parts in zip(*found, strict=True))
        best, names = scores.max(axis=1), scores.argmax(axis=1)
        kept = suppress(boxes, best, MOST_OVERLAP)
        kept = kept[~_within_better(boxes[kept])]
        labels = tuple(YOLO_CLASSES[CLASSES[at]] for at in names[kept])
        return DetectionFrame(np.clip(boxes[kept], 0.0, [width, height] * 2), best[kept], labels)

    def _in_crop(self, frame: ImageArray, crop: Crop) -> tuple[FloatArray, FloatArray]:
        left, top, side = crop
        outputs = self._session.run(None, {self._input: as_input(cut(frame, crop))})
        inner, scores = decoded(outputs)
        boxes = inner * (side / SIDE_PX) + [left, top] * 2
        near_px = CUT_PX * side / 832.0
        parted = (left > 0) & (boxes[:, 0] < left + near_px)
        parted |= (left + side < frame.shape[1]) & (boxes[:, 2] > left + side - near_px)
        return boxes, scores * np.where(parted, CUT_SCORE, 1.0)[:, None]


def _within_better(boxes: FloatArray) -> BoolArray:
    """Return which boxes, the best first, are mostly inside a better box or contain most of one."""
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    common = np.clip(high - low, 0.0, None).prod(axis=2)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    share = common / np.maximum(np.minimum(areas[:, None], areas[None]), 1e-9)
    dropped = np.zeros(len(boxes), bool)
    for at in range(1, len(boxes)):
        dropped[at] = bool((share[at, :at][~dropped[:at]] > MOST_WITHIN).any())
    return dropped


def cut(frame: ImageArray, crop: Crop) -> ImageArray:
    """Return a crop of an image, scaled to the input size of the network."""
    left, top, side = map(round, crop)
    part = frame[top : top + side, left : left + side]
    if part.shape[:2] == (SIDE_PX, SIDE_PX):
        return part
    cv2 = optional("cv2")
    return np.asarray(cv2.resize(part, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA))


def as_input(image: ImageArray) -> Float32Array:
    """Return an image as input of the network, shape (1, 3, 416, 416)."""
    planes = ((image - MEAN) / DEVIATION).astype(np.float32).transpose(2, 0, 1)
    return np.ascontiguousarray(planes[None])


def decoded(outputs: Sequence[NDArray[np.generic]]) -> tuple[FloatArray, FloatArray]:
    r"""Return boxes (n, 4) in pixels of the input, and their scores per class (n, classes).

    .. math:: d = s \sum_b b\, e^{z_b} / \sum_b e^{z_b}

    is the distance from the centre of a cell to a side, with the stride s and the logits z of eight bins.
    """
    found = list(_by_stride(outputs))
    boxes, scores = zip(*found, strict=True)
    return np.concatenate(boxes), np.concatenate(scores)


def _by_stride(outputs: Sequence[NDArray[np.generic]]) -> Iterator[tuple[FloatArray, FloatArray]]:
    levels = len(STRIDES_PX)
    for stride_px, all_scores, logits in zip(STRIDES_PX, outputs[:levels], outputs[levels:], strict=True):
        scores = np.asarray(all_scores, np.float64)[0][:, CLASSES]
        kept = np.flatnonzero(scores.max(axis=1) >= MIN_SCORE)
        weights = np.exp(np.asarray(logits, np.float64)[0, kept].reshape(-1, 4, BINS))
        sides = stride_px * (weights @ np.arange(BINS)) / weights.sum(axis=2)
        rows, columns = np.divmod(kept, SIDE_PX // stride_px)
        # Centre of a cell of `stride_px` pixels, measured from the centre of its first pixel.
        centres = stride_px * np.column_stack([columns, rows]) + 0.5 * (stride_px - 1)
        yield np.hstack([centres - sides[:, :2], centres + sides[:, 2:]]), np.clip(scores[kept], 0.0, 1.0)


def open_nanodet(path: str | Path | None = None, crops: Sequence[Crop] = OVAD_CROPS) -> NanoDet:
    """Open the model on one thread, because recordings are processed in parallel."""
    name = Path(path or os.environ.get("NANODET_ONNX", "nanodet_m.onnx"))
    if not name.is_file():
        raise InputFileError(name, "expected an ONNX model, found no file")
    onnxruntime = optional("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # Exporters list every weight as an input, and the runtime warns of each
    session = onnxruntime.InferenceSession(str(name), options, providers=["CPUExecutionProvider"])
    return NanoDet(session, crops)
