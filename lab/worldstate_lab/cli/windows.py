"""`worldstate-lab windows`: how well signature and cueing do on labelled feature windows.

Evaluate a signature classifier and its cueing on labelled feature windows.

  --protocol cv        5 folds by recording, stratified by label and junction
  --protocol lojo      leave one junction out
  --protocol transfer  learn on windows of a standing ego, predict those of --group

  --method baseline    as published: standardise, linear SVC, left/right mirroring; P(left) + P(right).
                       Keys that end in _absent are of eq. (6) with the visible explanation removed
  --method worldstate  windows compared with what their site sounds like; mirror-symmetric ensemble; eq. (6)
                       with the visible explanation removed. "rows" and "gains" compare it with the baseline,
                       with the untrained loudest direction, and with itself under the other references.
                       Under transfer it is one expert of the pattern above the site's quiet windows, its
                       risks shifted until hazards are as frequent as in training, and the ensemble a row

  --reference run      as `run` has it: learned from the ten windows of a second that came before, drawn from
                       other recordings of the junction, one in twenty of them a hazard; no label is read
  --reference cold     the mean of the training sites: a car in its first second
  --reference curated  all windows of the junction's other recordings, half of them hazards: no car has it

Thresholds and risk maps are set on inner out-of-fold scores, compared as under `run`, as in `train`.
Figures are means over the seeds; intervals are
the middle 95 % of 500 bootstrap samples of recordings, the same for every method.

With --model a finished model is evaluated instead; it is refused where it was trained on these recordings.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable, read_features, read_ids
from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.command import add_choice
from worldstate.cli.common.feature_options import add_table_options, read_beside
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.outputs import check_outputs
from worldstate.cli.common.progress import progress_bar
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate_lab.features.comparison import (
    comparison,
    report,
    row_predictions,
    run_passes,
    write_predictions,
)
from worldstate_lab.features.feature_evaluation import Predictions, predict_held_out
from worldstate_lab.features.methods import ROWS, Passes, row_of, rows_beside

Figures = dict[str, Any]
# What fits a line of the table; the JSON object has the gains of all figures.
SHOWN_GAINS = ("accuracy", "auroc_macro", "auroc_pooled", "tpr", "brier")

EXAMPLE = """\
examples:
  worldstate-lab windows features.csv --group static --protocol lojo --json
  worldstate-lab windows features.csv --model model.json --only testset.csv"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add_table_options(parser)
    add_choice(parser, "--method", "", "worldstate", "baseline")
    add_choice(parser, "--protocol", "what is held out", "cv", "lojo", "transfer")
    add_choice(parser, "--reference", "what windows are compared with", "run", "cold", "curated")
    add("--model", type=Path, help="evaluate this model file; no cross-validation")
    only = "CSV file with a column ID: only recordings of these windows"
    add("--only", type=Path, metavar="IDS", help=only)
    add("--alpha", type=float, default=0.02, help="false-positive budget (default: 0.02)")
    add("--seeds", type=int, default=5, metavar="N", help="seeds 0 to N - 1 (default: 5)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--predictions", type=Path, metavar="CSV", help="write one row a window and seed")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    check_outputs(arguments, "predictions")
    whole = read_features(arguments.table)
    table = whole.group(arguments.group)
    if arguments.only is not None:
        table = table.only(read_ids(arguments.only))
    evaluate = _evaluate_model if arguments.model is not None else _evaluate_method
    figures, predictions = evaluate(arguments, whole, table)
    if arguments.predictions is not None:
        write_predictions(arguments.predictions, table, predictions, range(len(predictions)))
    return CommandResult(figures, table=_flat(figures))


def _evaluate_method(
    arguments: argparse.Namespace, whole: FeatureTable, table: FeatureTable
) -> tuple[Figures, list[Predictions]]:
    row = row_of(arguments.method, arguments.protocol, arguments.reference)
    passes = _passes(arguments, whole, table, row)
    detail = report(table, passes[row]) if row == "baseline" else {}
    compared = comparison(table, passes, row, arguments.alpha)
    origin = _origin(arguments, arguments.method, arguments.protocol, arguments.seeds)
    return origin | {"row": row} | detail | compared, row_predictions(passes, row)


def _passes(
    arguments: argparse.Namespace, whole: FeatureTable, table: FeatureTable, row: str
) -> dict[str, Passes]:
    """Run every seed of the method and of those that it is compared with."""
    in_range("--seeds", arguments.seeds, 1, 10_000)
    in_range("--jobs", arguments.jobs, 1, 256)
    afar = arguments.protocol == "transfer"
    if afar and arguments.group != "dynamic":
        raise InvalidArgumentError("--protocol transfer: expected --group dynamic, static is learned from")
    names = (row, *rows_beside(row, arguments.protocol, arguments.reference))
    methods = list(dict.fromkeys(ROWS[name].method for name in names))
    with progress_bar("evaluating", arguments.seeds * len(methods)) as bar:
        return run_passes(
            methods,
            table,
            arguments.protocol,
            seeds=arguments.seeds,
            alpha=arguments.alpha,
            train=whole.group("static") if afar else None,
            simulated=read_beside(arguments, table),
            jobs=arguments.jobs,
            on_pass=bar.advance,
        )


def _evaluate_model(
    arguments: argparse.Namespace, whole: FeatureTable, table: FeatureTable
) -> tuple[Figures, list[Predictions]]:
    predictions = predict_held_out(
        read_model(arguments.model), table, arguments.alpha, arguments.reference, np.random.default_rng(0)
    )
    figures = _origin(arguments, "model", "held-out", 1) | report(table, [predictions])
    return figures, [predictions[1.0]]


def _origin(arguments: argparse.Namespace, method: str, protocol: str, seeds: int) -> Figures:
    return {
        "method": method,
        "protocol": protocol,
        "group": arguments.group,
        "reference": arguments.reference,
        "seeds": seeds,
        "alpha": arguments.alpha,
    }


def _flat(figures: Figures) -> dict[str, object]:
    """One line a junction and one a compared row, for people."""
    flat = {key: value for key, value in figures.items() if not isinstance(value, dict)}
    intervals = figures.get("intervals", {})
    for key, (low, high) in intervals.items():
        flat[key] = f"{figures[key]:.4g}  [{low:.4g}, {high:.4g}]"
    for environment, values in figures["per_group"].items():
        known = [f"{key} {value:.3g}" for key, value in values.items() if value is not None]
        flat[environment] = "  ".join(known)
    for row, gains in figures.get("gains", {}).items():
        flat[f"gain over {row}"] = "  ".join(
            f"{key} {gain['gain']:+.3f} [{gain['low']:+.3f}, {gain['high']:+.3f}]"
            for key, gain in gains.items()
            if key in SHOWN_GAINS
        )
    return flat
