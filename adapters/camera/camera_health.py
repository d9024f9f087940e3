"""Camera degradation: simulated on clean images by family and level, and estimated from images."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from worldstate.ground import InvalidArgumentError, finite_array, in_range
from worldstate.ground.checks import one_of
from worldstate.ground.extras import optional
from worldstate.ground.typing import Float32Array, FloatArray, ImageArray, IntArray

Family = Literal["blur", "darkness", "noise", "all"]
FAMILIES: tuple[Family, ...] = get_args(Family)

# Values of d at which the table is measured: clean, then the four levels of each family.
LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Gaussian blur in pixels, factor on the brightness, noise in grey levels (of 255).
STRENGTHS: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "blur": (0.0, 2.0, 4.0, 8.0, 16.0),
        "darkness": (1.0, 0.5, 0.25, 0.12, 0.06),
        "noise": (0.0, 10.0, 25.0, 50.0, 100.0),
    }
)

# Below this, a neighbour's weight exp(-1 / 2 sigma^2) is less than half a grey level, and OpenCV has no
# kernel.
_NO_BLUR_PX = 0.25
# A blur of this many pixels leaves no detail that is lost at half the resolution.
_WIDE_PX = 4.0
# Number of quantiles of the simulated noise; the last one is at 4.3 sigma.
QUANTILES = 1 << 16


def check_image(frame: ImageArray, least_px: int = 0) -> None:
    """Refuse an array that is no image, or an image with a shorter side."""
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or min(frame.shape[:2]) < least_px:
        raise InvalidArgumentError(f"frame: expected an image of uint8, got {frame.dtype} {frame.shape}")


def strength(family: str, degradation: float) -> float:
    """Return the strength of a family, except ``"all"``, at a degradation d in [0, 1]."""
    # Linear between the levels; darkness is linear in the logarithm.
    level = in_range("degradation", degradation, 0.0, 1.0)
    knots = np.array(STRENGTHS[family])
    if family == "darkness":
        return float(np.exp(np.interp(level, LEVELS, np.log(knots))))
    return float(np.interp(level, LEVELS, knots))


def darkness_of(factor: float) -> float:
    """Return the d in [0, 1] at which the brightness has this factor; 1 beyond the last level."""
    return float(np.interp(-np.log(max(factor, 1e-6)), -np.log(STRENGTHS["darkness"]), LEVELS))


def degrade(frame: ImageArray, family: Family, degradation: float, rng: np.random.Generator) -> ImageArray:
    r"""Return a frame as a degraded camera would take it.

    .. math:: y = \mathrm{clip}(\mathrm{round}(a\,(G_\sigma * x) + n)), \qquad n \sim N(0, s^2)

    where :math:`\sigma`, a and s are those of the family at d. ``"all"`` applies the three in the order
    optics, exposure, sensor.

    Shapes: frame (height, width).
    """
    check_image(frame)
    one_of("family", family, FAMILIES)
    if degradation == 0.0:
        return frame
    for name in STRENGTHS if family == "all" else (family,):
        frame = _STAGES[name](frame, strength(name, degradation), rng)
    return frame


def blurred(frame: ImageArray, sigma_px: float, rng: np.random.Generator) -> ImageArray:
    """Blur; a wide blur acts on a reduced image, whose pixels are a box filter of variance (f^2 - 1) / 12."""
    cv2 = optional("cv2")
    if sigma_px < _NO_BLUR_PX:
        return frame
    height, width = frame.shape[:2]
    factor = 1
    while factor < sigma_px / _WIDE_PX and min(height, width) >= 32 * factor:
        factor *= 2
    if factor > 1:
        frame = cv2.resize(frame, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    left_px = np.sqrt(sigma_px**2 - (factor**2 - 1) / 12.0) / factor
    # The border is mirrored at the middle of its pixel, which in a reduced image is nearer to the pixel's
    # edge.
    border = cv2.BORDER_REFLECT if factor > 1 else cv2.BORDER_REFLECT_101
    smooth: ImageArray = cv2.GaussianBlur(frame, (0, 0), left_px, borderType=border)
    return cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR) if factor > 1 else smooth


def _darkened(frame: ImageArray, factor: float, rng: np.random.Generator) -> ImageArray:
    return np.round(np.arange(256) * factor).astype(np.uint8)[frame]


def _noisy(frame: ImageArray, sigma: float, rng: np.random.Generator) -> ImageArray:
    # Grey levels are integers, so integer noise suffices: table look-up takes a third of the time of drawing.
    drawn = rng.integers(0, QUANTILES, frame.shape, dtype=np.uint16)
    grey: NDArray[np.int16] = np.rint(sigma * normal_quantiles()).astype(np.int16).take(drawn)
    grey += frame
    return np.clip(grey, 0, 255).astype(np.uint8)


@cache
def normal_quantiles() -> Float32Array:
    """Quantiles of the standard normal distribution."""
    from scipy.special import ndtri

    return np.asarray(ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES), dtype=np.float32)


_STAGES = {"blur": blurred, "darkness": _darkened, "noise": _noisy}


# While an image is clean (every d at most `_CLEAN`), the reference brightness and sharpness follow it with
# this time constant, but stay within a factor of the learned values, so that slow soiling does not become the
# reference.
_FOLLOW_S, _CLEAN, _MOST_DRIFT = 120.0, 0.15, 1.5
# Side of the analysed central part. It keeps the full resolution, because a reduced image would hide blur and
# noise.
LARGEST_PX = 640
FINE_PX, COARSE_PX = 1.0, 4.0
_SECOND_DIFFERENCE = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
_GAIN = 6.0
_MAD_TO_STD = 1.4826
# Variance from rounding to integer grey levels.
_QUANTISATION = 1.0 / 12.0


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """Brightness, noise and sharpness of one image."""

    brightness: float  # Mean grey level, 0 to 255
    noise: float  # Standard deviation of the pixel noise, grey levels
    # Gradient energy at 1 px over that at 4 px, without noise; independent of the brightness. None if the
    # noise is stronger.
    sharpness: float | None


def image_quality(frame: ImageArray) -> ImageQuality:
    r"""Measure brightness, noise and sharpness of a frame.

    .. math:: \hat\sigma = 1.4826\, \mathrm{med} |D * x| / 6,

    .. math:: q = \frac{E_1}{E_4}, \qquad
              E_s = \overline{|\nabla (G_s * x)|^2} - \frac{\hat\sigma^2 + 1/12}{4 \pi s^4}.

    Shapes: frame (height, width).

    References
    ----------
    Immerkaer, "Fast noise variance estimation", 1996.
    """
    # The noise is estimated by the median absolute deviation of a second difference, in which smooth surfaces
    # and straight edges cancel. The sharpness compares the gradient at two scales, without the contribution
    # of white noise to each.
    check_image(frame, least_px=16)
    # Imported here: it takes as long as all other imports of a run without a camera together.
    from scipy.ndimage import convolve

    grey = _central_grey(frame)
    second = np.abs(convolve(grey, _SECOND_DIFFERENCE.astype(np.float32)))
    noise = float(_MAD_TO_STD * np.median(second) / _GAIN)
    return ImageQuality(float(grey.mean()), noise, _sharpness(grey, noise))


def _central_grey(frame: ImageArray) -> Float32Array:
    top, left = (max((side - LARGEST_PX) // 2, 0) for side in frame.shape[:2])
    centre = frame[top : top + LARGEST_PX, left : left + LARGEST_PX]
    # One colour, because an average over the three would hide part of the noise.
    return np.asarray(centre if centre.ndim == 2 else centre[:, :, 1], dtype=np.float32)


def _sharpness(grey: Float32Array, noise: float) -> float | None:
    fine, fine_noise = _gradient_energy(grey, FINE_PX, noise)
    coarse, coarse_noise = _gradient_energy(grey, COARSE_PX, noise)
    return None if coarse <= coarse_noise or fine < fine_noise else max(fine, 0.0) / coarse


def _gradient_energy(grey: Float32Array, scale_px: float, noise: float) -> tuple[float, float]:
    """Return the energy of the gradient without the noise, and that of the noise."""
    from scipy.ndimage import gaussian_filter, sobel

    smooth = gaussian_filter(grey, scale_px)
    total = sum(float(np.mean((sobel(smooth, axis) / 8.0) ** 2)) for axis in (0, 1))
    spurious = (noise**2 + _QUANTISATION) / (4.0 * np.pi * scale_px**4)
    return total - spurious, spurious


@dataclass(frozen=True, slots=True)
class Health:
    """Degradation of an image per family, each d in [0, 1] on the scale of `LEVELS`.

    Examples
    --------
    >>> max(astuple(Health(blur=0.1, darkness=0.5, noise=0.0)))
    0.5
    """

    blur: float
    darkness: float
    noise: float


@dataclass(frozen=True, slots=True)
class CameraHealth:
    """Brightness, sharpness and noise of a camera's images, clean and at each level: the scale of d."""

    brightness: float  # Mean grey level of clean images, > 0
    sharpness: tuple[float, ...]  # At the five levels of blur, non-increasing
    noise: tuple[float, ...]  # At the five levels of noise, non-decreasing

    def __post_init__(self) -> None:
        in_range("brightness", self.brightness, 0.0, 255.0, open_low=True)
        sharpness = finite_array("sharpness", self.sharpness, (len(LEVELS),))
        noise = finite_array("noise", self.noise, (len(LEVELS),))
        if (np.diff(sharpness) > 0).any() or (np.diff(noise) < 0).any():
            raise InvalidArgumentError("expected sharpness that does not rise and noise that does not fall")
        if sharpness[0] <= 0.0 or noise[0] < 0.0:
            raise InvalidArgumentError("expected a positive sharpness and a noise >= 0")

    def estimate(self, quality: ImageQuality) -> Health:
        """Return d per family."""
        # If noise hides the sharpness, blur is not estimated; the noise is then the larger degradation.
        blur = 0.0
        if quality.sharpness is not None:
            blur = float(np.interp(-quality.sharpness, -np.array(self.sharpness), LEVELS))
        darkness = darkness_of(min(quality.brightness / self.brightness, 1.0))
        return Health(blur, darkness, float(np.interp(quality.noise, self.noise, LEVELS)))


