r"""Boosted regression trees as plain arrays: what a trained classifier leaves to be shipped.

.. math:: P(c \mid x) = \mathrm{softmax}_c \Big( b_c + \sum_{t \in T_c} v_t(x) \Big)

with v_t the value of the leaf that x reaches in tree t.

Source: J. H. Friedman, "Greedy function approximation: a gradient boosting machine", Ann. Statist. 29, 2001.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import freeze_arrays
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IndexArray

# A file from elsewhere must not make a walk of any length or size.
MOST_TREES, MOST_NODES, MOST_INPUTS = 4096, 255, 512
ROWS_AT_ONCE = 64


@dataclass(frozen=True, slots=True, eq=False)
class BoostedTrees:
    """Trees of several classes side by side, padded to one length.

    A node is a question, ``x[split] <= threshold``, that leads to the node `yes` or `no`, or a leaf, which
    leads to itself. A child stands behind its parent, so that every walk ends.

    Examples
    --------
    >>> stump = dict(split=[[0, 0, 0]], threshold=[[0.5, 0, 0]], yes=[[1, 1, 2]], no=[[2, 1, 2]])
    >>> trees = BoostedTrees(**stump, value=[[0.0, -1.0, 1.0]], tree_class=[0], baseline=[0.0, 0.0])
    >>> trees.scores(np.array([[0.2], [0.7]])).tolist()
    [[-1.0, 0.0], [1.0, 0.0]]
    """

    split: IndexArray  # shape (trees, nodes): Which input is asked for
    threshold: FloatArray  # shape (trees, nodes)
    yes: IndexArray  # shape (trees, nodes): Where to go if the input is not above it
    no: IndexArray  # shape (trees, nodes)
    value: FloatArray  # shape (trees, nodes): Of leaves
    tree_class: IndexArray  # shape (trees,): Which class's score a tree adds to
    baseline: FloatArray  # shape (classes,)

    def __post_init__(self) -> None:
        trees, nodes = np.shape(self.split)
        if not (0 < trees <= MOST_TREES and 0 < nodes <= MOST_NODES):
            raise InvalidArgumentError(
                f"split: expected at most {MOST_TREES} trees of {MOST_NODES} nodes, got {(trees, nodes)}"
            )
        for name in ("split", "yes", "no", "tree_class"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.intp))
        grid = (trees, nodes)
        freeze_arrays(self, threshold=grid, value=grid, baseline=(len(self.baseline),))
        here = np.arange(nodes)
        for name in ("yes", "no"):
            to = getattr(self, name)
            # Backwards a walk might never end; a leaf leads to itself.
            if to.shape != grid or (to < here).any() or (to >= nodes).any():
                raise InvalidArgumentError(f"{name}: expected the numbers of later nodes, shape {grid}")
        if ((self.yes == here) != (self.no == here)).any():
            raise InvalidArgumentError("no: expected a leaf to lead to itself on both ways")
        if self.split.shape != grid or self.split.min() < 0 or self.split.max() >= MOST_INPUTS:
            raise InvalidArgumentError(f"split: expected numbers of inputs below {MOST_INPUTS}")
        if (
            self.tree_class.shape != (trees,)
            or not np.isin(self.tree_class, np.arange(len(self.baseline))).all()
        ):
            raise InvalidArgumentError(f"tree_class: expected {trees} numbers of classes")

    @property
    def inputs(self) -> int:
        """Least number of inputs of a row."""
        return int(self.split.max()) + 1

    def scores(self, X: FloatArray) -> FloatArray:
        """Return the sums before the softmax, shape (n, inputs) -> (n, classes)."""
        # A few rows at a time stay in the cache: thousands at once take three times as long.
        some = range(0, len(X), ROWS_AT_ONCE)
        parts = [self._scores(X[first : first + ROWS_AT_ONCE]) for first in some]
        return np.concatenate(parts) if parts else np.zeros((0, len(self.baseline)))

    def _scores(self, X: FloatArray) -> FloatArray:
        # Flat indices: a walk of two rows takes a sixth of what indexing by row and tree takes.
        first = np.arange(len(self.split)) * self.split.shape[1]
        row = np.arange(len(X))[:, None] * X.shape[1]
        node = np.zeros((len(X), len(first)), np.intp)
        while True:
            at = first + node
            # Every tree of every row goes one question further; those in a leaf stay there.
            below = X.take(row + self.split.take(at)) <= self.threshold.take(at)
            following = np.where(below, self.yes.take(at), self.no.take(at))
            if (following == node).all():
                break
            node = following
        # Counted class by class: a product with a matrix of ones takes longer, and its sum of one row differs
        # from that of the same row among others.
        classes = len(self.baseline)
        bins = np.arange(len(X))[:, None] * classes + self.tree_class
        sums = np.bincount(bins.ravel(), self.value.take(first + node).ravel(), len(X) * classes)
        return np.asarray(self.baseline + sums.reshape(-1, classes))
