"""GOSPA of tracks in bearing, and prominence gating.

Prominence gating gives the accuracy of bearings with a camera reference as a function of the share kept.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.adapters.camera.box_linking import gated_pairs
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IndexArray
from worldstate.ground.values import NotUsable, wrap_angle
from worldstate.operations.recordings.hop_table import HopTable

# The paper's points: 3.4 degrees for all bearings, 2.4 degrees at 16 % coverage.
PUBLISHED = ((1.0, 3.4), (0.16, 2.4))
PUBLISHED_COVERAGE = PUBLISHED[1][0]
# Maximum number of thresholds of a curve, evenly spaced in coverage.
_MOST_POINTS = 200


@dataclass(frozen=True, slots=True, eq=False)
class GatingCurve:
    r"""Coverage and median error of bearings as functions of a threshold on their prominence.

    .. math:: c(\rho_0) = \frac{\#\{i : \rho_i \ge \rho_0\}}{n}, \qquad
              e(\rho_0) = \mathrm{median}\{|\epsilon_i| : \rho_i \ge \rho_0\}

    Parameters
    ----------
    threshold : ndarray, shape (T,)
        Smallest prominence kept, ascending.
    coverage : ndarray, shape (T,)
        Share of the bearings kept, in (0, 1].
    median_error_rad : ndarray, shape (T,)
        Median absolute error of the bearings kept, radians.

    Examples
    --------
    >>> curve = gating_curve([1.1, 1.2, 2.0, 3.0], [0.4, 0.3, 0.02, 0.01])
    >>> curve.coverage, curve.median_error_rad
    (array([1.  , 0.75, 0.5 , 0.25]), array([0.16 , 0.02 , 0.015, 0.01 ]))
    """

    threshold: FloatArray
    coverage: FloatArray
    median_error_rad: FloatArray

    def at_coverage(self, share: float) -> tuple[float, float]:
        r"""Return the highest threshold that keeps at least a share of the bearings, and the error there.

        .. math:: \rho^* = \max\{\rho_0 : c(\rho_0) \ge s\}

        Parameters
        ----------
        share : float
            In (0, 1].

        Returns
        -------
        threshold, median_error_rad : float
            Prominence, and radians.

        Raises
        ------
        InvalidArgumentError
            If the share is out of range.

        Examples
        --------
        >>> gating_curve([1.1, 1.2, 2.0, 3.0], [0.5, 0.25, 0.125, 0.125]).at_coverage(0.5)
        (2.0, 0.125)
        """
        least = in_range("share", share, 0.0, 1.0, open_low=True)
        last = int(np.flatnonzero(self.coverage >= least - 1e-12)[-1])
        return float(self.threshold[last]), float(self.median_error_rad[last])


def gating_curve(prominence: ArrayLike, error_rad: ArrayLike) -> GatingCurve:
    r"""Compute coverage and median error over the prominence threshold from bearings with known errors.

    .. math:: c(\rho_0) = \frac{\#\{i : \rho_i \ge \rho_0\}}{n}, \qquad
              e(\rho_0) = \mathrm{median}\{|\epsilon_i| : \rho_i \ge \rho_0\}

    Parameters
    ----------
    prominence : array_like, shape (n,)
        Peak-to-median ratios; n >= 1.
    error_rad : array_like, shape (n,)
        Bearing minus truth, wrapped here.

    Returns
    -------
    GatingCurve
        One point for each occurring prominence, or an evenly spaced choice; the first keeps all.

    Raises
    ------
    InvalidArgumentError
        If a shape is wrong, there are no bearings, or a value is not finite.

    References
    ----------
    The results of the paper (gating by the peak-to-median ratio); C. K. Chow, "On optimum recognition error
    and reject tradeoff", IEEE Trans. IT 16, 1970 (the curve).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> prominence = 1.0 + rng.exponential(0.5, 2000)
    >>> curve = gating_curve(prominence, rng.standard_normal(2000) * 0.1 / (prominence - 0.9))
    >>> len(curve.threshold), bool(curve.median_error_rad[150] < 0.5 * curve.median_error_rad[0])
    (200, True)
    """
    ratios = finite_array("prominence", prominence, (None,))
    errors = np.abs(wrap_angle(finite_array("error_rad", error_rad, ratios.shape)))
    if not len(ratios):
        raise InvalidArgumentError("prominence: expected at least one bearing, got none")
    order = np.argsort(ratios, kind="stable")
    ratios, errors = ratios[order], errors[order]
    # Equal prominences are kept or dropped together.
    starts = np.flatnonzero(np.diff(ratios, prepend=-np.inf))
    if len(starts) > _MOST_POINTS:
        starts = starts[np.linspace(0, len(starts) - 1, _MOST_POINTS).round().astype(np.intp)]
    medians = np.array([np.median(errors[start:]) for start in starts])
    return GatingCurve(ratios[starts], 1.0 - starts / len(ratios), medians)


def bearing_curve(checks: HopTable) -> GatingCurve | NotUsable:
    """Return the gating curve of the bearings that have a moving box as reference."""
    seen = np.isfinite(checks.error_rad)
    if not seen.any():
        return NotUsable("no bearing with a moving box in view")
    return gating_curve(checks.prominence[seen], checks.error_rad[seen])


def gated_median_deg(checks: HopTable) -> float:
    """Return the median error of the most prominent 16 %; NaN if no bearing has a reference."""
    curve = bearing_curve(checks)
    return np.nan if isinstance(curve, NotUsable) else np.degrees(curve.at_coverage(PUBLISHED_COVERAGE)[1])


# A miss costs half of it. At 20 degrees, a common choice for bearing trackers, no output (10) scores better
# than any estimate with an error of 10 degrees or more.
CUTOFF_RAD = math.radians(60.0)


@dataclass(frozen=True, slots=True, eq=False)
class Gospa:
    """GOSPA at one instant: the total to the power p is the sum of its three parts.

    Examples
    --------
    >>> one = gospa_bearing([0.1, 2.0], [0.0], cutoff_rad=1.0)
    >>> round(one.total_rad, 3), one.missed, one.false, one.pairs.tolist()
    (0.6, 0.0, 0.5, [[0, 0]])
    """

    total_rad: float
    localisation: float  # Sum of the p-th powers of the errors of the pairs
    missed: float  # Half of the cut-off to the power p for each truth without an estimate
    false: float  # The same for each estimate without a truth
    pairs: IndexArray  # shape (k, 2): Rows of the matched estimate and truth


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
    # target, so the assignment may use pairs only, each limited to the cut-off.
    estimates = finite_array("estimates_rad", estimates_rad, (None,))
    truths = finite_array("truths_rad", truths_rad, (None,))
    power = in_range("order", order, 1.0, math.inf)
    cut = in_range("cutoff_rad", cutoff_rad, 0.0, math.inf, open_low=True) ** power
    cost = _bearing_errors(estimates, truths) ** power
    pairs = gated_pairs(cost, cost <= cut, cut)
    parts = (
        float(cost[pairs[:, 0], pairs[:, 1]].sum()),
        cut / 2.0 * (truths.size - len(pairs)),
        cut / 2.0 * (estimates.size - len(pairs)),
    )
    return Gospa(sum(parts) ** (1.0 / power), *parts, pairs)


def _bearing_errors(truths_rad: FloatArray, estimates_rad: FloatArray) -> FloatArray:
    """Return the absolute angle of every estimate from every truth, shape (truths, estimates)."""
    return np.abs(wrap_angle(truths_rad[:, None] - estimates_rad))
