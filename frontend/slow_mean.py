"""A running mean per channel that leaves out the hops in which a channel was of no use."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Time constant, hops: three seconds.
_HOPS = 30


class SlowMean:
    """Exponential mean over hops, an ordinary mean until its time constant has passed.

    Parameters
    ----------
    n_channels : int
        Number of channels M.

    Attributes
    ----------
    mean : ndarray, shape (M,)
        0 where nothing was added.
    count : ndarray of int, shape (M,)
        Hops added.

    Examples
    --------
    >>> slow = SlowMean(2)
    >>> slow.add([1.0, 5.0], np.array([True, True]))
    >>> slow.add([3.0, 7.0], np.array([True, False]))
    >>> slow.mean, slow.count
    (array([2., 5.]), array([2, 1]))
    """

    def __init__(self, n_channels: int) -> None:
        self.mean = np.zeros(n_channels)
        self.count = np.zeros(n_channels, np.int64)

    def add(self, values: ArrayLike, good: NDArray[np.bool_]) -> None:
        """Take one value per channel (M,), of those that are good."""
        self.count += good
        weight = good / np.clip(self.count, 1, _HOPS)
        self.mean += weight * (np.asarray(values) - self.mean)
