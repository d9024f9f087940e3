"""One linear expert of an ensemble, and the views of a window that an expert may have."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from worldstate.ground import FloatArray, InvalidArgumentError
from worldstate.ground.checks import freeze_arrays

from .site_reference import KINDS, log_levels

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


SHAPE, SHAPE_CHANGE = "shape", "shape_change"
VIEWS = (*KINDS, SHAPE, SHAPE_CHANGE)


@dataclass(frozen=True, slots=True, eq=False)
class Expert:
    """One linear softmax classifier and its view of the window.

    Examples
    --------
    >>> Expert("mean", np.zeros(6), np.ones(6), np.zeros((4, 6)), np.zeros(4)).view
    'mean'
    """

    # `mean`, `median` or `quiet`: log-levels above that summary of the site; `shape`: a few numbers
    # of the window alone; `shape_change`: how they differ from those of the site's median.
    view: str
    mean: FloatArray  # shape (inputs,): Standardisation; scale > 0
    scale: FloatArray
    weights: FloatArray  # shape (classes, inputs): One row for each class of the model
    intercepts: FloatArray  # shape (classes,): Added to the weighted sums

    def __post_init__(self) -> None:
        if self.view not in VIEWS:
            raise InvalidArgumentError(f"view: expected one of {', '.join(VIEWS)}, got {self.view!r:.40}")
        inputs, classes = np.size(self.mean), np.size(self.intercepts)
        freeze_arrays(self, mean=(inputs,), scale=(inputs,), weights=(classes, inputs), intercepts=(classes,))
        if (self.scale <= 0).any():
            raise InvalidArgumentError("scale: expected positive numbers")

    def sums(self, seen: FloatArray) -> FloatArray:
        r"""Return what the softmax is taken of, shape (n, classes), from its view, shape (n, inputs).

        .. math:: a = W (v - \mu) / \sigma + b

        Shapes: seen (n, inputs).
        """
        return np.asarray((seen - self.mean) / self.scale @ self.weights.T + self.intercepts)


def expert_views(wanted: Collection[str], levels: FloatArray, reference: FloatArray) -> dict[str, FloatArray]:
    r"""Return the views, each of shape (n, inputs); parts that several share are computed once.

    .. math:: v = x - r \text{ (mean, median, quiet)}, \qquad v = \phi(x) \text{ (shape)}, \qquad
              v = \phi(x) - \phi(r_{median}) \text{ (change)}

    with phi by `shape_features`.

    Shapes: levels (n, features), reference (n, 3 * features).
    """
    summaries = dict(zip(KINDS, np.split(reference, len(KINDS), axis=1), strict=True))
    views = {kind: levels - summary for kind, summary in summaries.items() if kind in wanted}
    if SHAPE_CHANGE in wanted:
        # One call for both: of a single window most of it is what calls cost.
        shapes = shape_features(np.concatenate([levels, summaries["median"]]), SEGMENTS)
        views[SHAPE], of_site = shapes[: len(levels)], shapes[len(levels) :]
        views[SHAPE_CHANGE] = views[SHAPE] - of_site
    elif SHAPE in wanted:
        views[SHAPE] = shape_features(levels, SEGMENTS)
    return views


def log_softmax(sums: FloatArray) -> FloatArray:
    r"""Return the rows less the log of their summed exponentials.

    .. math:: \ell_c = a_c - \log \sum_{c'} e^{a_{c'}}

    Shapes: sums (n, classes).
    """
    below = sums - sums.max(axis=1, keepdims=True)
    return np.asarray(below - np.log(total(np.exp(below))))


def total(values: FloatArray) -> FloatArray:
    r"""Return the sums of rows, shape (n, 1), bit-identical under any order of the columns.

    .. math:: s_i = \sum_j x_{ij}

    Shapes: values (n, columns).

    Examples
    --------
    >>> total(np.array([[1.0, 2.0, 3.0]]))
    array([[6.]])
    """
    return np.asarray(np.sort(values, axis=1).sum(axis=1, keepdims=True))


def split_reference(X: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""Part windows with a reference behind them into log-levels and references.

    .. math:: x = \ln \max(X, 10^{-4})

    Shapes: X (n, 4 * features), returns (n, features).

    Examples
    --------
    >>> split_reference(np.array([[1.0, 0.1, 0.2, 0.3]]))
    (array([[0.]]), array([[0.1, 0.2, 0.3]]))
    """
    n_features = X.shape[1] // (1 + len(KINDS))
    return log_levels(X[:, :n_features]), X[:, n_features:]
