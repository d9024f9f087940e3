"""Speed of the ego vehicle over time, as its odometry reports it."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import freeze_arrays
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IntArray
from worldstate.ground.values import nanoseconds

# Faster than any road vehicle; the filter takes no more.
FASTEST_MPS = 100.0
# Odometry of a standing vehicle scatters by some centimetres a second.
STANDING_MPS = 0.2
# Odometry comes at 10 Hz or more: what is older does not tell the speed.
_HOLDS_NS = nanoseconds(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class EgoSpeed:
    """Forward speed at stamps, linear in between.

    Examples
    --------
    >>> speed = EgoSpeed(np.array([0, 1_000_000_000]), np.array([2.0, 4.0]))
    >>> speed.at(500_000_000), speed.at(3_000_000_000), speed.moves
    (3.0, None, True)
    """

    stamps_ns: IntArray  # Increasing, on the clock of the sound
    speed_mps: FloatArray  # Along the x axis of base_link, negative backwards

    def __post_init__(self) -> None:
        if not len(self.stamps_ns) or (np.diff(self.stamps_ns) <= 0).any():
            raise InvalidArgumentError("ego speed: expected at least one value, at increasing stamps")
        freeze_arrays(self, speed_mps=(len(self.stamps_ns),))
        fastest = float(np.abs(self.speed_mps).max())
        if fastest > FASTEST_MPS:
            raise InvalidArgumentError(f"ego speed: expected at most {FASTEST_MPS:g} m/s, got {fastest:g}")

    @property
    def moves(self) -> bool:
        """Whether the vehicle moves at any time."""
        return bool(np.abs(self.speed_mps).max() > STANDING_MPS)

    def at(self, stamp_ns: int) -> float | None:
        """Return the speed; None where the last report or the next is a second away."""
        if not self.stamps_ns[0] - _HOLDS_NS <= stamp_ns <= self.stamps_ns[-1] + _HOLDS_NS:
            return None
        # Relative to the first: a float holds nanoseconds since 1970 to a quarter of a microsecond only.
        past = (self.stamps_ns - self.stamps_ns[0]).astype(np.float64)
        return float(np.interp(float(stamp_ns - int(self.stamps_ns[0])), past, self.speed_mps))
