"""Sensors of a snapshot: health, last views, order of delivery, and the ego vehicle by its odometry."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from worldstate.ground.serialisation import ADDED, Count, Probability

Condition: TypeAlias = Literal["working", "impaired", "silent"]
MASKED = "masked by a vehicle in view"  # Reason of a Hearing, which the sensor itself is not to blame for


@dataclass(frozen=True, slots=True)
class SensorHealth:
    """How a sensor is, by what it said last.

    Parameters
    ----------
    sensor : str
        Source of measurements, or the sensor whose looks they carried.
    condition : {"working", "impaired", "silent"}
        Silent after a second without a measurement or a look; impaired where something is known to be wrong.
    stamp_ns : int
        Of its last measurement or look, ns.
    reason : str or None
        What is wrong; None where nothing is known to be.

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
    """How well a sensor that listens could hear: what it did not hear is evidence only that far.

    Parameters
    ----------
    sensor : str
        Source of measurements.
    share : float
        Probability that a hidden vehicle would have been noticed.
    since_ns : int
        Since when it has been what it is, ns.
    reason : str or None
        What keeps it from hearing; None where nothing does.
    kinds : mapping of str to float, or None
        Of each kind of road user, the share of approaches that would be noticed now: what the simulated exam
        of the model detected at the budget of its file, times `share`. None if the model's card has no such
        shares, its sequence model is not used, or nothing can be heard.

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
    """The last look of a sensor: where it searched, whether anything was there, and how often it errs.

    Parameters
    ----------
    sensor : str
        The one that looked.
    stamp_ns : int
        When, ns.
    found : bool
        Whether anything that moves was there.
    miss_rate, clutter_rate : float
        Probability to miss what is in view, and to find what is not.
    sector_rad : (float, float)
        From this azimuth to the left until that one.

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
        Of `base_link` in the map frame, m.
    yaw_rad : float
        Its x axis, counter-clockwise from that of the map.
    covariance : nested tuple of floats, shape (3, 3)
        Of (x, y, yaw).
    speed_mps, yaw_rate_rad_s : float
        Along its x axis and about its z axis, left positive.
    localised : bool
        Whether odometry has told the pose; else it is added up from where the first speed found the vehicle.

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
    """What has been wrong with the order of measurements since the filter began.

    Parameters
    ----------
    replayed : int
        Late ones, with a stamp before one already taken, that were put where they belong.
    repeated : int
        Delivered before, and dropped.
    too_late : int
        Later than the filter's lag, and dropped.
    reanchored : int
        Times that everything came too late for a second, by clocks that changed, and the belief began anew.
    held_back : int
        Ahead of all others by more than the filter's lag, and not confirmed by another one.
    boxes_left_out : int
        Boxes beyond the 64 of an image that count, of which moving ones and high scores go first.
    tracks_left_out : int
        Entities given up beyond the 128 likeliest.
    refused : int
        Inputs of a running source that were unreadable, impossible, late, repeated or of a stranger.

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
