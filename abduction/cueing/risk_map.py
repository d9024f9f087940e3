"""Calibrated risk: monotone maps from the statistic to the frequency of a hidden hazard, and their error.

Windows overlap, so the number of independent samples selects the map that is fitted. Calibration is measured
by the reliability curve, the expected calibration error (ECE), the Brier score and its skill.
"""

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import TINY, BoolArray, FloatArray, InvalidArgumentError, finite_array
from worldstate.ground.extras import optional
from worldstate.ground.serialisation import Layout
from worldstate.ground.typing import IndexArray
from worldstate.ground.values import RealT

# Tolerance on the gradient; values are in units of the largest one.
_GRADIENT_TOLERANCE = 1e-9


def sigmoid(value: FloatArray, slope: ArrayLike, offset: ArrayLike) -> FloatArray:
    r"""Return a falling or rising sigmoid without overflow; the arguments are broadcast.

    .. math:: p(f) = 1 / (1 + \exp(A f + B))

    Examples
    --------
    >>> sigmoid(np.array([0.0, 1e6]), -1.0, 0.0)
    array([0.5, 1. ])
    """
    exponent: FloatArray = np.asarray(slope) * value + np.asarray(offset)
    return np.asarray(np.exp(-np.logaddexp(0.0, exponent)))


def fit_sigmoid(values: ArrayLike, positive: ArrayLike) -> tuple[float, float]:
    r"""Return the maximum-likelihood (A, B), with Platt's prior on the targets.

    .. math:: \hat A, \hat B = \arg\min_{A, B} -\sum_i \big[ t_i \ln p(f_i) + (1 - t_i) \ln(1 - p(f_i)) \big],
              \qquad t_+ = \frac{n_+ + 1}{n_+ + 2}, \quad t_- = \frac{1}{n_- + 2}

    Shapes: values (n,), positive (n,).
    """
    decision = finite_array("values", values, (None,))
    label = finite_array("positive", positive, decision.shape) > 0.5
    if not decision.size:
        raise InvalidArgumentError("values: expected at least one decision value")
    n_positive, n_negative = int(label.sum()), int((~label).sum())
    target = np.where(label, (n_positive + 1) / (n_positive + 2), 1 / (n_negative + 2))
    # In units of the largest value, so that the tolerance does not depend on the scale.
    unit = float(np.abs(decision).max()) or 1.0
    design = np.stack([decision / unit, np.ones_like(decision)])

    def loss(point: FloatArray) -> tuple[float, FloatArray]:
        exponent = point @ design
        off = np.logaddexp(0.0, exponent) - (1.0 - target) * exponent
        return float(off.sum()), design @ (target - sigmoid(exponent, 1.0, 0.0))

    # Imported here because scipy.optimize takes longer to import than everything else in this file.
    from scipy.optimize import minimize

    start, options = [0.0, np.log((n_negative + 1) / (n_positive + 1))], {"gtol": _GRADIENT_TOLERANCE}
    slope, offset = minimize(loss, start, jac=True, method="BFGS", options=options).x.tolist()
    return slope / unit, offset


# Size from which isotonic regression is at least as good as Platt's map: see `fit_risk_map`.
SMALL_SAMPLE = 200


@dataclass(frozen=True, slots=True)
class IsotonicMap:
    """A map that is linear between knots and constant beyond them."""

    LAYOUT: ClassVar = Layout(constants={"kind": "isotonic"})

    statistics: tuple[float, ...]  # Knots, never falling
    risks: tuple[float, ...]  # Risk at each knot, in [0, 1], never falling

    def __post_init__(self) -> None:
        knots = finite_array("statistics", self.statistics, (None,))
        risks = finite_array("risks", self.risks, (knots.size,))
        if not knots.size or (np.diff(knots) < 0).any() or (np.diff(risks) < 0).any():
            raise InvalidArgumentError("risk map: expected at least one knot and sequences that do not fall")
        if risks[0] < 0 or risks[-1] > 1:
            raise InvalidArgumentError("risks: expected numbers in [0, 1]")

    def __call__(self, statistic: RealT) -> RealT:
        """Return the risk at one statistic or at an array of statistics."""
        risk = np.interp(statistic, self.statistics, self.risks)
        return float(risk) if np.ndim(statistic) == 0 else risk  # type: ignore[return-value]


