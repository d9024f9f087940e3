"""Input of the smoother: settings, and observations beside the bearings, approach rates and positions."""

import math
from dataclasses import dataclass
from typing import TypeAlias

from worldstate.ground.checks import in_range
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


@dataclass(frozen=True, slots=True)
class SmoothingSettings:
    r"""How far back the smoother corrects, and how vehicles are taken to drive.

    Parameters
    ----------
    lag_s : float
        How long states stay in the graph, s: longer than anybody is heard before he is seen.
    acceleration_psd : float
        Density of the white acceleration, m^2/s^3.
    robust_k : float
        Residual in standard deviations from which on the Huber loss of bearings, approach rates and boxes
        grows linearly.
    manoeuvre_k : float or None
        Scale of the Cauchy loss of the motion between two states, whose whitened norm is 2 in the mean.
        A driver then keeps the pace most of the time, and now and then brakes, accelerates or turns off,
        at a lower cost than as white acceleration. None for a Gaussian.
    range_m, range_log_std : float
        Prior of the distance at which an entity is first observed, and its deviation as a factor's logarithm.
    edge_std_rad : float
        How sharply line of sight begins at an edge: a vehicle is no point.
    relinearize_every : int
        Updates between two relinearisations.

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
    # 95 % as efficient as least squares where all residuals are Gaussian (Huber, 1981).
    robust_k: float = 1.345
    manoeuvre_k: float | None = None
    range_m: float = 25.0
    range_log_std: float = 0.7
    edge_std_rad: float = math.radians(1.0)
    # Relinearising at every update costs four times as much and moves the result by less than a percent.
    relinearize_every: int = 10

    def __post_init__(self) -> None:
        in_range("lag_s", self.lag_s, 0.0, 600.0, open_low=True)
        positive = ("acceleration_psd", "robust_k", "range_m", "range_log_std", "edge_std_rad")
        for name in positive:
            in_range(name, getattr(self, name), 0.0, 1e6, open_low=True)
        if self.manoeuvre_k is not None:
            in_range("manoeuvre_k", self.manoeuvre_k, 0.0, 1e6, open_low=True)
        in_range("relinearize_every", self.relinearize_every, 1, 1000)
