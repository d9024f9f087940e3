"""Staged degradation of camera frames: blur, darkness, sensor noise, four levels each."""

from collections.abc import Mapping
from functools import cache, lru_cache
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Float32Array, ImageArray

from .opencv import opencv

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
_QUANTILES = 1 << 16


def strength(family: str, degradation: float) -> float:
    """Return the strength of one of the three families at a degradation d in [0, 1]."""
    # Linear between the levels, darkness in the logarithm.
    level = in_range("degradation", degradation, 0.0, 1.0)
    if family not in STRENGTHS:
        raise InvalidArgumentError(f"family: expected {', '.join(STRENGTHS)}, got {family!r:.40}")
    knots = np.array(STRENGTHS[family])
    if family == "darkness":
        return float(np.exp(np.interp(level, LEVELS, np.log(knots))))
    return float(np.interp(level, LEVELS, knots))


def level_of(family: str, staged: float) -> float:
    """Return the d in [0, 1] of a strength, the inverse of `strength`; beyond the last level it is 1."""
    knots = np.array(STRENGTHS[family])
    if family == "darkness":
        return float(np.interp(-np.log(max(staged, 1e-6)), -np.log(knots), LEVELS))
    return float(np.interp(staged, knots, LEVELS))


def degrade(
    frame: ImageArray, family: Family, degradation: float, rng: np.random.Generator, reduced: float = 1.0
) -> ImageArray:
    r"""Return a frame as a degraded camera would have taken it.

    .. math:: y = \mathrm{clip}(\mathrm{round}(a\,(G_\sigma * x) + n)), \qquad n \sim N(0, s^2)

    with :math:`\sigma`, a and s those of the family at d; ``"all"`` takes the three together: optics first,
    exposure next, the sensor last. `reduced` is the number of the camera's pixels per side of one of the
    frame, whose mean it holds: the frame comes out as if it had been reduced after the degradation.

    Shapes: frame (height, width).
    """
    # A detector that works on a reduced image sees the same either way, for a tenth of the time: blur and
    # darkness commute with the mean over pixels, and of the noise only the mean over pixels is left.
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3):
        raise InvalidArgumentError(f"frame: expected an image of uint8, got {frame.dtype} {frame.shape}")
    if family not in FAMILIES:
        raise InvalidArgumentError(f"family: expected {', '.join(FAMILIES)}, got {family!r:.40}")
    level = in_range("degradation", degradation, 0.0, 1.0)
    if level == 0.0:
        return frame
    staged = tuple(STRENGTHS) if family == "all" else (family,)
    for name in staged:
        frame = _STAGES[name](frame, strength(name, level), rng, reduced)
    return frame


def _blurred(frame: ImageArray, sigma: float, rng: np.random.Generator, reduced: float) -> ImageArray:
    """Blur; a wide one on a reduced image, whose pixels are themselves a box of variance (f^2 - 1) / 12."""
    cv2 = opencv()
    sigma_px = sigma / reduced
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
    blurred: ImageArray = cv2.GaussianBlur(frame, (0, 0), left_px, borderType=border)
    return cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR) if factor > 1 else blurred


def _darkened(frame: ImageArray, factor: float, rng: np.random.Generator, reduced: float) -> ImageArray:
    table = np.round(np.arange(256) * factor).astype(np.uint8)
    return table[frame]


def _noisy(frame: ImageArray, sigma: float, rng: np.random.Generator, reduced: float) -> ImageArray:
    drawn = rng.integers(0, _QUANTILES, frame.shape, dtype=np.uint16)
    if reduced > 1.0:
        # Clipping moves the mean of a dark or bright pixel and narrows its noise, before the mean is taken.
        mean, std = _clipped_noise(sigma)
        # Cells that do not lie on whole pixels share those at their edges: the mean square of the weights of
        # cells anywhere is (r - 1/3) / r^2 a side.
        left = 1.0 / reduced if reduced.is_integer() else (reduced - 1.0 / 3.0) / reduced**2
        values = _normal().take(drawn) * (std * np.float32(left)).take(frame) + mean.take(frame)
        return np.clip(np.rint(values), 0, 255).astype(np.uint8)
    # Grey levels are whole, so the noise may be too: quantiles looked up, a third of the time of drawing it.
    grey: NDArray[np.int16] = np.rint(sigma * _normal()).astype(np.int16).take(drawn)
    grey += frame
    return np.clip(grey, 0, 255).astype(np.uint8)


@cache
def _normal() -> Float32Array:
    """Quantiles of the standard normal distribution."""
    return np.asarray(ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES), dtype=np.float32)


@lru_cache(maxsize=16)
def _clipped_noise(sigma: float) -> tuple[Float32Array, Float32Array]:
    """Mean and standard deviation of each grey level with noise, as a camera stores it; shape (256,)."""
    grey = np.arange(256.0)
    edges = ndtr((grey[:-1] + 0.5 - grey[:, None]) / sigma)
    share = np.diff(edges, axis=1, prepend=0.0, append=1.0)
    mean = share @ grey
    return mean.astype(np.float32), np.sqrt(share @ grey**2 - mean**2).astype(np.float32)


_STAGES = {"blur": _blurred, "darkness": _darkened, "noise": _noisy}