@dataclass(frozen=True, slots=True)
class PlattMap:
    r"""A sigmoid of the statistic's log-odds with two parameters, for small samples.

    .. math:: r = 1 / (1 + \exp(a\, \mathrm{logit}(s) + b)), \qquad a \le 0.
    """

    LAYOUT: ClassVar = Layout(constants={"kind": "platt"})

    slope: float  # a, not positive
    offset: float  # b

    def __post_init__(self) -> None:
        finite_array("slope, offset", (self.slope, self.offset), (2,))
        if self.slope > 0:
            raise InvalidArgumentError(f"slope: expected a number <= 0, got {self.slope}")

    def __call__(self, statistic: RealT) -> RealT:
        """Return the risk at one statistic or at an array of statistics."""
        risk = sigmoid(_logit(np.asarray(statistic, dtype=np.float64)), self.slope, self.offset)
        return float(risk) if np.ndim(statistic) == 0 else risk  # type: ignore[return-value]


RiskMap: TypeAlias = IsotonicMap | PlattMap


def fit_isotonic(statistics: ArrayLike, hazards: ArrayLike) -> IsotonicMap:
    r"""Fit the isotonic regression of hazard labels on statistics.

    .. math:: \hat g = \arg\min_g \sum_i (g(s_i) - y_i)^2, \qquad g \text{ never falling}

    Shapes: statistics (n,), hazards (n,).

    References
    ----------
    B. Zadrozny and C. Elkan, "Transforming classifier scores into accurate multiclass probability estimates",
    2002.
    """
    scores, labels = _checked_sample(statistics, hazards)
    regression = optional("sklearn.isotonic").IsotonicRegression
    fit = regression(y_min=0.0, y_max=1.0, out_of_bounds="clip").fit(scores, labels)
    return IsotonicMap(tuple(fit.X_thresholds_.tolist()), tuple(fit.y_thresholds_.tolist()))


def fit_platt(statistics: ArrayLike, hazards: ArrayLike) -> PlattMap:
    r"""Fit the sigmoid of hazard labels on the log-odds of statistics; a falling fit becomes constant.

    .. math:: r = 1 / (1 + \exp(a\, \mathrm{logit}(s) + b)), \qquad a \le 0

    Shapes: statistics, hazards (n,).

    References
    ----------
    J. Platt, "Probabilistic outputs for support vector machines", 1999.
    """
    # It raises the errors of `fit_isotonic`.
    scores, labels = _checked_sample(statistics, hazards)
    slope, offset = fit_sigmoid(_logit(scores), labels)
    if slope > 0:
        slope, offset = 0.0, float(np.log((~labels).sum() / labels.sum()))
    return PlattMap(slope, offset)


def fit_risk_map(statistics: ArrayLike, hazards: ArrayLike, independent: float | None = None) -> RiskMap:
    """Fit Platt's map to a small sample and the isotonic regression to a larger one.

    Platt's map is used if ``n < 200``.

    On simulated scores whose true map is a sigmoid, Platt's map is better at every size. If the true map is
    another monotone curve, isotonic regression has the better Brier score from 80 to 160 independent samples
    on. At 200 samples either choice costs at most 0.003, so the limit is there.

    Parameters
    ----------
    statistics, hazards : array_like, shape (n,)
        See `fit_isotonic`.
    independent : float, optional
        Equivalent number of independent samples, n by default. Windows of one recording are dependent.

    Returns
    -------
    RiskMap
        A `PlattMap` or an `IsotonicMap`.

    Raises
    ------
    InvalidArgumentError
        In the cases of `fit_isotonic`.

    References
    ----------
    J. Platt 1999, B. Zadrozny and C. Elkan 2002: see `fit_platt` and `fit_isotonic`. The limit was found by
    the simulation above.

    Examples
    --------
    >>> type(fit_risk_map([0.1, 0.2, 0.3, 0.9], [False, True, False, True])).__name__
    'PlattMap'
    """
    worth = np.size(statistics) if independent is None else independent
    return fit_platt(statistics, hazards) if worth < SMALL_SAMPLE else fit_isotonic(statistics, hazards)


def _logit(statistic: FloatArray) -> FloatArray:
    bounded = np.clip(statistic, TINY, 1.0 - TINY)
    return np.asarray(np.log(bounded / (1.0 - bounded)))


def _checked_sample(statistics: ArrayLike, hazards: ArrayLike) -> tuple[FloatArray, BoolArray]:
    scores = finite_array("statistics", statistics, (None,))
    labels = finite_array("hazards", hazards, scores.shape) > 0.5
    if not labels.any() or labels.all():
        raise InvalidArgumentError("hazards: expected windows with and without a hazard")
    return scores, labels


# Ten equal bins, as in the paper; more bins increase the ECE of perfectly calibrated labels.
BINS = 10


@dataclass(frozen=True, slots=True)
class ReliabilityCurve:
    """Predicted and observed frequencies in the bins that are not empty.

    Parameters
    ----------
    predicted, observed : ndarray, shape (bins,)
        Mean risk and share of hazards in each bin.
    counts : ndarray of int, shape (bins,)
        Number of windows in each bin.

    Examples
    --------
    >>> reliability_curve([0.15, 0.25, 0.9], [False, True, True], bins=2).counts
    array([2, 1])
    """

    predicted: FloatArray
    observed: FloatArray
    counts: IndexArray


