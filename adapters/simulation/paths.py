"""The ways from a moving source on the crossing street to a receiver in the ego's own street.

Both streets are unfolded: facades of the crossing street mirror the source, side walls of the ego's street
mirror the receiver. Every pair of images is one straight line through the mouth between the two corners. It
is either lit, and then it is that line, or it is bent round the nearer corner and pays the screen
attenuation. The side images decide where a hidden vehicle is heard: the corner's mirror image in the
opposite side wall lies in much shallower shadow than the corner itself.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from .bands import OCTAVES_HZ, smooth_step
from .diffraction import screen_attenuation_db
from .scene import Site

Array = NDArray[np.float64]

LIT_DEPTH_M = 0.25  # a line this far inside the mouth no longer touches the corner
FACADE_END_M = 0.5  # a reflection fades over this length at the end of a facade
LEFT, RIGHT = 0, 1


@dataclass(frozen=True, slots=True)
class SourceImage:
    """Mirror image of the source after `opposite` and `near` reflections in the crossing street.

    Parameters
    ----------
    x_m : float
        Where the image stands ahead of the ego, unfolded.
    gain : float
        Product of the reflection factors.
    near_planes_m : tuple of float
        Unfolded positions of the near facade that the line crosses; that facade has a gap at the mouth.
    """

    x_m: float
    gain: float
    near_planes_m: tuple[float, ...] = ()


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

    def mirror(self, y_m: Array) -> Array:
        """Lateral positions in the unfolded street."""
        return self.sign * y_m + self.offset_m


@dataclass(frozen=True, slots=True)
class Path:
    """One way, at a series of emission times.

    Parameters
    ----------
    source : SourceImage
        Image the line starts from.
    receiver : ReceiverImage
        Image it ends at.
    lit : ndarray, shape (T,)
        1 where the line is straight, 0 where it bends round the corner, smooth in between.
    edge : ndarray, shape (T,)
        The corner with the shorter way round, LEFT or RIGHT.
    bent_m : ndarray, shape (T,)
        Length round that corner to the array's centre.
    gain : ndarray, shape (T, 8)
        Amplitude per octave band without spherical spreading.
    """

    source: SourceImage
    receiver: ReceiverImage
    lit: Array
    edge: NDArray[np.int8]
    bent_m: Array
    gain: Array


def source_images(site: Site, lane_x_m: float) -> list[SourceImage]:
    """Images of a lane in the facades of the crossing street; only the lane itself where there is no wall.

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
        images.append(SourceImage(x, site.facade_reflection**order, planes))
    return images


def receiver_images(site: Site) -> list[ReceiverImage]:
    """Images of the ego's street in its side walls, up to `side_order` on either side.

    Examples
    --------
    >>> plan = Site("SA1", 2.8, 2.8, 4.0, 10.0, 2.8, 2.8, 6.0, side_order=1)
    >>> [(i.sign, i.offset_m) for i in receiver_images(plan)]
    [(1, 0.0), (-1, 5.6), (-1, -5.6)]
    """
    left, right = site.side_wall_left_m, site.side_wall_right_m
    images = [ReceiverImage(1, 0.0, 1.0)]
    for order in range(1, site.side_order + 1):
        gain = site.side_reflection**order
        shift = (order // 2) * 2.0 * (left + right)
        if order % 2:
            images += [
                ReceiverImage(-1, shift + 2.0 * left, gain),
                ReceiverImage(-1, -shift - 2.0 * right, gain),
            ]
        else:
            images += [ReceiverImage(1, shift, gain), ReceiverImage(1, -shift, gain)]
    return images


def trace_paths(site: Site, lane_x_m: float, source_y_m: Array, height_m: float, cap_db: float) -> list[Path]:
    """All paths from a source that moves along a lane to the array's centre at (0, 0).

    Parameters
    ----------
    site : Site
        The junction.
    lane_x_m : float
        Distance ahead of the source's lane.
    source_y_m : ndarray, shape (T,)
        Lateral positions of the source.
    height_m : float
        Height of the receiver above the source.
    cap_db : float
        Largest screen attenuation.

    Returns
    -------
    list of Path
        One per pair of source and receiver image.
    """
    pairs = product(source_images(site, lane_x_m), receiver_images(site))
    return [_trace(site, source, receiver, source_y_m, height_m, cap_db) for source, receiver in pairs]


def _trace(
    site: Site, source: SourceImage, receiver: ReceiverImage, source_y: Array, height: float, cap_db: float
) -> Path:
    mouth, left, right = site.corner_ahead_m, site.corner_left_m, -site.corner_right_m
    end_y = float(receiver.mirror(np.zeros(1))[0])
    crossing = end_y + (source_y - end_y) * mouth / source.x_m
    clearance = np.minimum(left - crossing, crossing - right)
    # The shorter way round: both are equal where the corner changes, so nothing jumps there.
    ways = [_bent_length(source.x_m, source_y, mouth, y, end_y, height) for y in (left, right)]
    edge, bent = np.argmin(ways, axis=0).astype(np.int8), np.minimum(*ways)
    straight = _length(source.x_m, source_y - end_y, height)
    detour = np.copysign(bent - straight, -clearance)
    screen_db = screen_attenuation_db(detour[:, None], OCTAVES_HZ, cap_db)
    aim_y = np.clip(crossing, right, left)
    walls = source.gain * receiver.gain * _near_facade(source, source_y, mouth, aim_y, left, right)
    gain = walls[:, None] * 10.0 ** (-screen_db / 20.0)
    return Path(source, receiver, smooth_step(clearance / LIT_DEPTH_M), edge, bent, gain)


def _length(dx: float | Array, dy: Array, dz: float) -> Array:
    return np.asarray(np.sqrt(dx * dx + dy * dy + dz * dz))


def _bent_length(
    source_x: float, source_y: Array, mouth: float, edge_y: float, end_y: float, height: float
) -> Array:
    """Shortest way over the vertical edge: the two legs lie in one unfolded plane."""
    before = np.hypot(source_x - mouth, source_y - edge_y)
    after = np.hypot(mouth, edge_y - end_y)
    return np.asarray(np.hypot(before + after, height))


def _near_facade(
    source: SourceImage, source_y: Array, mouth: float, aim_y: Array, left: float, right: float
) -> Array:
    """1 where every reflection in the near facade meets wall, 0 where it meets the mouth."""
    weight = np.ones_like(source_y)
    for plane in source.near_planes_m:
        met = aim_y + (source_y - aim_y) * (plane - mouth) / (source.x_m - mouth)
        weight *= smooth_step(np.maximum(met - left, right - met) / FACADE_END_M)
    return weight
