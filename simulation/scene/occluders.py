"""Bodies in the open that hide a vehicle: a lead vehicle, a bridge pier, a barrier at a merge.

A body is a convex outline of infinite height. Sound goes round it on the shorter side, by the corner with the
largest detour on that side, and has the screen attenuation of that detour. Its long sides are walls, which
mirror sources in front of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from worldstate.ground import BoolArray, FloatArray, InvalidArgumentError, finite_array

from .octave_bands import smooth_step

# x, which may change with time (T,), and y.
GroundPoint = tuple[float | FloatArray, float]

MAX_CORNERS = 16
# A shorter side is no mirror at the wavelengths of tyres and engines (0.3 to 3 m): most sound passes round
# it.
WALL_LENGTH_M = 10.0
# A reflection fades over this length at the end of a wall, where a half-plane reflects half the amplitude.
# The first Fresnel zone at 500 Hz is 1.9 m wide for source and receiver at 10 m on either side.
WALL_END_M = 2.0


@dataclass(frozen=True, slots=True)
class OccludingBody:
    """A convex outline on the ground."""

    # x ahead and y left of every corner; 2 corners (a thin screen) to 16
    corners_m: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        corners = finite_array("corners_m", self.corners_m, (None, 2))
        if not 2 <= len(corners) <= MAX_CORNERS:
            raise InvalidArgumentError(f"corners_m: expected 2 to {MAX_CORNERS} corners, got {len(corners)}")


@dataclass(frozen=True, slots=True)
class Wall:
    """A long side of a body, seen from outside."""

    start_m: tuple[float, float]  # The two ends of the wall
    end_m: tuple[float, float]
    outward: int  # Outer side of the line from start to end: +1 left, -1 right, 0 both

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
        """Return 1 if the wall reflects a point to a viewpoint and 0 if the ray misses it, shape (T,)."""
        along, off = self.along_and_off(x_m, y_m)
        eye_along, eye_off = self.along_and_off(*eye_m)
        before = (off * eye_off > 0.0) & (self.outward * off >= 0.0)
        # The reflection point divides the way along the wall in the ratio of the distances to it.
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
        """Distance between the two ends."""
        return float(np.hypot(self.end_m[0] - self.start_m[0], self.end_m[1] - self.start_m[1]))

    @property
    def _normal(self) -> tuple[float, float]:
        length = self.length_m
        return (self.start_m[1] - self.end_m[1]) / length, (self.end_m[0] - self.start_m[0]) / length

    def along_and_off(
        self, x_m: float | FloatArray, y_m: float | FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the coordinates along and off the wall; off is positive to the left of start to end."""
        normal_x, normal_y = self._normal
        to_x, to_y = x_m - self.start_m[0], y_m - self.start_m[1]
        return np.asarray(to_x * normal_y - to_y * normal_x), np.asarray(to_x * normal_x + to_y * normal_y)


def walls(body: OccludingBody) -> list[Wall]:
    """Return the sides of a body that are long enough to reflect sound.

    Examples
    --------
    >>> len(walls(OccludingBody(((-60.0, 2.6), (7.0, 2.6))))), len(walls(box(6.0, 12.0, -1.1, 1.1)))
    (1, 0)
    """
    corners = body.corners_m
    # A thin screen has one side, which reflects both ways.
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
    """Return when a body is between a viewpoint and a moving point, shape (T,)."""
    hidden = np.zeros(np.shape(y_m), np.bool_)
    for occluder in occluders:
        hidden |= _crosses(*_offsets(occluder, x_m, y_m, eye_m))
    return hidden


def detours(
    occluder: OccludingBody, x_m: FloatArray, y_m: FloatArray, end_m: GroundPoint
) -> tuple[FloatArray, NDArray[np.int_]]:
    """Return the detour round a body and the corner that it passes, shape (T,) each."""
    # The detour is negative if the line is clear, and 0 if the line touches the body.
    offset, along = _offsets(occluder, x_m, y_m, end_m)
    end_x, end_y = end_m
    via = np.array(
        [np.hypot(x_m - x, y_m - y) + np.hypot(end_x - x, end_y - y) for x, y in occluder.corners_m]
    )
    extra = np.maximum(via - np.hypot(x_m - end_x, y_m - end_y), 0.0)
    # A path round a body passes all corners of that side; the one with the largest detour represents them.
    sides = np.stack([np.where(side * offset > 0.0, extra, -1.0) for side in (1.0, -1.0)])
    cost, corner = sides.max(axis=1), sides.argmax(axis=1)
    blocked, shorter = _crosses(offset, along), cost[0] <= cost[1]
    # On a clear line, the corner that the line passes most closely gives the distance to the body.
    beside = np.where((along > 0.0) & (along < 1.0), extra, np.inf).min(axis=0)
    clear = np.where(np.isfinite(beside), beside, extra.min(axis=0))
    return (
        np.where(blocked, cost.min(axis=0), -clear),
        np.where(blocked, np.where(shorter, *corner), extra.argmin(axis=0)),
    )


def _offsets(
    occluder: OccludingBody, x_m: FloatArray, y_m: FloatArray, end_m: GroundPoint
) -> tuple[FloatArray, FloatArray]:
    """Return the lateral offset of every corner from the line, and its place along it 0..1, (corners, T)."""
    corners = np.array(occluder.corners_m)[:, :, None]
    dx, dy = x_m - end_m[0], y_m - end_m[1]
    length = np.hypot(dx, dy)
    # A line of zero length has no direction, and no body is across it.
    per_length = np.where(length > 1e-6, 1.0 / np.maximum(length, 1e-6), 0.0)
    to_x, to_y = corners[:, 0] - end_m[0], corners[:, 1] - end_m[1]
    return (to_y * dx - to_x * dy) * per_length, (to_x * dx + to_y * dy) * per_length**2


def _crosses(offset: FloatArray, along: FloatArray) -> BoolArray:
    """Return when a side of the outline crosses the line between its ends, shape (T,)."""
    onward, further = np.roll(offset, -1, axis=0), np.roll(along, -1, axis=0)
    apart = offset * onward < 0.0
    share = offset / np.where(apart, offset - onward, 1.0)
    met = along + (further - along) * share
    return np.asarray((apart & (met > 0.0) & (met < 1.0)).any(axis=0))
