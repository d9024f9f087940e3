"""Geometry of the site: azimuths of hidden vehicles, edges of occluders, and the camera's view."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.belief.kinematics.cartesian import NumbersT
from worldstate.belief.kinematics.motion import LEAST_STD, MotionBelief
from worldstate.ground import FloatArray, replaced, wrap_angle
from worldstate.measurement import CameraLook, Look, Sector

from .street_model import FilterSettings, StreetModel


def in_view(street: StreetModel) -> MotionBelief:
    """Return the prior motion of visible vehicles; only their azimuth is measured."""
    spread = (1.0, 1.0, 0.5, street.range_spread)
    return MotionBelief.around((0.0, 0.0, 0.0, math.log(street.range_m)), spread)


IN_VIEW = in_view(StreetModel())
# Hidden vehicles are at most this far past the edge: a vehicle in a crossing street is ahead, not abeam. At
# the default corner the limit is at 92 degrees.
_WIDEST_RAD = math.radians(60.0)


USUAL_EDGE_STD = math.radians(5.0)  # Deviation of the corner of a usual junction


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
    azimuth_rad: float  # Expected azimuth of a hidden vehicle
    std_rad: float
    edge_std_rad: float = USUAL_EDGE_STD
    pace_hz: float = 0.5  # Speed divided by the distance of the crossing lane
    hides: bool = True
    yaw_rad: float = 0.0  # Yaw of the ego vehicle in the map, if the edge is known there
    corner_m: float | None = None  # Distance of the corner; None if unknown
    certainty: float = 1.0  # P(the occluder is there)
    wall_m: float = 0.0  # Lateral distance of its wall; nearer objects are in front of it; 0 if unknown
    street: StreetModel = field(default_factory=StreetModel)

    @property
    def outwards(self) -> float:
        """Direction from the edge to the hidden area: 1 to the left, -1 to the right."""
        return math.copysign(1.0, wrap_angle(self.azimuth_rad - self.edge_azimuth_rad))

    @property
    def bias_std_rad(self) -> float:
        """Azimuth error of hidden sound that averaging does not remove: half the spread of vehicles."""
        return 0.5 * self.std_rad

    def distance_rad(self, azimuth_rad: NumbersT, width_rad: NumbersT | float = 0.0) -> NumbersT:
        """Return the angle, >= 0, between the occluder's edge and the leading end of a box."""
        return abs(wrap_angle(azimuth_rad - 0.5 * self.outwards * width_rad - self.edge_azimuth_rad))

    def prior(self) -> MotionBelief:
        """Return the prior motion of a vehicle hidden here."""
        street = self.street
        mean = self.azimuth_rad, 0.0, -street.closing_hz, math.log(street.range_m)
        # The deviation is as large as the mean.
        spread = self.std_rad, street.closing_hz, street.closing_hz, street.range_spread
        return MotionBelief.around(mean, spread)


# No slots: derived values are computed once and used in every step.
@dataclass(frozen=True)
class SiteGeometry:
    """All sides, the field of view and the settings, constant from step to step."""

    sides: tuple[SideGeometry, ...]  # Approach sides, in the order of the signature's directions
    view_half_angle_rad: float  # Half the field of view of the co-evidence channel, centred on the x axis
    settings: FilterSettings  # Settings of the belief
    ego_speed_mps: float = 0.0  # Speed along the x axis
    ego_yaw_rate_rad_s: float = 0.0

    @cached_property
    def street(self) -> StreetModel:
        """The parameters of the belief."""
        return self.settings.street

    def nearest_side(self, azimuth_rad: float) -> int:
        """Return the index of the side whose edge is nearest to an azimuth."""
        return min(range(len(self.sides)), key=lambda k: self.sides[k].distance_rad(azimuth_rad))

    def hiding_side(self, position_m: tuple[float, float]) -> int | None:
        """Return the side whose occluder hides a position, or None."""
        x, y = position_m
        (chances,) = self.behind(np.array([math.atan2(y, x)]), LEAST_STD, np.array([math.hypot(x, y)]))
        side = int(chances.argmax())
        return side if chances[side] >= 0.5 else None

    def behind(self, azimuth_rad: FloatArray, std_rad: FloatArray | float, range_m: FloatArray) -> FloatArray:
        """Return P(an object is behind an occluder) for some positions and all occluders, shape (n, K)."""
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
        """The sector that no occluder covers; each occluder has its own direction, as the x axis turns."""
        ways = (-1.0, 1.0)
        return Sector.in_sight(
            *([k.edge_azimuth_rad for k in self.sides if k.outwards == way] for way in ways)
        )

    @cached_property
    def expected(self) -> MotionBelief:
        """Priors of the vehicles hidden on each side, and last of those in view."""
        return MotionBelief.stacked([*(side.prior() for side in self.sides), in_view(self.street)])

    def past_edge(self, azimuth_rad: FloatArray, std_rad: FloatArray, way: FloatArray) -> FloatArray:
        """Return P(an azimuth is past the edge) for azimuths that move in the direction `way`, shape (n, K).

        `way` is 1 to the left, -1 to the right, 0 without a direction.
        """
        edge_rad, edge_std, outwards = self._edges
        past = way * wrap_angle(azimuth_rad - edge_rad) / np.hypot(std_rad, edge_std)
        hides = np.array([[one.hides] for one in self.sides])
        return normal_shares(np.where((way * outwards > 0.0) & hides, past, -np.inf).T)

    def line_of_sight(self, azimuth_rad: FloatArray, std_rad: FloatArray, range_m: FloatArray) -> FloatArray:
        """Return P(no occluder is in front) for some positions."""
        hidden = self.behind(azimuth_rad, np.hypot(std_rad[:, None], self._edges[1].T), range_m)
        return np.asarray(1.0 - np.maximum.reduce(hidden * [one.certainty for one in self.sides], 1))

    def view(self, look: Look) -> Sector:
        """Return the sector that a look has searched."""
        told = look.sector_rad
        return Sector(0.0, self.view_half_angle_rad) if told is None else Sector.between(*told)

    def in_sight(self, seen: CameraLook) -> Look:
        r"""Return a look as a look at the whole line of sight; outside its sector it missed everything.

        .. math:: \beta \leftarrow s\, \beta + (1 - s)

        with the searched share s of the line of sight. A look without a sector has searched all of it.
        """
        look, answer = seen.look, seen.look.answer
        if look.sector_rad is None or isinstance(answer, Unqueried):
            return look
        sight = self._sight
        both = sight.overlap(self.view(look))
        # Rounding can make the overlap larger than the whole.
        share = 0.0 if both is None else min(both.half_width_rad / sight.half_width_rad, 1.0)
        found = any(one.moving and sight.touches(one.azimuth_rad, one.width_rad) for one in seen.sightings)
        miss = share * answer.miss_rate + (1.0 - share)
        if not found:
            return replaced(look, answer=Absent(miss, answer.clutter_rate))
        # With a clutter rate of zero, a box would exclude everything else.
        return replaced(look, answer=Present(miss, answer.clutter_rate or self.street.clutter))


def normal_shares(deviations: FloatArray) -> FloatArray:
    """Return the shares of a normal distribution below the given deviations."""
    # The arrays are small, and importing scipy.special adds 0.1 s to every start.
    shares = [normal_share(one) for one in deviations.ravel().tolist()]
    return np.array(shares, float).reshape(deviations.shape)


def normal_share(deviations: float) -> float:
    """Return the share of a normal distribution below the given deviations."""
    return 0.5 * math.erfc(-deviations / math.sqrt(2.0))
