"""Positions of road users from a radar, a lidar or radio messages."""

from dataclasses import dataclass

import numpy as np

from worldstate.abduction.co_evidence import Sector as Sector
from worldstate.abduction.road_users import ClassShares, class_shares
from worldstate.ground import InvalidArgumentError, finite_array, in_range, integer_ns, named, nanoseconds
from worldstate.ground.checks import ABOVE_ZERO, BELOW_ONE, all_of, check_fields, pair

# Limits of accepted values: farther objects have no effect within the horizons of the filter. A covariance
# with variances outside these limits is singular after rounding or contains no information.
_FARTHEST_M, _FASTEST_MPS = 1e4, 200.0
_LEAST_VARIANCE, _LARGEST_VARIANCE = 1e-6, 1e6
# A scan is associated as a whole, and the time for this grows with the cube of its size.
MOST_POSITIONS = 128


@dataclass(frozen=True, slots=True)
class Position:
    """Position of one object in `base_link`, from a sensor or a message.

    Parameters
    ----------
    position_m : (float, float)
        x forward and y left, m.
    covariance : nested tuple of floats, shape (2, 2) or (4, 4)
        Of (x, y), m^2, or of (x, y, vx, vy) with a velocity. Symmetric and positive definite.
    velocity_mps : (float, float) or None
        Velocity over ground, along x and y.
    existence_probability : float
        P(the object exists) according to the sensor, or to the credentials of the sender, in (0, 1); 0.5 if
        unknown.
    classes : tuple of (str, float)
        Classes with their probabilities; empty if unknown.

    Raises
    ------
    InvalidArgumentError
        If a number is not finite or out of range, or the covariance is invalid or has the wrong size.

    Examples
    --------
    >>> Position((12.0, 3.0), ((0.2, 0.0), (0.0, 0.4))).velocity_mps is None
    True
    """

    position_m: tuple[float, float]
    covariance: tuple[tuple[float, ...], ...]
    velocity_mps: tuple[float, float] | None = None
    existence_probability: float = 0.5
    classes: ClassShares = ()

    def __post_init__(self) -> None:
        if self.velocity_mps is not None:
            velocity = pair("velocity_mps", self.velocity_mps, _FASTEST_MPS)
            object.__setattr__(self, "velocity_mps", velocity)
        known = 2 if self.velocity_mps is None else 4
        covariance = finite_array("covariance", self.covariance, (known, known))
        spread = np.linalg.eigvalsh(covariance)
        if not np.allclose(covariance, covariance.T, rtol=1e-9, atol=1e-9) or spread[0] < _LEAST_VARIANCE:
            expected = f"a symmetric matrix with eigenvalues of at least {_LEAST_VARIANCE}"
            raise InvalidArgumentError(f"covariance: expected {expected}, got {covariance.tolist()}")
        if spread[-1] > _LARGEST_VARIANCE:
            expected = f"eigenvalues of at most {_LARGEST_VARIANCE:g}"
            raise InvalidArgumentError(f"covariance: expected {expected}, got {spread[-1]:g}")
        even = 0.5 * (covariance + covariance.T)
        object.__setattr__(self, "covariance", tuple(tuple(row) for row in even.tolist()))
        object.__setattr__(self, "position_m", pair("position_m", self.position_m, _FARTHEST_M))
        check_fields(self, existence_probability=(ABOVE_ZERO, BELOW_ONE))
        object.__setattr__(self, "classes", class_shares("classes", self.classes))


@dataclass(frozen=True, slots=True)
class SearchedSector:
    """The sector in which a sensor would have detected objects in line of sight.

    Parameters
    ----------
    sector : Sector
        Azimuths of its field of view.
    range_m : float
        Largest range of detection.
    detection_probability : float
        Probability that it detects a road user there in one scan, in [0, 1).
    clutter_rate : float
        Probability that a detection is false, in (0, 1).

    Examples
    --------
    >>> SearchedSector(Sector(0.0, 1.05), range_m=70.0, detection_probability=0.9).clutter_rate
    0.01
    """

    sector: Sector
    range_m: float
    detection_probability: float
    clutter_rate: float = 0.01

    def __post_init__(self) -> None:
        check_fields(self, sector=Sector, range_m=(ABOVE_ZERO, _FARTHEST_M))
        check_fields(self, detection_probability=(0.0, BELOW_ONE), clutter_rate=(ABOVE_ZERO, BELOW_ONE))
        in_range("centre_rad", self.sector.centre_rad, -np.pi, np.pi)
        in_range("half_width_rad", self.sector.half_width_rad, ABOVE_ZERO, np.pi)


@dataclass(frozen=True, slots=True)
class PositionScan:
    """All positions from one source at one instant, and the searched sector.

    Parameters
    ----------
    source : str
        Name of the sensor or of the receiver.
    stamp_ns : int
        Time of the positions, ns on the stream's clock; with a latency, the arrival of the scan.
    positions : tuple of Position
        At most 128.
    searched : SearchedSector or None
        Sector that a sensor in line of sight has searched; its empty scan is evidence of absence. None for
        messages: these need no line of sight and give no evidence about vehicles that send none.
    latency_s : float
        Time from the scan to its stamp.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> car = Position((10.0, 14.0), ((1.0, 0.0), (0.0, 1.0)), existence_probability=0.95)
    >>> PositionScan("v2x", 100_000_000, (car,)).searched is None
    True
    """

    source: str
    stamp_ns: int
    positions: tuple[Position, ...] = ()
    searched: SearchedSector | None = None
    latency_s: float = 0.0

    def __post_init__(self) -> None:
        named("source", self.source)
        check_fields(self, searched=SearchedSector | None, latency_s=(0.0, 1e3))
        object.__setattr__(self, "positions", all_of("positions", self.positions, Position, MOST_POSITIONS))
        object.__setattr__(self, "stamp_ns", integer_ns("stamp_ns", self.stamp_ns))

    @property
    def observed_ns(self) -> int:
        """When the scan was taken."""
        return self.stamp_ns - nanoseconds(self.latency_s)
