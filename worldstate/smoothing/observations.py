r"""Input and output of the smoother: settings, observations, tracks and times of first sight.

An entity is :math:`(\theta, \dot\theta, \rho, \log r)` relative to an ego vehicle at rest. In Cartesian
coordinates, with the unit vectors d at :math:`\theta` and n to its left,

.. math:: p = r\, d, \qquad v = r\,(\rho\, d + \dot\theta\, n).
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from worldstate.belief.kinematics.motion import AZIMUTH, LEAST_STD, MotionBelief
from worldstate.ground import FloatArray, IntArray, in_range, seconds, wrap_angle
from worldstate.measurement import Approach, Bearing, Position

# No entity comes closer to the ego vehicle than this; at 0 bearings have no derivative.
_NEAREST_SQUARE_M2 = 0.25
# Without this limit, contradictory approach rates could raise log r, which is not measured, until exp
# overflows.
_FARTHEST_LOG_M = math.log(1e4)


def cartesian(state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (x, y, vx, vy) of a polar state, and its derivative, shape (4, 4)."""
    theta, turning, closing, log_range = state.tolist()
    r = math.exp(min(log_range, _FARTHEST_LOG_M))
    x, y = r * math.cos(theta), r * math.sin(theta)
    vx, vy = closing * x - turning * y, closing * y + turning * x
    slope = np.array([[-y, 0.0, 0.0, x], [x, 0.0, 0.0, y], [-vy, -y, x, vx], [vx, x, y, vy]])
    return np.array([x, y, vx, vy]), slope


def moved(state: FloatArray, step_s: float) -> FloatArray:
    """Return a polar state after some seconds of constant velocity; the azimuth is not wrapped.

    Examples
    --------
    >>> moved(np.array([6.0, 0.0, -0.1, 2.0]), 1.0).round(3).tolist()
    [6.0, 0.0, -0.111, 1.895]
    """
    theta, turning, closing, log_m = state.tolist()
    # The filter's `propagate` computes the same for arrays, but takes forty times as long for one entity.
    a, b = 1.0 + closing * step_s, turning * step_s
    q = max(a * a + b * b, LEAST_STD)
    radial = (a * closing + b * turning) / q
    return np.array([theta + math.atan2(b, a), turning / q, radial, log_m + 0.5 * math.log(q)])


def azimuth(place: FloatArray) -> tuple[float, FloatArray]:
    """Return the azimuth of a place, and its derivative with respect to (x, y, vx, vy)."""
    x, y = place[:2].tolist()
    square = max(x * x + y * y, _NEAREST_SQUARE_M2)
    return math.atan2(y, x), np.array([[-y / square, x / square, 0.0, 0.0]])


def closing_rate(place: FloatArray) -> tuple[float, FloatArray]:
    """Return 1/TTA = -r_dot/r of a place and its relative velocity, and its derivative."""
    x, y, vx, vy = place.tolist()
    square = max(x * x + y * y, _NEAREST_SQUARE_M2)
    rate = -(x * vx + y * vy) / square
    slope = np.array([[-vx - 2.0 * x * rate, -vy - 2.0 * y * rate, -x, -y]]) / square
    return rate, slope


