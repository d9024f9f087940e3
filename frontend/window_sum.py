"""Sums over a sliding window without subtraction: what has left the window has left no rounding behind."""

import numpy as np
from numpy.typing import NDArray


class WindowSum:
    """Sum of the last so many arrays, in a binary tree: each new one costs the additions on its path.

    A running sum from which the oldest is subtracted keeps the rounding of whatever was loud, and a sound a
    hundred decibels below would drown in it.

    Parameters
    ----------
    length : int
        Arrays in the window.
    shape : tuple of int
        Of each.

    Examples
    --------
    >>> window = WindowSum(3, (1,))
    >>> for value in (1e30, 1.0, 2.0, 4.0):
    ...     window.next_slot[...] = value
    ...     window.close_slot()
    >>> window.total.real
    array([7.], dtype=float32)
    """

    def __init__(self, length: int, shape: tuple[int, ...]) -> None:
        # Node n is the sum of nodes 2 n and 2 n + 1; leaves are the nodes from `length` on.
        self._nodes = np.zeros((2 * length, *shape), np.complex64)
        self._length = length
        self._slot = 0

    @property
    def next_slot(self) -> NDArray[np.complex64]:
        """Where the next array is to be written: the place of the oldest."""
        return np.asarray(self._nodes[self._length + self._slot])

    def close_slot(self) -> None:
        """Take what was written there."""
        node = (self._length + self._slot) // 2
        while node:
            np.add(self._nodes[2 * node], self._nodes[2 * node + 1], out=self._nodes[node])
            node //= 2
        self._slot = (self._slot + 1) % self._length

    @property
    def total(self) -> NDArray[np.complex64]:
        """Sum of the window; valid until the next array is taken."""
        return np.asarray(self._nodes[1])
