"""Where the ego is: it stands, or it drives up to the corner and stops there."""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.typing import FloatArray

BRAKING_MPS2 = 2.5
ARRAY_HEIGHT_M = 1.7  # origin of `base_link` above the road: the array's centre on the roof


@dataclass(frozen=True, slots=True)
class EgoMotion:
    """An ego that drives along its street at a constant speed, brakes and stops at the origin.

    Parameters
    ----------
    speed_mps : float
        Before braking; 0 for an ego that stands all the time.
    stop_s : float
        When it comes to stand.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> ego = EgoMotion(5.0, 8.0)
    >>> ego.x_m(np.array([5.0, 7.0, 9.0])), ego.at_mps(np.array([5.0, 7.0, 9.0]))
    (array([-10.  ,  -1.25,   0.  ]), array([5. , 2.5, 0. ]))
    """

    speed_mps: float = 0.0
    stop_s: float = 0.0

    def __post_init__(self) -> None:
        in_range("speed_mps", self.speed_mps, 0.0, 20.0)
        in_range("stop_s", self.stop_s, 0.0, 120.0)

    @property
    def stands(self) -> bool:
        """Whether it never moves."""
        return self.speed_mps == 0.0

    def later(self, start_s: float) -> "EgoMotion":
        """Return the same motion on a clock that begins so much later; it stands if it has stopped by then.

        Examples
        --------
        >>> EgoMotion(5.0, 8.0).later(-2.0).stop_s, EgoMotion(5.0, 8.0).later(9.0).stands
        (10.0, True)
        """
        left_s = self.stop_s - start_s
        return replace(self, stop_s=left_s) if left_s > 0.0 else EgoMotion()

    def at_mps(self, time_s: FloatArray) -> FloatArray:
        """Speed at any time, same shape as `time_s`."""
        return np.clip(BRAKING_MPS2 * (self.stop_s - time_s), 0.0, self.speed_mps)

    def x_m(self, time_s: FloatArray) -> FloatArray:
        """Position along the street, 0 where it stops, same shape as `time_s`."""
        left = np.maximum(self.stop_s - time_s, 0.0)
        braking = np.minimum(left, self.speed_mps / BRAKING_MPS2)
        return np.asarray(0.0 - 0.5 * BRAKING_MPS2 * braking**2 - self.speed_mps * (left - braking))
