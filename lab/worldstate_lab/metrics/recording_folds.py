"""Folds over recordings: no threshold is set on a recording that it is scored on."""

from collections.abc import Sequence

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import IndexArray

# By recording, as in the paper.
FOLDS = 5
_HAZARD_FREE = "none"


def deal_folds(
    labels: Sequence[str], groups: Sequence[str], rng: np.random.Generator, folds: int = FOLDS
) -> IndexArray:
    """Deal recordings to folds so that each holds its share of every label in every group, shape (n,).

    There are never more folds than recordings of the rarer kind, hazard-free or approach.

    Examples
    --------
    >>> labels = ["none", "left"] * 4
    >>> deal_folds(labels, ["SA1"] * 8, np.random.default_rng(0), folds=2)
    array([0, 1, 0, 0, 1, 1, 1, 0])
    """
    free = np.array([label == _HAZARD_FREE for label in labels], dtype=bool)
    counts = int((~free).sum()), int(free.sum())
    if min(*counts, folds) < 2:
        raise InvalidArgumentError(
            f"recordings: expected at least two approaches, two hazard-free ones and two folds, "
            f"got {counts[0]} approaches, {counts[1]} hazard-free ones and {folds} folds"
        )
    keys = [(~free[i], labels[i], groups[i], rng.random()) for i in range(len(labels))]
    order = sorted(range(len(labels)), key=keys.__getitem__)
    fold_of = np.empty(len(labels), dtype=np.intp)
    # Dealing goes on where the last stratum stopped, or the first folds would collect every remainder.
    fold_of[order] = np.arange(len(labels)) % min(*counts, folds)
    return fold_of
