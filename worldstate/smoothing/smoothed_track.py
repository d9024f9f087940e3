"""What the smoother says of an entity: where it was, hidden phase included, and when it came into view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.ground.typing import FloatArray, IntArray
from worldstate.ground.values import seconds

from .geometry import cartesian


@dataclass(frozen=True, slots=True)
class FirstSight:
    """When an entity came into line of sight past a corner, T0.

    Parameters
    ----------
    time_s, std_s : float
        Seconds on the stream's clock, and the standard deviation.

    Examples
    --------
    >>> FirstSight(12.4, 0.06).std_s
    0.06
    """

    time_s: float
    std_s: float


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedTrack:
    """The corrected trajectory of one entity within the lag.

    Parameters
    ----------
    entity : str
        Its name.
    stamps_ns : ndarray, shape (n,)
        Of its states, in order.
    motion : MotionBelief
        Polar states about `anchor_m`, mean (n, 4) and covariance (n, 4, 4).
    anchor_m : ndarray, shape (2,)
        Where the ego stood when the entity was first observed.
    smoother : {"fixed-lag smoother", "RTS smoother"}
        By which it was made: gtsam's factor graph, or filterpy's where gtsam is not installed.

    Examples
    --------
    >>> belief = MotionBelief.stacked([MotionBelief.around((0.0, 0.0, -0.1, 3.0), (0.1, 0.1, 0.1, 0.2))])
    >>> track = SmoothedTrack("car", np.array([0]), belief, np.zeros(2))
    >>> track.states.round(2).tolist(), track.position_std_m.round(1).tolist()
    ([[20.09, 0.0, -2.01, 0.0]], [4.0])
    """

    entity: str
    stamps_ns: IntArray
    motion: MotionBelief
    anchor_m: FloatArray
    smoother: Literal["fixed-lag smoother", "RTS smoother"] = "fixed-lag smoother"

    @property
    def time_s(self) -> FloatArray:
        """Time of every state, s."""
        return np.asarray(self.stamps_ns * 1e-9, np.float64)

    @property
    def states(self) -> FloatArray:
        """Mean (x, y, vx, vy) in the map, shape (n, 4)."""
        return np.array([cartesian(row, self.anchor_m)[0] for row in self.motion.mean])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of (x, y, vx, vy), shape (n, 4, 4), to first order."""
        slopes = np.array([cartesian(row, self.anchor_m)[1] for row in self.motion.mean])
        return np.asarray(slopes @ self.motion.covariance @ slopes.mT)

    @property
    def position_std_m(self) -> FloatArray:
        """Standard deviation of the position along its longest axis, shape (n,)."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariance[:, :2, :2])[:, -1]))


def crossing(stamps_ns: Sequence[int], beyond: Sequence[float]) -> tuple[int, float, float] | None:
    """Return the state after the last passage of an edge, its time, s, and the rate there; None without one.

    Examples
    --------
    >>> crossing([0, 10**9], [0.25, -0.25])
    (1, 0.5, 0.5)
    """
    crossed = [i for i in range(1, len(stamps_ns)) if beyond[i - 1] > 0.0 >= beyond[i]]
    if not crossed:
        return None
    i = crossed[-1]
    step_s = seconds(stamps_ns[i] - stamps_ns[i - 1])
    share, rate = beyond[i - 1] / (beyond[i - 1] - beyond[i]), (beyond[i - 1] - beyond[i]) / step_s
    return i, seconds(stamps_ns[i - 1]) + share * step_s, rate
