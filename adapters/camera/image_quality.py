"""Brightness, noise and sharpness of an image, estimated from the image itself."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve, gaussian_filter, sobel

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Float32Array, ImageArray

# Side of the central part that is analysed, at full resolution: a reduced image would hide blur and noise.
LARGEST_PX = 640
FINE_PX, COARSE_PX = 1.0, 4.0
_SECOND_DIFFERENCE = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
_GAIN = 6.0
_MAD_TO_STD = 1.4826
# Rounding to whole grey levels.
_QUANTISATION = 1.0 / 12.0


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """Brightness, noise and sharpness of one image."""

    brightness: float  # Mean grey level, 0 to 255
    noise: float  # Standard deviation of the pixel noise, grey levels
    # Gradient energy at 1 px over that at 4 px, noise taken off: it does not depend on the brightness. None
    # where the noise drowns it.
    sharpness: float | None


def image_quality(frame: ImageArray) -> ImageQuality:
    r"""Measure a frame.

    .. math:: \hat\sigma = 1.4826\, \mathrm{med} |D * x| / 6,

    .. math:: q = \frac{E_1}{E_4}, \qquad
              E_s = \overline{|\nabla (G_s * x)|^2} - \frac{\hat\sigma^2 + 1/12}{4 \pi s^4}.

    Shapes: frame (height, width).

    References
    ----------
    Immerkaer, "Fast noise variance estimation", 1996.
    """
    # The noise is that of the median absolute deviation of a second difference, in which smooth surfaces and
    # straight edges cancel,
    #
    # and the sharpness compares two scales of the gradient, less what white noise adds to each,
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or min(frame.shape[:2]) < 16:
        raise InvalidArgumentError(f"frame: expected an image of uint8, got {frame.dtype} {frame.shape}")
    grey = _central_grey(frame)
    second = np.abs(convolve(grey, _SECOND_DIFFERENCE.astype(np.float32)))
    noise = float(_MAD_TO_STD * np.median(second) / _GAIN)
    return ImageQuality(float(grey.mean()), noise, _sharpness(grey, noise))


def _central_grey(frame: ImageArray) -> Float32Array:
    top, left = (max((side - LARGEST_PX) // 2, 0) for side in frame.shape[:2])
    centre = frame[top : top + LARGEST_PX, left : left + LARGEST_PX]
    # One colour: an average over the three would hide part of the noise of each.
    return np.asarray(centre if centre.ndim == 2 else centre[:, :, 1], dtype=np.float32)


def _sharpness(grey: Float32Array, noise: float) -> float | None:
    fine, fine_noise = _gradient_energy(grey, FINE_PX, noise)
    coarse, coarse_noise = _gradient_energy(grey, COARSE_PX, noise)
    if coarse <= coarse_noise or fine < fine_noise:
        return None
    return max(fine, 0.0) / coarse


def _gradient_energy(grey: Float32Array, scale_px: float, noise: float) -> tuple[float, float]:
    """Energy of the gradient without, and of, the noise."""
    smooth = gaussian_filter(grey, scale_px)
    total = sum(float(np.mean((sobel(smooth, axis) / 8.0) ** 2)) for axis in (0, 1))
    spurious = (noise**2 + _QUANTISATION) / (4.0 * np.pi * scale_px**4)
    return total - spurious, spurious
