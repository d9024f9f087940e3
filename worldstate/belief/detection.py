"""Detections: what a box, a position or a message measures of one object, and the look that has found it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.road_users import ClassShares
from worldstate.belief.kinematics.motion import LEAST_STD
from worldstate.ground import FloatArray, wrap_angle
from worldstate.ground.serialisation import Probability
from worldstate.measurement import CameraLook, Sector, Sighting
from worldstate.measurement.position import Position, PositionScan

from .site_geometry import CLUTTER_RATE

# A look said to miss everything would carry no information; its miss rate is capped here.
_MOST_MISSES = 0.99
# Of an object before its first box is counted: indifferent, that one decides.
_FIRST_EXISTENCE = 0.5
# P(a new detection was not heard before): most vehicles from a side street are.
UNHEARD = 0.05
# m^2: messages tell of half a disc of 100 m.
_RADIO_AREA_M2 = 0.5 * math.pi * 100.0**2
# m/s: slower is parked, as far as a radar or a positioning receiver can tell.
_PARKED_MPS = 0.5
# Boxes of two cameras nearer to each other than so many deviations are of one object: both cameras would
# have missed one of two.
_SAME_SIGMA = 3.0
# All that tells two boxes apart: one that moves and one parked at the same place are two.
BY_ALL = attrgetter("azimuth_rad", "label", "score", "std_rad", "width_rad", "moving")
_BY_PLACE = attrgetter("position_m", "covariance", "velocity_mps", "existence_probability", "classes")
_BY_AZIMUTH = attrgetter("azimuth_rad", "std_rad", "classes", "width_rad", "moving")


@dataclass(frozen=True, slots=True)
class Detection:
    """What is measured of one object at one instant, by one look or by several."""

    azimuth_rad: float
    std_rad: float
    moving: bool | None  # None where nothing tells
    classes: ClassShares
    existence: Probability  # Of an object of which nothing else is known
    log_new: float  # Density of objects that were not known before, nats: 1/rad of boxes, 1/m^2 of positions
    found: Probability | None  # P(detected | in view); None of messages, which need no line of sight
    width_rad: float | None = None  # None where it is not measured
    position: Position | None = None


@dataclass(frozen=True, slots=True)
class Scan:
    """One look of one sensor: where it has searched and how well, and all that it has found."""

    source: str
    detections: tuple[Detection, ...]  # Ordered by what they are: the sensor's order carries no meaning
    sector: Sector | None  # None of messages, which search nothing
    miss_rate: float | None  # None where it was not asked
    clutter_rate: float
    weight: float  # Of a miss: looks that follow closely repeat each other's
    range_m: float = math.inf
    names_sector: bool = False  # Whether it is one of several cameras, each with a view of its own

    def searches(self, azimuth_rad: float) -> bool:
        """Tell whether the look says anything of what is there."""
        return self.sector is not None and self.miss_rate is not None and self.sector.touches(azimuth_rad)


def camera_scan(seen: CameraLook, view: Sector, weight: float) -> Scan:
    """Return the scan that a camera has made of a view."""
    answer, miss_rate, clutter_rate = seen.look.answer, None, CLUTTER_RATE
    if not isinstance(answer, Unqueried):
        miss_rate, clutter_rate = min(answer.miss_rate, _MOST_MISSES), answer.clutter_rate or CLUTTER_RATE
    # Boxes that come without an answer were found without a stated miss rate.
    found, log_new = 1.0 - (miss_rate or 0.0), math.log(UNHEARD / (2.0 * view.half_width_rad))
    boxes = (_of_box(one, log_new, found) for one in sorted(seen.sightings, key=BY_ALL))
    named = seen.look.sector_rad is not None
    return Scan("vision", tuple(boxes), view, miss_rate, clutter_rate, weight, names_sector=named)


def _of_box(box: Sighting, log_new: float, found: float) -> Detection:
    classes = ((box.label, box.score),)
    measured = box.azimuth_rad, max(box.std_rad, LEAST_STD), box.moving, classes
    return Detection(*measured, _FIRST_EXISTENCE, log_new, found, box.width_rad)


def position_scan(scan: PositionScan, weight: float) -> Scan:
    """Return the scan of a radar or a lidar, or what messages tell."""
    searched, places = scan.searched, sorted(scan.positions, key=_BY_PLACE)
    if searched is None:
        log_new = math.log(UNHEARD / _RADIO_AREA_M2)
        told = tuple(_of_position(one, log_new, None) for one in places)
        return Scan(scan.source, told, None, None, CLUTTER_RATE, weight)
    sector, found = searched.sector, searched.detection_probability
    log_new = math.log(UNHEARD / max(sector.half_width_rad * searched.range_m**2, 1.0))
    seen = tuple(_of_position(one, log_new, found) for one in places)
    rates = 1.0 - found, searched.clutter_rate
    return Scan(scan.source, seen, sector, *rates, weight, searched.range_m)


def _of_position(position: Position, log_new: float, found: float | None) -> Detection:
    (x, y), covariance = position.position_m, np.array(position.covariance)[:2, :2]
    range_m = max(math.hypot(x, y), 1.0)
    across = np.array([-y, x]) / range_m
    return Detection(
        math.atan2(y, x),
        math.sqrt(across @ covariance @ across) / range_m,
        None if position.velocity_mps is None else math.hypot(*position.velocity_mps) > _PARKED_MPS,
        position.classes,
        position.existence_probability,
        log_new,
        found,
        position=position,
    )


def fused(scans: Sequence[Scan]) -> tuple[list[Detection], FloatArray]:
    r"""Return the detections of an instant, and 1 for the looks that each is by, shape (detections, looks).

    Boxes of several cameras that are of one object are one detection, whatever the cameras are called:

    .. math:: \sigma^{-2} = \sum_s \sigma_s^{-2}, \qquad z = \sigma^2 \sum_s \sigma_s^{-2} z_s
    """
    if len(scans) == 1:
        return list(scans[0].detections), np.ones((len(scans[0].detections), 1))
    every = [(one, number) for number, scan in enumerate(scans) for one in scan.detections]
    every.sort(key=lambda pair: _BY_AZIMUTH(pair[0]))
    groups = [[pair] for pair in every]
    for a, b in _near_pairs([one for one, _ in every]):
        one, other = groups[a], groups[b]
        if {number for _, number in one}.isdisjoint(number for _, number in other):
            one += other
            groups = [one if group is other else group for group in groups]
    parts = list({id(group): group for group in groups}.values())
    by_look = np.zeros((len(parts), len(scans)))
    for i, group in enumerate(parts):
        by_look[i, [number for _, number in group]] = 1.0
    return [_joined([one for one, _ in group]) for group in parts], by_look


def _near_pairs(detections: Sequence[Detection]) -> list[tuple[int, int]]:
    """Return the pairs that may be of one object, the nearest first."""
    azimuth = np.array([one.azimuth_rad for one in detections])
    variance = np.square([one.std_rad for one in detections])
    moving = np.array([one.moving for one in detections], bool)
    squares = wrap_angle(azimuth[:, None] - azimuth) ** 2 / (variance[:, None] + variance)
    near = np.triu((squares <= _SAME_SIGMA**2) & (moving[:, None] == moving), 1)
    a, b = np.nonzero(near)
    order = np.argsort(squares[a, b], kind="stable")
    return list(zip(a[order].tolist(), b[order].tolist(), strict=True))


def _joined(same: Sequence[Detection]) -> Detection:
    if len(same) == 1:
        return same[0]
    best = max(same, key=lambda one: one.classes[0][1])
    weights = 1.0 / np.square([one.std_rad for one in same])
    offsets = wrap_angle(np.array([one.azimuth_rad for one in same]) - best.azimuth_rad)
    azimuth_rad = wrap_angle(best.azimuth_rad + float(weights @ offsets / weights.sum()))
    return replace(
        best,
        azimuth_rad=azimuth_rad,
        std_rad=1.0 / math.sqrt(weights.sum()),
        log_new=max(one.log_new for one in same),
        found=1.0 - math.prod(1.0 - (one.found or 0.0) for one in same),
        width_rad=max(one.width_rad or 0.0 for one in same),
    )
