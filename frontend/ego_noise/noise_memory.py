"""Recursive means of the noise: its covariance, and its level after whitening."""

import math
from collections import deque
from typing import Generic, TypeVar

import numpy as np

from worldstate.ground.typing import Complex64Array

Item = TypeVar("Item")


class GuardDelay(Generic[Item]):
    r"""Queue of hops, weighted :math:`w'_n = \min(w_n, \dots, w_{n + hops})` over the guard interval."""

    # Each hop leaves after `hops` hops. Without the delay a source is learned as noise in the moments before
    # it is detected.

    def __init__(self, hops: int) -> None:
        self._waiting: deque[Item] = deque()
        self._weights: deque[float] = deque(maxlen=hops + 1)

    def push(self, item: Item, weight: float) -> tuple[Item, float] | None:
        """Take a hop with its weight; return the one that leaves the delay, None while it fills."""
        self._waiting.append(item)
        self._weights.append(weight)
        if len(self._waiting) < (self._weights.maxlen or 0):
            return None
        return self._waiting.popleft(), min(self._weights)


# Memory of the level of whitened noise, hops: one second, for the level follows the speed of the vehicle.
_LEVEL_HOPS = 10.0


class NoiseCovariance:
    """Recursive mean of unit-length snapshots' covariance, per bin."""

    def __init__(self, n_bins: int, n_microphones: int, forgetting_frames: float) -> None:
        self.n_frames = 0.0
        self._sum = np.zeros((n_bins, n_microphones, n_microphones), np.complex64)
        self._forgetting = forgetting_frames

    def learn(self, total: Complex64Array, n_frames: int, weight: float) -> None:
        r"""Add a hop's sum (bins, M, M) over `n_frames` with a weight in (0, 1]; `total` is overwritten.

        .. math:: S \leftarrow e^{-w T / F} S + w \sum_t x_t x_t^H, \qquad n \leftarrow e^{-w T / F} n + w T
        """
        kept = math.exp(-weight * n_frames / self._forgetting)
        total *= np.float32(weight)
        self._sum *= np.float32(kept)
        self._sum += total
        self.n_frames = kept * self.n_frames + weight * n_frames

    def mean(self, bin_index: int) -> Complex64Array:
        """Return the covariance S / n of one bin; the mean of its diagonal is one."""
        return np.asarray(self._sum[bin_index] / np.float32(max(self.n_frames, 1e-30)))

    @property
    def total(self) -> Complex64Array:
        """The weighted sum S, (bins, M, M)."""
        return self._sum


class NoiseLevel:
    """Level of whitened noise relative to white noise, learned like the covariance."""

    def __init__(self, guard_hops: int) -> None:
        self._guard: GuardDelay[float] = GuardDelay(guard_hops)
        self._sum = self._weights = 0.0

    def push(self, level: float, weight: float) -> float:
        r"""Take a hop's level with its weight; return the level learned so far, 1 before any.

        .. math:: c = \frac{\sum_i w_i l_i e^{-W_i / 10}}{\sum_i w_i e^{-W_i / 10}}
        with the weights w of the levels l and W the weight learned since.
        """
        ripe = self._guard.push(level, weight)
        if ripe is not None and ripe[1] > 0.0:
            learned, weight = ripe
            kept = math.exp(-weight / _LEVEL_HOPS)
            self._sum = kept * self._sum + weight * learned
            self._weights = kept * self._weights + weight
        return self._sum / self._weights if self._weights else 1.0
