"""Camera view of the street without a vehicle: ground, side walls, corners, opposite side."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, ImageArray, IndexArray
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.vehicle import ARRAY_HEIGHT_M

# Maps two coordinates on a surface to red, green, blue in 0..255, shape (..., 3).
Paint = Callable[[Float32Array, Float32Array], Float32Array]

OVERSAMPLING = 2  # Rays per pixel in each direction
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
        """Index of an array of rays."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Index of an image; whole pixels only."""
        n = OVERSAMPLING
        return slice(self.top // n, self.bottom // n), slice(self.left // n, self.right // n)


@dataclass(frozen=True, slots=True)
class View:
    """A pinhole camera with several rays per pixel."""

    camera: PinholeCamera  # Size of the image, angle of view, position and direction

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
        """Return directions in `base_link`, of unit length along the optical axis, (rows, columns, 3)."""
        rows, columns = self.shape
        left = (0.5 * columns - 0.5 - np.arange(patch.left, patch.right)) / self.focal
        up = (0.5 * rows - 0.5 - np.arange(patch.top, patch.bottom)) / self.focal
        axes = self._axes
        rays = axes[0] + left[None, :, None] * axes[1] + up[:, None, None] * axes[2]
        return np.asarray(rays, np.float32)

    def around(self, points_m: FloatArray) -> Patch | None:
        """Return whole pixels around the projection of points ahead, (n, 3); None if it is outside."""
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
    """Return the first and last ray of the pixels that contain all values, within the image."""
    n = OVERSAMPLING
    low, high = np.clip([values.min(), values.max()], -n, limit + n)
    return max(int(low) // n * n, 0), min((int(high) // n + 1) * n, limit)


@dataclass(frozen=True, slots=True)
class Panel:
    """A painted rectangle perpendicular to one axis."""

    axis: int  # The constant coordinate: 0, 1 or 2
    at_m: float  # Value of that coordinate
    # Ranges of the other two coordinates, in the order of the axes.
    limits_m: tuple[tuple[float, float], tuple[float, float]]
    paint: Paint  # Colour as a function of those two coordinates


def cast_panels(
    view: View, patch: Patch, panels: list[Panel], sky: Paint
) -> tuple[Float32Array, Float32Array]:
    """Paint a patch of rays with the nearest panel that each ray meets, or the sky."""
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
    r"""Intersect rays with a convex solid :math:`\{p : n_k \cdot p \le o_k\}`.

    Shapes: rays (rows, columns, 3), eye_m (3,), normals, offsets (K, 3), returns (rows, columns).
    """
    enter, leave = np.full(rays.shape[:2], -np.inf, np.float32), np.full(rays.shape[:2], np.inf, np.float32)
    face = np.zeros(rays.shape[:2], np.intp)
    for number, (normal, offset) in enumerate(zip(normals.astype(np.float32), offsets, strict=True)):
        gap = np.float32(offset - normal @ eye_m)
        towards = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = gap / towards
        # A ray parallel to a face never meets it; outside of that face it misses the solid.
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


Colour = tuple[float, float, float]

BRICK_M, COURSE_M, JOINT_M = 0.21, 0.065, 0.01
STOREY_M = 2.9
OPENING_TOP_M, FRAME_M = 2.25, 0.07
FRAME: Colour = (196.0, 194.0, 188.0)
SILL: Colour = (168.0, 164.0, 156.0)
GLASS: Colour = (58.0, 66.0, 74.0)
# Half width, lower edge, height of the sill, and colour of an opening.
WINDOW, DOOR = (0.6, 0.95, 0.1, GLASS), (0.45, 0.0, 0.0, (70.0, 82.0, 78.0))


def cell_noise(a: ArrayLike, b: ArrayLike, seed: int) -> Float32Array:
    """Return a number in [0, 1) for every integer pair of coordinates, always the same for the same seed.

    Examples
    --------
    >>> once, again = cell_noise([0.0, 1.0], [2.0, 2.0], 1), cell_noise([0.0, 1.0], [2.0, 2.0], 1)
    >>> bool((once == again).all()), bool(once[0] != once[1])
    (True, True)
    """
    i, j = (np.floor(np.asarray(x)).astype(np.int64).astype(np.uint32) for x in (a, b))
    mixed = i * np.uint32(0x9E3779B1) + j * np.uint32(0x85EBCA77) + np.uint32(seed * 2654435761 & 0xFFFFFFFF)
    for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39)):
        mixed = (mixed ^ (mixed >> np.uint32(shift))) * np.uint32(factor)
    return np.asarray((mixed ^ (mixed >> np.uint32(15))) / np.float32(2**32), np.float32)


