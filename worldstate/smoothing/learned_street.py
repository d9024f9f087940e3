"""Model of a street, learned from vehicles that passed: edges, pace, arrivals and sound of its arms.

Only sufficient statistics are stored, so an update with a pass or with time needs no earlier passes.
"""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

from worldstate.abduction.sequence.street_sides import PassSound, SidePatterns
from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.serialisation import ADDED, Layout
from worldstate.state.context import Context, Occluder, Rates, blind_corner, hidden_behind


@dataclass(frozen=True, slots=True)
class NormalPrior:
    """Prior of a quantity at a place without observations.

    Examples
    --------
    >>> NormalPrior(mean=0.56, mean_std=0.1, spread=0.02).passes
    0.04
    """

    mean: float
    mean_std: float  # Deviation of the mean of this place
    spread: float  # Deviation of single observations from that mean
    freedom: float = 2.0  # Number of observations that the prior of the spread is worth

    @property
    def passes(self) -> float:
        """Number of observations that the mean is worth."""
        return round((self.spread / self.mean_std) ** 2, 12)


@dataclass(frozen=True, slots=True)
class Moments:
    """Sufficient statistics of a normal quantity; sums fade, so weights are not whole numbers.

    Examples
    --------
    >>> seen = Moments().plus(0.50).plus(0.54)
    >>> [round(value, 3) for value in seen.posterior(NormalPrior(0.56, 0.1, 0.02))]
    [0.521, 0.014, 0.02]
    """

    weight: float = 0.0
    total: float = 0.0
    squares: float = 0.0

    def __post_init__(self) -> None:
        in_range("weight", self.weight, 0.0, 1e12)

    def plus(self, value: float, weight: float = 1.0) -> "Moments":
        """Return the statistics after one more observation."""
        total, squares = self.total + weight * value, self.squares + weight * value * value
        return Moments(self.weight + weight, total, squares)

    def faded(self, factor: float) -> "Moments":
        """Return the statistics with a lower weight."""
        return Moments(factor * self.weight, factor * self.total, factor * self.squares)

    def posterior(self, prior: NormalPrior) -> tuple[float, float, float]:
        r"""Return mean, its standard deviation, and the spread of single observations.

        .. math:: m = \frac{k_0 m_0 + \sum x}{k_0 + n}, \quad
            s^2 = \frac{\nu_0 s_0^2 + \sum (x - \bar x)^2}{\nu_0 + n}, \quad \sigma_m = s / \sqrt{k_0 + n}
        """
        counted = prior.passes + self.weight
        mean = (prior.passes * prior.mean + self.total) / counted
        # Zero for a single observation, except for rounding.
        within = max(self.squares - self.total**2 / self.weight, 0.0) if self.weight > 0.0 else 0.0
        spread = math.sqrt((prior.freedom * prior.spread**2 + within) / (prior.freedom + self.weight))
        return mean, spread / math.sqrt(counted), spread

    def log_predictive(self, value: float, prior: NormalPrior) -> float:
        """Return the log density of the next observation, a Student t, nats."""
        # Imported here: scipy.stats takes a third of a second, and reading a context does not need it.
        from scipy.stats import t as student_t

        mean, mean_std, spread = self.posterior(prior)
        freedom, scale = prior.freedom + self.weight, math.hypot(spread, mean_std)
        return float(student_t.logpdf(value, freedom, mean, scale))


# On simulated streams one pass in twenty begins elsewhere: a bicycle whose first boxes were missed, or two
# vehicles tracked as one.
_STRAY = 0.05
# A single pass adds at most -log(0.05) = 3 nats, so at least two unusual passes in a row are needed.
_THRESHOLD = 5.0
# First boxes at one simulated corner are within 0.2 degrees of one another. With real bodies of different
# heights, and other misses, they are farther apart; this spread is learned from the passes.
_SPREAD_RAD = math.radians(0.5)
_KNOWN = 1.5  # Number of passes that make an edge known
_USUAL = blind_corner("left", 1)
# An edge in the view of a 69-degree camera is between 5 and 35 degrees from the axis.
_UNIFORM = -math.log(math.radians(30.0))
EDGE_PRIOR = NormalPrior(_USUAL.edge_azimuth_rad, _USUAL.edge_std_rad, _SPREAD_RAD, freedom=8.0)


