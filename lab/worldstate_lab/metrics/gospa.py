"""GOSPA on bearing: localisation, missed and false targets in one metric, and apart."""

import math
from dataclasses import dataclass

from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.typing import IndexArray
from worldstate.operations.metrics.assignment import bearing_errors, gated_pairs

# A miss costs half of it. At the 20 degrees that bearing trackers are often scored at, silence (10) beats
# every estimate that is 10 degrees off or more; at 60 it costs as much as the gate of the track measures.
CUTOFF_RAD = math.radians(60.0)


@dataclass(frozen=True, slots=True, eq=False)
class Gospa:
    """GOSPA of one moment: total to the power p is the sum of its three parts.

    Examples
    --------
    >>> one = gospa_bearing([0.1, 2.0], [0.0], cutoff_rad=1.0)
    >>> round(one.total_rad, 3), one.missed, one.false, one.pairs.tolist()
    (0.6, 0.0, 0.5, [[0, 0]])
    """

    total_rad: float
    localisation: float  # Sum of the p-th powers of the errors of the pairs
    missed: float  # Half a cut-off to the power p for each truth without an estimate
    false: float  # And for each estimate without a truth
    pairs: IndexArray  # shape (k, 2): Rows of estimate and truth that belong together


def gospa_bearing(
    estimates_rad: ArrayLike, truths_rad: ArrayLike, cutoff_rad: float = CUTOFF_RAD, order: float = 1.0
) -> Gospa:
    r"""Return the GOSPA (alpha = 2) between bearings, shapes (n,) and (m,); angles wrap.

    .. math:: d = \Big[\min_\gamma \sum_{(i,j) \in \gamma} d(x_i, y_j)^p
              + \frac{c^p}{2} \big(n + m - 2 |\gamma|\big)\Big]^{1/p}

    Examples
    --------
    >>> round(math.degrees(gospa_bearing([math.radians(179)], [math.radians(-179)]).total_rad), 6)
    2.0
    """
    # A. S. Rahmathullah, A. F. Garcia-Fernandez and L. Svensson, "Generalized optimal sub-pattern assignment
    # metric", FUSION 2017. With alpha = 2 a pair at the cut-off costs as much as one miss and one false
    # target, so that the assignment may run over pairs only, each cut off there.
    estimates = finite_array("estimates_rad", estimates_rad, (None,))
    truths = finite_array("truths_rad", truths_rad, (None,))
    power = in_range("order", order, 1.0, math.inf)
    cut = in_range("cutoff_rad", cutoff_rad, 0.0, math.inf, open_low=True) ** power
    cost = bearing_errors(estimates, truths) ** power
    pairs = gated_pairs(cost, cost <= cut, cut)
    parts = (
        float(cost[pairs[:, 0], pairs[:, 1]].sum()),
        cut / 2.0 * (truths.size - len(pairs)),
        cut / 2.0 * (estimates.size - len(pairs)),
    )
    return Gospa(sum(parts) ** (1.0 / power), *parts, pairs)
