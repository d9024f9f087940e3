"""Cross-validation splits that keep a recording in one fold."""

from collections.abc import Callable
from typing import Literal

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import TextArray

Protocol = Literal["cv", "lojo", "transfer"]
PROTOCOLS: tuple[Protocol, ...] = ("cv", "lojo", "transfer")
N_FOLDS = 5

Split = Callable[[FeatureTable, np.random.Generator], TextArray]


def recording_labels(table: FeatureTable) -> dict[str, str]:
    """Return the label of each recording: that of its hazard window where it has one besides ``front``."""
    labels: dict[str, str] = {}
    for key, label in zip(table.recording_keys.tolist(), table.labels.tolist(), strict=True):
        if key not in labels or label != "front":
            labels[key] = label
    return labels


def folds_by_recording(table: FeatureTable, rng: np.random.Generator, n_folds: int = N_FOLDS) -> TextArray:
    """Deal recordings to folds so that each holds its share of every label at every junction."""
    labels = recording_labels(table)
    if len(labels) < n_folds:
        raise InvalidArgumentError(f"expected at least {n_folds} recordings to split, got {len(labels)}")
    strata: dict[tuple[str, str], list[str]] = {}
    for key, label in labels.items():
        strata.setdefault((key.split("/")[0], label), []).append(key)
    # Dealing goes on where the last stratum stopped, or the first folds would collect every remainder.
    dealt = [key for stratum in sorted(strata) for key in rng.permutation(sorted(strata[stratum])).tolist()]
    fold_of = {key: str(position % n_folds) for position, key in enumerate(dealt)}
    return np.array([fold_of[key] for key in table.recording_keys.tolist()])


def junction_folds(table: FeatureTable, rng: np.random.Generator | None = None) -> TextArray:
    """Return the junction of each window: leave one junction out; nothing is drawn."""
    if len(np.unique(table.environments)) < 2:
        raise InvalidArgumentError("expected at least two junctions to leave one out")
    return table.environments


def split_for(protocol: Protocol) -> Split:
    """Return the way a protocol splits; ``transfer`` splits its training set by junction."""
    return folds_by_recording if protocol == "cv" else junction_folds
