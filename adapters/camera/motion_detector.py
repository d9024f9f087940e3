"""A detector of moving objects for a standing camera, by background subtraction."""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, ImageArray, IntArray

from .detections import DetectionFrame
from .edge_sharpness import difference, outlined_share
from .opencv import opencv

# No edge of an image is narrower: pixels have a size, and noise is smoothed before it is looked for.
NARROWEST_EDGE_PX = 3.0
# MOG2's own: a pixel moves when it is so many variances from every mode of its background.
MOG2_VARIANCES = 16.0

Background = Literal["mog2", "knn"]


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """Settings of the motion detector."""

    # Model of the background: Gaussian mixtures or nearest neighbours, both OpenCV's.
    background: Background = "mog2"
    width_px: int = 640  # Frames are reduced to this width first
    history: int = 100  # Frames that the background remembers
    warm_up: int = 5  # First frames, in which nothing is reported
    # Smallest difference that is motion, grey levels, Euclidean over the colours, > 0. The codec and the
    # sensor of a street camera scatter by some 3 grey levels a colour, 5 over three: three times that.
    least_contrast: float = 15.0
    min_area: float = 0.0015  # Smallest object as a share of the image, in (0, 1)
    max_area: float = 0.6  # Larger regions are changes of the light
    # Widest edge of an object as a share of the image's width, in (0, 1]. A change without one on at least
    # `outlined` of its outline is light: the glow of lamps, a cloud, or what a lens out of focus leaves.
    edge_width: float = 0.01
    # In [0, 1]; 0 lets everything through. Below one half, as a car has no edge where it meets its shadow.
    outlined: float = 0.25
    label: str = "car"  # The label of all boxes: background subtraction has no classes

    def __post_init__(self) -> None:
        if self.background not in get_args(Background):
            raise InvalidArgumentError(f"background: expected mog2 or knn, got {self.background!r:.40}")
        in_range("width_px", self.width_px, 16, 8192)
        in_range("history", self.history, 1, 100_000)
        in_range("warm_up", self.warm_up, 0, 100_000)
        in_range("least_contrast", self.least_contrast, 0.0, 255.0, open_low=True)
        in_range("min_area", self.min_area, 0.0, self.max_area, open_low=True)
        in_range("max_area", self.max_area, 0.0, 1.0)
        in_range("edge_width", self.edge_width, 0.0, 1.0, open_low=True)
        in_range("outlined", self.outlined, 0.0, 1.0)


class MotionDetector:
    """Detect moving objects in the images of a standing camera by background subtraction.

    Parameters
    ----------
    settings : MotionSettings, optional
        Background model, contrast, sizes and edges.

    Raises
    ------
    MissingExtraError
        If OpenCV is not installed.

    Examples
    --------
    >>> detector = MotionDetector(MotionSettings(width_px=64, warm_up=2))
    >>> street = np.random.default_rng(0).integers(90, 110, (48, 64, 3)).astype(np.uint8)
    >>> for _ in range(10): empty = detector.detect(street)
    >>> street[20:40, 10:30] = 220
    >>> len(empty), detector.detect(street).boxes_px.tolist()
    (0, [[10.0, 20.0, 30.0, 40.0]])
    """

    def __init__(self, settings: MotionSettings | None = None) -> None:
        self.settings = settings or MotionSettings()
        self._cv2 = opencv()
        self._background = self._make_background()
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
        if self._seen <= self.settings.warm_up:
            return DetectionFrame(np.empty((0, 4)), np.empty(0), ())
        scale = np.array([width, height] * 2) / np.array([small.shape[1], small.shape[0]] * 2)
        return self._objects(small, mask, scale)

    def _make_background(self) -> Any:
        chosen = self.settings
        least = chosen.least_contrast**2
        if chosen.background == "knn":
            return self._cv2.createBackgroundSubtractorKNN(chosen.history, least, detectShadows=False)
        model = self._cv2.createBackgroundSubtractorMOG2(chosen.history, MOG2_VARIANCES, detectShadows=False)
        model.setVarMin(least / MOG2_VARIANCES)
        return model

    def _reduced(self, frame: ImageArray) -> ImageArray:
        height, width = frame.shape[:2]
        if width <= self.settings.width_px:
            return frame
        size = (self.settings.width_px, max(round(height * self.settings.width_px / width), 1))
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
        kept = (share >= self.settings.min_area) & (share <= self.settings.max_area)
        kept[0] = False  # what does not move
        numbers = np.flatnonzero(kept)
        if numbers.size and self.settings.outlined > 0.0:
            numbers = numbers[self._has_outline(frame, labels, numbers)]
        left, top, width, height, area = stats[numbers].T.astype(np.float64)
        boxes = np.stack([left, top, left + width, top + height], axis=1) * scale
        return DetectionFrame(boxes, area / (width * height), (self.settings.label,) * numbers.size)

    def _has_outline(self, frame: ImageArray, labels: NDArray[np.int32], numbers: IntArray) -> BoolArray:
        """Return which regions are objects and not changes of the light."""
        apart = difference(frame, self._background.getBackgroundImage())
        width_px = max(self.settings.edge_width * frame.shape[1], NARROWEST_EDGE_PX)
        shares = [outlined_share(apart, labels == number, width_px) for number in numbers]
        return np.array(shares) >= self.settings.outlined
