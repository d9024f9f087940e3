"""Separate moving objects from changes of the light by the sharpness of their outline."""

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, Float32Array, ImageArray

from .opencv import opencv

# Smoothing against pixel noise in the gradient; far narrower than any edge width in use.
_SMOOTHING_PX = 0.7
# The contrast of a change is the level that it reaches over most of its area.
_CONTRAST_PERCENTILE = 75.0


def difference(frame: ImageArray, background: ImageArray) -> Float32Array:
    """Return the largest difference over the colours between a frame and its background, (height, width)."""
    if frame.shape != background.shape:
        raise InvalidArgumentError(f"background: expected the shape {frame.shape}, got {background.shape}")
    cv2 = opencv()
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
    in_range("width_px", width_px, 0.0, 1e6, open_low=True)
    if apart.shape != region.shape or not region.any():
        raise InvalidArgumentError(
            f"region: expected pixels of an image {apart.shape}, got {region.sum()} of {region.shape}"
        )
    cv2 = opencv()
    contrast = float(np.percentile(apart[region], _CONTRAST_PERCENTILE))
    across, down = (cv2.Sobel(apart, cv2.CV_32F, *order, scale=1.0 / 8.0) for order in ((1, 0), (0, 1)))
    reach = np.ones((2 * round(width_px) + 1,) * 2, dtype=np.uint8)
    steepest = cv2.dilate(cv2.magnitude(across, down), reach)
    outline = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    return float(np.mean(steepest[outline] >= contrast / width_px))
