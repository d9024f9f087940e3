"""Intervals of figures, and of differences between methods, by drawing recordings again and again."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.calibration_error import brier_score, expected_calibration_error
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.operations.metrics.roc import auroc
from worldstate.operations.training.feature_evaluation import Predictions
from worldstate.operations.training.splits import recording_labels

# Twelve samples lie beyond each end of the interval.
DRAWS = 500
COVERAGE = 0.95
FIGURES = ("accuracy", "auroc_macro", "auroc_pooled", "worst_group_auroc", "tpr", "fpr", "ece", "brier")

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class FigureDraws:
    """Figures of one method on every bootstrap sample; the same samples for every method.

    Examples
    --------
    >>> low, high = FigureDraws({"tpr": np.linspace(0.0, 40.0, 41)}).interval("tpr")
    >>> round(low, 3), round(high, 3)
    (1.0, 39.0)
    """

    values: Mapping[str, FloatArray]  # shape (draws,): For each of `FIGURES`

    def interval(self, figure: str) -> Interval:
        """Return the middle 95 %."""
        return _middle(self.values[figure])

    def intervals(self) -> dict[str, Interval]:
        """Return the middle 95 % of every figure."""
        return {figure: self.interval(figure) for figure in self.values}

    def gains(self, other: "FigureDraws") -> dict[str, Interval]:
        """Return the middle 95 % of the difference to another method on the same samples."""
        return {figure: _middle(self.values[figure] - other.values[figure]) for figure in self.values}


def recording_draws(table: FeatureTable, rng: np.random.Generator, draws: int = DRAWS) -> list[IndexArray]:
    """Draw recordings with replacement, as many of each label at each junction as there are."""
    keys = table.recording_keys
    rows = {key: np.flatnonzero(keys == key) for key in np.unique(keys).tolist()}
    strata: dict[tuple[str, str], list[IndexArray]] = {}
    for key, label in recording_labels(table).items():
        strata.setdefault((key.split("/")[0], label), []).append(rows[key])
    return [np.concatenate(_resampled(strata.values(), rng)) for _ in range(draws)]


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
            expected_calibration_error(risk, labels),
            brier_score(risk, labels),
        ]


def _resampled(strata: Iterable[list[IndexArray]], rng: np.random.Generator) -> list[IndexArray]:
    drawn = ((members, rng.integers(len(members), size=len(members))) for members in strata)
    return [members[i] for members, chosen in drawn for i in chosen]


def _middle(values: FloatArray) -> Interval:
    tail = (1.0 - COVERAGE) / 2.0
    low, high = np.quantile(values, [tail, 1.0 - tail]).tolist()
    return low, high
