"""`worldstate-lab windows`: performance of signature and cueing on labelled feature windows.

Evaluate a signature classifier and its cueing on labelled feature windows.

  --protocol cv        5 folds by recording, stratified by label and junction
  --protocol lojo      leave one junction out
  --protocol transfer  train on windows of a standing ego, predict those of --group

  --method baseline    as published: standardise, linear SVC, left/right mirroring; P(left) + P(right)
  --method worldstate  windows relative to the average of their site; mirror-symmetric ensemble; eq. (6)
                       without the visible explanation. "rows" and "gains" compare it with the baseline
                       and with itself under the other references. Under transfer it is one expert of the
                       pattern above the site's quiet windows, its risks shifted until hazards are as frequent
                       as in training, and the ensemble is a row

  --reference run      as in `run`: learned from the ten preceding windows of a second, drawn from other
                       recordings of the junction, one in twenty of them a hazard; no label is used
  --reference cold     the mean of the training sites: a car in its first second
  --reference curated  all windows of the junction's other recordings, half of them hazards: no car has it

Thresholds and risk maps are set on inner out-of-fold scores of windows with the same reference as the scored
ones, under `run` with five drawn streams, as in `model fit`. Figures are means over the seeds; intervals are
the middle 95 % of 500 bootstrap samples of recordings, the same for every method.

--model evaluates a finished model; it is refused if it was trained on these recordings.

Examples
--------
  worldstate-lab windows features.csv --group static --protocol lojo --json
  worldstate-lab windows features.csv --model model.json --only testset.csv
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from worldstate.abduction.cueing.risk_map import brier_score, expected_calibration_error
from worldstate.abduction.signature.ensemble_training import SimulatedWindows
from worldstate.adapters.datasets.feature_table import FeatureTable, read_features, read_ids
from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.command import add_choice
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.cli.model.fit import add_table_options, read_beside
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IndexArray
from worldstate.operations.metrics.approach_table import auroc, mean_of
from worldstate_lab.features.feature_evaluation import (
    Predictions,
    Protocol,
    evaluate_pass,
    methods,
    predict_held_out,
    row_of,
    rows_beside,
)
from worldstate_lab.metrics.intervals import (
    DRAWS,
    auroc_by_group,
    calibration_error_sampling,
    middle,
    paired_gains,
    recording_draws,
)

# The floor depends on the risks alone: another seed per run would only add noise.
FLOOR_SEED = 0
Figures = dict[str, float | None]


def window_figures(table: FeatureTable, predictions: Predictions) -> Figures:
    """Return the figures of one pass over the table."""
    risk = predictions.risk[table.hazards | table.hazard_free]
    floor, floor_std = calibration_error_sampling(risk, np.random.default_rng(FLOOR_SEED))
    found = _figures_on(table, predictions)(np.arange(len(table)))
    return found | {"ece_floor": floor, "ece_floor_std": floor_std}


def _figures_on(table: FeatureTable, one: Predictions) -> Callable[[IndexArray], Figures]:
    """Return a function from rows to their figures: hazard windows against hazard-free ones."""
    # `front` is used in the 4-class accuracy only.
    hazards, hazard_free, correct = table.hazards, table.hazard_free, one.classes == table.labels
    sites = np.unique(table.environments, return_inverse=True)[1]

    def figures(rows: IndexArray) -> Figures:
        scored = rows[(hazards | hazard_free)[rows]]
        labels, score, risk = hazards[scored], one.score[scored], one.risk[scored]
        by_site, decision = auroc_by_group(score, labels, sites[scored]), one.decision[rows]
        if not by_site:
            raise InvalidArgumentError("junctions: expected one with hazard and hazard-free windows")
        free, at = hazard_free[rows], sites[rows]
        false = [float(decision[free & (at == site)].mean()) for site in np.unique(at[free])]
        return {
            "accuracy": float(correct[rows].mean()),
            "auroc_macro": float(np.mean(list(by_site.values()))),
            "auroc_pooled": auroc(score, labels),
            "worst_group_auroc": min(by_site.values()),
            "tpr": mean_of(decision[hazards[rows]]),
            "fpr": mean_of(decision[free]),
            "worst_group_fpr": max(false),
            "ece": expected_calibration_error(risk, labels),
            "brier": brier_score(risk, labels),
        }

    return figures


def report(table: FeatureTable, predictions: Predictions) -> dict[str, Any]:
    """Return the figures of one pass, and counts."""
    return {**window_figures(table, predictions), **count_windows(table)}


def count_windows(table: FeatureTable) -> dict[str, int]:
    """Return the numbers of windows by class, and of recordings."""
    return {
        "n_windows": len(table),
        "n_hazard": int(table.hazards.sum()),
        "n_hazard_free": int(table.hazard_free.sum()),
        "n_recordings": len(np.unique(table.recording_keys)),
    }


def mean_figures(figures: Sequence[Figures]) -> Figures:
    """Return the mean of each figure, None if it is not defined.

    Examples
    --------
    >>> mean_figures([{"tpr": 0.5, "fpr": None}, {"tpr": 1.0, "fpr": None}])
    {'tpr': 0.75, 'fpr': None}
    """
    return {
        key: mean_of([value for figure in figures if (value := figure[key]) is not None])
        for key in figures[0]
    }


# The same samples for every method and run, so that differences between methods are paired.
BOOTSTRAP_SEED = 0


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
) -> dict[str, list[Predictions]]:
    """Run every seed of every method; the result does not depend on the number of jobs."""
    known = methods(simulated)
    tasks = [(name, seed) for name in names for seed in range(seeds)]
    run = delayed(evaluate_pass)
    outcomes = Parallel(n_jobs=jobs, return_as="generator")(
        run(known[name], table, protocol, seed=seed, alpha=alpha, train=train) for name, seed in tasks
    )
    passes: dict[str, list[Predictions]] = {name: [] for name in names}
    for (name, _), outcome in zip(tasks, outcomes, strict=True):
        passes[name].append(outcome)
        on_pass()
    return passes


def comparison(
    table: FeatureTable, passes: Mapping[str, Sequence[Predictions]], row: str, draws: int = DRAWS
) -> dict[str, Any]:
    """Return the figures of one row, those of all others, and its gains over each.

    Parameters
    ----------
    table : FeatureTable
        Predicted windows.
    passes : mapping of str to list
        From `run_passes`.
    row : str
        Method of the plain keys.
    draws : int
        Number of bootstrap samples.

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
    >>> comparison(table, passes, "baseline", draws=20)["auroc_pooled"] > 0.9
    True
    """
    samples = recording_draws(table, np.random.default_rng(BOOTSTRAP_SEED), draws)
    drawn = {name: draw_figures(table, mine, samples) for name, mine in passes.items()}
    rows: dict[str, dict[str, Any]] = {
        name: mean_figures([window_figures(table, one) for one in mine])
        | {"intervals": {figure: middle(values) for figure, values in drawn[name].items()}}
        for name, mine in passes.items()
    }
    others = [name for name in rows if name != row]
    return {
        **rows[row],
        **count_windows(table),
        "rows": {name: rows[name] for name in others},
        "gains": {
            name: {
                figure: {"gain": rows[row][figure] - rows[name][figure], "low": low, "high": high}
                for figure, (low, high) in paired_gains(drawn[row], drawn[name]).items()
            }
            for name in others
        },
    }


def draw_figures(
    table: FeatureTable, passes: Sequence[Predictions], samples: Sequence[IndexArray]
) -> dict[str, FloatArray]:
    """Return the figures on every bootstrap sample of recordings, mean over the passes (seeds)."""
    # The mean ECE of bootstrap samples is larger than that of the sample, so only the width of its interval
    # is meaningful.
    measures = [_figures_on(table, one) for one in passes]
    found = [[measure(rows) for rows in samples] for measure in measures]
    draws = {name: [[one[name] for one in mine] for mine in found] for name in found[0][0]}
    return {name: np.array(values, float).mean(axis=0) for name, values in draws.items()}


# Gains in the table; the JSON object has all of them.
SHOWN_GAINS = ("accuracy", "auroc_macro", "auroc_pooled", "tpr", "brier")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add_table_options(parser)
    add_choice(parser, "--method", "", "worldstate", "baseline")
    add_choice(parser, "--protocol", "unit that is held out", "cv", "lojo", "transfer")
    add_choice(parser, "--reference", "reference of the windows", "run", "cold", "curated")
    add("--model", type=Path, help="evaluate this model file without cross-validation")
    only = "CSV file with a column ID: use only the windows of these recordings"
    add("--only", type=Path, metavar="IDS", help=only)
    add("--alpha", type=float, default=0.02, help="false-positive budget (default: 0.02)")
    add("--seeds", type=int, default=5, metavar="N", help="seeds 0 to N - 1 (default: 5)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    whole = read_features(arguments.table)
    table = whole.group(arguments.group)
    if arguments.only is not None:
        table = table.only(read_ids(arguments.only))
    given = ("method", "protocol", "group", "reference", "seeds", "alpha")
    origin: dict[str, Any] = {name: getattr(arguments, name) for name in given}
    if arguments.model is not None:
        model, rng = read_model(arguments.model), np.random.default_rng(0)
        predictions = predict_held_out(model, table, arguments.alpha, arguments.reference, rng)
        origin |= {"method": "model", "protocol": "held-out", "seeds": 1}
        figures = origin | report(table, predictions)
    else:
        row = row_of(arguments.method, arguments.protocol, arguments.reference)
        figures = origin | {"row": row} | comparison(table, _passes(arguments, whole, table, row), row)
    return CommandResult(figures, table=_flat(figures))


def _passes(
    arguments: argparse.Namespace, whole: FeatureTable, table: FeatureTable, row: str
) -> dict[str, list[Predictions]]:
    """Run every seed of the method and of its peers."""
    in_range("--seeds", arguments.seeds, 1, 10_000)
    afar = arguments.protocol == "transfer"
    if afar and arguments.group != "dynamic":
        raise InvalidArgumentError("--protocol transfer: expected --group dynamic, training uses static")
    names = (row, *rows_beside(row, arguments.protocol, arguments.reference))
    with progress_bar("evaluating", arguments.seeds * len(names)) as bar:
        return run_passes(
            names,
            table,
            arguments.protocol,
            seeds=arguments.seeds,
            alpha=arguments.alpha,
            train=whole.group("static") if afar else None,
            simulated=read_beside(arguments, table),
            jobs=arguments.jobs,
            on_pass=bar.advance,
        )


def _flat(figures: Mapping[str, Any]) -> dict[str, object]:
    """Return one line per figure and per compared row, as text."""
    flat = {key: value for key, value in figures.items() if not isinstance(value, dict)}
    intervals = figures.get("intervals", {})
    for key, (low, high) in intervals.items():
        flat[key] = f"{figures[key]:.4g}  [{low:.4g}, {high:.4g}]"
    for row, gains in figures.get("gains", {}).items():
        flat[f"gain over {row}"] = "  ".join(
            f"{key} {gain['gain']:+.3f} [{gain['low']:+.3f}, {gain['high']:+.3f}]"
            for key, gain in gains.items()
            if key in SHOWN_GAINS
        )
    return flat
