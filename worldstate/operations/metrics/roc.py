"""Areas under the ROC curve and rates at a threshold."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray


def auroc(scores: ArrayLike, positive: ArrayLike) -> float | None:
    r"""Return the area under the ROC curve, None where a label is missing altogether.

    .. math:: P(s^+ > s^-) + P(s^+ = s^-) / 2

    Parameters
    ----------
    scores : array_like, shape (n,)
        Larger for positives, one hopes.
    positive : array_like of bool, shape (n,)
        Labels.

    Returns
    -------
    float or None
        In [0, 1].

    Raises
    ------
    InvalidArgumentError
        If the shapes differ or a score is not finite.

    Examples
    --------
    >>> auroc([0.1, 0.4, 0.4, 0.8], [False, True, False, True])
    0.875
    """
    values = finite_array("scores", scores, (None,))
    labels = finite_array("positive", positive, values.shape) > 0.5
    n_positive, n_negative = int(labels.sum()), int((~labels).sum())
    if not n_positive or not n_negative:
        return None
    return float(rank_wins([values[labels]], [values[~labels]])[0, 0]) / (n_positive * n_negative)


def auroc_by_group(scores: ArrayLike, positive: ArrayLike, groups: ArrayLike) -> dict[str, float]:
    """Return the area of each group that has both labels, in the order of their names.

    Shapes: scores, positive (n,), groups (n,).
    """
    values, labels, names = np.asarray(scores), np.asarray(positive), np.asarray(groups)
    areas = {str(name): auroc(values[names == name], labels[names == name]) for name in np.unique(names)}
    return {name: area for name, area in areas.items() if area is not None}


def macro(by_group: Mapping[str, float]) -> float:
    """Return the mean over groups.

    Examples
    --------
    >>> macro({"SA1": 1.0, "SB1": 0.5})
    0.75
    """
    if not by_group:
        raise InvalidArgumentError("groups: expected at least one with hazard and hazard-free windows")
    return float(np.mean(list(by_group.values())))


def rate(decisions: BoolArray, among: BoolArray) -> float | None:
    """Return the share of decisions among the chosen rows, None where there are none.

    Examples
    --------
    >>> rate(np.array([True, False, True]), np.array([True, True, False]))
    0.5
    """
    return float(decisions[among].mean()) if among.any() else None


def worst_rate(alarms: BoolArray, hazard_free: BoolArray, sites: AnyArray) -> float:
    r"""Return the share of hazard-free windows that are in alarm at the junction where it is largest.

    .. math:: \max_s \frac{\sum_i a_i f_i [s_i = s]}{\sum_i f_i [s_i = s]}

    Shapes: alarms, hazard_free, sites (n,).

    Examples
    --------
    >>> free = np.ones(4, dtype=bool)
    >>> worst_rate(np.array([True, False, False, False]), free, np.array([0, 0, 1, 1]))
    0.5
    """
    rates = [rate(alarms, hazard_free & (sites == site)) for site in np.unique(sites[hazard_free])]
    return max(one for one in rates if one is not None)


def rank_wins(positives: Sequence[FloatArray], negatives: Sequence[FloatArray]) -> FloatArray:
    r"""Return how often windows of recording p score above those of recording q, shape (P, Q).

    .. math:: W_{pq} = \sum_{i \in p, j \in q} [s_i > s_j] + [s_i = s_j] / 2

    The area under the ROC curve over any choice of recordings is then a ratio of sums, ties included.

    Examples
    --------
    >>> rank_wins([np.array([0.5, 0.9])], [np.array([0.5]), np.array([0.1, 0.7])])
    array([[1.5, 3. ]])
    """
    scores = np.concatenate([np.zeros(0), *positives])
    ends = np.cumsum([0, *map(len, positives)])
    wins = np.zeros((len(positives), len(negatives)))
    for q, one in enumerate(map(np.sort, negatives)):
        below = (np.searchsorted(one, scores, "left") + np.searchsorted(one, scores, "right")) / 2.0
        # Halves are exact in binary, so differences of the running sum are.
        wins[:, q] = np.diff(np.concatenate([[0.0], np.cumsum(below)])[ends])
    return wins
