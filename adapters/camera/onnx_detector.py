"""A user's own detector: an ONNX model whose output is of YOLO's form."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.extras import optional
from worldstate.ground.typing import Float32Array, FloatArray, ImageArray, IntArray

from .box_linking import overlaps
from .detections import MAX_BOXES_A_FRAME, DetectionFrame

# ONNX files are protocol buffers, which end at 2 GiB.
MAX_BYTES = 2 << 30
MIN_SCORE = 0.25  # Lowest score that is reported
MOST_OVERLAP = 0.5  # Of two boxes that overlap by more, the better one is kept
SIDE_PX = 640  # Of the square that the model takes, where its input has no fixed size
# Grey level of the border of a letterbox, that of YOLO's training.
GREY = 114


class OnnxDetector:
    """Run an ONNX model of YOLO's form on images.

    The image is fitted into a square, the rest filled with grey, and passed as (1, 3, side, side), red first,
    in [0, 1]. For the output see `decode_yolo`.

    Parameters
    ----------
    session : onnxruntime.InferenceSession
        An open model; `open_onnx` opens one from a file.
    labels : tuple of str
        Names of the classes in the order of the model, at least one.

    Raises
    ------
    InvalidArgumentError
        If the model does not take one image, or no class is named.

    Examples
    --------
    A stand-in for a model that finds one car in every image:

    >>> from types import SimpleNamespace
    >>> image = SimpleNamespace(name="images", shape=[1, 3, 64, 64], type="tensor(float)")
    >>> class OneCar:
    ...     def get_inputs(self): return [image]
    ...     def run(self, names, feed): return [np.array([[[32.0], [32.0], [20.0], [10.0], [0.9]]])]
    >>> found = OnnxDetector(OneCar(), ("car",)).detect(np.zeros((64, 64, 3), np.uint8))
    >>> found.labels, found.boxes_px.tolist()
    (('car',), [[22.0, 27.0, 42.0, 37.0]])
    """

    def __init__(self, session: Any, labels: tuple[str, ...]) -> None:
        if not labels:
            raise InvalidArgumentError("labels: expected at least one class name")
        inputs = session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4:
            raise InvalidArgumentError("model: expected one input of shape (1, 3, height, width)")
        self._labels, self._session = labels, session
        self._input = str(inputs[0].name)
        self._size = tuple(
            side if isinstance(side, int) and side > 0 else SIDE_PX for side in inputs[0].shape[2:]
        )

    def detect(self, frame: ImageArray, /) -> DetectionFrame:
        """Return the detections of the model.

        Parameters
        ----------
        frame : ndarray of uint8, shape (height, width, 3)
            Blue first.

        Returns
        -------
        DetectionFrame
            Boxes in pixels of the image, after non-maximum suppression.

        Raises
        ------
        InvalidArgumentError
            If the frame is no colour image or the model's output is not of YOLO's form.
        """
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise InvalidArgumentError(f"frame: expected a colour image, got {frame.dtype} {frame.shape}")
        tensor, scale = self._letterbox(frame)
        outputs = self._session.run(None, {self._input: tensor})
        boxes, scores, classes = decode_yolo(outputs[0], len(self._labels))
        limits = np.array([frame.shape[1], frame.shape[0]] * 2, dtype=np.float64)
        return self._best(np.clip(boxes / scale, 0.0, limits), scores, classes)

    def _letterbox(self, frame: ImageArray) -> tuple[Float32Array, float]:
        cv2 = optional("cv2")
        height, width = frame.shape[:2]
        scale = min(self._size[0] / height, self._size[1] / width)
        fitted = cv2.resize(frame, (max(round(width * scale), 1), max(round(height * scale), 1)))
        square = np.full((*self._size, 3), GREY, dtype=np.uint8)
        square[: fitted.shape[0], : fitted.shape[1]] = fitted
        planes = np.ascontiguousarray(square[:, :, ::-1].transpose(2, 0, 1), dtype=np.float32)
        return planes[None] / np.float32(255.0), scale

    def _best(self, boxes: FloatArray, scores: FloatArray, classes: IntArray) -> DetectionFrame:
        kept = np.flatnonzero(scores >= MIN_SCORE)
        kept = kept[np.argsort(-scores[kept], kind="stable")][: 10 * MAX_BOXES_A_FRAME]
        # Boxes of different classes never suppress each other: each class lies in a plane of its own.
        planes = boxes[kept] + 1e5 * classes[kept, None]
        kept = kept[suppress(planes, scores[kept], MOST_OVERLAP)][:MAX_BOXES_A_FRAME]
        names = tuple(self._labels[c] for c in classes[kept])
        return DetectionFrame(boxes[kept], scores[kept], names)


def open_onnx(path: str | Path, labels: tuple[str, ...]) -> OnnxDetector:
    """Open a model file with onnxruntime, on the processor.

    Parameters
    ----------
    path : str or Path
        Model file.
    labels : tuple of str
        Names of the classes in the order of the model, at least one.

    Returns
    -------
    OnnxDetector
        Ready to detect.

    Raises
    ------
    InputFileError
        If it is missing, larger than 2 GiB, or no model that onnxruntime takes.
    MissingExtraError
        If onnxruntime is not installed.

    Examples
    --------
    >>> try:
    ...     open_onnx("missing.onnx", ("car", "bicycle"))
    ... except InputFileError as error:
    ...     print(error)
    missing.onnx: expected an ONNX model (No such file or directory)
    """
    name = Path(path)
    try:
        if name.stat().st_size > MAX_BYTES:
            raise InputFileError(name, f"expected a model of at most {MAX_BYTES >> 30} GiB")
    except OSError as error:
        raise InputFileError(name, f"expected an ONNX model ({error.strerror})") from error
    onnxruntime = optional("onnxruntime")
    try:
        session = onnxruntime.InferenceSession(str(name), providers=["CPUExecutionProvider"])
        return OnnxDetector(session, labels)
    except Exception as error:  # onnxruntime raises bare classes of its own
        raise InputFileError(name, f"expected an ONNX detector, it does not open: {error}") from error


def decode_yolo(output: NDArray[np.generic], classes: int) -> tuple[FloatArray, FloatArray, IntArray]:
    r"""Turn the raw output of a YOLO model into boxes.

    Shapes: returns (n, 4).
    """
    # Three forms are distinguished by their shape, with C classes and n candidates: (1, 4 + C, n), centre and
    # size with a score a class; (1, n, 5 + C), with an objectness in front that multiplies them; (1, n, 6),
    # corners, score and class, of a model that suppresses doubles itself. Six columns with one class are
    # read as the second.
    array = np.asarray(output, dtype=np.float64)
    if array.ndim != 3 or array.shape[0] != 1 or not np.isfinite(array).all():
        raise InvalidArgumentError(f"output: expected finite numbers of shape (1, ., .), got {array.shape}")
    rows, columns = array.shape[1:]
    if columns == 5 + classes:
        per_class = array[0, :, 5:] * array[0, :, 4:5]
        return _from_centres(array[0, :, :4], per_class)
    if rows == 4 + classes:
        return _from_centres(array[0, :4].T, array[0, 4:].T)
    if columns == 6:
        return _from_corners(array[0], classes)
    expected = f"(1, {4 + classes}, n), (1, n, {5 + classes}) or (1, n, 6)"
    raise InvalidArgumentError(f"output: expected {expected} for {classes} classes, got {array.shape}")


def _from_centres(centres: FloatArray, per_class: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    half = centres[:, 2:] / 2
    boxes = np.concatenate([centres[:, :2] - half, centres[:, :2] + half], axis=1)
    best = per_class.argmax(axis=1)
    return boxes, np.clip(per_class.max(axis=1), 0.0, 1.0), best.astype(np.int64)


def _from_corners(rows: FloatArray, classes: int) -> tuple[FloatArray, FloatArray, IntArray]:
    found = rows[:, 5].astype(np.int64)
    if ((found < 0) | (found >= classes)).any():
        raise InvalidArgumentError(f"output: expected classes 0 to {classes - 1}")
    return rows[:, :4], np.clip(rows[:, 4], 0.0, 1.0), found


def suppress(boxes_px: FloatArray, scores: FloatArray, most_overlap: float) -> IntArray:
    """Return the indices after non-maximum suppression of boxes (n, 4) by scores (n,), the best first."""
    left = np.argsort(-scores, kind="stable")
    kept = []
    while left.size:
        kept.append(left[0])
        rest = left[1:]
        left = rest[overlaps(boxes_px[left[:1]], boxes_px[rest])[0] <= most_overlap]
    return np.array(kept, dtype=np.int64)
