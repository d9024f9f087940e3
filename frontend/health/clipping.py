"""Clipping: samples that accumulate at one extreme value of a channel, whatever that value is."""

import numpy as np

from worldstate.ground.typing import Float32Array, FloatArray

# Width of the interval below an extreme, in halves of the span: an unclipped sound has more samples there
# than at the extreme itself.
_SHELL = np.float32(0.1)
# Step to the next value, in halves of the span, from which coarse quantisation would be taken for clipping.
_COARSE = np.float32(0.02)
# Fewer samples at the extreme occur by chance.
_MIN_COUNT = 16


class ClippingCounter:
    """Count samples at and just below the highest and the lowest value of every channel."""

    # An unclipped sound reaches its extreme once and the values just below it more often; a clipped one stays
    # at it. Only hops that reach the extreme again are counted, so that a clean stream costs nothing; a new
    # extreme restarts the count, because the old one was no clipping level.

    def __init__(self, n_channels: int) -> None:
        self._n_samples = 0
        self._extreme = np.full((2, n_channels), -np.inf, np.float32)
        self._at = np.zeros((2, n_channels), np.int64)
        self._below = np.zeros((2, n_channels), np.int64)

    def push(self, samples: Float32Array, lowest: Float32Array, highest: Float32Array) -> None:
        r"""Take the samples (n, M) of a hop and their extremes (M,).

        .. math:: n_{at} = \#\{x = x_{max}\}, \qquad
                  n_{below} = \#\{x_{max} - \tfrac1{20} s \le x < x_{max}\}

        Shapes: samples (n, M), lowest, highest (M,).
        """
        # Counted for x and for -x; s is the span of the hop.
        self._n_samples += len(samples)
        span = highest - lowest
        self._side(0, np.float32(1.0), samples, highest, span)
        self._side(1, np.float32(-1.0), samples, -lowest, span)

    def _side(
        self,
        side: int,
        sign: np.float32,
        samples: Float32Array,
        top: Float32Array,
        span: Float32Array,
    ) -> None:
        extreme, at, below = self._extreme[side], self._at[side], self._below[side]
        reached = np.flatnonzero((top == extreme) & (span > 0.0))
        higher = top > extreme
        extreme[higher], at[higher], below[higher] = top[higher], 0, 0
        if len(reached):
            values = sign * samples[:, reached]
            is_at = values == extreme[reached]
            n_at = is_at.sum(axis=0)
            half = np.float32(0.5) * span[reached]
            n_below = (values >= extreme[reached] - _SHELL * half).sum(axis=0) - n_at
            next_level = values.max(axis=0, where=~is_at, initial=-np.inf)
            fine = extreme[reached] - next_level < _COARSE * half
            at[reached] += n_at * fine
            below[reached] += n_below * fine

    def clipped_share(self) -> FloatArray:
        r"""Share of all samples at a clipping level, shape (M,); 0 for channels without one.

        .. math:: q = \frac1n \sum_{sides} n_{at}\, [n_{at} \ge 16,\; n_{at} > n_{below}]
        """
        clipped = np.where((self._at >= _MIN_COUNT) & (self._at > self._below), self._at, 0)
        return np.asarray(clipped.sum(axis=0) / max(self._n_samples, 1))
