"""Sequence models and streams of random numbers."""

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import COLUMNS, INPUTS
from worldstate.abduction.sequence.sequence_model import GROUPS, BoostedTrees, SequenceAlarm, SequenceModel
from worldstate.ground.typing import FloatArray


def evidence_of(rng: np.random.Generator, hops: int) -> FloatArray:
    """Return the columns of a random walk with occasionally unusable looming."""
    single = rng.normal(size=(7, hops)).cumsum(axis=1)
    refused = rng.random(hops) < 0.3
    single[4, refused] = 0.0
    single[5] = np.where(refused, 10.0, np.minimum(np.abs(single[5]) + 0.01, 10.0))
    sides, bands = (rng.normal(size=(hops, width)).cumsum(axis=0) for width in (2, 4))
    return np.concatenate([sides, single.T, bands], axis=1)


def column(name: str) -> int:
    """Return the index of a named column of streams."""
    return COLUMNS.index(name)


def sequence_model(rng: np.random.Generator, alarm: SequenceAlarm | None = None) -> SequenceModel:
    """Return a model of five stumps per input."""
    trees = 5 * len(INPUTS)
    here = np.tile([0, 1, 2], (trees, 1))
    split, threshold = np.zeros((trees, 3), int), np.zeros((trees, 3))
    split[:, 0], threshold[:, 0] = np.arange(trees) % len(INPUTS), rng.normal(size=trees)
    yes, no = here.copy(), here.copy()
    yes[:, 0], no[:, 0] = 1, 2
    stumps = BoostedTrees(
        *(split, threshold, yes, no, rng.normal(size=(trees, 3))),
        rng.integers(0, len(GROUPS), trees),
        np.zeros(len(GROUPS)),
    )
    share = 0.9 * rng.dirichlet(np.ones(len(GROUPS))) + 0.1 / len(GROUPS)
    return SequenceModel(stumps, share, margin_s=0.2, alarm=alarm)
