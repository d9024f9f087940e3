"""Paths from a moving source on the crossing street to a receiver in the ego's street.

Both streets are unfolded: facades of the crossing street mirror the source, side walls of the ego's street
mirror the receiver. Every pair of images is one straight line through the mouth between the two corners. A
lit line is straight; a shadowed one bends round the nearer corner and has the screen attenuation. The side
images determine the apparent direction of a hidden vehicle: the corner's mirror image in the opposite side
wall is in much shallower shadow than the corner itself.
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ, smooth_step

from .diffraction import EXTERIOR_RAD, edge_gain

LIT_DEPTH_M = 0.25  # A line this far inside the mouth is not affected by the corner
NEAREST_M = 0.5  # Shortest leg round a corner
FACADE_END_M = 0.5  # Length over which a reflection fades at the end of a facade
LEFT, RIGHT = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class SourceImage:
    """Mirror image of the source after `opposite` and `near` reflections in the crossing street."""

    x_m: float | FloatArray  # shape (T,): Unfolded distance of the image ahead of the origin
    gain: float  # Product of the reflection factors
    # Unfolded positions of the near facade that the line crosses; that facade has a gap at the mouth.
    near_planes_m: tuple[float, ...] = ()
    order: int = 0  # Number of reflections


@dataclass(frozen=True, slots=True)
class ReceiverImage:
    """Mirror image of the ego's street, y -> sign * y + offset.

    Examples
    --------
    >>> ReceiverImage(-1, 5.6, 0.8).mirror(np.array([0.5]))
    array([5.1])
    """

    sign: int
    offset_m: float
    gain: float
    order: int = 0
    # The walls met, LEFT or RIGHT, and their positions in the unfolded street, the nearest first.
    walls: tuple[tuple[int, float], ...] = ()

    def mirror(self, y_m: FloatArray) -> FloatArray:
        """Return lateral positions in the unfolded street."""
        return self.sign * y_m + self.offset_m


DIRECT = ReceiverImage(1, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Path:
    """One path at a series of emission times."""

    source: SourceImage  # Image at its start
    receiver: ReceiverImage  # Image at its end
    # shape (T,): 1 if the line is straight, 0 if it bends round the corner, smooth in between.
    lit: FloatArray
    edge: NDArray[np.int8]  # shape (T,): Corner of the shorter detour, LEFT or RIGHT
    bent_m: FloatArray  # shape (T,): Length round that corner to the array's centre
    gain: FloatArray  # shape (T, 8): Amplitude per octave band without spherical spreading
    before_m: FloatArray  # shape (T,): Horizontal length before the corner
    edge_y_m: FloatArray  # shape (T,): Lateral position of that corner


def source_images(site: Site, lane_x_m: float | FloatArray) -> list[SourceImage]:
    """Return the images of a lane in the facades of the crossing street; the lane alone without a wall.

    Examples
    --------
    >>> plan = Site("SA1", 2.8, 2.8, 4.0, 10.0, 2.8, 2.8, 6.0, facade_order=2)
    >>> [(i.x_m, round(i.gain, 2)) for i in source_images(plan, 6.0)]
    [(6.0, 1.0), (14.0, 0.8), (18.0, 0.64)]
    """
    if site.opposite_wall_m is None:
        return [SourceImage(lane_x_m, 1.0)]
    mouth, depth = site.corner_ahead_m, site.opposite_wall_m - site.corner_ahead_m
    inside = lane_x_m - mouth
    images = []
    for order in range(site.facade_order + 1):
        turns = (order + 1) // 2
        x = mouth + 2.0 * depth * turns + (inside if order % 2 == 0 else -inside)
        planes = tuple(mouth + 2.0 * depth * i for i in range(1, order // 2 + 1))
        images.append(SourceImage(x, site.facade_reflection**order, planes, order))
    return images


def receiver_images(site: Site) -> list[ReceiverImage]:
    """Return the images of the ego's street in its side walls, up to `side_order` on either side.

    Examples
    --------
    >>> plan = Site("SA1", 2.8, 2.8, 4.0, 10.0, 2.8, 2.8, 6.0, side_order=1)
    >>> [(i.sign, i.offset_m) for i in receiver_images(plan)]
    [(1, 0.0), (-1, 5.6), (-1, -5.6)]
    """
    left, right = site.side_wall_left_m, site.side_wall_right_m
    images = [DIRECT]
    for order in range(1, site.side_order + 1):
        shift = (order // 2) * 2.0 * (left + right)
        for first, sign, near in ((LEFT, 1.0, left), (RIGHT, -1.0, right)):
            # Unfolded outwards, the walls alternate at intervals of the street's width.
            walls = tuple(((first + k) % 2, sign * (near + k * (left + right))) for k in range(order))
            gain = math.prod(site.side_reflection * site.side_shares[wall] for wall, _ in walls)
            offset = sign * (shift + 2.0 * near * (order % 2))
            images.append(ReceiverImage(-1 if order % 2 else 1, offset, gain, order, walls))
    return images


def trace_paths(
    site: Site,
    lane_x_m: float | FloatArray,
    source_y_m: FloatArray,
    height_m: float,
    cap_db: float,
    *,
    receiver_x_m: float | FloatArray = 0.0,
    specular: tuple[FloatArray, FloatArray] | None = None,
) -> list[Path]:
    """Return all paths from a source that moves in the crossing street to the array at (receiver_x_m, 0).

    Shapes: lane_x_m (T,), source_y_m (T,), receiver_x_m (T,), specular two of (8,): mirrored shares of the
    facades of the crossing street and of the side walls.
    """
    facades, sides = (np.ones(len(OCTAVES_HZ)),) * 2 if specular is None else specular
    paths = []
    for source, receiver in product(source_images(site, lane_x_m), receiver_images(site)):
        passage = through_mouth(site, (source.x_m, source_y_m), (receiver_x_m, receiver.offset_m), height_m)
        walls = source.gain * receiver.gain * near_facade(site, source, source_y_m, passage.aim_y_m)
        walls = walls * side_walls(site, receiver, receiver_x_m, (site.corner_ahead_m, passage.aim_y_m))
        gain = walls[:, None] * facades**source.order * sides**receiver.order * passage.screen_gain(cap_db)
        edge_y = np.where(passage.edge == LEFT, site.corner_left_m, -site.corner_right_m)
        before = np.hypot(source.x_m - site.corner_ahead_m, source_y_m - edge_y)
        paths.append(Path(source, receiver, passage.lit, passage.edge, passage.bent_m, gain, before, edge_y))
    return paths


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """A line from a source in the crossing street through the mouth over time, shape (T,) each."""

    # Distance of the line inside the mouth; negative if a corner blocks it.
    clearance_m: FloatArray
    edge: NDArray[np.int8]  # Corner of the shorter detour, LEFT or RIGHT
    straight_m: FloatArray  # Length of the line, and of the detour round that corner
    bent_m: FloatArray
    aim_y_m: FloatArray  # Lateral position at which the line, or the detour, passes the mouth
    turn_rad: FloatArray  # Angle between the two legs at that corner, below pi if the line is lit
    reduced_m: FloatArray  # Product of the two horizontal legs over their sum

    @property
    def lit(self) -> FloatArray:
        """Return 1 if the line is straight, 0 if it bends round the corner, smooth in between."""
        return smooth_step(self.clearance_m / LIT_DEPTH_M)

    def screen_gain(self, cap_db: float) -> FloatArray:
        """Return the amplitude after the corner, shape (T, 8)."""
        gain = edge_gain(self.turn_rad, self.reduced_m, self.bent_m - self.straight_m, OCTAVES_HZ)
        return np.asarray(np.maximum(gain, 10.0 ** (-cap_db / 20.0)))


def through_mouth(
    site: Site,
    source_m: tuple[float | FloatArray, FloatArray],
    end_m: tuple[float | FloatArray, float],
    height_m: float,
) -> Passage:
    """Follow a line from a source, beyond or in the mouth, to a receiver before it.

    Examples
    --------
    >>> plan = Site("SA1", 2.8, 2.8, 4.0, 10.0, 2.8, 2.8, 6.0)
    >>> passage = through_mouth(plan, (8.0, np.array([2.0, 12.0])), (0.0, 0.0), 0.0)
    >>> passage.clearance_m, passage.lit
    (array([ 1.8, -3.2]), array([1., 0.]))
    """
    mouth, left, right = site.corner_ahead_m, site.corner_left_m, -site.corner_right_m
    (x, y), (end_x, end_y) = source_m, end_m
    run, depth = x - end_x, mouth - end_x
    # A source that has turned into the ego's street is in front of the mouth; its own position is used there.
    crossing = end_y + (y - end_y) * depth / np.maximum(run, depth)
    clearance = np.minimum(left - crossing, crossing - right)
    # Over a vertical edge both legs are in one unfolded plane. The shorter detour is used; both are equal
    # when the corner changes, so the gain is continuous.
    legs = []
    for sign, at in ((1.0, left), (-1.0, right)):
        both = np.hypot(x - mouth, y - at), np.hypot(depth, at - end_y)
        legs.append(np.stack(np.broadcast_arrays(*both, sign * (y - at), sign * (at - end_y))))
    ways = [np.hypot(before + after, height_m) for before, after, _, _ in legs]
    across = y - end_y
    straight = np.sqrt(run * run + across * across + height_m * height_m)
    edge, bent = np.argmin(ways, axis=0).astype(np.int8), np.minimum(*ways)
    before, after, out, back = np.where(edge == LEFT, *legs)
    turn = EXTERIOR_RAD - np.arctan2(np.maximum(x - mouth, 0.0), out) - np.arctan2(back, depth)
    reduced = before * after / np.maximum(before + after, NEAREST_M)
    return Passage(clearance, edge, straight, bent, np.clip(crossing, right, left), turn, reduced)


def side_walls(
    site: Site,
    receiver: ReceiverImage,
    end_x_m: float | FloatArray,
    aim_m: tuple[float | FloatArray, FloatArray],
) -> FloatArray:
    """Return 1 if every reflection on the path meets wall and 0 if one meets an opening, shape (T,).

    Examples
    --------
    >>> plan = Site("SA1", 2.8, 2.8, 4.0, 10.0, 2.8, 2.8, 6.0, left_openings_m=((1.0, 3.0),))
    >>> image = receiver_images(plan)[1]
    >>> side_walls(plan, image, 0.0, (4.0, np.array([0.0, -2.8]))).round(2)  # met at 2.0 and 1.33 m
    array([0.  , 0.07])
    """
    openings = site.left_openings_m, site.right_openings_m
    end_y, (aim_x, aim_y) = receiver.offset_m, aim_m
    weight = np.ones_like(aim_y)
    for wall, plane in receiver.walls:
        if openings[wall]:
            share = (plane - end_y) / (aim_y - end_y)
            weight = weight * on_wall(openings[wall], end_x_m + share * (aim_x - end_x_m))
    return weight


def on_wall(openings_m: tuple[tuple[float, float], ...], x_m: FloatArray) -> FloatArray:
    """Return 1 on a wall and 0 in its openings, smooth over the width of a reflection.

    Examples
    --------
    >>> on_wall(((1.0, 3.0),), np.array([0.0, 2.0, 3.5]))
    array([1., 0., 1.])
    """
    weight = np.ones_like(x_m)
    for begin, end in openings_m:
        outside = np.maximum(begin - x_m, x_m - end)
        weight = weight * smooth_step(0.5 + outside / (2.0 * FACADE_END_M))
    return weight


def near_facade(site: Site, source: SourceImage, source_y: FloatArray, aim_y: FloatArray) -> FloatArray:
    """Return 1 if every reflection in the near facade meets wall and 0 if one meets the mouth, shape (T,)."""
    mouth, left, right = site.corner_ahead_m, site.corner_left_m, -site.corner_right_m
    weight = np.ones_like(source_y)
    for plane in source.near_planes_m:
        # A source in the ego's street would be behind that facade, so its line meets the mouth only.
        met = aim_y + (source_y - aim_y) * (plane - mouth) / np.maximum(source.x_m - mouth, plane - mouth)
        weight *= smooth_step(np.maximum(met - left, right - met) / FACADE_END_M)
    return weight
