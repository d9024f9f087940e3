"""Surfaces of a street by formula: brick, asphalt, paving, grass, windows; metres in, colours out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.typing import Float32Array

Colour = tuple[float, float, float]

BRICK_M, COURSE_M, JOINT_M = 0.21, 0.065, 0.01
STOREY_M = 2.9
OPENING_TOP_M, FRAME_M = 2.25, 0.07
FRAME: Colour = (196.0, 194.0, 188.0)
SILL: Colour = (168.0, 164.0, 156.0)
GLASS: Colour = (58.0, 66.0, 74.0)


def cell_noise(a: ArrayLike, b: ArrayLike, seed: int) -> Float32Array:
    """Draw a number in [0, 1) for every whole pair of coordinates, always the same for the same seed.

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
    """Noise in [0, 1) without edges, features of about `cell_m`."""
    x, y = a / np.float32(cell_m), b / np.float32(cell_m)
    left, low = np.floor(x), np.floor(y)
    fx, fy = _ease(x - left), _ease(y - low)
    corners = [[cell_noise(left + i, low + j, seed) for i in (0, 1)] for j in (0, 1)]
    below, above = ((1.0 - fx) * pair[0] + fx * pair[1] for pair in corners)
    return np.asarray((1.0 - fy) * below + fy * above, np.float32)


def _ease(t: Float32Array) -> Float32Array:
    return t * t * (3.0 - 2.0 * t)


def tinted(colour: Colour, shade: ArrayLike) -> Float32Array:
    """Return a colour times a shade of any shape, with a last axis of three."""
    return np.asarray(np.asarray(shade, np.float32)[..., None] * np.array(colour, np.float32), np.float32)


def asphalt(a: Float32Array, b: Float32Array, seed: int) -> Float32Array:
    """Paint asphalt: dark, mottled, with patches."""
    patches = np.where(smooth_noise(a, b, 2.7, seed) > 0.62, -0.07, 0.0)
    shade = (
        0.85 + 0.16 * smooth_noise(a, b, 0.6, seed + 1) + 0.22 * (cell_noise(a / 0.02, b / 0.02, seed) - 0.5)
    )
    return tinted((96.0, 97.0, 99.0), shade + patches)


def paving(a: Float32Array, b: Float32Array, seed: int) -> Float32Array:
    """Paint paving bricks in courses, brown grey."""
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
    """Paint a wall in stretcher bond, a along it, b up."""
    weather = 0.9 + 0.2 * smooth_noise(a, b, 1.8, seed + 7)
    return tinted(colour, weather * _courses(a, b, BRICK_M, COURSE_M, seed))


def _courses(a: Float32Array, b: Float32Array, length_m: float, height_m: float, seed: int) -> Float32Array:
    """Shade of stones in courses, every other one half a stone along, joints darker."""
    course = np.floor(b / np.float32(height_m))
    along = a / np.float32(length_m) + 0.5 * np.mod(course, 2.0)
    shade = 0.85 + 0.3 * cell_noise(along, course, seed)
    joint = (np.mod(along, 1.0) < JOINT_M / length_m) | (np.mod(b / height_m, 1.0) < JOINT_M / height_m)
    return np.where(joint, 0.72, shade).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Facade:
    """A house front: brick, windows in every storey, doors at the ground."""

    colour: Colour  # Of the brick
    bay_m: float  # Distance between windows
    foot_m: float  # Coordinate of the ground
    brightness: float  # Of the light that falls on it
    seed: int  # Which house

    def paint(self, a: Float32Array, b: Float32Array) -> Float32Array:
        """Colours at places along the wall and up."""
        up = b - np.float32(self.foot_m)
        image = brick(a, up, self.colour, self.seed)
        bay, storey = np.floor(a / self.bay_m), np.floor(up / STOREY_M)
        x = a - (bay + 0.5) * np.float32(self.bay_m)
        y = up - storey * np.float32(STOREY_M)
        doors = (storey < 1) & (cell_noise(bay, storey, self.seed + 1) < 0.3)
        drawn = cell_noise(bay + np.floor(1.5 * x), np.floor(0.7 * y), self.seed + 3) < 0.3
        mirrored = 0.75 + 0.5 * np.clip((y - 0.9) / 1.4, 0.0, 1.0)
        for opening, here in ((WINDOW, ~doors), (DOOR, doors)):
            half, low = opening.half_m, opening.low_m
            image[here & (np.abs(x) < half) & (y > low) & (y < OPENING_TOP_M)] = FRAME
            pane = here & (np.abs(x) < half - FRAME_M) & (np.abs(x) > 0.5 * FRAME_M)
            pane &= (y > low + FRAME_M) & (y < OPENING_TOP_M - FRAME_M)
            image[pane] = tinted(opening.colour, mirrored * np.where(drawn, 1.5, 1.0))[pane]
            image[here & (np.abs(x) < half + 0.08) & (y > low - opening.sill_m) & (y < low)] = SILL
        # Walls are darker at their foot, where less of the sky is seen.
        light = self.brightness * (0.72 + 0.28 * np.clip(up / 1.5, 0.0, 1.0))
        return np.asarray(image * light[..., None], np.float32)


@dataclass(frozen=True, slots=True)
class _Opening:
    """Half the width of a hole in a wall, where it begins, the height of its sill, what fills it."""

    half_m: float
    low_m: float
    sill_m: float
    colour: Colour


WINDOW = _Opening(0.6, 0.95, 0.1, GLASS)
DOOR = _Opening(0.45, 0.0, 0.0, (70.0, 82.0, 78.0))
