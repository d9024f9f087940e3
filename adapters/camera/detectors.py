"""Detectors: moving objects for a standing camera by background subtraction, and a user's own ONNX model.

The output of a model has YOLO's form.
"""

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from worldstate.ground.errors import InputFileError, InvalidArgumentError, OwnPartError
from worldstate.ground.extras import optional
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, ImageArray, IntArray

from .box_linking import overlaps
from .camera_health import check_image
from .detections import MAX_BOXES_A_FRAME, DetectionFilter, DetectionFrame

# No edge of an image is narrower: pixels have a size, and noise is smoothed before the search.
NARROWEST_EDGE_PX = 3.0
# MOG2's default: a pixel moves if it is this many variances from every mode of its background.
MOG2_VARIANCES = 16.0

WIDTH_PX = 640  # Frames are reduced to this width first
HISTORY = 100  # Number of frames in the background
WARM_UP = 5  # First frames, which give no detections
# Smallest difference that is motion, grey levels, Euclidean over the colours, > 0. The codec and the sensor
# of a street camera have a noise of some 3 grey levels per colour, or 5 over the three colours; the value is
# three times the latter.
LEAST_CONTRAST = 15.0
MIN_AREA = 0.0015  # Smallest object as a share of the image
MAX_AREA = 0.6  # Larger regions are changes of the light
# Widest edge of an object as a share of the image's width. A change without an edge on at least `OUTLINED` of
# its outline is light: the glow of lamps, a cloud, or the blur of a lens out of focus.
EDGE_WIDTH = 0.01
# 0 accepts every region. The value is below one half, because a car has no edge at its shadow.
OUTLINED = 0.25
LABEL = "car"  # Label of all boxes: background subtraction has no classes
# All boxes of moving objects count, because their score is no confidence.
ALL_MOTION = DetectionFilter(frozenset({LABEL}), 0.0, 0.0)
# Smoothing against pixel noise in the gradient; far narrower than any edge width in use.
_SMOOTHING_PX = 0.7
# The contrast of a change is the level that it reaches over most of its area.
_CONTRAST_PERCENTILE = 75.0

Background = Literal["mog2", "knn"]


class MotionDetector:
    """Detect moving objects in the images of a standing camera by background subtraction.

    Parameters
    ----------
    background : {"mog2", "knn"}
        Model of the background: Gaussian mixtures or nearest neighbours, both OpenCV's.

    Raises
    ------
    MissingExtraError
        If OpenCV is not installed.

    Examples
    --------
    >>> detector = MotionDetector()
    >>> street = np.random.default_rng(0).integers(90, 110, (48, 64, 3)).astype(np.uint8)
    >>> for _ in range(10): empty = detector.detect(street)
    >>> street[20:40, 10:30] = 220
    >>> len(empty), detector.detect(street).boxes_px.tolist()
    (0, [[10.0, 20.0, 30.0, 40.0]])
    """

    def __init__(self, background: Background = "mog2") -> None:
        self._cv2 = optional("cv2")
        self._background = self._make_background(background)
        self._seen = 0

    def detect(self, frame: ImageArray, /) -> DetectionFrame:
        """Return the moving objects; the score is the moving share of the box.

        Parameters
        ----------
        frame : ndarray of uint8, shape (height, width) or (height, width, 3)
            The next image of the video.

        Returns
        -------
        DetectionFrame
            Boxes in pixels; empty during the warm-up.

        Raises
        ------
        InvalidArgumentError
            If the frame is not an image of uint8.
        """
        check_image(frame, least_px=1)
        small = reduced_to(frame, WIDTH_PX)
        mask, self._seen = self._moving(small), self._seen + 1
        if self._seen <= WARM_UP:
            return DetectionFrame(np.empty((0, 4)), np.empty(0), ())
        scale = np.tile(frame.shape[1::-1], 2) / np.tile(small.shape[1::-1], 2)
        return self._objects(small, mask, scale)

    def _make_background(self, kind: Background) -> Any:
        least = LEAST_CONTRAST**2
        if kind == "knn":
            return self._cv2.createBackgroundSubtractorKNN(HISTORY, least, detectShadows=False)
        model = self._cv2.createBackgroundSubtractorMOG2(HISTORY, MOG2_VARIANCES, detectShadows=False)
        model.setVarMin(least / MOG2_VARIANCES)
        return model

    def _moving(self, frame: ImageArray) -> ImageArray:
        """Return the mask of moving pixels, specks removed and parts of one object joined."""
        mask = self._background.apply(frame)
        speck = np.ones((3, 3), dtype=np.uint8)
        joint = np.ones((frame.shape[1] // 80 * 2 + 1,) * 2, dtype=np.uint8)
        mask = self._cv2.morphologyEx(mask, self._cv2.MORPH_OPEN, speck)
        return np.asarray(self._cv2.morphologyEx(mask, self._cv2.MORPH_CLOSE, joint))

    def _objects(self, frame: ImageArray, mask: ImageArray, scale: FloatArray) -> DetectionFrame:
        _, labels, stats, _ = self._cv2.connectedComponentsWithStats(mask, connectivity=8)
        share = stats[:, 4] / mask.size
        kept = (share >= MIN_AREA) & (share <= MAX_AREA)
        kept[0] = False  # The static part
        numbers = np.flatnonzero(kept)
        if numbers.size:
            numbers = numbers[self._has_outline(frame, labels, numbers)]
        left, top, width, height, area = stats[numbers].T.astype(np.float64)
        boxes = np.stack([left, top, left + width, top + height], axis=1) * scale
        return DetectionFrame(boxes, area / (width * height), (LABEL,) * numbers.size)

    def _has_outline(self, frame: ImageArray, labels: NDArray[np.int32], numbers: IntArray) -> BoolArray:
        """Return which regions are objects rather than changes of the light."""
        apart = _difference(frame, self._background.getBackgroundImage())
        width_px = max(EDGE_WIDTH * frame.shape[1], NARROWEST_EDGE_PX)
        return np.array([outlined_share(apart, labels == number, width_px) for number in numbers]) >= OUTLINED


def reduced_to(frame: ImageArray, width_px: int) -> ImageArray:
    """Return an image with at most this width, its aspect ratio kept."""
    height, width = frame.shape[:2]
    if width <= width_px:
        return frame
    cv2, size = optional("cv2"), (width_px, max(round(height * width_px / width), 1))
    return np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA))


