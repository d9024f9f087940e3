"""The pattern of a window over azimuth: its mirror image, peaks, widths, sides and changes."""

import numpy as np

from worldstate.ground.typing import FloatArray

SEGMENTS = 2


def mirror_features(X: FloatArray, segments: int = SEGMENTS) -> FloatArray:
    r"""Return the features of the mirrored scene: azimuths reversed within each segment.

    .. math:: \bar x_{s,a} = x_{s, A - 1 - a}

    Shapes: X (n, segments * azimuths).
    """
    return X.reshape(len(X), segments, -1)[:, :, ::-1].reshape(X.shape)


_SHARPNESS = 4.0


def shape_features(levels: FloatArray, segments: int = 2) -> FloatArray:
    r"""Return peaks, sides, widths and changes of log-levels over directions, shape (n, 13 * segments + 5).

    .. math:: p = \sum_a w_a u_a, \qquad \sigma^2 = \sum_a w_a u_a^2 - p^2, \qquad
              w_a \propto e^{4 (x_a - \max x)}, \quad \sum_a w_a = 1

    Shapes: levels (n, segments * directions).
    """
    # are side and width, u running from -1 to 1; the others are extremes, means, deviations and differences.
    #
    # Mirroring the directions exchanges the sides and changes the sign of what points to one.
    stretches = levels.reshape(len(levels), segments, -1)
    by_segment = np.stack(_columns(stretches), axis=2).reshape(len(levels), -1)
    change = np.stack(_change(stretches[:, 0], stretches[:, -1]), axis=1)
    return np.concatenate([by_segment, change], axis=1)


def _columns(levels: FloatArray) -> list[FloatArray]:
    """Numbers of each stretch, every one of shape (n, segments)."""
    n_directions = levels.shape[2]
    peak, middle = levels.max(axis=2), np.median(levels, axis=2)
    third = n_directions // 3
    first = levels[:, :, :third].max(axis=2)
    centre = levels[:, :, third : n_directions - third].max(axis=2)
    last = levels[:, :, n_directions - third :].max(axis=2)
    position, width = _centroid(levels)
    heights = [peak, middle, levels.min(axis=2), peak - middle]
    sides = [first, centre, last, first - last, position, np.abs(position)]
    return [*heights, *sides, levels.std(axis=2), width, np.diff(levels, axis=2).std(axis=2)]


def _centroid(levels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and spread of the direction, on [-1, 1], weighted by the levels above their peak's foot."""
    direction = np.linspace(-1.0, 1.0, levels.shape[2])
    weights = np.exp(_SHARPNESS * (levels - levels.max(axis=2, keepdims=True)))
    weights /= weights.sum(axis=2, keepdims=True)
    # Sums, not products of matrices: a row then comes out to the bit the same among whatever others.
    position, square = (weights * direction).sum(axis=2), (weights * direction**2).sum(axis=2)
    return position, np.sqrt(np.maximum(square - position**2, 0.0))


def _change(first: FloatArray, last: FloatArray) -> list[FloatArray]:
    change = last - first
    peak = last.max(axis=1) - first.max(axis=1)
    return [change.max(axis=1), change.min(axis=1), change.mean(axis=1), peak, change.std(axis=1)]
