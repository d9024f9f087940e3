"""Detections: boxes, positions and messages, and the looks that contain them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.road_users import ClassShares
from worldstate.belief.kinematics.motion import FARTHEST_M, LEAST_STD
from worldstate.ground import FloatArray, replaced, wrap_angle
from worldstate.measurement import CameraLook, Position, PositionScan, Sector

from .site_geometry import SiteGeometry
from .street_model import StreetModel

# m/s: slower is parked, within the accuracy of a radar or a positioning receiver.
_PARKED_MPS = 0.5
# Boxes of two cameras within this many deviations belong to one object: each of the cameras would otherwise
# have missed one of two objects.
_SAME_SIGMA = 3.0
# All properties that distinguish boxes: a moving and a parked one at the same place are two objects.
BY_ALL = attrgetter("azimuth_rad", "label", "score", "std_rad", "width_rad", "moving")
_BY_PLACE = attrgetter("position_m", "covariance", "velocity_mps", "existence_probability", "classes")
_MEASURED = attrgetter("azimuth_rad", "std_rad", "width_rad", "moving")


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Measurements of objects at one instant, by one look or several; shape (n,) each."""

    azimuth_rad: FloatArray
    std_rad: FloatArray
    width_rad: FloatArray  # NaN if not measured
    moving: FloatArray  # 1 or 0, NaN if unknown
    existence: FloatArray  # P(a real object | it is not a known one)
    log_new: FloatArray  # Log density of new objects and clutter, nats: 1/rad for boxes, 1/m^2 for positions
    found: FloatArray  # P(detected | in view), 0 for messages, which need no line of sight
    classes: tuple[ClassShares, ...]
    positions: tuple[Position, ...] = ()  # Measured positions; empty for boxes
    in_sight: bool = True  # Whether detection needs line of sight; false for messages

    @classmethod
    def of(
        cls,
        rows: ArrayLike,
        classes: tuple[ClassShares, ...],
        positions: tuple[Position, ...] = (),
        in_sight: bool = True,
    ) -> "Detections":
        """Return detections from their rows of numbers, classes and positions."""
        columns = zip(_NUMBERS, np.array(rows, float).reshape(-1, len(_NUMBERS)).T, strict=True)
        return cls(**dict(columns), classes=classes, positions=positions, in_sight=in_sight)

    def line_of_sight(self, site: SiteGeometry) -> FloatArray:
        """Return P(no occluder is in front) for every detection; it is 1 for boxes."""
        if not self.positions:
            return np.ones(len(self))
        range_m = np.array([math.hypot(*one.position_m) for one in self.positions])
        return site.line_of_sight(self.azimuth_rad, self.std_rad, range_m)

    def seen_through(self, site: SiteGeometry) -> "Detections":
        """Return the detections under the condition that new objects are detected in line of sight only."""
        in_sight = self.line_of_sight(site)
        total = 1.0 - self.existence * (1.0 - in_sight)
        existence, log_new = self.existence * in_sight / total, self.log_new + np.log(total)
        return replaced(self, existence=existence, log_new=log_new)

    def __len__(self) -> int:
        return len(self.classes)


@dataclass(frozen=True, slots=True)
class Scan:
    """One look of one sensor: the searched sector, the miss rate and all detections."""

    source: str
    detections: Detections  # Sorted by content: the sensor's order has no effect
    sector: Sector | None  # Searched sector; None for messages, which search nothing
    miss_rate: float | None  # Miss rate of the look; None if the sensor was not queried
    weight: float  # Weight of a miss: looks in quick succession repeat one another's misses
    range_m: float = math.inf
    names_sector: bool = False  # Whether the sensor is one of several cameras with separate views


def miss_rates(scans: Sequence[Scan], azimuth_rad: FloatArray) -> FloatArray:
    """Return P(all looks miss an object in view there), NaN if no look has searched there."""
    rates = np.full(len(azimuth_rad), math.nan)
    for one in scans:
        if one.sector is not None and one.miss_rate is not None:
            from_centre_rad = np.abs(wrap_angle(azimuth_rad - one.sector.centre_rad))
            searched = from_centre_rad <= one.sector.half_width_rad
            rates[searched] = np.where(np.isnan(rates), 1.0, rates)[searched] * one.miss_rate
    return rates


