"""Threshold and risk map from windows that stand alone, one hazard-free window a recording."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldstate.abduction.neyman_pearson import neyman_pearson_threshold
from worldstate.abduction.risk_map import RiskMap, fit_isotonic
from worldstate.abduction.signature import hazard_statistic
from worldstate.errors import InvalidArgumentError

Numbers = NDArray[np.float64]
Flags = NDArray[np.bool_]

# The published statistic takes no account of vision; ours removes the visible explanation.
PUBLISHED_MISS_RATE = 1.0
ABSENT_MISS_RATE = 0.0
MISS_RATES = (PUBLISHED_MISS_RATE, ABSENT_MISS_RATE)


@dataclass(frozen=True, slots=True)
class WindowCalibration:
    """What was learned on calibration windows and is applied unchanged to others.

    Parameters
    ----------
    miss_rate : float
        beta at which the statistic is formed.
    gamma : float
        Threshold.
    risk_map : RiskMap
        From statistic to risk.
    """

    miss_rate: float
    gamma: float
    risk_map: RiskMap

    def apply(self, probabilities: Numbers) -> tuple[Numbers, Numbers, Flags]:
        """Return statistic, risk and decision of each window from posteriors, shape (n, 4)."""
        score = hazard_statistic(probabilities, self.miss_rate)
        return score, self.risk_map(score), score >= self.gamma


def calibrate_windows(
    probabilities: Numbers, hazards: Flags, hazard_free: Flags, *, alpha: float, miss_rate: float
) -> WindowCalibration:
    """Set threshold and isotonic map on posteriors of windows that the classifier was not trained on.

    The threshold is set for single windows. A sustained rule alarms on a part of those only, and so keeps
    the budget too.

    Parameters
    ----------
    probabilities : ndarray, shape (n, 4)
        Posteriors of front, left, none, right.
    hazards, hazard_free : ndarray of bool, shape (n,)
        Labels; windows that are neither are left out.
    alpha : float
        Budget.
    miss_rate : float
        beta of the statistic.

    Raises
    ------
    InvalidArgumentError
        If hazard or hazard-free windows are missing, or alpha is out of range.

    Examples
    --------
    >>> posteriors = np.array([[0.1, 0.7, 0.1, 0.1], [0.1, 0.1, 0.7, 0.1], [0.0, 0.1, 0.8, 0.1]])
    >>> hazards = np.array([True, False, False])
    >>> calibration = calibrate_windows(posteriors, hazards, ~hazards, alpha=0.5, miss_rate=1.0)
    >>> calibration.apply(posteriors)[2]
    array([ True, False, False])
    """
    if not hazards.any() or not hazard_free.any():
        raise InvalidArgumentError("calibration: expected windows with and without a hazard")
    score = hazard_statistic(probabilities, miss_rate)
    scored = hazards | hazard_free
    return WindowCalibration(
        miss_rate=miss_rate,
        gamma=neyman_pearson_threshold(list(score[hazard_free][:, None]), alpha),
        risk_map=fit_isotonic(score[scored], hazards[scored]),
    )
