"""A running mean per channel that leaves out the hops in which a channel was of no use."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.typing import BoolArray

# Time constant, hops: three seconds.
_HOPS = 30


class RunningMean:
    """Exponential mean over hops, an ordinary mean until its time constant has passed.

    Examples
    --------
    >>> slow = RunningMean((1, 2))
    >>> slow.add([[1.0, 5.0]], np.array([True, True]))
    >>> slow.add([[3.0, 7.0]], np.array([True, False]))
    >>> slow.mean, slow.count
    (array([[2., 5.]]), array([2, 1]))
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.mean = np.zeros(shape)
        self.count = np.zeros(shape[1], np.int64)

    def add(self, values: ArrayLike, good: BoolArray) -> None:
        r"""Take the values of a hop, of this shape, and the channels that are good (M,).

        .. math:: \mu \leftarrow \mu + \frac{x - \mu}{\min(n, 30)}

        Shapes: values (M, ...), good (M,).
        """
        self.count += good
        weight = good / np.clip(self.count, 1, _HOPS)
        self.mean += weight * (np.asarray(values) - self.mean)
