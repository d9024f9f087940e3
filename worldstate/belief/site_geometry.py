"""Geometry of the site: where hidden vehicles are, where they come into view, and what the camera sees."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.belief.kinematics.cartesian import NumbersT
from worldstate.belief.kinematics.motion import LEAST_STD, MotionBelief
from worldstate.ground import FloatArray, replaced, wrap_angle
from worldstate.measurement import CameraLook, Look, Sector

from .settings import FilterSettings
from .street_model import StreetModel


def in_view(street: StreetModel) -> MotionBelief:
    """Return the prior of a vehicle in view, of which only the azimuth is measured."""
    spread = (1.0, 1.0, 0.5, street.range_spread)
    return MotionBelief.around((0.0, 0.0, 0.0, math.log(street.range_m)), spread)


IN_VIEW = in_view(StreetModel())
# A vehicle in a crossing street stands ahead, not abeam: at the default corner, up to 92 degrees.
_WIDEST_RAD = math.radians(60.0)


USUAL_EDGE_STD = math.radians(5.0)  # Of the corner of a usual junction


@dataclass(frozen=True, slots=True)
class SideGeometry:
    """One approach side.

    Examples
    --------
    >>> round(SideGeometry("left", 0.56, 0.96, 0.35).distance_rad(-0.2), 2)
    0.76
    """

    label: str  # Direction label of the signature model
    edge_azimuth_rad: float  # Edge of the occluder
    azimuth_rad: float  # Where vehicles are while it hides them
    std_rad: float
    edge_std_rad: float = USUAL_EDGE_STD
    pace_hz: float = 0.5  # Speed over the distance of the crossing lane
    hides: bool = True
    yaw_rad: float = 0.0  # Of the ego in the map, where the edge is known there
    corner_m: float | None = None  # Distance of the corner; None if it is not known
    certainty: float = 1.0  # P(the occluder stands there)
    wall_m: float = 0.0  # How far beside the ego its wall runs: what is nearer stands in front; 0 if unknown
    street: StreetModel = field(default_factory=StreetModel)

    @property
    def outwards(self) -> float:
        """The way from the edge to what it hides: 1 to the left, -1 to the right."""
        return math.copysign(1.0, wrap_angle(self.azimuth_rad - self.edge_azimuth_rad))

    @property
    def bias_std_rad(self) -> float:
        """Error of the azimuth of hidden sound that averaging does not remove: half of where vehicles are."""
        return 0.5 * self.std_rad

    def distance_rad(self, azimuth_rad: NumbersT, width_rad: NumbersT | float = 0.0) -> NumbersT:
        """Return the angle, >= 0, between the occluder's edge and the end of a box that leads past it."""
        return abs(wrap_angle(azimuth_rad - 0.5 * self.outwards * width_rad - self.edge_azimuth_rad))

    def prior(self) -> MotionBelief:
        """Return the prior motion of a vehicle hidden here."""
        street = self.street
        mean = self.azimuth_rad, 0.0, -street.closing_hz, math.log(street.range_m)
        # Give or take as much again.
        spread = self.std_rad, street.closing_hz, street.closing_hz, street.range_spread
        return MotionBelief.around(mean, spread)