def smooth_noise(a: Float32Array, b: Float32Array, cell_m: float, seed: int) -> Float32Array:
    """Return smooth noise in [0, 1), with features of about `cell_m`."""
    x, y = a / np.float32(cell_m), b / np.float32(cell_m)
    left, low = np.floor(x), np.floor(y)
    fx, fy = _ease(x - left), _ease(y - low)
    corners = [[cell_noise(left + i, low + j, seed) for i in (0, 1)] for j in (0, 1)]
    below, above = ((1.0 - fx) * pair[0] + fx * pair[1] for pair in corners)
    return np.asarray((1.0 - fy) * below + fy * above, np.float32)


def _ease(t: Float32Array) -> Float32Array:
    return t * t * (3.0 - 2.0 * t)


def tinted(colour: Colour, shade: ArrayLike) -> Float32Array:
    """Return a colour times a shade of any shape; the last axis has length three."""
    return np.asarray(np.asarray(shade, np.float32)[..., None] * np.array(colour, np.float32), np.float32)


def asphalt(a: Float32Array, b: Float32Array, seed: int) -> Float32Array:
    """Paint asphalt: dark, mottled, with patches."""
    patches = np.where(smooth_noise(a, b, 2.7, seed) > 0.62, -0.07, 0.0)
    grain = cell_noise(a / 0.02, b / 0.02, seed) - 0.5
    shade = 0.85 + 0.16 * smooth_noise(a, b, 0.6, seed + 1) + 0.22 * grain
    return tinted((96.0, 97.0, 99.0), shade + patches)


def paving(a: Float32Array, b: Float32Array, seed: int) -> Float32Array:
    """Paint brown-grey paving bricks in courses."""
    return tinted((124.0, 108.0, 98.0), _courses(a, b, 0.2, 0.1, seed))


def flags(a: Float32Array, b: Float32Array, seed: int) -> Float32Array:
    """Paint concrete flags of 30 cm."""
    return tinted((150.0, 148.0, 143.0), _courses(a, b, 0.3, 0.3, seed))


def grass(a: Float32Array, b: Float32Array, seed: int) -> Float32Array:
    """Paint a verge."""
    shade = 0.75 + 0.3 * smooth_noise(a, b, 1.3, seed) + 0.3 * (cell_noise(a / 0.03, b / 0.03, seed) - 0.5)
    return tinted((92.0, 108.0, 70.0), shade)


def leaves(a: Float32Array, b: Float32Array, seed: int) -> Float32Array:
    """Paint a hedge."""
    shade = 0.6 + 0.5 * smooth_noise(a, b, 0.25, seed) + 0.3 * (cell_noise(a / 0.06, b / 0.06, seed) - 0.5)
    return tinted((70.0, 84.0, 56.0), shade)


def brick(a: Float32Array, b: Float32Array, colour: Colour, seed: int) -> Float32Array:
    """Paint a wall in stretcher bond, a along the wall, b upwards."""
    weather = 0.9 + 0.2 * smooth_noise(a, b, 1.8, seed + 7)
    return tinted(colour, weather * _courses(a, b, BRICK_M, COURSE_M, seed))