def birth(births: float, clutter_rate: float, score: float, size: float) -> tuple[float, float]:
    r"""Return P(a detection of no known object is of a new one), and the log density of such detections.

    .. math:: r = \frac{\lambda_b}{\lambda_b + \lambda_c / L}, \qquad
              u = \frac{\lambda_b + \lambda_c / L}{A}, \qquad
              L = \frac{s}{1 - s}, \quad \lambda_c = -\log(1 - c)

    with the expected numbers of new objects :math:`\lambda_b` and false detections :math:`\lambda_c` per look
    in a view of size A, and the detector's score s as a likelihood ratio of object to clutter. Source: D.
    Musicki, R. Evans, "Joint integrated probabilistic data association: JIPDA", IEEE Trans. Aerosp. Electron.
    Syst. 40, 2004.

    Examples
    --------
    >>> [round(birth(0.05, 0.01, score, 1.2)[0], 2) for score in (0.05, 0.5, 0.9)]
    [0.21, 0.83, 0.98]
    """
    clutter = -math.log1p(-clutter_rate) * (1.0 / max(score, LEAST_STD) - 1.0)
    return births / (births + clutter), math.log((births + clutter) / size)


def camera_scan(seen: CameraLook, view: Sector, weight: float, street: StreetModel) -> Scan:
    """Return the scan of a view by a camera."""
    answer, miss_rate, clutter_rate = seen.look.answer, None, street.clutter
    if not isinstance(answer, Unqueried):
        # A look that misses everything carries no information.
        miss_rate = min(answer.miss_rate, 1.0 - street.doubt)
        clutter_rate = min(answer.clutter_rate, 1.0 - street.doubt) or street.clutter
    # Boxes without an answer have no stated miss rate.
    found, width_rad = 1.0 - (miss_rate or 0.0), 2.0 * max(view.half_width_rad, LEAST_STD)
    boxes = sorted(seen.sightings, key=BY_ALL)
    rows = [
        (*_MEASURED(one), *birth(street.births, clutter_rate, one.score, width_rad), found) for one in boxes
    ]
    detections = Detections.of(rows, tuple(((one.label, one.score),) for one in boxes))
    np.maximum(detections.std_rad, LEAST_STD, out=detections.std_rad)
    named = seen.look.sector_rad is not None
    return Scan("vision", detections, view, miss_rate, weight, names_sector=named)


def position_scan(scan: PositionScan, weight: float, street: StreetModel) -> Scan:
    """Return the scan of a radar or a lidar, or of messages."""
    searched, places = scan.searched, tuple(sorted(scan.positions, key=_BY_PLACE))
    if searched is None:
        # Messages cover half a disc.
        log_new = math.log(street.births / (0.5 * math.pi * FARTHEST_M**2))
        new = [(one.existence_probability, log_new) for one in places]
        return Scan(scan.source, _of_positions(places, new, None), None, None, weight)
    sector, found = searched.sector, searched.detection_probability
    area_m2 = max(sector.half_width_rad * searched.range_m**2, 1.0)
    new = [birth(street.births, searched.clutter_rate, one.existence_probability, area_m2) for one in places]
    return Scan(scan.source, _of_positions(places, new, found), sector, 1.0 - found, weight, searched.range_m)


def _of_positions(
    places: tuple[Position, ...], new: Sequence[tuple[float, float]], found: float | None
) -> Detections:
    rows = []
    for one, existence_and_density in zip(places, new, strict=True):
        (x, y), covariance, velocity = one.position_m, np.array(one.covariance)[:2, :2], one.velocity_mps
        range_m = max(math.hypot(x, y), 1.0)
        across = np.array([-y, x]) / range_m
        std_rad = math.sqrt(across @ covariance @ across) / range_m
        moving = math.nan if velocity is None else float(math.hypot(*velocity) > _PARKED_MPS)
        measured = math.atan2(y, x), std_rad, math.nan, moving
        rows.append((*measured, *existence_and_density, found or 0.0))
    return Detections.of(rows, tuple(one.classes for one in places), places, found is not None)


