"""A street learned from the vehicles that passed: edges, pace, arrivals, sound of its arms.

Only sufficient statistics are kept: a pass is added, and time forgotten, without the passes before it.
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
    """What is believed of a quantity at a place where it was never observed.

    Examples
    --------
    >>> NormalPrior(mean=0.56, mean_std=0.1, spread=0.02).passes
    0.04
    """

    mean: float
    mean_std: float  # Of the place's own mean
    spread: float  # Of single observations about it
    freedom: float = 2.0  # Observations that the spread counts as

    @property
    def passes(self) -> float:
        """How many observations the mean counts as."""
        return round((self.spread / self.mean_std) ** 2, 12)


@dataclass(frozen=True, slots=True)
class Moments:
    """Sufficient statistics of a normal quantity; sums fade, so weights are no whole numbers.

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
        """Return them with one observation more."""
        total, squares = self.total + weight * value, self.squares + weight * value * value
        return Moments(self.weight + weight, total, squares)

    def faded(self, factor: float) -> "Moments":
        """Return them with everything weighed less."""
        return Moments(factor * self.weight, factor * self.total, factor * self.squares)

    def posterior(self, prior: NormalPrior) -> tuple[float, float, float]:
        r"""Return mean, its standard deviation, and the spread of single observations.

        .. math:: m = \frac{k_0 m_0 + \sum x}{k_0 + n}, \quad
            s^2 = \frac{\nu_0 s_0^2 + \sum (x - \bar x)^2}{\nu_0 + n}, \quad \sigma_m = s / \sqrt{k_0 + n}
        """
        counted = prior.passes + self.weight
        mean = (prior.passes * prior.mean + self.total) / counted
        # Of a single observation it is zero, but for rounding.
        within = max(self.squares - self.total**2 / self.weight, 0.0) if self.weight > 0.0 else 0.0
        spread = math.sqrt((prior.freedom * prior.spread**2 + within) / (prior.freedom + self.weight))
        return mean, spread / math.sqrt(counted), spread

    def log_predictive(self, value: float, prior: NormalPrior) -> float:
        """Return the log density of the next observation, a Student t, nats."""
        # scipy.stats takes a third of a second to import, and a context is read without it.
        from scipy.stats import t as student_t

        mean, mean_std, spread = self.posterior(prior)
        freedom, scale = prior.freedom + self.weight, math.hypot(spread, mean_std)
        return float(student_t.logpdf(value, freedom, mean, scale))


# Of passes on simulated streams one in twenty begins elsewhere: a bicycle whose first boxes were missed, two
# vehicles taken for one.
_STRAY = 0.05
# A single pass adds -log(.05) = 3 nats at most, so that at least two in a row have to be strange.
_THRESHOLD = 5.0
# First boxes at one simulated corner lie within .2 degrees of one another; real ones, of bodies of other
# heights and with other misses, farther apart, which the passes tell.
_SPREAD_RAD = math.radians(0.5)
_KNOWN = 1.5  # Passes that make an edge known
_USUAL = blind_corner("left", 1)
# An edge that a camera of 69 degrees sees stands between 5 and 35 degrees from the axis.
_UNIFORM = -math.log(math.radians(30.0))
EDGE_PRIOR = NormalPrior(_USUAL.edge_azimuth_rad, _USUAL.edge_std_rad, _SPREAD_RAD, freedom=8.0)


@dataclass(frozen=True, slots=True)
class LearnedEdge:
    r"""Azimuth of an edge, radians away from the axis, and how much the last passes contradict it.

    With :math:`p(x)` the predictive density of the next pass's edge and :math:`u` a uniform one over the
    edges that a camera sees, a pass belongs to the edge with the probability r and adds to the surprise S,

    .. math:: r = \frac{(1 - \epsilon)\, p}{(1 - \epsilon)\, p + \epsilon u}, \qquad
        S \leftarrow \max\left(0,\; S + \log \frac{u}{(1 - \epsilon)\, p + \epsilon u}\right)

    (Page, "Continuous inspection schemes", 1954). Beyond a threshold the edge is what the passes since S was
    zero say.

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
        """Where it stands."""
        return self.moments.posterior(EDGE_PRIOR)[0]

    @property
    def std_rad(self) -> float:
        """Standard deviation of where the next vehicle comes into view."""
        _, mean_std, spread = self.moments.posterior(EDGE_PRIOR)
        return math.hypot(mean_std, spread)

    def with_pass(self, azimuth_rad: float) -> "LearnedEdge":
        """Return it after one more vehicle came into view, at an azimuth away from the axis."""
        expected = math.log1p(-_STRAY) + self.moments.log_predictive(azimuth_rad, EDGE_PRIOR)
        either = math.log(math.exp(expected) + _STRAY * math.exp(_UNIFORM))
        # A first pass far from the usual corner contradicts nothing that was seen here.
        met = self.moments.weight > 0.0
        surprise = max(0.0, self.surprise + _UNIFORM - either) if met else 0.0
        since = self.since.plus(azimuth_rad) if surprise > 0.0 else Moments()
        if surprise > _THRESHOLD:
            # Against a single pass two others are no change of the place: that one was the stray.
            return LearnedEdge(since, changes=self.changes + (self.moments.weight >= _KNOWN))
        moments = self.moments.plus(azimuth_rad, math.exp(expected - either))
        return LearnedEdge(moments, surprise, since, self.changes)

    def faded(self, factor: float) -> "LearnedEdge":
        """Return it with everything weighed less; surprise is not a matter of age."""
        return replace(self, moments=self.moments.faded(factor))


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
        edge, log_pace = self.edge.faded(factor), self.log_pace.faded(factor)
        return LearnedArm(self.direction, edge, log_pace, factor * self.arrivals, factor * self.exposure_s)


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