def learn_health(clean: Iterable[ImageArray], rng: np.random.Generator) -> CameraHealth:
    """Measure the scale of a camera on clean images and on degraded copies of them."""
    brightness, sharpness, noise = [], [], []
    for frame in clean:
        brightness.append(image_quality(frame).brightness)
        blurred = [image_quality(degrade(frame, "blur", d, rng)).sharpness for d in LEVELS]
        sharpness.append([np.nan if value is None else value for value in blurred])
        noise.append([image_quality(degrade(frame, "noise", d, rng)).noise for d in LEVELS])
    return health_scale(np.array(brightness), np.array(sharpness), np.array(noise))


def health_scale(brightness: FloatArray, sharpness: FloatArray, noise: FloatArray) -> CameraHealth:
    """Return the scale from measures of clean images and of their copies at each level.

    Shapes: brightness (n,), sharpness and noise (n, levels). Sharpness is NaN if noise hides it.
    """
    if not brightness.size or np.isnan(sharpness).all(axis=0).any():
        raise InvalidArgumentError("clean: expected at least one image with a measurable sharpness")
    return CameraHealth(
        brightness=float(np.median(brightness)),
        sharpness=tuple(np.minimum.accumulate(np.nanmedian(sharpness, axis=0)).tolist()),
        noise=tuple(np.maximum.accumulate(np.median(noise, axis=0)).tolist()),
    )


