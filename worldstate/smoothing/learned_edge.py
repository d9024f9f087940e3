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

from worldstate.state.context import blind_corner

from .running_moments import Moments, NormalPrior

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