def _courses(a: Float32Array, b: Float32Array, length_m: float, height_m: float, seed: int) -> Float32Array:
    """Return the shade of stones with dark joints; every other course is shifted by half a stone."""
    course = np.floor(b / np.float32(height_m))
    along = a / np.float32(length_m) + 0.5 * np.mod(course, 2.0)
    shade = 0.85 + 0.3 * cell_noise(along, course, seed)
    joint = (np.mod(along, 1.0) < JOINT_M / length_m) | (np.mod(b / height_m, 1.0) < JOINT_M / height_m)
    return np.where(joint, 0.72, shade).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Facade:
    """A house front: brick, windows on every storey, doors on the ground floor."""

    colour: Colour  # Colour of the brick
    bay_m: float  # Distance between windows
    brightness: float  # Brightness of the incident light
    seed: int  # Seed of the house

    def paint(self, a: Float32Array, b: Float32Array) -> Float32Array:
        """Return the colours at positions along the wall and upwards."""
        up = b - np.float32(ROAD_Z_M)
        image = brick(a, up, self.colour, self.seed)
        bay, storey = np.floor(a / self.bay_m), np.floor(up / STOREY_M)
        x = a - (bay + 0.5) * np.float32(self.bay_m)
        y = up - storey * np.float32(STOREY_M)
        doors = (storey < 1) & (cell_noise(bay, storey, self.seed + 1) < 0.3)
        drawn = cell_noise(bay + np.floor(1.5 * x), np.floor(0.7 * y), self.seed + 3) < 0.3
        mirrored = 0.75 + 0.5 * np.clip((y - 0.9) / 1.4, 0.0, 1.0)
        for (half, low, sill, colour), here in ((WINDOW, ~doors), (DOOR, doors)):
            image[here & (np.abs(x) < half) & (y > low) & (y < OPENING_TOP_M)] = FRAME
            pane = here & (np.abs(x) < half - FRAME_M) & (np.abs(x) > 0.5 * FRAME_M)
            pane &= (y > low + FRAME_M) & (y < OPENING_TOP_M - FRAME_M)
            image[pane] = tinted(colour, mirrored * np.where(drawn, 1.5, 1.0))[pane]
            image[here & (np.abs(x) < half + 0.08) & (y > low - sill) & (y < low)] = SILL
        # Walls are darker at their foot, which receives less light from the sky.
        light = self.brightness * (0.72 + 0.28 * np.clip(up / 1.5, 0.0, 1.0))
        return np.asarray(image * light[..., None], np.float32)


ROAD_Z_M = -ARRAY_HEIGHT_M
FAR_M = 150.0
# A building projects from its side wall over the last metre before the corner.
PIER_M = 1.0
PAVEMENT_M = 0.9
# Sites without a wall opposite have a verge with a hedge and houses behind.
HEDGE_AHEAD_M, HEDGE_HEIGHT_M, HOUSES_AHEAD_M = 16.0, 1.7, 34.0
STRIP_ROWS = 64
BRICKS = ((134.0, 92.0, 76.0), (150.0, 120.0, 96.0), (116.0, 88.0, 80.0), (160.0, 146.0, 124.0))


@dataclass(frozen=True, slots=True, eq=False)
class StreetView:
    """The static part of the view, painted once."""

    view: View  # The camera
    image: ImageArray  # shape (rows, columns, 3): One colour per ray
    depth: Float32Array  # shape (rows, columns): Metres along the optical axis

    def pixels(self) -> Float32Array:
        """Return the image, shape (height, width, 3)."""
        rows = range(0, self.image.shape[0], STRIP_ROWS * OVERSAMPLING)
        step = STRIP_ROWS * OVERSAMPLING
        return np.concatenate([reduced(self.image[row : row + step].astype(np.float32)) for row in rows])


# Painting takes 4 s, a third of the time of a recording's video. The cache holds OVAD's five sites, 66 MB
# each.
@lru_cache(maxsize=5)
def paint_street(site: Site, view: View) -> StreetView:
    """Paint a site; it is the same in every recording."""
    panels = street_panels(site)
    rows, columns = view.shape
    image, depth = np.empty((rows, columns, 3), np.uint8), np.empty((rows, columns), np.float32)
    for top in range(0, rows, STRIP_ROWS):
        strip = Patch(top, min(top + STRIP_ROWS, rows), 0, columns)
        colours, depth[strip.slices] = cast_panels(view, strip, panels, _sky)
        image[strip.slices] = np.clip(colours, 0.0, 255.0).round()
    return StreetView(view, image, depth)


def street_panels(site: Site) -> list[Panel]:
    """Return every surface of a site."""
    rng = site_generator(site.name, "look")
    seeds = rng.integers(0, 1 << 16, 8).tolist()
    colours = rng.permutation(len(BRICKS)).tolist()
    left = Facade(BRICKS[colours[0]], rng.uniform(2.6, 3.4), 0.85, seeds[0])
    right = Facade(BRICKS[colours[1]], rng.uniform(2.6, 3.4), 0.8, seeds[1])
    heights = rng.uniform(6.0, 8.5, 3)
    front = Facade(BRICKS[colours[2]], rng.uniform(2.8, 3.6), 0.95, seeds[3])
    return [
        Panel(2, ROAD_Z_M, ((-5.0, FAR_M), (-FAR_M, FAR_M)), _Ground(site, seeds[2]).paint),
        *_building(site, 1.0, left, heights[0]),
        *_building(site, -1.0, right, heights[1]),
        *_opposite(site, front, heights[2]),
    ]


