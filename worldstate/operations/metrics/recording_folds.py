"""Folds over recordings: no threshold is set on a recording that it is scored on."""

from collections.abc import Sequence

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.typing import IntArray


def recording_folds(labels: Sequence[str], folds: int, rng: np.random.Generator) -> IntArray:
    """Deal recordings to folds at random, each label in its turn."""
    in_range("folds", folds, 1, 100_000)
    order = rng.permutation(len(labels))
    order = order[np.argsort([labels[i] for i in order], kind="stable")]
    dealt = np.empty(len(labels), dtype=np.int64)
    dealt[order] = np.arange(len(labels)) % folds
    return dealt
