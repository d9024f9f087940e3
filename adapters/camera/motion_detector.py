"""A detector of moving objects for a standing camera, by background subtraction."""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import optional
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, ImageArray, IntArray

from .detections import DetectionFrame

# No edge of an image is narrower: pixels have a size, and noise is smoothed before it is looked for.
NARROWEST_EDGE_PX = 3.0
# MOG2's own: a pixel moves when it is so many variances from every mode of its background.
MOG2_VARIANCES = 16.0

WIDTH_PX = 640  # Frames are reduced to this width first
HISTORY = 100  # Frames that the background remembers
WARM_UP = 5  # First frames, in which nothing is reported
# Smallest difference that is motion, grey levels, Euclidean over the colours, > 0. The codec and the sensor
# of a street camera scatter by some 3 grey levels a colour, 5 over three: three times that.
LEAST_CONTRAST = 15.0
MIN_AREA = 0.0015  # Smallest object as a share of the image
MAX_AREA = 0.6  # Larger regions are changes of the light
# Widest edge of an object as a share of the image's width. A change without one on at least `OUTLINED` of its
# outline is light: the glow of lamps, a cloud, or what a lens out of focus leaves.
EDGE_WIDTH = 0.01
# 0 lets everything through. Below one half, as a car has no edge where it meets its shadow.
OUTLINED = 0.25
LABEL = "car"  # Of all boxes: background subtraction has no classes
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
        """Return the moving objects; the score is the share of the box that moves.

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
            If the frame is no image of uint8.
        """
        if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or not frame.size:
            raise InvalidArgumentError(f"frame: expected an image of uint8, got {frame.dtype} {frame.shape}")
        height, width = frame.shape[:2]
        small = self._reduced(frame)
        mask = self._moving(small)
        self._seen += 1
        if self._seen <= WARM_UP:
            return DetectionFrame(np.empty((0, 4)), np.empty(0), ())
        scale = np.array([width, height] * 2) / np.array([small.shape[1], small.shape[0]] * 2)
        return self._objects(small, mask, scale)

    def _make_background(self, kind: Background) -> Any:
        least = LEAST_CONTRAST**2
        if kind == "knn":
            return self._cv2.createBackgroundSubtractorKNN(HISTORY, least, detectShadows=False)
        model = self._cv2.createBackgroundSubtractorMOG2(HISTORY, MOG2_VARIANCES, detectShadows=False)
        model.setVarMin(least / MOG2_VARIANCES)
        return model

    def _reduced(self, frame: ImageArray) -> ImageArray:
        height, width = frame.shape[:2]
        if width <= WIDTH_PX:
            return frame
        size = (WIDTH_PX, max(round(height * WIDTH_PX / width), 1))
        reduced: ImageArray = self._cv2.resize(frame, size, interpolation=self._cv2.INTER_AREA)
        return reduced

    def _moving(self, frame: ImageArray) -> ImageArray:
        """Return the mask of moving pixels, specks removed and parts of one object joined."""
        mask = self._background.apply(frame)
        speck = np.ones((3, 3), dtype=np.uint8)
        joint = np.ones((frame.shape[1] // 80 * 2 + 1,) * 2, dtype=np.uint8)
        mask = self._cv2.morphologyEx(mask, self._cv2.MORPH_OPEN, speck)
        joined: ImageArray = self._cv2.morphologyEx(mask, self._cv2.MORPH_CLOSE, joint)
        return joined

    def _objects(self, frame: ImageArray, mask: ImageArray, scale: FloatArray) -> DetectionFrame:
        _, labels, stats, _ = self._cv2.connectedComponentsWithStats(mask, connectivity=8)
        share = stats[:, 4] / mask.size
        kept = (share >= MIN_AREA) & (share <= MAX_AREA)
        kept[0] = False  # what does not move
        numbers = np.flatnonzero(kept)
        if numbers.size:
            numbers = numbers[self._has_outline(frame, labels, numbers)]
        left, top, width, height, area = stats[numbers].T.astype(np.float64)
        boxes = np.stack([left, top, left + width, top + height], axis=1) * scale
        return DetectionFrame(boxes, area / (width * height), (LABEL,) * numbers.size)

    def _has_outline(self, frame: ImageArray, labels: NDArray[np.int32], numbers: IntArray) -> BoolArray:
        """Return which regions are objects and not changes of the light."""
        apart = _difference(frame, self._background.getBackgroundImage())
        width_px = max(EDGE_WIDTH * frame.shape[1], NARROWEST_EDGE_PX)
        shares = [outlined_share(apart, labels == number, width_px) for number in numbers]
        return np.array(shares) >= OUTLINED


def _difference(frame: ImageArray, background: ImageArray) -> Float32Array:
    """Return the largest difference over the colours between a frame and its background, (height, width)."""
    cv2 = optional("cv2")
    apart = cv2.absdiff(frame, background)
    apart = apart if apart.ndim == 2 else apart.max(axis=2)
    smooth: Float32Array = cv2.GaussianBlur(apart.astype(np.float32), (0, 0), _SMOOTHING_PX)
    return smooth


def outlined_share(apart: Float32Array, region: BoolArray, width_px: float) -> float:
    r"""Return the share of a region's outline that is an edge.

    .. math:: \max_{|q - p| \le w} |\nabla D(q)| \ge C / w,

    with C the 75th percentile of the change D over the region. An edge that a lens smears by
    :math:`\sigma` has the slope :math:`C / (\sigma \sqrt{2 \pi})`: it counts up to
    :math:`\sigma \approx 0.4 w`. The glow of lamps on a wall, a passing cloud and a step of the exposure
    change many pixels, but by less from each to the next.

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
