"""Isotonic regression on a two-dimensional grid."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

# Far below the resolution of any miss rate that is counted.
_SWEEPS = 2000
_TOLERANCE = 1e-10


def isotonic_grid(values: ArrayLike, weights: ArrayLike) -> FloatArray:
    r"""Return the grid closest to `values` that does not fall along rows or columns.

    .. math:: \min_g \sum_{ij} w_{ij} (g_{ij} - v_{ij})^2 \quad \text{subject to} \quad
              g_{ij} \le g_{i+1,j},\ g_{ij} \le g_{i,j+1},

    Shapes: values (rows, columns), weights (rows, columns).

    References
    ----------
    Dykstra and Robertson, "An algorithm for isotonic regression for two or more independent variables", 1982.
    """
    # by Dykstra's projections onto the two sets in turn, each a pooling of adjacent violators.
    grid = finite_array("values", values, (None, None)).copy()
    weight = finite_array("weights", weights, grid.shape)
    if not grid.size or (weight <= 0).any():
        raise InvalidArgumentError("weights: expected a grid of positive numbers")
    along_rows, along_columns = np.zeros_like(grid), np.zeros_like(grid)
    for _ in range(_SWEEPS):
        before = grid
        by_row = _pooled_rows(grid + along_rows, weight)
        along_rows += grid - by_row
        grid = _pooled_rows((by_row + along_columns).T, weight.T).T
        along_columns += by_row - grid
        if max(np.abs(grid - before).max(), np.abs(grid - by_row).max()) < _TOLERANCE:
            break
    # What is left of the alternation, far below any rate that could be measured, must not break the order.
    return np.maximum.accumulate(np.maximum.accumulate(grid, axis=0), axis=1)


def _pooled_rows(values: FloatArray, weights: FloatArray) -> FloatArray:
    rows = [_pooled(value, weight) for value, weight in zip(values, weights, strict=True)]
    return np.array(rows)


def _pooled(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Pool adjacent violators of one sequence."""
    means: list[float] = []
    masses: list[float] = []
    counts: list[int] = []
    for value, weight in zip(values.tolist(), weights.tolist(), strict=True):
        means.append(value)
        masses.append(weight)
        counts.append(1)
        while len(means) > 1 and means[-2] > means[-1]:
            mean, mass, count = means.pop(), masses.pop(), counts.pop()
            total = masses[-1] + mass
            means[-1] = (means[-1] * masses[-1] + mean * mass) / total
            masses[-1] = total
            counts[-1] += count
    return np.repeat(means, counts)
