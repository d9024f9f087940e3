"""Figures of signature and cueing on labelled windows, every row beside the others, with paired intervals."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from scipy.special import bdtrc

from worldstate.abduction.cueing.calibration_error import (
    brier_score,
    calibration_error_sampling,
    expected_calibration_error,
)
from worldstate.abduction.signature.ensemble_training import SimulatedWindows
from worldstate.abduction.signature.window_classes import CLASSES
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.operations.metrics.roc import auroc, auroc_by_group, macro, rate, worst_rate
from worldstate.operations.training.window_calibration import ABSENT_MISS_RATE
from worldstate_lab.metrics.intervals import DRAWS, middle, paired_gains, recording_draws

from .feature_evaluation import Predictions, Protocol, evaluate_pass
from .methods import ROWS, Passes, methods

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


# The same samples for every method and run: the differences between methods are paired.
BOOTSTRAP_SEED = 0
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


def run_passes(
    names: Sequence[str],
    table: FeatureTable,
    protocol: Protocol,
    *,
    seeds: int,
    alpha: float,
    train: FeatureTable | None = None,
    simulated: SimulatedWindows | None = None,
    jobs: int = 1,
    on_pass: Callable[[], None] = lambda: None,
) -> dict[str, Passes]:
    """Run every seed of every method; the outcome does not depend on the number of jobs."""
    known = methods(simulated)
    tasks = [(name, seed) for name in names for seed in range(seeds)]
    run = delayed(evaluate_pass)
    outcomes = Parallel(n_jobs=jobs, return_as="generator")(
        run(known[name], table, protocol, seed=seed, alpha=alpha, train=train) for name, seed in tasks
    )
    passes: dict[str, Passes] = {name: [] for name in names}
    for (name, _), outcome in zip(tasks, outcomes, strict=True):
        passes[name].append(outcome)
        on_pass()
    return passes


def comparison(
    table: FeatureTable, passes: Mapping[str, Passes], row: str, alpha: float, draws: int = DRAWS
) -> dict[str, Any]:
    """Return the figures of one row, those of all others, and what the one gains on each.

    Parameters
    ----------
    table : FeatureTable
        Windows that were predicted.
    passes : mapping of str to list
        From `run_passes`.
    row : str
        Name in `ROWS` of the one that the plain keys are of.
    alpha : float
        Budget, for the test of the achieved false-positive rate.
    draws : int
        Bootstrap samples behind the intervals.

    Raises
    ------
    InvalidArgumentError
        If there are no passes of that row's method.

    Returns
    -------
    dict
        Figures of the row, its intervals, the other rows, and the gains.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> labels, keys = np.repeat(["left", "none", "right", "front"], 20), np.arange(80).astype(str)
    >>> features = np.where(labels == "none", 0.1, 0.2)[:, None] * rng.lognormal(0.0, 0.2, (80, 60))
    >>> table = FeatureTable(features, labels, keys, np.tile(["SA1", "SB1"], 40), keys, (None,) * 80)
    >>> passes = run_passes(["baseline"], table, "cv", seeds=1, alpha=0.1)
    >>> comparison(table, passes, "baseline", alpha=0.1, draws=20)["auroc_pooled"] > 0.9
    True
    """
    chosen = {name: row_predictions(passes, name) for name in ROWS if ROWS[name].method in passes}
    if row not in chosen:
        raise InvalidArgumentError(f"method: expected passes of {row}, got {', '.join(passes)}")
    samples = recording_draws(table, np.random.default_rng(BOOTSTRAP_SEED), draws)
    drawn = {name: draw_figures(table, mine, samples) for name, mine in chosen.items()}
    rows = {name: _row_figures(table, mine, drawn[name], alpha) for name, mine in chosen.items()}
    others = [name for name in rows if name != row]
    return {
        **rows[row],
        "statistic": "absent" if ROWS[row].miss_rate == ABSENT_MISS_RATE else "published",
        **count_windows(table),
        "per_group": report_groups(table, chosen[row]),
        "rows": {name: rows[name] for name in others},
        "gains": {
            name: _gains(rows[row], rows[name], paired_gains(drawn[row], drawn[name])) for name in others
        },
    }


def row_predictions(passes: Mapping[str, Passes], row: str) -> list[Predictions]:
    """Return the predictions of one row, seed by seed."""
    return [one[ROWS[row].miss_rate] for one in passes[ROWS[row].method]]


def _row_figures(
    table: FeatureTable, passes: Sequence[Predictions], draws: Mapping[str, FloatArray], alpha: float
) -> dict[str, Any]:
    figures = mean_figures([window_figures(table, one) for one in passes])
    n = int(table.hazard_free.sum())
    # Probability of as many false positives or more, were the true rate the budget.
    p_value = float(bdtrc(round((figures["fpr"] or 0.0) * n) - 1, n, alpha))
    return {
        **figures,
        "fpr_p_value": p_value,
        "intervals": {name: middle(one) for name, one in draws.items()},
    }


def _gains(
    ours: Mapping[str, Any], theirs: Mapping[str, Any], intervals: Mapping[str, tuple[float, float]]
) -> dict[str, dict[str, float]]:
    return {
        figure: {"gain": ours[figure] - theirs[figure], "low": low, "high": high}
        for figure, (low, high) in intervals.items()
    }


def draw_figures(
    table: FeatureTable, passes: Sequence[Predictions], samples: Sequence[IndexArray]
) -> dict[str, FloatArray]:
    """Return the figures on every bootstrap sample of recordings, mean over the passes (seeds)."""
    # The mean ECE of bootstrap samples lies above that of the sample itself: read its interval as a width.
    measures = [_figures_on(table, one) for one in passes]
    figures = np.array([[measure(rows) for rows in samples] for measure in measures]).mean(axis=0)
    return dict(zip(FIGURES, figures.T, strict=True))


def _figures_on(table: FeatureTable, one: Predictions) -> Callable[[IndexArray], list[float]]:
    """Return what forms one number for each of `FIGURES` from some rows."""
    hazards, hazard_free, correct = table.hazards, table.hazard_free, one.classes == table.labels
    sites = np.unique(table.environments, return_inverse=True)[1]

    def figures(rows: IndexArray) -> list[float]:
        scored = rows[(hazards | hazard_free)[rows]]
        labels, score, risk, there = (values[scored] for values in (hazards, one.score, one.risk, sites))
        areas = [auroc(score[there == site], labels[there == site]) for site in np.unique(there)]
        known = [area for area in areas if area is not None]
        decision = one.decision[rows]
        return [
            float(correct[rows].mean()),
            float(np.mean(known)),
            auroc(score, labels) or 0.0,
            min(known),
            float(decision[hazards[rows]].mean()),
            float(decision[hazard_free[rows]].mean()),
            worst_rate(decision, hazard_free[rows], sites[rows]),
            expected_calibration_error(risk, labels),
            brier_score(risk, labels),
        ]

    return figures