def reliability_curve(risk: ArrayLike, hazards: ArrayLike, bins: int = BINS) -> ReliabilityCurve:
    r"""Return the reliability curve over bins of equal width on [0, 1].

    .. math:: \overline r_b = \frac1{n_b} \sum_{i \in b} r_i, \qquad
              \overline y_b = \frac1{n_b} \sum_{i \in b} y_i

    Parameters
    ----------
    risk : array_like, shape (n,)
        Predicted probabilities in [0, 1].
    hazards : array_like of bool, shape (n,)
        Observed outcomes.
    bins : int
        Number of bins.

    Returns
    -------
    ReliabilityCurve
        Without empty bins.

    Raises
    ------
    InvalidArgumentError
        If the sample is empty, the shapes differ or a risk is outside [0, 1].

    References
    ----------
    M. DeGroot and S. Fienberg, "The comparison and evaluation of forecasters", The Statistician 32, 1983.

    Examples
    --------
    >>> curve = reliability_curve([0.1, 0.1, 0.9, 0.9], [0, 1, 1, 1], bins=2)
    >>> curve.predicted, curve.observed
    (array([0.1, 0.9]), array([0.5, 1. ]))
    """
    predicted, labels = _checked_risk(risk, hazards)
    index = np.minimum((predicted * bins).astype(np.intp), bins - 1)
    counts = np.bincount(index, minlength=bins)
    filled = counts > 0
    mean_risk = np.bincount(index, predicted, bins)[filled] / counts[filled]
    frequency = np.bincount(index, labels, bins)[filled] / counts[filled]
    return ReliabilityCurve(mean_risk, frequency, counts[filled])


def expected_calibration_error(risk: ArrayLike, hazards: ArrayLike, bins: int = BINS) -> float:
    r"""Return the expected calibration error.

    .. math:: ECE = \sum_b \frac{n_b}{n} \left| \overline{r}_b - \overline{y}_b \right|

    It raises the errors of `reliability_curve`.

    Parameters
    ----------
    risk, hazards : array_like, shape (n,)
        Predicted risk in [0, 1] and outcome, 0 or 1.
    bins : int
        Number of bins of equal width.

    Returns
    -------
    float
        Error in [0, 1].

    References
    ----------
    Guo et al., "On calibration of modern neural networks", 2017.

    Examples
    --------
    >>> round(expected_calibration_error([0.1, 0.1, 0.9, 0.9], [False, False, True, True]), 3)
    0.1
    """
    curve = reliability_curve(risk, hazards, bins)
    return float(curve.counts @ np.abs(curve.predicted - curve.observed) / curve.counts.sum())


def brier_score(risk: ArrayLike, hazards: ArrayLike) -> float:
    r"""Return the mean squared difference between risk and outcome.

    .. math:: B = \frac1n \sum_i (r_i - y_i)^2

    It raises the errors of `reliability_curve`.

    Parameters
    ----------
    risk, hazards : array_like, shape (n,)
        Predicted risk in [0, 1] and outcome, 0 or 1.

    Returns
    -------
    float
        Score in [0, 1].

    References
    ----------
    G. W. Brier, "Verification of forecasts expressed in terms of probability", Monthly Weather Review 78,
    1950.

    Examples
    --------
    >>> round(brier_score([0.1, 0.8], [False, True]), 3)
    0.025
    """
    predicted, labels = _checked_risk(risk, hazards)
    return float(np.mean((predicted - labels) ** 2))


def brier_skill(risk: ArrayLike, hazards: ArrayLike) -> float | None:
    r"""Return the Brier skill against a constant forecast; None if all outcomes are equal.

    .. math:: 1 - B / \bar y (1 - \bar y)

    Examples
    --------
    >>> brier_skill([0.5, 0.5], [False, True]), brier_skill([0.5, 0.0], [False, True])
    (0.0, -1.5)
    """
    # The constant is the true share of hazards, which is unknown beforehand. As a forecast it has an ECE of
    # 0, so calibration alone is not sufficient.
    _, labels = _checked_risk(risk, hazards)
    constant = float(labels.var())
    return 1.0 - brier_score(risk, hazards) / constant if constant else None


def _checked_risk(risk: ArrayLike, hazards: ArrayLike) -> tuple[FloatArray, FloatArray]:
    predicted = finite_array("risk", risk, (None,))
    labels = (finite_array("hazards", hazards, predicted.shape) > 0.5).astype(np.float64)
    if not predicted.size or predicted.min() < 0.0 or predicted.max() > 1.0:
        raise InvalidArgumentError("risk: expected at least one number, all in [0, 1]")
    return predicted, labels
