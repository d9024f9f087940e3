"""Threshold and risk map from single windows, one hazard-free window a recording."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit, logit

from worldstate.abduction.cueing.risk_map import RiskMap, fit_isotonic
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray

FitMap = Callable[[ArrayLike, ArrayLike], RiskMap]

# The published statistic takes no account of vision; ours removes the visible explanation.
PUBLISHED_MISS_RATE = 1.0
ABSENT_MISS_RATE = 0.0
_SMALLEST_GAMMA = 1e-12
MISS_RATES = (PUBLISHED_MISS_RATE, ABSENT_MISS_RATE)


@dataclass(frozen=True, slots=True)
class WindowCalibration:
    """What was learned on calibration windows and is applied unchanged to others."""

    miss_rate: float  # beta at which the statistic is formed
    gamma: float  # Threshold
    risk_map: RiskMap  # From statistic to risk

    def apply(self, probabilities: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return statistic, risk and decision of each window from posteriors, shape (n, 4)."""
        score = hazard_statistic(probabilities, self.miss_rate)
        return score, self.risk_map(score), score >= self.gamma


def calibrate_windows(
    probabilities: FloatArray,
    hazards: BoolArray,
    hazard_free: BoolArray,
    *,
    alpha: float,
    miss_rate: float,
    fit_map: FitMap = fit_isotonic,
) -> WindowCalibration:
    """Set threshold and risk map on posteriors of windows that the classifier was not trained on.

    Shapes: probabilities (n, 4), hazards, hazard_free (n,).

    Examples
    --------
    >>> posteriors = np.array([[0.1, 0.7, 0.1, 0.1], [0.1, 0.1, 0.7, 0.1], [0.0, 0.1, 0.8, 0.1]])
    >>> hazards = np.array([True, False, False])
    >>> calibration = calibrate_windows(posteriors, hazards, ~hazards, alpha=0.5, miss_rate=1.0)
    >>> calibration.apply(posteriors)[2]
    array([ True, False, False])
    """
    # The threshold is set for single windows. A sustained rule alarms on a part of those only, and so keeps
    # the budget too.
    if not hazards.any() or not hazard_free.any():
        raise InvalidArgumentError("calibration: expected windows with and without a hazard")
    score = hazard_statistic(probabilities, miss_rate)
    scored = hazards | hazard_free
    return WindowCalibration(
        miss_rate=miss_rate,
        gamma=neyman_pearson_threshold(list(score[hazard_free][:, None]), alpha),
        risk_map=fit_map(score[scored], hazards[scored]),
    )


def between(levels: Sequence[WindowCalibration]) -> WindowCalibration:
    """Return one calibration of several of the same statistic, from the most careful to the boldest."""
    # A classifier at a junction that it never saw stands between two that can be measured on its training
    # set: one that saw fewer junctions and not this one (leave one junction out), and one that saw this one
    # too (leave recordings out). The first is too careful, the second too bold, so the threshold is taken
    # half-way between them, in log-odds. The risk map is that of the boldest: statistics of windows that
    # are compared with their site mean the same elsewhere, those of a classifier from too few junctions do
    # not.
    if not levels:
        raise InvalidArgumentError("levels: expected at least one calibration")
    if len(levels) == 1:
        return levels[0]
    gammas = np.clip([level.gamma for level in levels], _SMALLEST_GAMMA, 1.0 - _SMALLEST_GAMMA)
    return replace(levels[-1], gamma=float(expit(logit(gammas).mean())))