def _building(site: Site, side: float, front: Facade, height_m: float) -> list[Panel]:
    """Return the side wall, and front and side of the pier at its corner; `side` is +1 left, -1 right."""
    wall = site.side_wall_left_m if side > 0 else site.side_wall_right_m
    corner = site.corner_left_m if side > 0 else site.corner_right_m
    start, end = site.corner_ahead_m - PIER_M, site.corner_ahead_m
    up = (ROAD_Z_M, ROAD_Z_M + height_m)
    plain = Facade(front.colour, 1e6, front.brightness, front.seed)
    depth = (min(side * corner, side * wall), max(side * corner, side * wall))
    return [
        Panel(1, side * wall, ((-20.0, start), up), front.paint),
        Panel(0, start, (depth, up), plain.paint),
        Panel(1, side * corner, ((start, end), up), plain.paint),
    ]


def _opposite(site: Site, front: Facade, height_m: float) -> list[Panel]:
    across = (-FAR_M, FAR_M)
    if site.opposite_wall_m is not None:
        return [Panel(0, site.opposite_wall_m, (across, (ROAD_Z_M, ROAD_Z_M + height_m)), front.paint)]
    hedge = site.far_kerb_m + HEDGE_AHEAD_M - 9.0
    green = partial(leaves, seed=front.seed)
    return [
        Panel(0, hedge, (across, (ROAD_Z_M, ROAD_Z_M + HEDGE_HEIGHT_M)), green),
        Panel(0, HOUSES_AHEAD_M, (across, (ROAD_Z_M, ROAD_Z_M + height_m + 1.0)), front.paint),
    ]


@dataclass(frozen=True, slots=True)
class _Ground:
    """Paved lane between the buildings, asphalt across, kerbs, a broken centre line, give-way teeth."""

    site: Site
    seed: int

    def paint(self, ahead: Float32Array, left: Float32Array) -> Float32Array:
        near, far = self.site.corner_ahead_m + self.site.verge_m, self.site.far_kerb_m
        image = paving(left, ahead, self.seed)
        road, pavement = (ahead > near) & (ahead < far), (ahead > far) & (ahead < far + PAVEMENT_M)
        np.copyto(image, asphalt(ahead, left, self.seed), where=road[..., None])
        beyond = flags(left, ahead, self.seed) if self.site.opposite_wall_m else grass(ahead, left, self.seed)
        np.copyto(image, beyond, where=(ahead > far)[..., None])
        np.copyto(image, flags(left, ahead, self.seed), where=pavement[..., None])
        kerb = (np.abs(ahead - far) < 0.07) | (np.abs(ahead - near - 0.05) < 0.07)
        image[kerb] = (166.0, 164.0, 158.0)
        worn = tinted((206.0, 206.0, 200.0), 0.8 + 0.2 * smooth_noise(ahead, left, 0.1, self.seed))
        np.copyto(image, worn, where=self._marked(ahead, left)[..., None])
        image *= self._light(ahead, left)[..., None]
        return image

    def _marked(self, ahead: Float32Array, left: Float32Array) -> BoolArray:
        middle = self.site.far_kerb_m - 0.5 * self.site.street_width_m
        line = (np.abs(ahead - middle) < 0.05) & (np.mod(left, 3.0) < 1.2)
        depth = ahead - (self.site.corner_ahead_m - 0.75)
        centre = 0.75 * (np.floor(left / 0.75) + 0.5)
        tooth = np.abs(left - centre) < 0.25 * np.clip(depth / 0.6, 0.0, 1.0)
        between = (centre < self.site.corner_left_m - 0.6) & (centre > -self.site.corner_right_m + 0.6)
        return np.asarray(line | (tooth & (depth > 0.0) & (depth < 0.6) & between))

    def _light(self, ahead: Float32Array, left: Float32Array) -> Float32Array:
        """Return the light, which is lower at the foot of the walls of the ego's street."""
        gap = np.minimum(self.site.side_wall_left_m - left, left + self.site.side_wall_right_m)
        inside = 0.65 + 0.35 * np.clip(gap / 1.2, 0.0, 1.0)
        return np.where(ahead < self.site.corner_ahead_m, inside, 1.0).astype(np.float32)


def _sky(left: Float32Array, up: Float32Array) -> Float32Array:
    """Return an overcast sky, brighter towards the horizon."""
    clouds = 0.97 + 0.06 * smooth_noise(left, up * 2.0, 0.3, 1)
    return tinted((206.0, 211.0, 217.0), clouds * (1.04 - 0.12 * np.clip(up, 0.0, 1.0)))
