"""Areas under the ROC curve, ties included."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.typing import FloatArray


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
