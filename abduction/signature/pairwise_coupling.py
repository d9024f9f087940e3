r"""Class probabilities from probabilities of pairs.

For classes i and j let :math:`r_{ij}` estimate :math:`P(i \mid i \text{ or } j)`. The probabilities are

.. math:: \arg\min_p \sum_i \sum_{j \ne i} (r_{ji} p_i - r_{ij} p_j)^2 \quad \text{with} \quad \sum_i p_i = 1,

whose optimality conditions are linear and whose solution is never negative.

Source: Wu, Lin, Weng, "Probability estimates for multi-class classification by pairwise coupling", 2004,
second method.
"""

from itertools import combinations

import numpy as np

from worldstate.ground.typing import FloatArray

# As in libsvm: no pair is ever certain, and so no log-likelihood is ever infinite.
SMALLEST_PROBABILITY = 1e-7


def class_pairs(n_classes: int) -> list[tuple[int, int]]:
    """Return all pairs i < j in the order of a one-against-one machine."""
    return list(combinations(range(n_classes), 2))


def couple(pairwise: FloatArray, n_classes: int) -> FloatArray:
    r"""Return class probabilities, shape (n, classes), positive and summing to one.

    .. math:: \hat p = \arg\min_p \sum_i \sum_{j \ne i} (r_{ji} p_i - r_{ij} p_j)^2, \qquad \sum_i p_i = 1
    """
    bounded = np.clip(pairwise, SMALLEST_PROBABILITY, 1.0 - SMALLEST_PROBABILITY)
    right_side = np.zeros((n_classes + 1, 1))
    right_side[n_classes] = 1.0
    solution = np.linalg.solve(_optimality_matrix(bounded, n_classes), right_side)[:, :n_classes, 0]
    positive = np.maximum(solution, SMALLEST_PROBABILITY)
    probabilities: FloatArray = positive / positive.sum(axis=1, keepdims=True)
    return probabilities


def _optimality_matrix(pairwise: FloatArray, n_classes: int) -> FloatArray:
    """Bordered quadratic form [[Q, 1], [1', 0]], shape (n, classes + 1, classes + 1)."""
    matrix = np.zeros((len(pairwise), n_classes + 1, n_classes + 1))
    matrix[:, :n_classes, n_classes] = matrix[:, n_classes, :n_classes] = 1.0
    for column, (i, j) in enumerate(class_pairs(n_classes)):
        first = pairwise[:, column]
        second = 1.0 - first
        matrix[:, i, i] += second**2
        matrix[:, j, j] += first**2
        matrix[:, i, j] -= first * second
        matrix[:, j, i] -= first * second
    return matrix
