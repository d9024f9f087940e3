"""The walls of a junction, as far as they decide by which ways sound reaches the ego."""

from dataclasses import dataclass

from worldstate.ground.checks import in_range


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