@dataclass(frozen=True, slots=True)
class LearnedEdge:
    r"""Azimuth of an edge, radians from the axis, and how strongly the last passes contradict it.

    With the predictive density :math:`p(x)` of the next pass's edge and a uniform density :math:`u` over the
    edges in a camera's view, a pass belongs to the edge with the probability r and adds to the surprise S,

    .. math:: r = \frac{(1 - \epsilon)\, p}{(1 - \epsilon)\, p + \epsilon u}, \qquad
        S \leftarrow \max\left(0,\; S + \log \frac{u}{(1 - \epsilon)\, p + \epsilon u}\right)

    (Page, "Continuous inspection schemes", 1954). Beyond a threshold the edge is estimated again from the
    passes since S was zero.

    Examples
    --------
    >>> edge = LearnedEdge()
    >>> for azimuth_rad in (0.50, 0.51, 0.50, 0.40, 0.41):
    ...     edge = edge.with_pass(azimuth_rad)
    >>> round(edge.mean_rad, 2), edge.changes
    (0.41, 1)
    """

    moments: Moments = field(default_factory=Moments)
    surprise: float = 0.0
    since: Moments = field(default_factory=Moments)  # Passes since the surprise was zero
    changes: int = 0

    @property
    def mean_rad(self) -> float:
        """Mean azimuth of the edge."""
        return self.moments.posterior(EDGE_PRIOR)[0]

    @property
    def std_rad(self) -> float:
        """Standard deviation of the azimuth at which the next vehicle comes into view."""
        _, mean_std, spread = self.moments.posterior(EDGE_PRIOR)
        return math.hypot(mean_std, spread)

    def with_pass(self, azimuth_rad: float) -> "LearnedEdge":
        """Return the edge after one more vehicle came into view at an azimuth from the axis."""
        expected = math.log1p(-_STRAY) + self.moments.log_predictive(azimuth_rad, EDGE_PRIOR)
        either = math.log(math.exp(expected) + _STRAY * math.exp(_UNIFORM))
        # A first pass far from the usual corner contradicts no earlier pass.
        met = self.moments.weight > 0.0
        surprise = max(0.0, self.surprise + _UNIFORM - either) if met else 0.0
        since = self.since.plus(azimuth_rad) if surprise > 0.0 else Moments()
        if surprise > _THRESHOLD:
            # If two passes contradict a single earlier one, the earlier one was the outlier: the place has
            # not changed.
            return LearnedEdge(since, changes=self.changes + (self.moments.weight >= _KNOWN))
        moments = self.moments.plus(azimuth_rad, math.exp(expected - either))
        return LearnedEdge(moments, surprise, since, self.changes)

    def faded(self, factor: float) -> "LearnedEdge":
        """Return the edge with a lower weight of its passes; the surprise does not depend on age."""
        return replace(self, moments=self.moments.faded(factor))


Arm = Literal["left", "right"]
ARMS: tuple[Arm, Arm] = ("left", "right")
# A building stays for years, traffic changes with the season: after a month a pass has a third of its weight.
DAY_S = 86400.0
FORGETTING_S = 30.0 * DAY_S
# Logarithm of the pace. Drivers at a usual corner have 0.5 per second. Simulated junctions have medians of
# 0.4 to 0.7, and their drivers differ by a factor of 1.35.
PACE_PRIOR = NormalPrior(math.log(0.5), 0.22, 0.3)
# An arm without an observed edge keeps the corner of a usual junction.
_LEAST_WEIGHT = 0.5


@dataclass(frozen=True, slots=True)
class StreetPass:
    """One vehicle that came into view from an arm.

    Examples
    --------
    >>> StreetPass("right", edge_rad=-0.52, pace_hz=0.4).arm
    'right'
    """

    arm: Arm
    edge_rad: float | None  # Azimuth of the edge that it passed; None if the image ends before it
    pace_hz: float | None  # Rate at which the tangent of its azimuth fell there
    sound: PassSound | None = None  # Sound before it came into view


@dataclass(frozen=True, slots=True)
class LearnedArm:
    """One arm: its edge, the pace of its drivers, and its arrivals in the observed time."""

    direction: Arm
    edge: LearnedEdge = field(default_factory=LearnedEdge)
    log_pace: Moments = field(default_factory=Moments)
    arrivals: float = 0.0
    exposure_s: float = 0.0

    @property
    def rate_hz(self) -> float:
        """Expected arrivals per second; a Gamma prior around the usual rate is worth one arrival."""
        # One minute of observation outweighs this prior, because the rates of streets differ from it by a
        # factor of three in either direction.
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
        """Return the arm after one more vehicle came from it."""
        edge, log_pace = self.edge, self.log_pace
        if one.edge_rad is not None:
            edge = edge.with_pass(abs(one.edge_rad))
        if one.pace_hz is not None:
            log_pace = log_pace.plus(math.log(one.pace_hz))
        return LearnedArm(self.direction, edge, log_pace, self.arrivals + 1.0, self.exposure_s)

    def faded(self, factor: float) -> "LearnedArm":
        """Return the arm with a lower weight of its passes."""
        edge, log_pace = self.edge.faded(factor), self.log_pace.faded(factor)
        return LearnedArm(self.direction, edge, log_pace, factor * self.arrivals, factor * self.exposure_s)


@dataclass(frozen=True, slots=True)
class LearnedStreet:
    """Model of one place from the vehicles that passed it.

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
    # Sound patterns of both arms
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
    """Return the street after it was observed for a time."""
    in_range("time_s", time_s, 0.0, 1e9)
    left, right = (replace(arm, exposure_s=arm.exposure_s + time_s) for arm in street.arms)
    return replace(street, arms=(left, right))


def forgotten(street: LearnedStreet, time_s: float) -> LearnedStreet:
    """Return the street some time later: weights decrease, and means stay the same."""
    factor = math.exp(-in_range("time_s", time_s, 0.0, 1e12) / FORGETTING_S)
    left, right = (arm.faded(factor) for arm in street.arms)
    return replace(street, arms=(left, right), patterns=street.patterns.faded(factor))


def context_of(street: LearnedStreet) -> Context:
    """Return a street as the context of a filter, with its edges and paces; the rest is as in `Context()`.

    Arrivals are left out, because the filter learns the present traffic itself. As priors they would move the
    alarm away from the onsets per hour for which it was set.

    Examples
    --------
    >>> street = with_pass(LearnedStreet(site="Elm Street"), StreetPass("left", 0.45, 0.6))
    >>> [(round(one.edge_azimuth_rad, 2), one.assumed) for one in context_of(street).occluders]
    [(0.45, False), (-0.56, True)]
    """
    usual = Context()
    return replace(usual, occluders=tuple(map(_occluder, street.arms, usual.occluders)), site=street.site)


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
