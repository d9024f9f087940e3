"""Interface of a detector, overlap of boxes and non-maximum suppression."""

from typing import Protocol

import numpy as np

from worldstate.ground.typing import FloatArray, ImageArray, IntArray

from .detections import DetectionFrame


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


def overlaps(boxes_px: FloatArray, others_px: FloatArray) -> FloatArray:
    r"""Return the intersection over union of every box with every other one.

    .. math:: IoU = |A \cap B| / |A \cup B|

    Shapes: boxes_px, others_px (n, 4).
    """
    low = np.maximum(boxes_px[:, None, :2], others_px[None, :, :2])
    high = np.minimum(boxes_px[:, None, 2:], others_px[None, :, 2:])
    common = np.clip(high - low, 0.0, None).prod(axis=2)
    union = _areas(boxes_px)[:, None] + _areas(others_px)[None, :] - common
    return np.asarray(np.divide(common, union, out=np.zeros_like(common), where=union > 0))


def suppress(boxes_px: FloatArray, scores: FloatArray, most_overlap: float) -> IntArray:
    """Return the indices after non-maximum suppression of boxes (n, 4) by scores (n,), the best first."""
    left = np.argsort(-scores, kind="stable")
    kept = []
    while left.size:
        kept.append(left[0])
        rest = left[1:]
        left = rest[overlaps(boxes_px[left[:1]], boxes_px[rest])[0] <= most_overlap]
    return np.array(kept, dtype=np.int64)


def _areas(boxes_px: FloatArray) -> FloatArray:
    return np.asarray(np.clip(boxes_px[:, 2:] - boxes_px[:, :2], 0.0, None).prod(axis=1))
