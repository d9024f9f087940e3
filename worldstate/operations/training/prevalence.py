"""Prior shift without labels: risk moved until its mean equals the training prevalence."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import expit, logit

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

SMALLEST_RISK = 1e-6


def matched_risk(risk: ArrayLike, table: FeatureTable, mean_risk: float) -> FloatArray:
    r"""Return the risks, those of each junction shifted in log-odds, shape (n,).

    .. math:: r' = \sigma(\mathrm{logit}\, r + b), \qquad
              \tfrac{1}{n} \sum_i \sigma(\mathrm{logit}\, r_i + b) = \bar r,

    with the mean over the junction's other recordings. No label is looked at, but the share of hazards among
    the windows is taken to be what it was in training: true of a curated set, false of a street by the hour.

    Shapes: risk (n,).
    """
    values = finite_array("risk", risk, (len(table),))
    mean = in_range("mean_risk", mean_risk, 0.0, 1.0, open_low=True, open_high=True)
    if (values < 0).any() or (values > 1).any():
        raise InvalidArgumentError("risk: expected numbers in [0, 1]")
    log_odds = logit(np.clip(values, SMALLEST_RISK, 1.0 - SMALLEST_RISK))
    keys, matched = table.recording_keys, np.empty(len(table))
    for key in np.unique(keys):
        mine = keys == key
        others = (table.environments == table.environments[mine][0]) & ~mine
        if not others.any():
            raise InvalidArgumentError(f"recording {key}: expected another recording of its junction")
        matched[mine] = expit(log_odds[mine] + _shift(log_odds[others], mean))
    return matched


def _shift(log_odds: FloatArray, mean: float) -> float:
    def surplus(shift: float) -> float:
        return float(expit(log_odds + shift).mean()) - mean

    farthest = float(np.abs(log_odds).max() + abs(logit(mean)) + 1.0)
    return float(brentq(surplus, -farthest, farthest))
