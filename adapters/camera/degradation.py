"""Staged degradation of camera frames: blur, darkness, sensor noise, four levels each."""

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.typing import Float32Array, ImageArray

from .video import opencv

Family = Literal["blur", "darkness", "noise", "all"]
FAMILIES: tuple[Family, ...] = get_args(Family)

# d at which the table is measured: clean, then the four levels of each family.
LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Gaussian blur in pixels, factor on the brightness, noise in grey levels of 255.
STRENGTHS: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "blur": (0.0, 2.0, 4.0, 8.0, 16.0),
        "darkness": (1.0, 0.5, 0.25, 0.12, 0.06),
        "noise": (0.0, 10.0, 25.0, 50.0, 100.0),
    }
)

# Below, a neighbour's weight exp(-1 / 2 sigma^2) is less than half a grey level, and OpenCV finds no kernel.
_NO_BLUR_PX = 0.25
# A blur of this many pixels leaves no detail that half the resolution would lose.
_WIDE_PX = 4.0
# Number of quantiles of the staged noise, which ends at 4.3 sigma.
QUANTILES = 1 << 16


def strength(family: str, degradation: float) -> float:
    """Return the strength of one of the three families at a degradation d in [0, 1]."""
    # Linear between the levels, darkness in the logarithm.
    level = in_range("degradation", degradation, 0.0, 1.0)
    knots = np.array(STRENGTHS[family])
    if family == "darkness":
        return float(np.exp(np.interp(level, LEVELS, np.log(knots))))
    return float(np.interp(level, LEVELS, knots))


def darkness_of(factor: float) -> float:
    """Return the d in [0, 1] of a factor on the brightness; beyond the last level it is 1."""
    return float(np.interp(-np.log(max(factor, 1e-6)), -np.log(STRENGTHS["darkness"]), LEVELS))


def degrade(frame: ImageArray, family: Family, degradation: float, rng: np.random.Generator) -> ImageArray:
    r"""Return a frame as a degraded camera would have taken it.

    .. math:: y = \mathrm{clip}(\mathrm{round}(a\,(G_\sigma * x) + n)), \qquad n \sim N(0, s^2)

    with :math:`\sigma`, a and s those of the family at d; ``"all"`` takes the three together: optics first,
    exposure next, the sensor last.

    Shapes: frame (height, width).
    """
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3):
        raise InvalidArgumentError(f"frame: expected an image of uint8, got {frame.dtype} {frame.shape}")
    if family not in FAMILIES:
        raise InvalidArgumentError(f"family: expected {', '.join(FAMILIES)}, got {family!r:.40}")
    if degradation == 0.0:
        return frame
    staged = tuple(STRENGTHS) if family == "all" else (family,)
    for name in staged:
        frame = _STAGES[name](frame, strength(name, degradation), rng)
    return frame


def blurred(frame: ImageArray, sigma_px: float, rng: np.random.Generator) -> ImageArray:
    """Blur; a wide one on a reduced image, whose pixels are themselves a box of variance (f^2 - 1) / 12."""
    cv2 = opencv()
    if sigma_px < _NO_BLUR_PX:
        return frame
    height, width = frame.shape[:2]
    factor = 1
    while factor < sigma_px / _WIDE_PX and min(height, width) >= 32 * factor:
        factor *= 2
    if factor > 1:
        frame = cv2.resize(frame, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    left_px = np.sqrt(sigma_px**2 - (factor**2 - 1) / 12.0) / factor
    # The border is mirrored in its pixel's middle, which in a reduced image lies nearer to the pixel's edge.
    border = cv2.BORDER_REFLECT if factor > 1 else cv2.BORDER_REFLECT_101
    smooth: ImageArray = cv2.GaussianBlur(frame, (0, 0), left_px, borderType=border)
    return cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR) if factor > 1 else smooth


def _darkened(frame: ImageArray, factor: float, rng: np.random.Generator) -> ImageArray:
    table = np.round(np.arange(256) * factor).astype(np.uint8)
    return table[frame]


def _noisy(frame: ImageArray, sigma: float, rng: np.random.Generator) -> ImageArray:
    # Grey levels are whole, so the noise may be too: quantiles looked up, a third of the time of drawing it.
    drawn = rng.integers(0, QUANTILES, frame.shape, dtype=np.uint16)
    grey: NDArray[np.int16] = np.rint(sigma * normal_quantiles()).astype(np.int16).take(drawn)
    grey += frame
    return np.clip(grey, 0, 255).astype(np.uint8)


@cache
def normal_quantiles() -> Float32Array:
    """Quantiles of the standard normal distribution."""
    return np.asarray(ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES), dtype=np.float32)


_STAGES = {"blur": blurred, "darkness": _darkened, "noise": _noisy}
