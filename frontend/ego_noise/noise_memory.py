"""What is remembered of noise: its covariance, and its level once it is whitened."""

import math

import numpy as np

from worldstate.ground.typing import Complex64Array

from .guard_delay import GuardDelay

# Memory of the level of whitened noise, hops.
_LEVEL_HOPS = 10.0


class NoiseCovariance:
    """Recursive mean of unit-length snapshots' covariance, per bin.

    Examples
    --------
    >>> noise = NoiseCovariance(n_bins=1, n_microphones=2, forgetting_frames=1e6)
    >>> noise.learn(np.array([[[[2.0, 2.0], [2.0, 2.0]]]], np.complex64)[0], n_frames=2, weight=1.0)
    >>> noise.mean(0).real.tolist(), noise.n_frames
    ([[1.0, 1.0], [1.0, 1.0]], 2.0)
    """

    def __init__(self, n_bins: int, n_microphones: int, forgetting_frames: float) -> None:
        self.n_frames = 0.0
        self._sum = np.zeros((n_bins, n_microphones, n_microphones), np.complex64)
        self._forgetting = forgetting_frames

    def learn(self, total: Complex64Array, n_frames: int, weight: float) -> None:
        r"""Take a hop's sum (bins, M, M) over so many frames, with a weight in (0, 1]; `total` is consumed.

        .. math:: S \leftarrow e^{-w T / F} S + w \sum_t x_t x_t^H, \qquad n \leftarrow e^{-w T / F} n + w T

        Shapes: total (bins, M, M).
        """
        kept = math.exp(-weight * n_frames / self._forgetting)
        total *= np.float32(weight)
        self._sum *= np.float32(kept)
        self._sum += total
        self.n_frames = kept * self.n_frames + weight * n_frames

    def mean(self, bin_index: int) -> Complex64Array:
        r"""Covariance of one bin; the mean of its diagonal is one.

        .. math:: \hat R = S / n

        References
        ----------
        As for `NoiseCovariance.learn`, after D. E. Tyler 1987.
        """
        return np.asarray(self._sum[bin_index] / np.float32(max(self.n_frames, 1e-30)))

    @property
    def total(self) -> Complex64Array:
        """Sum that the mean is made of, (bins, M, M)."""
        return self._sum


class NoiseLevel:
    """Level of whitened noise over that of white noise, learned like the covariance.

    Examples
    --------
    >>> level = NoiseLevel(guard_hops=0)
    >>> level.push(3.0, 1.0), level.push(9.0, 0.0), level.push(5.0, 1.0)
    (3.0, 3.0, 4.04...)
    """

    def __init__(self, guard_hops: int) -> None:
        self._guard: GuardDelay[float] = GuardDelay(guard_hops)
        self._sum = self._weights = 0.0

    def push(self, level: float, weight: float) -> float:
        r"""Take a hop's level with the weight of the gate; return the level learned, 1 before there is any.

        .. math:: c = \frac{\sum_i w_i l_i e^{-W_i / 10}}{\sum_i w_i e^{-W_i / 10}}
        """
        # over the levels l with the weights w, W being the weight learned since.
        ripe = self._guard.push(level, weight)
        if ripe is not None and ripe[1] > 0.0:
            learned, weight = ripe
            kept = math.exp(-weight / _LEVEL_HOPS)
            self._sum = kept * self._sum + weight * learned
            self._weights = kept * self._weights + weight
        return self._sum / self._weights if self._weights else 1.0