def _difference(frame: ImageArray, background: ImageArray) -> Float32Array:
    """Return the largest difference over the colours between a frame and its background, (height, width)."""
    cv2 = optional("cv2")
    apart = cv2.absdiff(frame, background)
    apart = apart if apart.ndim == 2 else apart.max(axis=2)
    return np.asarray(cv2.GaussianBlur(apart.astype(np.float32), (0, 0), _SMOOTHING_PX))


def outlined_share(apart: Float32Array, region: BoolArray, width_px: float) -> float:
    r"""Return the share of a region's outline that is an edge.

    .. math:: \max_{|q - p| \le w} |\nabla D(q)| \ge C / w,

    with C the 75th percentile of the change D over the region. An edge that a lens blurs by :math:`\sigma`
    has the slope :math:`C / (\sigma \sqrt{2 \pi})`: it is accepted up to :math:`\sigma \approx 0.4 w`. The
    glow of lamps on a wall, a passing cloud and a step of the exposure change many pixels, but little between
    neighbours.

    Shapes: apart (height, width), region (height, width).
    """
    # A pixel of the outline is an edge if within `width_px` of it the change rises by its whole contrast over
    # at most that width: regions without a gradient at their boundary are changes of the light (Javed,
    # Shafique and Shah, 2002).
    cv2 = optional("cv2")
    contrast = float(np.percentile(apart[region], _CONTRAST_PERCENTILE))
    across, down = (cv2.Sobel(apart, cv2.CV_32F, *order, scale=1.0 / 8.0) for order in ((1, 0), (0, 1)))
    reach = np.ones((2 * round(width_px) + 1,) * 2, dtype=np.uint8)
    steepest = cv2.dilate(cv2.magnitude(across, down), reach)
    outline = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    return float(np.mean(steepest[outline] >= contrast / width_px))


# ONNX files are protocol buffers, whose limit is 2 GiB.
MAX_BYTES = 2 << 30
MIN_SCORE = 0.25  # Lowest score in the output
MOST_OVERLAP = 0.5  # Of two boxes with a larger overlap, the better one is kept
SIDE_PX = 640  # Side of the model's square input if it has no fixed size
# Grey level of the border of a letterbox, as in YOLO's training.
GREY = 114


