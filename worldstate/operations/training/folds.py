"""Folds that keep a recording whole, and posteriors of windows by classifiers that did not see their fold."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from worldstate.abduction.signature.window_classes import CLASSES
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, TextArray

N_FOLDS = 5

Trained = TypeVar("Trained")


def recording_labels(table: FeatureTable) -> dict[str, str]:
    """Return the label of each recording: that of its hazard window where it has one besides ``front``."""
    labels: dict[str, str] = {}
    for key, label in zip(table.recording_keys.tolist(), table.labels.tolist(), strict=True):
        if key not in labels or label != "front":
            labels[key] = label
    return labels


def folds_by_recording(table: FeatureTable, rng: np.random.Generator) -> TextArray:
    """Deal recordings to folds so that each holds its share of every label at every junction."""
    labels = recording_labels(table)
    if len(labels) < N_FOLDS:
        raise InvalidArgumentError(f"expected at least {N_FOLDS} recordings to split, got {len(labels)}")
    strata: dict[tuple[str, str], list[str]] = {}
    for key, label in labels.items():
        strata.setdefault((key.split("/")[0], label), []).append(key)
    # Dealing goes on where the last stratum stopped, or the first folds would collect every remainder.
    dealt = [key for stratum in sorted(strata) for key in rng.permutation(sorted(strata[stratum])).tolist()]
    fold_of = {key: str(position % N_FOLDS) for position, key in enumerate(dealt)}
    return np.array([fold_of[key] for key in table.recording_keys.tolist()])


def junction_folds(table: FeatureTable) -> TextArray:
    """Return the junction of each window: leave one junction out."""
    if len(np.unique(table.environments)) < 2:
        raise InvalidArgumentError("expected at least two junctions to leave one out")
    return table.environments


def out_of_fold(
    table: FeatureTable,
    folds: TextArray,
    fit: Callable[[FeatureTable], Trained],
    ask: Callable[[Trained, BoolArray], FloatArray],
) -> FloatArray:
    """Return posteriors of each window from a classifier trained on the other folds, shape (n, 4).

    `ask` returns those of the chosen rows of `table`, shape (rows, 4).
    """
    probabilities = np.empty((len(table), len(CLASSES)))
    for fold in np.unique(folds):
        held_out = folds == fold
        probabilities[held_out] = ask(fit(table.select(~held_out)), held_out)
    return probabilities
