"""Bodies in the open that hide a vehicle: a lead vehicle, a bridge pier, a barrier at a merge.

A body is a convex outline, taken as infinitely high. Sound goes round it on the shorter side, by the one
corner of that side that costs most, and pays the screen attenuation of that detour. Its long sides are walls,
which mirror what stands before them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from worldstate.ground import BoolArray, FloatArray, InvalidArgumentError, finite_array

from .octave_bands import smooth_step

# x, which may move (T,), and y.
GroundPoint = tuple[float | FloatArray, float]

MAX_CORNERS = 16
# A shorter side is no mirror at the wavelengths of tyres and engines (.3 to 3 m): most passes round it.
WALL_LENGTH_M = 10.0
# A reflection fades over this length about the end of a wall, where a half-plane reflects half the amplitude.
# The first Fresnel zone at 500 Hz between places 10 m away on either side is 1.9 m wide.
WALL_END_M = 2.0


@dataclass(frozen=True, slots=True)
class OccludingBody:
    """A convex outline on the ground."""

    corners_m: tuple[tuple[float, float], ...]  # x ahead and y left of every corner, 2 (a thin screen) to 16

    def __post_init__(self) -> None:
        corners = finite_array("corners_m", self.corners_m, (None, 2))
        if not 2 <= len(corners) <= MAX_CORNERS:
            raise InvalidArgumentError(f"corners_m: expected 2 to {MAX_CORNERS} corners, got {len(corners)}")


@dataclass(frozen=True, slots=True)
class Wall:
    """A long side of a body, seen from outside."""

    start_m: tuple[float, float]  # Its two ends
    end_m: tuple[float, float]
    outward: int  # Side of the line from start to end that is outside, +1 left, -1 right, 0 both

    def mirrored(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mirror images of points, shape (T,) each.

        Examples
        --------
        >>> [float(v) for v in Wall((0.0, 2.0), (20.0, 2.0), 0).mirrored(np.array(5.0), np.array(0.5))]
        [5.0, 3.5]
        """
        _, off = self.along_and_off(x_m, y_m)
        normal_x, normal_y = self._normal
        return x_m - 2.0 * off * normal_x, y_m - 2.0 * off * normal_y

    def reflects(self, x_m: FloatArray, y_m: FloatArray, eye_m: GroundPoint) -> FloatArray:
        """1 where a wall mirrors a point to an eye, 0 where the ray misses it, shape (T,)."""
        along, off = self.along_and_off(x_m, y_m)
        eye_along, eye_off = self.along_and_off(*eye_m)
        before = (off * eye_off > 0.0) & (self.outward * off >= 0.0)
        # The ray meets the wall where it divides the way along it as the distances to it.
        share = np.abs(off) / np.maximum(np.abs(off) + np.abs(eye_off), 1e-9)
        met = along + (eye_along - along) * share
        inside = np.minimum(met, self.length_m - met)
        return np.asarray(before * smooth_step(0.5 + inside / WALL_END_M))

    def mirrored_body(self, body: OccludingBody) -> OccludingBody:
        """Return the mirror image of a body."""
        x, y = self.mirrored(*np.array(body.corners_m).T)
        return OccludingBody(tuple(zip(x.tolist(), y.tolist(), strict=True)))

    @property
    def length_m(self) -> float:
        """From one end to the other."""
        return float(np.hypot(self.end_m[0] - self.start_m[0], self.end_m[1] - self.start_m[1]))

    @property
    def _normal(self) -> tuple[float, float]:
        length = self.length_m
        return (self.start_m[1] - self.end_m[1]) / length, (self.end_m[0] - self.start_m[0]) / length

    def along_and_off(
        self, x_m: float | FloatArray, y_m: float | FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Coordinates along the wall and off it, positive to the left of the line from start to end."""
        normal_x, normal_y = self._normal
        to_x, to_y = x_m - self.start_m[0], y_m - self.start_m[1]
        return np.asarray(to_x * normal_y - to_y * normal_x), np.asarray(to_x * normal_x + to_y * normal_y)


def walls(body: OccludingBody) -> list[Wall]:
    """Return the sides of a body that are long enough to mirror sound.

    Examples
    --------
    >>> len(walls(OccludingBody(((-60.0, 2.6), (7.0, 2.6))))), len(walls(box(6.0, 12.0, -1.1, 1.1)))
    (1, 0)
    """
    corners = body.corners_m
    # A thin screen has one side, which mirrors both ways.
    pairs = [corners] if len(corners) == 2 else zip(corners, corners[1:] + corners[:1], strict=True)
    middle = np.mean(corners, axis=0)
    found = []
    for start, end in pairs:
        wall = Wall(start, end, 0)
        if wall.length_m >= WALL_LENGTH_M:
            off = float(wall.along_and_off(*middle)[1])
            found.append(replace(wall, outward=-int(np.sign(off)) if len(corners) > 2 else 0))
    return found


def box(near_m: float, far_m: float, right_m: float, left_m: float) -> OccludingBody:
    """Return an upright rectangular outline."""
    return OccludingBody(((near_m, right_m), (far_m, right_m), (far_m, left_m), (near_m, left_m)))


def hidden_by(
    occluders: Sequence[OccludingBody], x_m: FloatArray, y_m: FloatArray, eye_m: GroundPoint
) -> BoolArray:
    """Tell when a body stands between an eye and a point that moves, shape (T,)."""
    hidden = np.zeros(np.shape(y_m), np.bool_)
    for occluder in occluders:
        hidden |= _crosses(*_offsets(occluder, x_m, y_m, eye_m))
    return hidden


def detours(
    occluder: OccludingBody, x_m: FloatArray, y_m: FloatArray, end_m: GroundPoint
) -> tuple[FloatArray, NDArray[np.int_]]:
    """Return how much longer the way round a body is, and by which corner it goes, shape (T,) each."""
    # The detour is negative where the line is clear; it passes through 0 where the line touches the body.
    offset, along = _offsets(occluder, x_m, y_m, end_m)
    end_x, end_y = end_m
    via = np.array(
        [np.hypot(x_m - x, y_m - y) + np.hypot(end_x - x, end_y - y) for x, y in occluder.corners_m]
    )
    extra = np.maximum(via - np.hypot(x_m - end_x, y_m - end_y), 0.0)
    # Round a body on one side means past all of its corners there; the costliest stands for them.
    sides = np.stack([np.where(side * offset > 0.0, extra, -1.0) for side in (1.0, -1.0)])
    cost, corner = sides.max(axis=1), sides.argmax(axis=1)
    blocked, shorter = _crosses(offset, along), cost[0] <= cost[1]
    # In the light the body is as far away as the corner that the line passes most closely.
    beside = np.where((along > 0.0) & (along < 1.0), extra, np.inf).min(axis=0)
    clear = np.where(np.isfinite(beside), beside, extra.min(axis=0))
    return (
        np.where(blocked, cost.min(axis=0), -clear),
        np.where(blocked, np.where(shorter, *corner), extra.argmin(axis=0)),
    )


def _offsets(
    occluder: OccludingBody, x_m: FloatArray, y_m: FloatArray, end_m: GroundPoint
) -> tuple[FloatArray, FloatArray]:
    """Lateral offset of every corner from the line, and how far along it is, 0..1, shape (corners, T)."""
    corners = np.array(occluder.corners_m)[:, :, None]
    dx, dy = x_m - end_m[0], y_m - end_m[1]
    length = np.hypot(dx, dy)
    # A line of no length has no direction, and nothing stands across it.
    per_length = np.where(length > 1e-6, 1.0 / np.maximum(length, 1e-6), 0.0)
    to_x, to_y = corners[:, 0] - end_m[0], corners[:, 1] - end_m[1]
    return (to_y * dx - to_x * dy) * per_length, (to_x * dx + to_y * dy) * per_length**2


def _crosses(offset: FloatArray, along: FloatArray) -> BoolArray:
    """Tell when a side of the outline crosses the line between its ends, shape (T,)."""
    onward, further = np.roll(offset, -1, axis=0), np.roll(along, -1, axis=0)
    apart = offset * onward < 0.0
    share = offset / np.where(apart, offset - onward, 1.0)
    met = along + (further - along) * share
    return np.asarray((apart & (met > 0.0) & (met < 1.0)).any(axis=0))
