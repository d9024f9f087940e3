"""A street learned from the vehicles that passed: edges, pace, arrivals, sound of its arms.

Only sufficient statistics are kept: a pass is added, and time forgotten, without the passes before it.
"""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

from worldstate.abduction.sequence.street_sides import PassSound, SidePatterns
from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.serialisation import ADDED, Layout
from worldstate.state.context import Context, Occluder, Rates, hidden_behind

from .learned_edge import LearnedEdge, Moments, NormalPrior

Arm = Literal["left", "right"]
ARMS: tuple[Arm, Arm] = ("left", "right")
# A building stands for years, traffic changes with the season: after a month a pass counts a third.
DAY_S = 86400.0
FORGETTING_S = 30.0 * DAY_S
# Of the logarithm: drivers at a usual corner have .5 per second; simulated junctions have .4 to .7 in the
# median, and their drivers differ by a factor of 1.35.
PACE_PRIOR = NormalPrior(math.log(0.5), 0.22, 0.3)
# An arm of which no edge was seen keeps the corner of a usual junction.
_LEAST_WEIGHT = 0.5


@dataclass(frozen=True, slots=True)
class StreetPass:
    """One vehicle that came into view out of an arm.

    Examples
    --------
    >>> StreetPass("right", edge_rad=-0.52, pace_hz=0.4).arm
    'right'
    """

    arm: Arm
    edge_rad: float | None  # Azimuth of the edge that it came out of; None where the image ends before it
    pace_hz: float | None  # How fast the tangent of its azimuth fell there
    sound: PassSound | None = None  # Before it came into view


@dataclass(frozen=True, slots=True)
class LearnedArm:
    """One arm: its edge, the pace of its drivers, and how many vehicles came in which time."""

    direction: Arm
    edge: LearnedEdge = field(default_factory=LearnedEdge)
    log_pace: Moments = field(default_factory=Moments)
    arrivals: float = 0.0
    exposure_s: float = 0.0

    @property
    def rate_hz(self) -> float:
        """Expected arrivals a second: a Gamma prior about the usual rate, which counts as one arrival."""
        # A minute of watching outweighs it: streets differ by a factor of three either way.
        usual_hz = Rates().arrival_hz
        return usual_hz * (1.0 + self.arrivals) / (1.0 + usual_hz * self.exposure_s)

    @property
    def pace_hz(self) -> float:
        """Pace of the median driver."""
        return math.exp(self.log_pace.posterior(PACE_PRIOR)[0])

    @property
    def pace_spread(self) -> float:
        """Standard deviation of the logarithm of the next driver's pace."""
        _, mean_std, spread = self.log_pace.posterior(PACE_PRIOR)
        return math.hypot(mean_std, spread)

    def with_pass(self, one: StreetPass) -> "LearnedArm":
        """Return it after one more vehicle came out of it."""
        edge, log_pace = self.edge, self.log_pace
        if one.edge_rad is not None:
            edge = edge.with_pass(abs(one.edge_rad))
        if one.pace_hz is not None:
            log_pace = log_pace.plus(math.log(one.pace_hz))
        return LearnedArm(self.direction, edge, log_pace, self.arrivals + 1.0, self.exposure_s)

    def faded(self, factor: float) -> "LearnedArm":
        """Return it with everything weighed less."""
        return LearnedArm(
            self.direction,
            self.edge.faded(factor),
            self.log_pace.faded(factor),
            factor * self.arrivals,
            factor * self.exposure_s,
        )


@dataclass(frozen=True, slots=True)
class LearnedStreet:
    """What is known of one place from the vehicles that passed it.

    Examples
    --------
    >>> street = LearnedStreet(site="Elm Street")
    >>> for azimuth_rad in (0.50, 0.51, 0.50):
    ...     street = with_pass(street, StreetPass("left", azimuth_rad, 0.4))
    >>> left = street.arms[0]
    >>> round(left.edge.mean_rad, 2), round(left.pace_hz, 2)
    (0.5, 0.44)
    """

    LAYOUT: ClassVar = Layout("worldstate.LearnedStreet", "1.3.0")

    site: str | None = None
    arms: tuple[LearnedArm, LearnedArm] = (LearnedArm("left"), LearnedArm("right"))
    # What either arm sounds like
    patterns: SidePatterns = field(default_factory=SidePatterns, metadata=ADDED)

    def __post_init__(self) -> None:
        directions = tuple(arm.direction for arm in self.arms)
        if directions != ARMS:
            raise InvalidArgumentError(f"arms: expected the arms {ARMS}, got {directions}")


def with_pass(street: LearnedStreet, one: StreetPass) -> LearnedStreet:
    """Return the street after one more vehicle came into view."""
    left, right = (arm.with_pass(one) if arm.direction == one.arm else arm for arm in street.arms)
    heard = street.patterns if one.sound is None else street.patterns.with_pass(one.arm, one.sound)
    return replace(street, arms=(left, right), patterns=heard)


def watched(street: LearnedStreet, time_s: float) -> LearnedStreet:
    """Return the street after it was watched for a time."""
    in_range("time_s", time_s, 0.0, 1e9)
    left, right = (replace(arm, exposure_s=arm.exposure_s + time_s) for arm in street.arms)
    return replace(street, arms=(left, right))


def forgotten(street: LearnedStreet, time_s: float) -> LearnedStreet:
    """Return the street some time later: everything counts less, and means stay where they are."""
    factor = math.exp(-in_range("time_s", time_s, 0.0, 1e12) / FORGETTING_S)
    left, right = (arm.faded(factor) for arm in street.arms)
    return replace(street, arms=(left, right), patterns=street.patterns.faded(factor))


def context_of(street: LearnedStreet) -> Context:
    """Return a street as the context of a filter: its edges and paces; the rest is as in `Context()`.

    Arrivals are left to the filter, which learns the traffic of the hour: given as priors, they move its
    alarm away from the onsets an hour that it was set for.

    Examples
    --------
    >>> street = with_pass(LearnedStreet(site="Elm Street"), StreetPass("left", 0.45, 0.6))
    >>> [(round(one.edge_azimuth_rad, 2), one.assumed) for one in context_of(street).occluders]
    [(0.45, False), (-0.56, True)]
    """
    usual = Context()
    occluders = tuple(map(_occluder, street.arms, usual.occluders))
    return replace(usual, occluders=occluders, site=street.site)


def _occluder(arm: LearnedArm, usual: Occluder) -> Occluder:
    sign = math.copysign(1.0, usual.edge_azimuth_rad)
    known = arm.edge.moments.weight >= _LEAST_WEIGHT
    edge_rad = arm.edge.mean_rad if known else abs(usual.edge_azimuth_rad)
    hidden_rad, hidden_std = hidden_behind(1.0, sign * math.tan(edge_rad), arm.pace_hz)
    return replace(
        usual,
        edge_azimuth_rad=sign * edge_rad,
        hidden_azimuth_rad=hidden_rad,
        hidden_std_rad=hidden_std,
        edge_std_rad=arm.edge.std_rad if known else usual.edge_std_rad,
        pace_hz=arm.pace_hz,
        assumed=not known,
    )