def log_range(place: FloatArray) -> tuple[float, FloatArray]:
    """Return the logarithm of the distance, and its derivative."""
    x, y = place[:2].tolist()
    square = max(x * x + y * y, _NEAREST_SQUARE_M2)
    return 0.5 * math.log(square), np.array([[x / square, y / square, 0.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Range:
    """A measured distance.

    Parameters
    ----------
    range_m, std_m : float
        Metres, > 0.

    Examples
    --------
    >>> Range(12.0, 0.5).range_m
    12.0
    """

    range_m: float
    std_m: float


@dataclass(frozen=True, slots=True)
class AngularHeight:
    """Angular height of a box around an entity, which gives the distance if the true height is known.

    Parameters
    ----------
    height_rad : float
        Radians, > 0.
    relative_std : float
        Relative standard deviation, > 0.
    true_height_m, true_relative_std : float
        True height of such an entity and its relative deviation; only those of its first box are used.

    Examples
    --------
    >>> AngularHeight(0.12, 0.03).true_height_m
    1.5
    """

    height_rad: float
    relative_std: float
    true_height_m: float = 1.5
    # Range from a small car to a sports utility vehicle.
    true_relative_std: float = 0.1


Observation: TypeAlias = Bearing | Approach | Position | Range | AngularHeight


@dataclass(frozen=True, slots=True)
class SmoothingSettings:
    r"""Lag of the smoother, and motion model of vehicles.

    Parameters
    ----------
    lag_s : float
        Time that states stay in the graph, s; longer than the time from a vehicle's first sound to its sight.
    acceleration_psd : float
        Density of the white acceleration, m^2/s^3.
    robust_k : float
        Residual, in standard deviations, above which the Huber loss of bearings, approach rates and boxes
        grows linearly.
    manoeuvre_k : float or None
        Scale of the Cauchy loss of the motion between two states, whose whitened norm is 2 on average. The
        loss fits drivers who keep their pace most of the time and sometimes brake, accelerate or turn off:
        such manoeuvres cost less than under white acceleration. None for a Gaussian loss.
    relinearize_every : int
        Number of updates between two relinearisations.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> SmoothingSettings(lag_s=20.0).acceleration_psd
    1.0
    """

    lag_s: float = 15.0
    acceleration_psd: float = 1.0
    # 95 % of the efficiency of least squares if all residuals are Gaussian (Huber, 1981).
    robust_k: float = 1.345
    manoeuvre_k: float | None = None
    # Relinearisation at every update takes four times as long and changes the result by less than 1 %.
    relinearize_every: int = 10

    def __post_init__(self) -> None:
        in_range("lag_s", self.lag_s, 0.0, 600.0, open_low=True)
        in_range("acceleration_psd", self.acceleration_psd, 0.0, 1e6, open_low=True)
        in_range("robust_k", self.robust_k, 0.0, 1e6, open_low=True)
        if self.manoeuvre_k is not None:
            in_range("manoeuvre_k", self.manoeuvre_k, 0.0, 1e6, open_low=True)
        in_range("relinearize_every", self.relinearize_every, 1, 1000)


@dataclass(frozen=True, slots=True)
class FirstSight:
    """Time T0 at which an entity came into line of sight past an edge.

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
        Stamps of its states, in order.
    motion : MotionBelief
        Polar states relative to the ego vehicle, mean (n, 4) and covariance (n, 4, 4).
    smoother : {"fixed-lag smoother", "RTS smoother"}
        Method: gtsam's factor graph, or filterpy's smoother if gtsam is not installed.

    Examples
    --------
    >>> belief = MotionBelief.stacked([MotionBelief.around((0.0, 0.0, -0.1, 3.0), (0.1, 0.1, 0.1, 0.2))])
    >>> track = SmoothedTrack("car", np.array([0]), belief)
    >>> track.states.round(2).tolist(), track.position_std_m.round(1).tolist()
    ([[20.09, 0.0, -2.01, 0.0]], [4.0])
    """

    entity: str
    stamps_ns: IntArray
    motion: MotionBelief
    smoother: Literal["fixed-lag smoother", "RTS smoother"] = "fixed-lag smoother"

    @property
    def time_s(self) -> FloatArray:
        """Time of every state, s."""
        return np.asarray(self.stamps_ns * 1e-9, np.float64)

    @property
    def states(self) -> FloatArray:
        """Mean (x, y, vx, vy), shape (n, 4)."""
        return np.array([cartesian(row)[0] for row in self.motion.mean])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of (x, y, vx, vy), shape (n, 4, 4), to first order."""
        slopes = np.array([cartesian(row)[1] for row in self.motion.mean])
        return np.asarray(slopes @ self.motion.covariance @ slopes.mT)

    @property
    def position_std_m(self) -> FloatArray:
        """Standard deviation of the position along its longest axis, shape (n,)."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariance[:, :2, :2])[:, -1]))

    def first_sight(self, side: int, edge_rad: float, edge_std_rad: float) -> FirstSight | None:
        r"""Return when it last passed the azimuth of an edge; None if this was not within the lag.

        With the azimuth u beyond the edge, on side 1 (left) or -1 (right) of it,

        .. math:: u(T_0) = 0, \qquad \sigma = \sqrt{\sigma_\theta^2 + \sigma_{edge}^2}\, /\, |\dot u|.

        Examples
        --------
        >>> spread = 0.03, 0.1, 0.1, 0.2
        >>> ends = [MotionBelief.around((at_rad, -0.5, 0.0, 3.0), spread) for at_rad in (0.8, 0.3)]
        >>> track = SmoothedTrack("car", np.array([0, 10**9]), MotionBelief.stacked(ends))
        >>> first = track.first_sight(1, edge_rad=0.55, edge_std_rad=0.04)
        >>> round(first.time_s, 2), round(first.std_s, 2)
        (0.5, 0.1)
        """
        beyond = side * wrap_angle(self.motion.mean[:, AZIMUTH] - edge_rad)
        # Azimuths wrap behind the ego vehicle: a decrease by half a turn or more is not a passage of the
        # edge.
        ahead = beyond[:-1] - beyond[1:] < math.pi
        crossed = np.flatnonzero((beyond[:-1] > 0.0) & (beyond[1:] <= 0.0) & ahead)
        if not crossed.size:
            return None
        before, after = int(crossed[-1]), int(crossed[-1]) + 1
        step_s = seconds(int(self.stamps_ns[after] - self.stamps_ns[before]))
        passed = float(beyond[before] - beyond[after])
        time_s = seconds(int(self.stamps_ns[before])) + float(beyond[before]) / passed * step_s
        spread_rad = math.sqrt(self.motion.covariance[after, AZIMUTH, AZIMUTH] + edge_std_rad**2)
        return FirstSight(time_s, spread_rad / (passed / step_s))
