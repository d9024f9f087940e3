"""What the smoother takes beside bearings, approach rates and positions of the filter's measurements."""

from dataclasses import dataclass
from typing import TypeAlias

from worldstate.measurement.measurement import Approach, Bearing
from worldstate.measurement.position import Position


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
    """The height of a box around an entity, as an angle: it tells the distance as well as the true height.

    Parameters
    ----------
    height_rad : float
        Radians, > 0.
    relative_std : float
        Its standard deviation over itself, > 0.
    true_height_m, true_relative_std : float
        How high such an entity is, and how widely that varies; said once, with the first of its boxes.

    Examples
    --------
    >>> AngularHeight(0.12, 0.03).true_height_m
    1.5
    """

    height_rad: float
    relative_std: float
    true_height_m: float = 1.5
    # From a small car to a sports utility vehicle.
    true_relative_std: float = 0.1


@dataclass(frozen=True, slots=True)
class ReflectedBearing:
    """The azimuth of an entity's image in a wall.

    Parameters
    ----------
    wall : str
        Name of a wall of the smoother.
    azimuth_rad, std_rad : float
        As of a bearing.

    Examples
    --------
    >>> ReflectedBearing("opposite", 0.4, 0.1).wall
    'opposite'
    """

    wall: str
    azimuth_rad: float
    std_rad: float


@dataclass(frozen=True, slots=True)
class PastEdge:
    """Whether a sensor that needs line of sight found an entity, which tells where it is beside an edge.

    Parameters
    ----------
    corner : str
        Name of a corner of the smoother.
    seen : bool
        Whether it was detected.
    detection_probability : float
        Of an entity in line of sight, in (0, 1).
    clutter_rate : float
        Probability that a detection is of nobody, in (0, 1).

    Examples
    --------
    >>> PastEdge("left", seen=False).detection_probability
    0.9
    """

    corner: str
    seen: bool
    detection_probability: float = 0.9
    clutter_rate: float = 0.01


@dataclass(frozen=True, slots=True)
class EgoStep:
    """How the ego has moved since the last update, in its own axes then.

    Parameters
    ----------
    ahead_m, left_m, turn_rad : float
        Way and turn, left positive.
    std : (float, float, float)
        Standard deviations of the three, > 0.

    Examples
    --------
    >>> EgoStep(0.5, 0.0, 0.0).std
    (0.02, 0.02, 0.002)
    """

    ahead_m: float
    left_m: float
    turn_rad: float
    std: tuple[float, float, float] = (0.02, 0.02, 0.002)


Observation: TypeAlias = Bearing | Approach | Position | Range | AngularHeight | ReflectedBearing | PastEdge
