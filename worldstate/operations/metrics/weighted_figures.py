"""Figures where every recording counts as often as a bootstrap draw holds it: all draws in one go."""

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray, IndexArray


def draw_weights(draws: IndexArray, recordings: int) -> FloatArray:
    """Return how often each recording is in each draw, shape (D, recordings).

    Examples
    --------
    >>> draw_weights(np.array([[0, 0, 2]]), recordings=3)
    array([[2., 0., 1.]])
    """
    return np.array([np.bincount(one, minlength=recordings) for one in draws], np.float64)


def ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    """Return the quotient, NaN where there is nothing to divide by.

    Examples
    --------
    >>> ratio(np.array([1.0, 0.0]), np.array([2.0, 0.0]))
    array([0.5, nan])
    """
    quotient: FloatArray = np.divide(above, below, out=np.full(below.shape, np.nan), where=below > 0.0)
    return quotient


def known_mean(values: FloatArray) -> FloatArray:
    """Return the mean over the first axis of what is not NaN.

    Examples
    --------
    >>> known_mean(np.array([[1.0, np.nan], [3.0, np.nan]]))
    array([ 2., nan])
    """
    # `nanmean` warns where a column is all NaN, which here is an answer like any other.
    known = np.isfinite(values)
    return ratio(np.where(known, values, 0.0).sum(axis=0), known.sum(axis=0))


def weighted_median(values: FloatArray, times: FloatArray) -> FloatArray:
    """Return the median of values (n,) that count times[d, i] times, NaN where none does, shape (D,).

    Examples
    --------
    >>> weighted_median(np.array([5.0, 1.0, 2.0]), np.array([[1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]))
    array([2. , 3.5])
    """
    if not values.size:
        return np.full(len(times), np.nan)
    order = np.argsort(values)
    kept = np.cumsum(times[:, order], axis=1)
    half = kept[:, -1:] / 2.0
    # Of an even number the mean of the two in the middle, as numpy's median of the repeated values.
    low, high = np.argmax(kept >= half, axis=1), np.argmax(kept > half, axis=1)
    median = (values[order][low] + values[order][high]) / 2.0
    return np.where(half[:, 0] > 0.0, median, np.nan)


def highest_share(values: FloatArray, times: FloatArray, share: float) -> BoolArray:
    """Return which values stand at or above the highest threshold that keeps a share of them, shape (D, n).

    Examples
    --------
    >>> highest_share(np.array([1.0, 3.0, 2.0]), np.ones((1, 3)), share=0.5)
    array([[False,  True,  True]])
    """
    if not values.size:
        return np.zeros(times.shape, bool)
    order = np.argsort(-values, kind="stable")
    kept = np.cumsum(times[:, order], axis=1)
    # Equal values are kept together; sums of whole numbers are exact, the product with the share is not.
    last = np.argmax(kept >= share * kept[:, -1:] - 1e-9, axis=1)
    return np.asarray(values >= values[order][last][:, None])
