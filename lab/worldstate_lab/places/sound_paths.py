"""The walls of a junction, and the ways by which sound reaches the array from the crossing street.

Facades of the crossing street mirror the source, side walls of the ego's street mirror the array. Each pair
of images is one line through the mouth between the corners: where it misses the mouth, it bends round the
nearer corner. Lines from mirrored images cross the mouth where their walls stand, so none is counted that
meets no wall.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.typing import FloatArray

SPEED_OF_SOUND_MPS = 343.0
# Far vehicles are heard by the order whose line still meets the mouth: 2 at 11 m, 3 at 15 m, on alternating
# sides. With three orders a real vehicle at 9 m was put on the wrong side for half a second.
SIDE_ORDER, FACADE_ORDER = 8, 2
# A line this far inside the mouth has lost the corner's 5 dB.
LIT_DEPTH_M = 0.5


@dataclass(frozen=True, slots=True)
class StreetWalls:
    """Two side walls that end at the corners, the street that crosses beyond them, and the wall it faces.

    Parameters
    ----------
    corner_ahead_m : float
        How far ahead of the array the corners stand, at the ends of the side walls.
    left_m, right_m : float
        Distance of the side walls to the left and to the right of the array.
    crossing_m : float
        How far ahead vehicles cross, beyond the corners.
    facing_m : float or None
        How far ahead the wall beyond the crossing street stands; None where there is none.

    Raises
    ------
    InvalidArgumentError
        If a distance is out of range, or the street does not lie between corners and facing wall.

    Examples
    --------
    >>> [round(limit, 2) for limit in StreetWalls(4.45, 2.8, 2.8, 7.15, facing_m=9.9).sight_m]
    [-4.5, 4.5]
    """

    corner_ahead_m: float
    left_m: float
    right_m: float
    crossing_m: float
    facing_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("corner_ahead_m", "left_m", "right_m"):
            in_range(name, getattr(self, name), 0.5, 100.0)
        in_range("crossing_m", self.crossing_m, self.corner_ahead_m + 0.5, 200.0)
        if self.facing_m is not None:
            in_range("facing_m", self.facing_m, self.crossing_m + 0.5, 200.0)

    @property
    def sight_m(self) -> tuple[float, float]:
        """Limits (right, left) of what is in line of sight on the crossing street, y left positive."""
        reach = self.crossing_m / self.corner_ahead_m
        return -self.right_m * reach, self.left_m * reach


@dataclass(frozen=True, slots=True)
class SoundPath:
    """One way from every place, shape (N,), at every frequency, (F,)."""

    azimuth_rad: FloatArray  # shape (N,): Where it arrives from
    length_m: FloatArray  # shape (N,)
    passed: FloatArray  # shape (N, F): Share of the power that the corner lets pass
    facades: int  # Number of reflections in the crossing street
    side_walls: tuple[int, int]  # Number of reflections in the left and in the right side wall

    def power(self, facade: float, left: float, right: float) -> FloatArray:
        r"""Return :math:`\rho_f^{2 n_f} \rho_l^{2 n_l} \rho_r^{2 n_r} D / r^2`, shape (N, F)."""
        of_left, of_right = self.side_walls
        walls = facade**self.facades * left**of_left * right**of_right
        return np.asarray(walls**2 * self.passed / self.length_m[:, None] ** 2)


def sound_paths(
    walls: StreetWalls, crossing_m: float, along_m: FloatArray, frequencies_hz: FloatArray
) -> list[SoundPath]:
    """Return all ways from places on a lane, those from behind a corner included.

    Examples
    --------
    >>> walls = StreetWalls(4.45, 2.8, 2.8, 7.15)
    >>> direct = sound_paths(walls, 7.15, np.array([2.0, 12.0]), np.array([500.0]))[0]
    >>> np.degrees(direct.azimuth_rad).round(1), direct.passed.round(3).ravel()
    (array([15.6, 32.2]), array([1.   , 0.018]))
    """
    mouth, left, right = walls.corner_ahead_m, walls.left_m, -walls.right_m
    paths = []
    for facades, ahead in enumerate(_source_images(walls, crossing_m)):
        for end, sign, side_walls in _array_images(walls):
            crossed = end + (along_m - end) * mouth / ahead
            aim = np.clip(crossed, right, left)
            straight = np.hypot(ahead, along_m - end)
            way = np.hypot(ahead - mouth, along_m - aim) + np.hypot(mouth, aim - end)
            inside = np.minimum(crossed - right, left - crossed)
            passed = _corner_share(way - straight, inside, frequencies_hz)
            azimuth = np.arctan2(sign * (aim - end), mouth)
            paths.append(SoundPath(azimuth, way, passed, facades, side_walls))
    return paths


def _source_images(walls: StreetWalls, crossing_m: float) -> list[float]:
    """Distances ahead of a lane and of its images in the two facades of the crossing street."""
    if walls.facing_m is None:
        return [crossing_m]
    mouth, depth = walls.corner_ahead_m, walls.facing_m - walls.corner_ahead_m
    inside = crossing_m - mouth
    return [
        mouth + 2.0 * depth * ((order + 1) // 2) + inside * (-1) ** order for order in range(FACADE_ORDER + 1)
    ]


def _array_images(walls: StreetWalls) -> Iterator[tuple[float, int, tuple[int, int]]]:
    """Yield lateral place, orientation and reflections (left, right) of the array's images."""
    yield 0.0, 1, (0, 0)
    width = walls.left_m + walls.right_m
    for order in range(1, SIDE_ORDER + 1):
        shift, odd = 2.0 * width * (order // 2), order % 2
        more, fewer = (order + 1) // 2, order // 2
        yield shift + 2.0 * walls.left_m * odd, (-1) ** order, (more, fewer)
        yield -shift - 2.0 * walls.right_m * odd, (-1) ** order, (fewer, more)


def _corner_share(detour_m: FloatArray, inside_m: FloatArray, frequencies_hz: FloatArray) -> FloatArray:
    r"""Power behind a screen, (N, F), after Maekawa: :math:`1 / (3 + 20 N)`, :math:`N = 2 \delta f / c`."""
    # Z. Maekawa, "Noise reduction by screens", Applied Acoustics 1 (1968): 10 log10(3 + 20 N) dB.
    fresnel = 2.0 * detour_m[:, None] * frequencies_hz / SPEED_OF_SOUND_MPS
    lit = np.clip(inside_m / LIT_DEPTH_M, 0.0, 1.0)[:, None]
    return np.where(inside_m[:, None] < 0.0, 1.0 / (3.0 + 20.0 * fresnel), (1.0 + 2.0 * lit) / 3.0)
