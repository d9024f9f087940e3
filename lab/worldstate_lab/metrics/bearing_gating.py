"""Prominence gating: the accuracy of bearings that a camera could check against the share that is kept."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable, wrap_angle
from worldstate.operations.recordings.hop_table import HopTable

# The paper's second point: 2.4 degrees at 16 % coverage, after 3.4 degrees on all.
PUBLISHED = ((1.0, 3.4), (0.16, 2.4))
PUBLISHED_COVERAGE = PUBLISHED[1][0]
# Thresholds of a curve, evenly spread over the coverage.
_MOST_POINTS = 200


@dataclass(frozen=True, slots=True, eq=False)
class GatingCurve:
    r"""Coverage and median error of bearings over the threshold on their prominence.

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
        One point for every prominence that occurs, or an even choice of them; the first keeps all.

    Raises
    ------
    InvalidArgumentError
        On another shape, no bearings, NaN or infinity.

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
    """Trade coverage for accuracy, by the bearings that a moving box could check."""
    seen = np.isfinite(checks.error_rad)
    if not seen.any():
        return NotUsable("no bearing with a moving box in view")
    return gating_curve(checks.prominence[seen], checks.error_rad[seen])


def gated_median_deg(checks: HopTable) -> float:
    """Return the median error of the most prominent 16 %; NaN where no bearing could be checked."""
    curve = bearing_curve(checks)
    return np.nan if isinstance(curve, NotUsable) else np.degrees(curve.at_coverage(PUBLISHED_COVERAGE)[1])
