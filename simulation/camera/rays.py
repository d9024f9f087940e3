"""Rays of the camera and what they meet first: planes of a street, solids of a vehicle."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.typing import Float32Array, FloatArray, IndexArray

# From two coordinates on a surface to red, green, blue in 0..255, shape (..., 3).
Paint = Callable[[Float32Array, Float32Array], Float32Array]

OVERSAMPLING = 2  # rays across a pixel and down
NEAREST_M = 0.05


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of the image in rays: rows from `top` to `bottom`, columns from `left` to `right`."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """For indexing an array of rays."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def pixels(self) -> tuple[slice, slice]:
        """For indexing an image; whole pixels only."""
        n = OVERSAMPLING
        return slice(self.top // n, self.bottom // n), slice(self.left // n, self.right // n)


@dataclass(frozen=True, slots=True)
class View:
    """A pinhole camera with a few rays a pixel."""

    camera: PinholeCamera  # Size of the image, angle of view, place and direction

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of rays."""
        return OVERSAMPLING * self.camera.height_px, OVERSAMPLING * self.camera.width_px

    @property
    def whole(self) -> Patch:
        """All of the image."""
        return Patch(0, self.shape[0], 0, self.shape[1])

    @property
    def focal(self) -> float:
        """Focal length in rays."""
        return 0.5 * self.shape[1] / math.tan(self.camera.half_angle_rad)

    def rays(self, patch: Patch) -> Float32Array:
        """Directions in `base_link`, one unit long along the optical axis, shape (rows, columns, 3)."""
        rows, columns = self.shape
        left = (0.5 * columns - 0.5 - np.arange(patch.left, patch.right)) / self.focal
        up = (0.5 * rows - 0.5 - np.arange(patch.top, patch.bottom)) / self.focal
        axes = self._axes
        rays = axes[0] + left[None, :, None] * axes[1] + up[:, None, None] * axes[2]
        return np.asarray(rays, np.float32)

    def around(self, points_m: FloatArray) -> Patch | None:
        """Return whole pixels around the projection of points ahead, (n, 3); None where it is outside."""
        ahead, left, up = (self._axes @ (points_m - self.camera.position_m).T).astype(np.float64)
        ahead = np.maximum(ahead, NEAREST_M)
        rows, columns = self.shape
        across = 0.5 * columns - self.focal * left / ahead
        down = 0.5 * rows - self.focal * up / ahead
        low, high = _whole(across, columns)
        top, bottom = _whole(down, rows)
        return Patch(top, bottom, low, high) if low < high and top < bottom else None

    @property
    def _axes(self) -> FloatArray:
        """Forward, left and up, shape (3, 3)."""
        yaw, pitch = self.camera.yaw_rad, self.camera.pitch_rad
        sin_yaw, cos_yaw, sin_pitch, cos_pitch = np.sin(yaw), np.cos(yaw), np.sin(pitch), np.cos(pitch)
        forward = [cos_yaw * cos_pitch, sin_yaw * cos_pitch, sin_pitch]
        up = [-cos_yaw * sin_pitch, -sin_yaw * sin_pitch, cos_pitch]
        return np.array([forward, [-sin_yaw, cos_yaw, 0.0], up])


def _whole(values: FloatArray, limit: int) -> tuple[int, int]:
    """First and last ray of the pixels that hold all values, within the image."""
    n = OVERSAMPLING
    low, high = np.clip([values.min(), values.max()], -n, limit + n)
    return max(int(low) // n * n, 0), min((int(high) // n + 1) * n, limit)


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle across one axis, painted."""

    axis: int  # 0, 1 or 2: the coordinate that is constant
    at_m: float  # Its value
    # Ranges of the two others, in the order of the axes.
    limits_m: tuple[tuple[float, float], tuple[float, float]]
    paint: Paint  # Colour by those two coordinates


def cast_panels(
    view: View, patch: Patch, panels: list[Panel], sky: Paint
) -> tuple[Float32Array, Float32Array]:
    """Paint a patch of rays with the nearest panel that each meets, or the sky."""
    rays, eye = view.rays(patch), view.camera.position_m
    image = sky(rays[..., 1] / rays[..., 0], rays[..., 2] / rays[..., 0])
    depth = np.full(rays.shape[:2], np.inf, np.float32)
    for panel in panels:
        first, second = (axis for axis in range(3) if axis != panel.axis)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (panel.at_m - eye[panel.axis]) / rays[..., panel.axis]
            a, b = (eye[axis] + reach * rays[..., axis] for axis in (first, second))
        (a_low, a_high), (b_low, b_high) = panel.limits_m
        met = (reach > NEAREST_M) & (reach < depth)
        met &= (a >= a_low) & (a <= a_high) & (b >= b_low) & (b <= b_high)
        image[met] = panel.paint(a[met], b[met])
        depth[met] = reach[met]
    return image, depth


def cast_solid(
    rays: Float32Array, eye_m: FloatArray, normals: FloatArray, offsets: FloatArray
) -> tuple[Float32Array, IndexArray]:
    r"""Meet a convex solid :math:`\{p : n_k \cdot p \le o_k\}`.

    Shapes: rays (rows, columns, 3), eye_m (3,), normals, offsets (K, 3), returns (rows, columns).
    """
    enter, leave = np.full(rays.shape[:2], -np.inf, np.float32), np.full(rays.shape[:2], np.inf, np.float32)
    face = np.zeros(rays.shape[:2], np.intp)
    for number, (normal, offset) in enumerate(zip(normals.astype(np.float32), offsets, strict=True)):
        gap = np.float32(offset - normal @ eye_m)
        towards = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = gap / towards
        # A ray along a face never meets it; outside of that face it misses the solid.
        leave[(towards == 0.0) & (gap < 0.0)] = -np.inf
        np.minimum(leave, reach, out=leave, where=towards > 0.0)
        later = (towards < 0.0) & (reach > enter)
        enter[later], face[later] = reach[later], number
    enter[(enter > leave) | (enter <= NEAREST_M)] = np.inf
    return enter, face


def reduced(image: Float32Array) -> Float32Array:
    """Average the rays of each pixel, (rows, columns, 3) to (height, width, 3).

    Examples
    --------
    >>> reduced(np.arange(12, dtype=np.float32).reshape(2, 2, 3))
    array([[[4.5, 5.5, 6.5]]], dtype=float32)
    """
    n = OVERSAMPLING
    total = sum(image[i::n, j::n] for i in range(n) for j in range(n))
    return np.asarray(total / np.float32(n * n), np.float32)
