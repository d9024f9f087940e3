"""Sums of matrices over a sliding window that remember nothing of what has left it."""

import numpy as np

from worldstate.ground.typing import Complex64Array

# Rounding that may build up, relative to what is in the window, before it is summed again from its parts.
_DEBT = 1e-5
_EPS = float(np.finfo(np.float32).eps)


class WindowSum:
    """Sum of the last so many sets of positive semidefinite matrices, in single precision.

    Examples
    --------
    >>> window = WindowSum(3, n_bins=1, size=1)
    >>> for value in (1e30, 1.0, 2.0, 4.0):
    ...     window.open_slot()[...] = value
    ...     window.close_slot()
    >>> window.total.real
    array([[[7.]]], dtype=float32)
    """

    # Adding the newest and subtracting the oldest costs two passes, but leaves behind the rounding of
    # whatever was loud, and a sound a hundred decibels below would drown in it. So the rounding is kept
    # account of, by the traces that came and went; where it has grown to a hundred-thousandth of what is
    # there, the window is summed again.

    def __init__(self, length: int, n_bins: int, size: int) -> None:
        self._parts = np.zeros((length, n_bins, size, size), np.complex64)
        self.total = np.zeros((n_bins, size, size), np.complex64)
        self._traces = np.zeros((length, n_bins))
        self._debt = np.zeros(n_bins)
        self._slot = 0

    def open_slot(self) -> Complex64Array:
        r"""Take the oldest set out and give its place, for the newest to be written to.

        .. math:: S \leftarrow S - A_{n - L}
        """
        oldest = self._parts[self._slot]
        self._debt += _EPS * self._traces[self._slot]
        self.total -= oldest
        return np.asarray(oldest)

    def close_slot(self) -> None:
        r"""Take in what was written there.

        .. math:: S \leftarrow S + A_n, \qquad
                  S \leftarrow \sum_i A_i \text{ where } \epsilon \sum_j t_j > 10^{-5} \sum_i t_i

        with the traces t of what is there, i, and of all that came and went since it was last summed anew, j.
        """
        newest = self._parts[self._slot]
        self.total += newest
        self._traces[self._slot] = np.einsum("bmm->bm", newest).real.sum(axis=1)
        self._debt += _EPS * self._traces[self._slot]
        self._slot = (self._slot + 1) % len(self._parts)
        if (self._debt > _DEBT * self._traces.sum(axis=0)).any():
            np.sum(self._parts, axis=0, out=self.total)
            self._debt[:] = 0.0
