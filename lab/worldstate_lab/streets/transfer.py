"""What the published classifier, trained on one set of windows, makes of another."""

from dataclasses import dataclass

import numpy as np

from worldstate.abduction.signature.published_training import PublishedClassifier
from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.typing import FloatArray, IndexArray
from worldstate.operations.metrics.roc import auroc
from worldstate_lab.metrics.intervals import Interval, middle, recording_draws

DRAWS = 500


@dataclass(frozen=True, slots=True)
class Transfer:
    """Hidden against empty windows of one set, by a classifier trained on another."""

    windows: int
    auroc: float  # Area of the classifier and of the loudest direction on the same windows
    scalar: float
    gain: Interval | None  # Middle 95 % of their difference over bootstrap samples of recordings


def published_transfer(
    train: FeatureTable, test: FeatureTable, rng: np.random.Generator, draws: int = 0
) -> Transfer:
    """Train on one set and rank the windows of another; intervals where `draws` are asked for."""
    score = trained_score(train, rng, test.features)
    loudest = test.features.max(axis=1)
    gains = [
        area_of(score, test, rows) - area_of(loudest, test, rows)
        for rows in (recording_draws(test, rng, draws) if draws else ())
    ]
    used = int((test.hazards | test.hazard_free).sum())
    interval = middle(np.array(gains)) if gains else None
    return Transfer(used, area_of(score, test), area_of(loudest, test), interval)


def trained_score(train: FeatureTable, rng: np.random.Generator, features: FloatArray) -> FloatArray:
    """Return P(hidden) over P(hidden) + P(none) of features, by the published classifier on log features."""
    # Logarithms travel better than raw features (.98 for .95 from real to simulated sound), and front windows
    # are neither hidden nor empty: they do not enter the ratio.
    classifier = PublishedClassifier(rng).fit(np.log(train.features), train.labels)
    return hazard_statistic(classifier.predict_proba(np.log(features)), miss_rate=0.0)


def area_of(score: FloatArray, table: FeatureTable, rows: IndexArray | None = None) -> float:
    """Return the area of hidden above empty windows, NaN where a class is missing."""
    rows = np.arange(len(table)) if rows is None else rows
    scored = rows[(table.hazards | table.hazard_free)[rows]]
    area = auroc(score[scored], table.hazards[scored])
    return float("nan") if area is None else area
