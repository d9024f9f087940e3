"""GOSPA of tracks in bearing, and the error of the most prominent bearings."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from worldstate.adapters.camera.box_linking import gated_pairs
from worldstate.ground.checks import finite_array
from worldstate.ground.values import wrap_angle
from worldstate.operations.recordings.hop_table import HopTable

# The paper's coverage of gated bearings.
PUBLISHED_COVERAGE = 0.16
# Maximum number of thresholds that are tried, evenly spaced in coverage.
_MOST_POINTS = 200


def gated_median_deg(checks: HopTable) -> float:
    r"""Return the median error of the most prominent 16 %; NaN if no bearing has a reference.

    .. math:: \mathrm{median}\{|\epsilon_i| : \rho_i \ge \rho^*\}, \qquad
              \rho^* = \max\{\rho_0 : \#\{i : \rho_i \ge \rho_0\} \ge 0.16\, n\}

    References
    ----------
    The results of the paper (gating by the peak-to-median ratio); C. K. Chow, "On optimum recognition error
    and reject tradeoff", IEEE Trans. IT 16, 1970.

    Examples
    --------
    >>> checks = {"prominence": np.array([1.1, 1.2, 2.0, 3.0]), "error_rad": np.radians([40, 30, 2, np.nan])}
    >>> round(gated_median_deg(HopTable(checks)), 9)
    2.0
    """
    seen = np.isfinite(checks.error_rad)
    if not seen.any():
        return np.nan
    order = np.argsort(checks.prominence[seen], kind="stable")
    ratios = checks.prominence[seen][order]
    errors = np.abs(wrap_angle(checks.error_rad[seen]))[order]
    # Equal prominences are kept or dropped together.
    starts = np.flatnonzero(np.diff(ratios, prepend=-np.inf))
    if len(starts) > _MOST_POINTS:
        starts = starts[np.linspace(0, len(starts) - 1, _MOST_POINTS).round().astype(np.intp)]
    enough = starts[1.0 - starts / len(ratios) >= PUBLISHED_COVERAGE - 1e-12]
    return float(np.degrees(np.median(errors[enough[-1] :])))


# A miss costs half of it. At 20 degrees, a common choice for bearing trackers, no output (10) scores better
# than any estimate with an error of 10 degrees or more.
CUTOFF_RAD = math.radians(60.0)


class Gospa(NamedTuple):
    """GOSPA at one instant: the total is the sum of its three parts."""

    localisation: float  # Sum of the errors of the pairs
    missed: float  # Half of the cut-off for each truth without an estimate
    false: float  # The same for each estimate without a truth

    @property
    def total_rad(self) -> float:
        """Sum of the parts."""
        return sum(self)


def gospa_bearing(estimates_rad: ArrayLike, truths_rad: ArrayLike, cutoff_rad: float = CUTOFF_RAD) -> Gospa:
    r"""Return the GOSPA (p = 1, alpha = 2) between bearings, shapes (n,) and (m,); angles wrap.

    .. math:: d = \min_\gamma \sum_{(i,j) \in \gamma} d(x_i, y_j) + \frac{c}{2} \big(n + m - 2 |\gamma|\big)

    Examples
    --------
    >>> round(math.degrees(gospa_bearing([math.radians(179)], [math.radians(-179)]).total_rad), 6)
    2.0
    """
    # A. S. Rahmathullah, A. F. Garcia-Fernandez and L. Svensson, "Generalized optimal sub-pattern assignment
    # metric", FUSION 2017. With alpha = 2 a pair at the cut-off costs as much as one miss and one false
    # target, so the assignment may use pairs only, each limited to the cut-off.
    estimates = finite_array("estimates_rad", estimates_rad, (None,))
    truths = finite_array("truths_rad", truths_rad, (None,))
    cost = np.abs(wrap_angle(estimates[:, None] - truths))
    pairs = gated_pairs(cost, cost <= cutoff_rad, cutoff_rad)
    missed, false = (cutoff_rad / 2.0 * (size - len(pairs)) for size in (truths.size, estimates.size))
    return Gospa(float(cost[pairs[:, 0], pairs[:, 1]].sum()), missed, false)
