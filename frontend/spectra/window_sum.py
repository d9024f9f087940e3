"""Sliding-window sum of matrices with bounded round-off."""

import numpy as np

from worldstate.ground.typing import Complex64Array

# Round-off, relative to the sum, from which the window is summed again from its parts.
_MAX_ROUND_OFF = 1e-5
_EPS = float(np.finfo(np.float32).eps)


class WindowSum:
    """Sum of the last `length` sets of positive semidefinite matrices, in single precision."""

    # Adding the newest and subtracting the oldest set costs two passes, but leaves the round-off of loud sets
    # behind, in which a sound 100 dB below would be lost. The round-off is bounded by the traces added and
    # subtracted; where it may exceed 1e-5 of the sum, the window is summed again.

    def __init__(self, length: int, n_bins: int, size: int) -> None:
        self._parts = np.zeros((length, n_bins, size, size), np.complex64)
        self.total = np.zeros((n_bins, size, size), np.complex64)
        self._traces = np.zeros((length, n_bins))
        self._round_off = np.zeros(n_bins)
        self._slot = 0

    def open_slot(self) -> Complex64Array:
        r"""Subtract the oldest set and return its memory, into which the newest is to be written.

        .. math:: S \leftarrow S - A_{n - L}
        """
        oldest = self._parts[self._slot]
        self._round_off += _EPS * self._traces[self._slot]
        self.total -= oldest
        return np.asarray(oldest)

    def close_slot(self) -> None:
        r"""Add the set that was written.

        .. math:: S \leftarrow S + A_n, \qquad
                  S \leftarrow \sum_i A_i \text{ where } \epsilon \sum_j t_j > 10^{-5} \sum_i t_i

        with the traces t of the sets i in the window and of all sets j added or subtracted since the last
        full sum.
        """
        newest = self._parts[self._slot]
        self.total += newest
        self._traces[self._slot] = np.einsum("bmm->bm", newest).real.sum(axis=1)
        self._round_off += _EPS * self._traces[self._slot]
        self._slot = (self._slot + 1) % len(self._parts)
        if (self._round_off > _MAX_ROUND_OFF * self._traces.sum(axis=0)).any():
            np.sum(self._parts, axis=0, out=self.total)
            self._round_off[:] = 0.0
