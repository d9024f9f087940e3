"""Sensors of a snapshot: how each is, and what each searched last."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from worldstate.ground.serialisation import Probability

Condition: TypeAlias = Literal["working", "impaired", "silent"]


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
class SearchedView:
    """The last look of a sensor: where it searched, whether anything was there, and how often it errs.

    Parameters
    ----------
    sensor : str
        Who looked.
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
