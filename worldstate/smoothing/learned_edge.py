r"""The edge of an occluder, learned from where vehicles came into view, and learned anew where it moved.

With :math:`p(x)` the predictive density of the next pass's edge and :math:`u` a uniform one over the edges
that a camera sees, a pass belongs to the edge with the probability r and adds to the surprise S,

.. math:: r = \frac{(1 - \epsilon)\, p}{(1 - \epsilon)\, p + \epsilon u}, \qquad
    S \leftarrow \max\left(0,\; S + \log \frac{u}{(1 - \epsilon)\, p + \epsilon u}\right)

(Page, "Continuous inspection schemes", 1954). Beyond a threshold the edge is what the passes since S was zero
say.
"""

import math
from dataclasses import dataclass, field, replace

from worldstate.ground.checks import in_range
from worldstate.state.context import blind_corner


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
        return Moments(
            self.weight + weight, self.total + weight * value, self.squares + weight * value * value
        )

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
        mean, mean_std, spread = self.posterior(prior)
        freedom, scale = prior.freedom + self.weight, math.hypot(spread, mean_std)
        away = (value - mean) / scale
        return (
            math.lgamma(0.5 * (freedom + 1.0))
            - math.lgamma(0.5 * freedom)
            - 0.5 * math.log(freedom * math.pi)
            - math.log(scale)
            - 0.5 * (freedom + 1.0) * math.log1p(away * away / freedom)
        )


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
    """Azimuth of an edge, radians away from the axis, and how much the last passes contradict it.

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