class HealthMonitor:
    """Track a camera's degradation against a clean reference that adapts to the daylight."""

    def __init__(self, health: CameraHealth) -> None:
        self.reference = self._learned = health
        self._stamp_ns: int | None = None

    def update(self, stamp_ns: int, quality: ImageQuality) -> Health:
        """Process the quality of the next image; return the degradation per family."""
        seen = self.reference.estimate(quality)
        elapsed_s = 0.0 if self._stamp_ns is None else max(stamp_ns - self._stamp_ns, 0) / 1e9
        self._stamp_ns = stamp_ns
        if max(astuple(seen)) <= _CLEAN:
            self._follow(quality, 1.0 - math.exp(-elapsed_s / _FOLLOW_S))
        return seen

    def _follow(self, quality: ImageQuality, weight: float) -> None:
        held, learned = self.reference, self._learned
        brightness = self._moved(held.brightness, quality.brightness, learned.brightness, weight)
        sharpest = held.sharpness[0]
        if quality.sharpness is not None:
            sharpest = self._moved(sharpest, quality.sharpness, learned.sharpness[0], weight)
        scale = sharpest / learned.sharpness[0]
        curve = tuple(value * scale for value in learned.sharpness)
        self.reference = replace(held, brightness=min(brightness, 255.0), sharpness=curve)

    def _moved(self, held: float, seen: float, learned: float, weight: float) -> float:
        return min(max(held + weight * (seen - held), learned / _MOST_DRIFT), learned * _MOST_DRIFT)


@dataclass(frozen=True, slots=True, eq=False)
class DegradationLog:
    """Degradation over time, as a function of the stamp for `VisionQuery`."""

    stamps_ns: IntArray  # shape (n,): Increasing
    degradation: FloatArray  # shape (n,): d in [0, 1]

    def __post_init__(self) -> None:
        d = finite_array("degradation", self.degradation, (np.size(self.stamps_ns),))
        if not d.size or (np.diff(self.stamps_ns) <= 0).any() or d.min() < 0.0 or d.max() > 1.0:
            raise InvalidArgumentError("degradation: expected numbers in [0, 1] at increasing time stamps")

    def __call__(self, stamp_ns: int) -> float:
        """Return d at the last stamp up to `stamp_ns`; before the first stamp, the first d."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns, side="right")) - 1
        return float(self.degradation[max(index, 0)])
