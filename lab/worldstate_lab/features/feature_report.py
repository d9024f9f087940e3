"""Figures of an evaluation on feature windows, and the table from which anyone can recompute them."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.abduction.cueing.calibration_error import (
    brier_score,
    calibration_error_sampling,
    expected_calibration_error,
)
from worldstate.abduction.signature.window_classes import CLASSES
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.typing import BoolArray
from worldstate.operations.metrics.roc import auroc, auroc_by_group, macro, rate, worst_rate

from .feature_evaluation import Predictions

# The floor belongs to the risks: another seed in every run would only add noise to it.
FLOOR_SEED = 0
Figures = dict[str, float | None]
POSTERIORS = tuple(f"p_{label}" for label in CLASSES)
COLUMNS = ("seed", "fold", "recording", "environment", "class", *POSTERIORS, "score", "risk", "decision")


def window_figures(table: FeatureTable, predictions: Predictions) -> Figures:
    """Return the figures of one pass over the table."""
    # Hazard windows against hazard-free ones; `front` counts in the 4-class accuracy only.
    scored = table.hazards | table.hazard_free
    hazards, score, risk = table.hazards[scored], predictions.score[scored], predictions.risk[scored]
    floor, floor_std = calibration_error_sampling(risk, np.random.default_rng(FLOOR_SEED))
    by_group = auroc_by_group(score, hazards, table.environments[scored])
    return {
        "accuracy": float(np.mean(predictions.classes == table.labels)),
        "auroc_macro": macro(by_group),
        "auroc_pooled": auroc(score, hazards),
        "worst_group_auroc": min(by_group.values()),
        "tpr": rate(predictions.decision, table.hazards),
        "fpr": rate(predictions.decision, table.hazard_free),
        "worst_group_fpr": worst_rate(predictions.decision, table.hazard_free, table.environments),
        "ece_raw": expected_calibration_error(score, hazards),
        "ece": expected_calibration_error(risk, hazards),
        "ece_floor": floor,
        "ece_floor_std": floor_std,
        "brier_raw": brier_score(score, hazards),
        "brier": brier_score(risk, hazards),
    }


def _group_figures(table: FeatureTable, predictions: Predictions, here: BoolArray) -> Figures:
    """Return accuracy, area and rates of one junction; None where a label is missing there."""
    scored = here & (table.hazards | table.hazard_free)
    return {
        "accuracy": rate(predictions.classes == table.labels, here),
        "auroc": auroc(predictions.score[scored], table.hazards[scored]),
        "tpr": rate(predictions.decision, here & table.hazards),
        "fpr": rate(predictions.decision, here & table.hazard_free),
    }


def report(table: FeatureTable, passes: Sequence[dict[float, Predictions]]) -> dict[str, Any]:
    """Return the mean figures over all passes (seeds), with their standard deviation between seeds."""
    published, absent = ([one[beta] for one in passes] for beta in (1.0, 0.0))
    figures = [window_figures(table, predictions) for predictions in published]
    return {
        **mean_figures(figures),
        **{f"{key}_absent": value for key, value in _absent_figures(table, absent).items()},
        "seed_std": _deviations(figures, ("accuracy", "auroc_macro", "auroc_pooled", "tpr", "fpr", "ece")),
        **count_windows(table),
        "per_group": report_groups(table, published),
    }


def count_windows(table: FeatureTable) -> dict[str, int]:
    """Return the numbers of windows, by what they hold, and of recordings."""
    return {
        "n_windows": len(table),
        "n_hazard": int(table.hazards.sum()),
        "n_hazard_free": int(table.hazard_free.sum()),
        "n_recordings": len(np.unique(table.recording_keys)),
    }


def _deviations(figures: Sequence[Figures], keys: tuple[str, ...]) -> Figures:
    return {key: float(np.std([figure[key] for figure in figures])) for key in keys}  # type: ignore[arg-type]


def mean_figures(figures: Sequence[Figures]) -> Figures:
    """Return the mean of each figure, None where it could not be had.

    Examples
    --------
    >>> mean_figures([{"tpr": 0.5, "fpr": None}, {"tpr": 1.0, "fpr": None}])
    {'tpr': 0.75, 'fpr': None}
    """
    means: Figures = {}
    for key in figures[0]:
        values = [figure[key] for figure in figures if figure[key] is not None]
        means[key] = float(np.mean(values)) if values else None  # type: ignore[arg-type]
    return means


def write_predictions(
    path: str | Path, table: FeatureTable, passes: Sequence[Predictions], seeds: Sequence[int]
) -> None:
    """Write one row a window and seed, whole or not at all; floats as they are, to the last digit."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for seed, predictions in zip(seeds, passes, strict=True):
            writer.writerows([seed, *row] for row in _prediction_rows(table, predictions))


def _prediction_rows(table: FeatureTable, predictions: Predictions) -> list[tuple[object, ...]]:
    columns = (
        predictions.folds,
        table.recordings,
        table.environments,
        table.labels,
        *predictions.probabilities.T,
        predictions.score,
        predictions.risk,
        predictions.decision.astype(int),
    )
    return list(zip(*(column.tolist() for column in columns), strict=True))


def _absent_figures(table: FeatureTable, passes: Sequence[Predictions]) -> Figures:
    figures = mean_figures([window_figures(table, predictions) for predictions in passes])
    del figures["accuracy"]  # The posteriors, and so the classes, are the same.
    return figures


def report_groups(table: FeatureTable, passes: Sequence[Predictions]) -> dict[str, Figures]:
    """Return the figures of each junction, mean over the passes, with its number of windows."""
    figures: dict[str, Figures] = {}
    for environment in np.unique(table.environments).tolist():
        here = table.environments == environment
        means = mean_figures([_group_figures(table, one, here) for one in passes])
        figures[environment] = {"n_windows": int(here.sum()), **means}
    return figures
