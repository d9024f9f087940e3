"""Context: rates, occluders, priors and the field of view, which are given before any measurement."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar

from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.checks import ABOVE_ZERO, all_of, check_fields, pair
from worldstate.ground.serialisation import ADDED, Layout, Probability

_LEAST_STD_RAD, _FASTEST, _FARTHEST_M = 1e-4, 100.0, 1e6  # _FASTEST is in Hz or m/s

_AZIMUTHS_RAD, _STDS_RAD = (-math.pi, math.pi), (ABOVE_ZERO, math.pi)
_OCCLUDER = {
    "id": str,
    "direction": str,
    "edge_azimuth_rad": _AZIMUTHS_RAD,
    "hidden_azimuth_rad": _AZIMUTHS_RAD,
    "hidden_std_rad": _STDS_RAD,
    "edge_std_rad": _STDS_RAD,
    "pace_hz": (ABOVE_ZERO, _FASTEST),
    "assumed": bool,
    "hides": bool,
    "crossing_m": (0.0, 2.0 * _FARTHEST_M, None),
}
_PASSED_M = 0.5  # A corner less than this far ahead is abeam: vehicles that pass it are in view


@dataclass(frozen=True, slots=True)
class Rates:
    """Transition rates of the explanations without measurements, 1/s.

    Their equilibrium is the prior of a context without priors. The defaults describe a side street with a few
    vehicles per minute: a hidden vehicle is audible for some 3 s before it comes into view, and is in view
    for about as long.

    Parameters
    ----------
    arrival_hz : float
        none -> hidden, per direction.
    emergence_hz : float
        hidden -> visible.
    departure_hz : float
        hidden -> none: it turns away or becomes silent.
    reocclusion_hz : float
        visible -> hidden, all directions together.
    visible_arrival_hz : float
        none -> visible: traffic that was never hidden.
    visible_departure_hz : float
        visible -> none.

    Raises
    ------
    InvalidArgumentError
        If a rate is negative or not finite.

    Examples
    --------
    >>> Rates(arrival_hz=0.01).emergence_hz
    0.3
    """

    arrival_hz: float = 0.05  # Three vehicles a minute from each side
    emergence_hz: float = 0.3  # Audible for some 3 s before it comes into view
    departure_hz: float = 0.1  # One in four hidden vehicles never comes into view
    reocclusion_hz: float = arrival_hz  # One in seven vehicles in view goes behind a corner again
    visible_arrival_hz: float = arrival_hz  # Along the ego vehicle's own street, as from a side
    visible_departure_hz: float = emergence_hz  # In view for 3 s

    def __post_init__(self) -> None:
        check_fields(self, **{one.name: (0.0, _FASTEST) for one in fields(self)})

    def priors(self, sides: int) -> "Priors":
        r"""Return the equilibrium for a number of sides: the three probabilities p with p Q = 0.

        Examples
        --------
        >>> usual = Rates().priors(2)
        >>> round(usual.hidden, 3), round(usual.visible, 3), round(usual.none, 3)
        (0.176, 0.235, 0.588)
        """
        arrival_hz = sides * self.arrival_hz
        # The weight of a state is the sum over the paths into it from both other states.
        leaves_hidden = self.emergence_hz + self.departure_hz
        leaves_visible = self.reocclusion_hz + self.visible_departure_hz
        hidden = arrival_hz * leaves_visible + self.visible_arrival_hz * self.reocclusion_hz
        visible = arrival_hz * self.emergence_hz + self.visible_arrival_hz * leaves_hidden
        none = leaves_hidden * leaves_visible - self.emergence_hz * self.reocclusion_hz
        total = hidden + visible + none
        if total <= 0.0:  # All rates are zero: no state is ever left
            return Priors(0.0, 0.0, 1.0)
        return Priors(hidden / total, visible / total, none / total)


@dataclass(frozen=True, slots=True)
class Priors:
    """Probabilities of the three explanations.

    Parameters
    ----------
    hidden, visible, none : float
        In [0, 1]; they sum to one.

    Raises
    ------
    InvalidArgumentError
        If they do not sum to one.

    Examples
    --------
    >>> Priors(0.2, 0.3, 0.5).hidden
    0.2
    """

    hidden: Probability
    visible: Probability
    none: Probability

    def __post_init__(self) -> None:
        values = (self.hidden, self.visible, self.none)
        if min(values) < 0 or not math.isclose(sum(values), 1.0, rel_tol=1e-5):
            raise InvalidArgumentError(f"priors: expected three probabilities that sum to one, got {values}")


@dataclass(frozen=True, slots=True)
class Occluder:
    """A static object that hides one approach side.

    Parameters
    ----------
    id : str
        Name, unique in the context.
    direction : str
        Label of the approach side that it hides, as in the signature model.
    edge_azimuth_rad : float
        Azimuth of its edge, at which hidden vehicles come into view; left positive.
    hidden_azimuth_rad, hidden_std_rad : float
        Mean azimuth of hidden vehicles behind it, and their standard deviation.
    edge_std_rad : float
        Standard deviation of the edge.
    pace_hz : float
        Speed of vehicles behind it divided by the distance of their lane, 1/s: the rate at which the tangent
        of their azimuth decreases.
    assumed : bool
        Whether it is assumed, as the corner of a typical junction, because the place is unknown.
    hides : bool
        Whether it hides vehicles. It is false for an open road, and after the ego vehicle has passed it: then
        sound from this side comes from a vehicle in view or outside the camera's view, never from a hidden
        one.
    corner_m : (float, float) or None
        Its corner in the map frame, metres: the edge then moves with the ego vehicle. Without it the edge
        keeps its azimuth.
    crossing_m : float or None
        Place at which the lane behind it crosses the x axis of the map, metres.

    Examples
    --------
    >>> Occluder("corner", "left", 0.56, 0.96, 0.35).direction
    'left'
    """

    id: str
    direction: str
    edge_azimuth_rad: float
    hidden_azimuth_rad: float
    hidden_std_rad: float
    # The corners of OVAD's junctions are at 32 +- 5 degrees from the place at which the ego stops.
    edge_std_rad: float = math.radians(5.0)
    pace_hz: float = 0.5  # Real vehicles of OVAD pass T0 at 4 to 5 m/s, some 9 m ahead
    assumed: bool = False
    hides: bool = field(default=True, metadata=ADDED)
    corner_m: tuple[float, float] | None = field(default=None, metadata=ADDED)
    crossing_m: float | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        check_fields(self, **_OCCLUDER)
        if self.corner_m is not None:
            object.__setattr__(self, "corner_m", pair("corner_m", self.corner_m, _FARTHEST_M))
            # Otherwise an ego vehicle would cross the lane before it has passed the corner.
            if self.crossing_m is not None and self.crossing_m <= max(self.corner_m[0], 0.0):
                expected = f"the lane beyond the corner, {self.corner_m[0]} m ahead"
                raise InvalidArgumentError(f"crossing_m: expected {expected}, got {self.crossing_m}")


def blind_corner(direction: str, side: int) -> Occluder:
    """Return the building corner of a blind junction, edge at 32 deg, vehicles behind it at 55 +- 20 deg.

    Parameters
    ----------
    direction : str
        Label of the approach side.
    side : {1, -1}
        1 for left, -1 for right.

    Returns
    -------
    Occluder
        The corner on that side.

    Examples
    --------
    >>> round(blind_corner("right", -1).edge_azimuth_rad, 2)
    -0.56
    """
    # The nominal corner of OVAD's junctions; three quarters of the peaks in its real hidden windows are at 42
    # to 63 deg.
    edge, hidden, std = math.radians(32.0), math.radians(55.0), math.radians(20.0)
    return Occluder(f"corner_{direction}", direction, side * edge, side * hidden, std, assumed=True)


def corner_at(
    direction: str,
    corner_m: tuple[float, float],
    crossing_m: float,
    *,
    speed_mps: float = 4.5,
    corner_std_m: float = 0.5,
) -> Occluder:
    r"""Return the occluder with its corner at a given place.

    A vehicle in the crossing lane, ``crossing_m`` ahead, is in line of sight past the corner as soon as

    .. math:: \tan\theta \le \tan a = y_c / x_c

    Parameters
    ----------
    direction : str
        Label of the approach side.
    corner_m : tuple of float
        The corner, x ahead and y to the left of the ego, metres (REP-103).
    crossing_m : float
        Distance ahead of the lane in which vehicles come from this side, metres; beyond the corner.
    speed_mps : float
        Usual speed of the vehicles as they come into view.
    corner_std_m : float
        Standard deviation of either coordinate of the corner.

    Returns
    -------
    Occluder
        Edge and pace as seen from the ego; hidden vehicles are 2 +- 1 s behind the edge.

    Raises
    ------
    InvalidArgumentError
        If the corner is not ahead, on the x axis, or not nearer than the lane.

    Examples
    --------
    >>> corner = corner_at("left", (5.0, 3.0), 9.0)
    >>> round(math.degrees(corner.edge_azimuth_rad)), corner.pace_hz
    (31, 0.5)
    """
    x_m, y_m = corner_m
    if not (0.0 < x_m < crossing_m < math.inf) or y_m == 0.0 or not math.isfinite(y_m):
        raise InvalidArgumentError(
            f"corner_m: expected it ahead, beside the x axis, nearer than {crossing_m} m, got {corner_m}"
        )
    in_range("speed_mps", speed_mps, 0.0, _FASTEST, open_low=True)
    in_range("corner_std_m", corner_std_m, 0.0, _FARTHEST_M, open_low=True)
    pace_hz = speed_mps / crossing_m
    hidden_rad, hidden_std = hidden_behind(x_m, y_m, pace_hz)
    return Occluder(
        f"corner_{direction}",
        direction,
        math.atan2(y_m, x_m),
        hidden_rad,
        hidden_std,
        # Across the line of sight, where an isotropic error has the same deviation.
        edge_std_rad=min(corner_std_m / math.hypot(x_m, y_m), math.pi),
        pace_hz=pace_hz,
        corner_m=(x_m, y_m),
        crossing_m=crossing_m,
    )


def open_side(direction: str, side: int) -> Occluder:
    """Return an approach side without an occluder: an open road; `side` is 1 left, -1 right.

    Examples
    --------
    >>> open_side("left", 1).hides
    False
    """
    return replace(blind_corner(direction, side), id=f"open_{direction}", assumed=False, hides=False)


def seen_from(
    occluder: Occluder, pose: tuple[float, float, float], position_std_m: float, yaw_std_rad: float
) -> Occluder:
    r"""Return an occluder as seen from the ego vehicle at a pose (x, y, yaw) in the map frame, m and rad.

    .. math:: a' = \operatorname{atan2}(y_c - y, x_c - x) - \psi, \qquad
              \sigma_{a'}^2 = \sigma_a^2 + \sigma_{xy}^2 / r^2 + \sigma_\psi^2

    An occluder without `corner_m` is returned unchanged. An occluder that the ego vehicle has passed hides
    nothing.

    Examples
    --------
    >>> corner = corner_at("left", (5.0, 3.0), 9.0)
    >>> nearer = seen_from(corner, (2.0, 0.0, 0.1), 0.1, 0.01)
    >>> round(math.degrees(nearer.edge_azimuth_rad), 1), seen_from(corner, (5.0, 0.0, 0.0), 0.1, 0.01).hides
    (39.3, False)
    """
    if occluder.corner_m is None:
        return occluder
    (corner_x, corner_y), (x, y, yaw) = occluder.corner_m, pose
    ahead_m, beside_m = corner_x - x, corner_y - y
    if ahead_m < _PASSED_M or beside_m * corner_y <= 0.0:
        return replace(occluder, hides=False)
    before_m, now_m = math.hypot(corner_x, corner_y), math.hypot(ahead_m, beside_m)
    std_m = math.hypot(occluder.edge_std_rad * before_m, position_std_m)
    nearer = 1.0 if occluder.crossing_m is None else occluder.crossing_m / (occluder.crossing_m - x)
    pace_hz = occluder.pace_hz * nearer
    hidden_rad, hidden_std = hidden_behind(ahead_m, beside_m, pace_hz)
    return replace(
        occluder,
        edge_azimuth_rad=math.remainder(math.atan2(beside_m, ahead_m) - yaw, math.tau),
        hidden_azimuth_rad=math.remainder(hidden_rad - yaw, math.tau),
        hidden_std_rad=hidden_std,
        edge_std_rad=min(math.hypot(std_m / now_m, yaw_std_rad), math.pi),
        pace_hz=min(pace_hz, _FASTEST),
    )


def hidden_behind(ahead_m: float, beside_m: float, pace_hz: float) -> tuple[float, float]:
    """Return azimuth and standard deviation of a hidden vehicle that comes into view in 2 +- 1 s."""
    slope = abs(beside_m) / ahead_m
    near, middle, far = (math.atan(slope + pace_hz * time_s) for time_s in (1.0, 2.0, 3.0))
    # For a very distant or very near corner the three azimuths are equal.
    return math.copysign(middle, beside_m), max(0.5 * (far - near), _LEAST_STD_RAD)


@dataclass(frozen=True, slots=True)
class Context:
    """The place and the ego vehicle.

    Parameters
    ----------
    rates : Rates
        Transition rates of the explanations.
    occluders : tuple of Occluder
        One per approach side, in the order of the signature model's directions.
    priors : Priors or None
        Priors of the explanations. In a context that a user gives: the usual values at this place (None for
        the equilibrium of the rates); in a snapshot: predicted to its time. The log-odds of a sequence model
        are shifted to given priors, by -0.5 to +2 nats; without priors they keep the share of hazards in
        training.
    hidden_by_side : mapping of str to float, or None
        P(a vehicle comes into view from a side within 8 s) by direction, from an external model; it replaces
        the prior of that side. If it changes between steps, the odds of the belief are multiplied by the
        ratio of its odds, with and without a sequence model.
    ego_speed_mps, degradation : float or None
        Ego speed, which means straight motion without odometry, and degradation level d of the co-evidence
        channel in [0, 1].
    site : str or None
        Name of the place.
    view_half_angle_rad : float
        Half of the horizontal field of view of the co-evidence channel, which is centred on the x axis.

    Raises
    ------
    InvalidArgumentError
        If there is no occluder, if two have the same id or direction, or if a number is out of range.

    Examples
    --------
    >>> Context().directions
    ('left', 'right')
    """

    LAYOUT: ClassVar = Layout(order="site ego_speed_mps degradation priors")

    rates: Rates = Rates()
    # Without a map a blind junction is assumed, because the library is made for such junctions.
    occluders: tuple[Occluder, ...] = (blind_corner("left", 1), blind_corner("right", -1))
    priors: Priors | None = None
    ego_speed_mps: float | None = None
    degradation: Probability | None = None
    site: str | None = None
    view_half_angle_rad: float = 0.6  # Of OVAD's camera
    hidden_by_side: Mapping[str, Probability] | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        object.__setattr__(self, "occluders", all_of("occluders", self.occluders, Occluder))
        for names in (self.directions, tuple([occluder.id for occluder in self.occluders])):
            if not names or len(set(names)) != len(names):
                raise InvalidArgumentError(f"occluders: expected different ids and directions, got {names}")
        check_fields(self, rates=Rates, priors=Priors | None, site=str | None, hidden_by_side=Mapping | None)
        check_fields(self, view_half_angle_rad=(0.0, math.pi), degradation=(0.0, 1.0, None))
        check_fields(self, ego_speed_mps=(-_FASTEST, _FASTEST, None))
        for side, chance in (self.hidden_by_side or {}).items():
            in_range(f"hidden_by_side[{side!r:.40}]", chance, 0.0, 1.0)
            if side not in self.directions:
                raise InvalidArgumentError(f"hidden_by_side: expected {self.directions}, got {side!r:.40}")

    @property
    def directions(self) -> tuple[str, ...]:
        """Labels of the approach sides."""
        return tuple([occluder.direction for occluder in self.occluders])
