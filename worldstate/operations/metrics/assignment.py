"""One-to-one assignment of bearings to bearings within a gate."""

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import wrap_angle


def bearing_errors(truths_rad: FloatArray, estimates_rad: FloatArray) -> FloatArray:
    """Return the absolute angle of every estimate from every truth, shape (truths, estimates)."""
    return np.abs(wrap_angle(truths_rad[:, None] - estimates_rad))


def gated_pairs(cost: FloatArray, within: BoolArray, price: float) -> IndexArray:
    """Return row and column of each pair of the cheapest assignment, shape (k, 2), within the gate.

    In the choice, a pair that is not within it costs `price`.

    Examples
    --------
    >>> cost = np.array([[1.0, 5.0], [9.0, 2.0], [9.0, 1.0]])
    >>> gated_pairs(cost, cost <= 3.0, price=100.0)
    array([[0, 0],
           [2, 1]])
    """
    # Imported where it is used: it takes 0.4 s, which a command that only prints its options would pay.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(np.where(within, cost, price))
    kept = within[rows, columns]
    return np.column_stack([rows[kept], columns[kept]])