# No slots: what follows from the sides is computed once, and read in every step.
@dataclass(frozen=True)
class SiteGeometry:
    """All sides, the field of view and the settings, constant from step to step."""

    sides: tuple[SideGeometry, ...]  # Approach sides, in the order of the signature's directions
    view_half_angle_rad: float  # Half the field of view of the co-evidence channel, centred on the x axis
    settings: FilterSettings  # Windows, births and deaths
    ego_speed_mps: float = 0.0  # Along the x axis
    ego_yaw_rate_rad_s: float = 0.0

    @cached_property
    def street(self) -> StreetModel:
        """The numbers of the belief."""
        return self.settings.street

    def nearest_side(self, azimuth_rad: float) -> int:
        """Return the index of the side whose edge is nearest to an azimuth."""
        return min(range(len(self.sides)), key=lambda k: self.sides[k].distance_rad(azimuth_rad))

    def hiding_side(self, position_m: tuple[float, float]) -> int | None:
        """Return the side whose occluder hides what stands at a place, if one does."""
        x, y = position_m
        (chances,) = self.behind(np.array([math.atan2(y, x)]), LEAST_STD, np.array([math.hypot(x, y)]))
        side = int(chances.argmax())
        return side if chances[side] >= 0.5 else None

    def behind(self, azimuth_rad: FloatArray, std_rad: FloatArray | float, range_m: FloatArray) -> FloatArray:
        """Return the chances that what stands at some places is behind the occluders, shape (n, K)."""
        edge_rad, _, outwards = self._edges[..., 0]
        yaw_rad, wall_m = np.array([(one.yaw_rad, one.wall_m) for one in self.sides]).T
        beside_m = range_m[:, None] * np.abs(np.sin(azimuth_rad[:, None] + yaw_rad))
        past = outwards * wrap_angle(azimuth_rad[:, None] - edge_rad)
        chances = normal_shares(past / std_rad) - normal_shares((past - _WIDEST_RAD) / std_rad)
        return np.asarray(chances * [one.hides for one in self.sides] * (beside_m > wall_m))

    @cached_property
    def _edges(self) -> FloatArray:
        edges = np.array([(one.edge_azimuth_rad, one.edge_std_rad, one.outwards) for one in self.sides])
        return edges.T[:, :, None]

    @cached_property
    def _sight(self) -> Sector:
        """What all occluders leave free, by their own sides: those of the x axis turn with the ego."""
        ways = (-1.0, 1.0)
        return Sector.in_sight(
            *([k.edge_azimuth_rad for k in self.sides if k.outwards == way] for way in ways)
        )

    @cached_property
    def expected(self) -> MotionBelief:
        """What is expected of vehicles that are hidden on each side, and last of those in view."""
        return MotionBelief.stacked([*(side.prior() for side in self.sides), in_view(self.street)])

    def past_edge(self, azimuth_rad: FloatArray, std_rad: FloatArray, way: FloatArray) -> FloatArray:
        """Return the chances that azimuths lie past the edges on their way, shape (n, K).

        The way is 1 to the left, -1 to the right, 0 of none.
        """
        edge_rad, edge_std, outwards = self._edges
        past = way * wrap_angle(azimuth_rad - edge_rad) / np.hypot(std_rad, edge_std)
        hides = np.array([[one.hides] for one in self.sides])
        return normal_shares(np.where((way * outwards > 0.0) & hides, past, -np.inf).T)

    def line_of_sight(self, azimuth_rad: FloatArray, std_rad: FloatArray, range_m: FloatArray) -> FloatArray:
        """Return P(no occluder stands before what is at some places)."""
        hidden = self.behind(azimuth_rad, np.hypot(std_rad[:, None], self._edges[1].T), range_m)
        return np.asarray(1.0 - np.maximum.reduce(hidden * [one.certainty for one in self.sides], 1))

    def view(self, look: Look) -> Sector:
        """Return where a look has searched."""
        told = look.sector_rad
        return Sector(0.0, self.view_half_angle_rad) if told is None else Sector.between(*told)

    def in_sight(self, seen: CameraLook) -> Look:
        r"""Return a look as one at all that is in line of sight: of where it did not search, it missed all.

        .. math:: \beta \leftarrow s\, \beta + (1 - s)

        with the share s of the line of sight that it searched. One that names no sector has searched it all.
        """
        look, answer = seen.look, seen.look.answer
        if look.sector_rad is None or isinstance(answer, Unqueried):
            return look
        sight = self._sight
        both = sight.overlap(self.view(look))
        # Rounding may take the overlap above the whole.
        share = 0.0 if both is None else min(both.half_width_rad / sight.half_width_rad, 1.0)
        found = any(one.moving and sight.touches(one.azimuth_rad, one.width_rad) for one in seen.sightings)
        miss = share * answer.miss_rate + (1.0 - share)
        if not found:
            return replaced(look, answer=Absent(miss, answer.clutter_rate))
        # With a clutter rate of zero a box would rule out everything else.
        return replaced(look, answer=Present(miss, answer.clutter_rate or self.street.clutter))


def normal_shares(deviations: FloatArray) -> FloatArray:
    """Return the shares of a normal distribution below so many deviations."""
    # Of a few numbers each: importing scipy.special takes a tenth of a second of every start.
    shares = [normal_share(one) for one in deviations.ravel().tolist()]
    return np.array(shares, float).reshape(deviations.shape)


def normal_share(deviations: float) -> float:
    """Return the share of a normal distribution below so many deviations."""
    return 0.5 * math.erfc(-deviations / math.sqrt(2.0))
