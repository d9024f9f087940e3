"""Odometry: motion and pose of the ego vehicle from wheels, an inertial unit or a localiser."""

import math
from dataclasses import dataclass

from worldstate.ground import integer_ns, named, wrap_angle
from worldstate.ground.checks import ABOVE_ZERO, check_fields, pair

FARTHEST_M = 1e8  # UTM's northings go up to 1e7
_MOST_TURNS_RAD = 1e6  # Large enough for a localiser that does not wrap its yaw
_RANGES = {
    "speed_mps": (-100.0, 100.0),
    "yaw_rate_rad_s": (-10.0, 10.0),
    "speed_std_mps": (0.0, 100.0),
    "yaw_rate_std_rad_s": (0.0, 10.0),
}


@dataclass(frozen=True, slots=True)
class EgoPose:
    """Pose of the ego vehicle in the map frame, in which the context gives its corners.

    Parameters
    ----------
    position_m : (float, float)
        Position of `base_link`, m.
    yaw_rad : float
        Angle of its x axis, counter-clockwise from that of the map; wrapped into (-pi, pi].
    position_std_m, yaw_std_rad : float
        Standard deviations; that of the position is per axis.

    Examples
    --------
    >>> EgoPose((12.0, 0.0)).yaw_rad
    0.0
    """

    position_m: tuple[float, float]
    yaw_rad: float = 0.0
    position_std_m: float = 0.1
    yaw_std_rad: float = 0.01

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_m", pair("position_m", self.position_m, FARTHEST_M))
        check_fields(self, yaw_rad=(-_MOST_TURNS_RAD, _MOST_TURNS_RAD))
        if abs(self.yaw_rad) > math.pi:
            object.__setattr__(self, "yaw_rad", wrap_angle(self.yaw_rad))
        check_fields(self, position_std_m=(ABOVE_ZERO, 1e3), yaw_std_rad=(ABOVE_ZERO, math.pi))


@dataclass(frozen=True, slots=True)
class Odometry:
    """Twist of the ego vehicle, and its pose if a localiser measures it.

    The twist holds until the next message, so the ego vehicle drives an arc between two messages. Without a
    pose the arcs are added up from the first message, whose place is the origin of the map.

    Parameters
    ----------
    source : str
        Name of the sensor.
    stamp_ns : int
        Time of the twist, ns on the stream's clock.
    speed_mps, yaw_rate_rad_s : float
        Speed along the x axis of `base_link`, and yaw rate about its z axis, left positive.
    speed_std_mps, yaw_rate_std_rad_s : float
        Standard deviations.
    pose : EgoPose or None
        Pose that replaces the sum of the arcs.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> Odometry("wheels", 100_000_000, 5.0, yaw_rate_rad_s=0.1).pose is None
    True
    """

    source: str
    stamp_ns: int
    speed_mps: float
    yaw_rate_rad_s: float = 0.0
    speed_std_mps: float = 0.1  # Typical of wheel encoders at town speeds
    yaw_rate_std_rad_s: float = 0.01  # Typical of an automotive gyroscope with its bias
    pose: EgoPose | None = None

    def __post_init__(self) -> None:
        named("source", self.source)
        check_fields(self, pose=EgoPose | None, **_RANGES)
        object.__setattr__(self, "stamp_ns", integer_ns("stamp_ns", self.stamp_ns))
