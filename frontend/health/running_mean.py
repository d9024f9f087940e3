"""A running mean per channel over its usable hops."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.typing import BoolArray

# Time constant, hops: three seconds.
_HOPS = 30


class RunningMean:
    """Exponential mean over hops, an ordinary mean until its time constant has passed."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.mean = np.zeros(shape)
        self.count = np.zeros(shape[1], np.int64)

    def add(self, values: ArrayLike, good: BoolArray) -> None:
        r"""Take the values of a hop, shape (statistics, M), and the usable channels, shape (M,).

        .. math:: \mu_{sm} \leftarrow \mu_{sm} + g_m \frac{x_{sm} - \mu_{sm}}{\min(n_m, 30)}
        """
        self.count += good
        weight = good / np.clip(self.count, 1, _HOPS)
        self.mean += weight * (np.asarray(values) - self.mean)