def fused(scans: Sequence[Scan]) -> tuple[Detections, FloatArray]:
    r"""Return the detections of an instant, with 1 for each look that made one, shape (detections, looks).

    Boxes of several cameras that belong to one object become one detection:

    .. math:: \sigma^{-2} = \sum_s \sigma_s^{-2}, \qquad z = \sigma^2 \sum_s \sigma_s^{-2} z_s
    """
    if len(scans) == 1:
        return scans[0].detections, np.ones((len(scans[0].detections), 1))
    boxes, looks = _in_order([one.detections for one in scans])
    groups = [[number] for number in range(len(boxes))]
    for a, b in _near_pairs(boxes):
        one, other = groups[a], groups[b]
        if {looks[i] for i in one}.isdisjoint(looks[i] for i in other):
            one += other
            groups = [one if group is other else group for group in groups]
    parts = list({id(group): group for group in groups}.values())
    by_look = np.zeros((len(parts), len(scans)))
    for i, group in enumerate(parts):
        by_look[i, [looks[number] for number in group]] = 1.0
    return _joined(boxes, parts), by_look


def _in_order(every: Sequence[Detections]) -> tuple[Detections, list[int]]:
    """Return all boxes of several looks, sorted by content, and the look of each box."""
    classes = [shares for one in every for shares in one.classes]
    looks = [number for number, one in enumerate(every) for _ in one.classes]
    rows = np.concatenate([_rows(one) for one in every])
    keys = [(*row[:2], shares, *row[2:]) for row, shares in zip(rows.tolist(), classes, strict=True)]
    order = sorted(range(len(keys)), key=keys.__getitem__)
    boxes = Detections.of(rows[order], tuple(classes[i] for i in order))
    return boxes, [looks[i] for i in order]


_NUMBERS = [one.name for one in fields(Detections) if one.type is FloatArray]


def _rows(boxes: Detections) -> FloatArray:
    return np.stack([getattr(boxes, name) for name in _NUMBERS], axis=1)


def _near_pairs(boxes: Detections) -> list[tuple[int, int]]:
    """Return the pairs of boxes that may belong to one object, the nearest first."""
    azimuth, variance, moving = boxes.azimuth_rad, np.square(boxes.std_rad), boxes.moving
    squares = wrap_angle(azimuth[:, None] - azimuth) ** 2 / (variance[:, None] + variance)
    near = np.triu((squares <= _SAME_SIGMA**2) & (moving[:, None] == moving), 1)
    a, b = np.nonzero(near)
    order = np.argsort(squares[a, b], kind="stable")
    return list(zip(a[order].tolist(), b[order].tolist(), strict=True))


def _joined(boxes: Detections, groups: Sequence[list[int]]) -> Detections:
    # Equal scores are ordered by label: an order of azimuths would change in a mirrored world.
    best = [max(group, key=lambda i: boxes.classes[i][0][::-1]) for group in groups]
    joined = Detections.of(_rows(boxes)[best], tuple(boxes.classes[i] for i in best))
    for at, group in enumerate(groups):
        if len(group) > 1:
            weights = 1.0 / np.square(boxes.std_rad[group])
            middle_rad = float(boxes.azimuth_rad[best[at]])
            offsets = wrap_angle(boxes.azimuth_rad[group] - middle_rad)
            joined.azimuth_rad[at] = wrap_angle(middle_rad + float(weights @ offsets / weights.sum()))
            joined.std_rad[at] = 1.0 / math.sqrt(weights.sum())
            joined.width_rad[at] = boxes.width_rad[group].max()
            joined.log_new[at] = boxes.log_new[group].max()
            joined.existence[at] = 1.0 - (1.0 - boxes.existence[group]).prod()
            joined.found[at] = 1.0 - (1.0 - boxes.found[group]).prod()
    return joined