class OnnxDetector:
    """Run an ONNX model of YOLO's form on images.

    The image is fitted into a square, the rest is filled with grey, and the input has the shape (1, 3, side,
    side), red first, in [0, 1]. For the output see `decode_yolo`.

    Parameters
    ----------
    session : onnxruntime.InferenceSession
        An open model; `open_onnx` opens one from a file.
    labels : tuple of str
        Names of the classes in the order of the model, at least one.
    name : str
        Name of the model, for messages.

    Raises
    ------
    InvalidArgumentError
        If the model does not take one image, or no class name is given.

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

    def __init__(self, session: Any, labels: tuple[str, ...], name: str = "model") -> None:
        if not labels:
            raise InvalidArgumentError("labels: expected at least one class name")
        inputs = session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4:
            raise InvalidArgumentError("model: expected one input of shape (1, 3, height, width)")
        self._labels, self._session, self._name = labels, session, name
        self._input = str(inputs[0].name)
        sides = inputs[0].shape[2:]
        self._size = tuple(side if isinstance(side, int) and side > 0 else SIDE_PX for side in sides)

    def detect(self, frame: ImageArray, /) -> DetectionFrame:
        """Return the detections of the model.

        Parameters
        ----------
        frame : ndarray of uint8, shape (height, width, 3)
            Image in the order blue, green, red.

        Returns
        -------
        DetectionFrame
            Boxes in pixels of the image, after non-maximum suppression.

        Raises
        ------
        InvalidArgumentError
            If the frame is not a colour image or the model's output does not have YOLO's form.
        OwnPartError
            If the model fails.
        """
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise InvalidArgumentError(f"frame: expected a colour image, got {frame.dtype} {frame.shape}")
        tensor, scale = self._letterbox(frame)
        try:
            outputs = self._session.run(None, {self._input: tensor})
        except Exception as error:  # onnxruntime raises its own bare classes
            raise OwnPartError(self._name, error) from error
        boxes, scores, classes = decode_yolo(outputs[0], len(self._labels))
        return self._best(np.clip(boxes / scale, 0.0, np.tile(frame.shape[1::-1], 2)), scores, classes)

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
        # Each class has its own plane, so that boxes of different classes never suppress each other.
        planes = boxes[kept] + 1e5 * classes[kept, None]
        kept = kept[suppress(planes, scores[kept], MOST_OVERLAP)][:MAX_BOXES_A_FRAME]
        return DetectionFrame(boxes[kept], scores[kept], tuple(self._labels[c] for c in classes[kept]))


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
        If the file is missing, larger than 2 GiB, or not a model for onnxruntime.
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
        with redirect_stdout(io.StringIO()):  # It prints its retries
            session = onnxruntime.InferenceSession(str(name), providers=["CPUExecutionProvider"])
        return OnnxDetector(session, labels, str(name))
    except Exception as error:  # onnxruntime raises its own bare classes
        told = " ".join(str(error).split())
        raise InputFileError(name, f"expected an ONNX detector, it does not open: {told}") from error


def decode_yolo(output: NDArray[np.generic], classes: int) -> tuple[FloatArray, FloatArray, IntArray]:
    r"""Convert the raw output of a YOLO model into boxes.

    Shapes: returns (n, 4).
    """
    # Three forms are distinguished by their shape, with C classes and n candidates: (1, 4 + C, n), centre and
    # size with a score per class; (1, n, 5 + C), with an objectness in front that multiplies them; (1, n, 6),
    # corners, score and class, of a model that suppresses duplicates itself. Six columns with one class are
    # read as the second.
    array = np.asarray(output, dtype=np.float64)
    if array.ndim != 3 or array.shape[0] != 1 or not np.isfinite(array).all():
        raise InvalidArgumentError(f"output: expected finite numbers of shape (1, ., .), got {array.shape}")
    rows, columns = array.shape[1:]
    if columns == 5 + classes:
        return _from_centres(array[0, :, :4], array[0, :, 5:] * array[0, :, 4:5])
    if rows == 4 + classes:
        return _from_centres(array[0, :4].T, array[0, 4:].T)
    if columns == 6:
        return _from_corners(array[0], classes)
    expected = f"(1, {4 + classes}, n), (1, n, {5 + classes}) or (1, n, 6)"
    raise InvalidArgumentError(f"output: expected {expected} for {classes} classes, got {array.shape}")


def _from_centres(centres: FloatArray, per_class: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    half = centres[:, 2:] / 2
    boxes = np.concatenate([centres[:, :2] - half, centres[:, :2] + half], axis=1)
    return boxes, np.clip(per_class.max(axis=1), 0.0, 1.0), per_class.argmax(axis=1).astype(np.int64)


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
