"""Figures of released windows on every bootstrap sample of their recordings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.calibration_error import brier_score, expected_calibration_error
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.operations.metrics.roc import auroc, worst_rate
from worldstate.operations.training.feature_evaluation import Predictions
from worldstate.operations.training.splits import recording_labels
from worldstate_lab.metrics.recording_draws import DRAWS, FigureDraws, stratified_draws

FIGURES = (
    "accuracy",
    "auroc_macro",
    "auroc_pooled",
    "worst_group_auroc",
    "tpr",
    "fpr",
    "worst_group_fpr",
    "ece",
    "brier",
)


def recording_draws(table: FeatureTable, rng: np.random.Generator, draws: int = DRAWS) -> list[IndexArray]:
    """Return the windows of recordings drawn with replacement, within each label at each junction."""
    keys, labels = table.recording_keys, recording_labels(table)
    rows = [np.flatnonzero(keys == key) for key in labels]
    strata = [(key.split("/")[0], label) for key, label in labels.items()]
    return [np.concatenate([rows[i] for i in one]) for one in stratified_draws(strata, rng, draws)]


def draw_figures(
    table: FeatureTable, passes: Sequence[Predictions], samples: Sequence[IndexArray]
) -> FigureDraws:
    """Return the figures on every sample, mean over the passes (seeds)."""
    # The mean ECE of bootstrap samples lies above that of the sample itself: read its interval as a width.
    outcomes = [_Outcome.of(table, predictions) for predictions in passes]
    figures = np.array([[outcome.figures(rows) for rows in samples] for outcome in outcomes]).mean(axis=0)
    return FigureDraws(dict(zip(FIGURES, figures.T, strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class _Outcome:
    """Labels and predictions side by side, as plain arrays of shape (n,)."""

    hazards: BoolArray
    hazard_free: BoolArray
    sites: IndexArray
    correct: BoolArray
    score: FloatArray
    risk: FloatArray
    decision: BoolArray

    @classmethod
    def of(cls, table: FeatureTable, one: Predictions) -> "_Outcome":
        sites = np.unique(table.environments, return_inverse=True)[1]
        correct = one.classes == table.labels
        return cls(table.hazards, table.hazard_free, sites, correct, one.score, one.risk, one.decision)

    def figures(self, rows: IndexArray) -> list[float]:
        """Return one number for each of `FIGURES`."""
        hazards, hazard_free, decision = self.hazards[rows], self.hazard_free[rows], self.decision[rows]
        scored = rows[hazards | hazard_free]
        labels, score, risk, sites = (a[scored] for a in (self.hazards, self.score, self.risk, self.sites))
        areas = [auroc(score[sites == site], labels[sites == site]) for site in np.unique(sites)]
        known = [area for area in areas if area is not None]
        return [
            float(self.correct[rows].mean()),
            float(np.mean(known)),
            auroc(score, labels) or 0.0,
            min(known),
            float(decision[hazards].mean()),
            float(decision[hazard_free].mean()),
            worst_rate(decision, hazard_free, self.sites[rows]),
            expected_calibration_error(risk, labels),
            brier_score(risk, labels),
        ]
