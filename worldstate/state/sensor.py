"""Sensors of a snapshot: health, last looks, order of delivery, and the ego vehicle by its odometry."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from worldstate.ground.serialisation import ADDED, Count, Probability

Condition: TypeAlias = Literal["working", "impaired", "silent"]
MASKED = "masked by a vehicle in view"  # A reason in `Hearing` that is not a fault of the sensor


@dataclass(frozen=True, slots=True)
class SensorHealth:
    """Health of a sensor, by its last measurement or look.

    Parameters
    ----------
    sensor : str
        Source of measurements, or the sensor whose looks were part of them.
    condition : {"working", "impaired", "silent"}
        Silent after one second without a measurement or a look; impaired if a fault is known.
    stamp_ns : int
        Time of its last measurement or look, ns.
    reason : str or None
        The known fault, or None.

    Examples
    --------
    >>> SensorHealth("acoustic", "impaired", 1_000_000_000, "sounds like speech").condition
    'impaired'
    """

    sensor: str
    condition: Condition
    stamp_ns: int
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class Hearing:
    """How well an array could receive a hidden vehicle: its silence is evidence only to this degree.

    Parameters
    ----------
    sensor : str
        Source of measurements.
    share : float
        Probability that a hidden vehicle would have been detected.
    since_ns : int
        Time since which the share has had this value, ns.
    reason : str or None
        Why the share is reduced, or None.
    kinds : mapping of str to float, or None
        For each kind of road user, the share of approaches that would be detected now: the share detected in
        the simulated exam of the model at the budget of its file, times `share`. None if the model card has
        no such shares, the sequence model is not used, or `share` is 0.

    Examples
    --------
    >>> Hearing("acoustic", 0.0, 1_000_000_000, "lost samples").reason
    'lost samples'
    """

    sensor: str
    share: Probability
    since_ns: int
    reason: str | None = None
    kinds: Mapping[str, Probability] | None = field(default=None, metadata=ADDED)


@dataclass(frozen=True, slots=True)
class SearchedView:
    """The last look of a sensor: the searched sector, its result, and the error rates.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    stamp_ns : int
        Time of the look, ns.
    found : bool
        Whether a moving object was found.
    miss_rate, clutter_rate : float
        Probability of a missed vehicle in view, and of a false detection.
    sector_rad : (float, float)
        Azimuths of the right and the left end of the searched sector.

    Examples
    --------
    >>> SearchedView("camera", 0, False, 0.04, 0.01, (-0.6, 0.6)).found
    False
    """

    sensor: str
    stamp_ns: int
    found: bool
    miss_rate: Probability
    clutter_rate: Probability
    sector_rad: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Ego:
    """Pose in the map frame and twist of the ego vehicle.

    Parameters
    ----------
    position_m : (float, float)
        Position of `base_link` in the map frame, m.
    yaw_rad : float
        Azimuth of its x axis in the map frame, counter-clockwise.
    covariance : nested tuple of floats, shape (3, 3)
        Covariance of (x, y, yaw).
    speed_mps, yaw_rate_rad_s : float
        Speed along its x axis and rate about its z axis, left positive.
    localised : bool
        Whether odometry contains the pose; otherwise the pose is integrated from the place of the first
        speed.

    Examples
    --------
    >>> Ego((2.0, 0.0), 0.0, ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 1e-4)), 5.0, 0.0).speed_mps
    5.0
    """

    position_m: tuple[float, float]
    yaw_rad: float
    covariance: tuple[tuple[float, ...], ...]
    speed_mps: float
    yaw_rate_rad_s: float
    localised: bool = field(default=False, metadata=ADDED)


@dataclass(frozen=True, slots=True)
class Delivery:
    """Numbers of faulty deliveries since the filter began.

    Parameters
    ----------
    replayed : int
        Late measurements within the lag of the filter, which were inserted at their own time.
    repeated : int
        Repeated measurements, which were dropped.
    too_late : int
        Measurements later than the lag of the filter, which were dropped.
    reanchored : int
        Restarts of the belief after all measurements of one second were too late because a clock had changed.
    held_back : int
        Measurements more than the lag ahead of all others, which no other measurement has confirmed.
    boxes_left_out : int
        Boxes beyond the 64 that are used of an image; moving boxes and high scores are preferred.
    tracks_left_out : int
        Entities dropped beyond the 128 likeliest.
    refused : int
        Inputs of a running source that were unreadable, impossible, late, repeated or of an unknown sender.

    Examples
    --------
    >>> Delivery().too_late
    0
    """

    replayed: Count = 0
    repeated: Count = 0
    too_late: Count = 0
    reanchored: Count = 0
    held_back: Count = field(default=0, metadata=ADDED)
    boxes_left_out: Count = field(default=0, metadata=ADDED)
    tracks_left_out: Count = field(default=0, metadata=ADDED)
    refused: Count = field(default=0, metadata=ADDED)
