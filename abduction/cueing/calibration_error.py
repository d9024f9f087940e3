"""Calibration of risk: reliability curve, ECE with its sampling floor, Brier score and skill."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import InvalidArgumentError, finite_array
from worldstate.ground.typing import FloatArray, IndexArray

# Ten equal bins, as in the paper; more of them raise the sampling floor.
BINS = 10


@dataclass(frozen=True, slots=True)
class ReliabilityCurve:
    """Predicted against observed frequency, in the bins that are not empty.

    Parameters
    ----------
    predicted, observed : ndarray, shape (bins,)
        Mean risk and share of hazards of each bin.
    counts : ndarray of int, shape (bins,)
        Windows in each.

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
        What came true.
    bins : int
        How many.

    Returns
    -------
    ReliabilityCurve
        Bins without a window are left out.

    Raises
    ------
    InvalidArgumentError
        If the sample is empty, the shapes differ or a risk is no probability.

    References
    ----------
    M. DeGroot and S. Fienberg, "The comparison and evaluation of forecasters", The Statistician 32, 1983.

    Examples
    --------
    >>> curve = reliability_curve([0.1, 0.1, 0.9, 0.9], [0, 1, 1, 1], bins=2)
    >>> curve.predicted, curve.observed
    (array([0.1, 0.9]), array([0.5, 1. ]))
    """
    predicted, labels = _checked_sample(risk, hazards)
    index = _bin_index(predicted, bins)
    counts = np.bincount(index, minlength=bins)
    filled = counts > 0
    mean_risk = np.bincount(index, predicted, bins)[filled] / counts[filled]
    frequency = np.bincount(index, labels, bins)[filled] / counts[filled]
    return ReliabilityCurve(mean_risk, frequency, counts[filled])


def expected_calibration_error(risk: ArrayLike, hazards: ArrayLike, bins: int = BINS) -> float:
    r"""Return the expected calibration error.

    .. math:: ECE = \sum_b \frac{n_b}{n} \left| \overline{r}_b - \overline{y}_b \right|

    Errors are those of `reliability_curve`.

    Parameters
    ----------
    risk, hazards : array_like, shape (n,)
        Predicted risk in [0, 1], and 0 or 1.
    bins : int
        Of equal width.

    Returns
    -------
    float
        In [0, 1].

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

    Errors are those of `reliability_curve`.

    Parameters
    ----------
    risk, hazards : array_like, shape (n,)
        Predicted risk in [0, 1], and 0 or 1.

    Returns
    -------
    float
        In [0, 1].

    References
    ----------
    G. W. Brier, "Verification of forecasts expressed in terms of probability", Monthly Weather Review 78,
    1950.

    Examples
    --------
    >>> round(brier_score([0.1, 0.8], [False, True]), 3)
    0.025
    """
    predicted, labels = _checked_sample(risk, hazards)
    return float(np.mean((predicted - labels) ** 2))


def brier_skill(risk: ArrayLike, hazards: ArrayLike) -> float | None:
    r"""Return the share of a constant's Brier score that the risk saves, None where a label is missing.

    .. math:: 1 - B / \bar y (1 - \bar y)

    Examples
    --------
    >>> brier_skill([0.5, 0.5], [False, True]), brier_skill([0.5, 0.0], [False, True])
    (0.0, -1.5)
    """
    # The constant is the true share of hazards, not known beforehand. Stated in every window, it has
    # an ECE of 0: calibration alone is no merit.
    _, labels = _checked_sample(risk, hazards)
    constant = float(labels.var())
    return 1.0 - brier_score(risk, hazards) / constant if constant else None


def _bin_index(predicted: FloatArray, bins: int) -> IndexArray:
    return np.minimum((predicted * bins).astype(np.intp), bins - 1)


def _checked_sample(risk: ArrayLike, hazards: ArrayLike) -> tuple[FloatArray, FloatArray]:
    predicted = finite_array("risk", risk, (None,))
    labels = (finite_array("hazards", hazards, predicted.shape) > 0.5).astype(np.float64)
    if not predicted.size or predicted.min() < 0.0 or predicted.max() > 1.0:
        raise InvalidArgumentError("risk: expected at least one number, all in [0, 1]")
    return predicted, labels
