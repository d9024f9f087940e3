"""`worldstate evaluate-features`: how well signature and cueing do on labelled feature windows."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldstate.cli.output import print_summary
from worldstate.cli.progress import progress_bar

if TYPE_CHECKING:
    from worldstate.adapters.feature_table import FeatureTable
    from worldstate.evaluation.features import Predictions

Passes = list[dict[float, "Predictions"]]

DESCRIPTION = """\
Evaluate the signature classifier and its cueing on labelled feature windows.

  --protocol cv    5 folds by recording, stratified by label and junction
  --protocol lojo  leave one junction out

Thresholds and risk maps are set on inner out-of-fold scores, split in the same way. The plain keys are of the
published statistic P(left) + P(right); keys that end in _absent are of eq. (post) with the visible one of the
explanations removed. Figures are means over the seeds.

With --model a finished model is evaluated instead; it is refused where it was trained on these recordings."""

EXAMPLE = """\
examples:
  worldstate evaluate-features features.csv --group static --protocol cv --json
  worldstate evaluate-features features.csv --model model.json --only testset.csv"""


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the command and its options."""
    parser = subparsers.add_parser(
        "evaluate-features",
        help="evaluate signature and cueing on feature windows",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("table", type=Path, metavar="CSV", help="windows: feat0..feat59, Class, ID, ...")
    parser.add_argument(
        "--group",
        choices=("static", "dynamic", "all"),
        default="static",
        help="standing ego, moving ego or both (default: %(default)s)",
    )
    parser.add_argument(
        "--protocol", choices=("cv", "lojo"), default="cv", help="who is held out (default: %(default)s)"
    )
    parser.add_argument("--method", choices=("baseline",), default="baseline", help="baseline: as published")
    parser.add_argument("--model", type=Path, help="evaluate this model file; no cross-validation")
    parser.add_argument(
        "--only", type=Path, metavar="IDS", help="CSV file with a column ID: only recordings of these windows"
    )
    parser.add_argument("--alpha", type=float, default=0.02, help="false-positive budget (default: 0.02)")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="seeds 0 to N - 1 (default: 5)")
    parser.add_argument("--predictions", type=Path, metavar="CSV", help="write one row a window and seed")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; return its exit code."""
    from worldstate.adapters.feature_table import read_features, read_ids
    from worldstate.evaluation.feature_report import report, write_predictions

    table = read_features(arguments.table).group(arguments.group)
    if arguments.only is not None:
        table = table.only(read_ids(arguments.only))
    finished = arguments.model is not None
    passes = _model_pass(arguments, table) if finished else _cross_validation(arguments, table)
    figures = {
        "method": "model" if finished else arguments.method,
        "protocol": "held-out" if finished else arguments.protocol,
        "group": arguments.group,
        "seeds": len(passes),
        "alpha": arguments.alpha,
        **report(table, passes),
    }
    if arguments.predictions is not None:
        write_predictions(arguments.predictions, table, [one[1.0] for one in passes], range(len(passes)))
    print_summary(figures if arguments.json else _flat(figures), as_json=arguments.json)
    return 0


def _cross_validation(arguments: argparse.Namespace, table: "FeatureTable") -> Passes:
    import numpy as np

    from worldstate.abduction.signature_training import PublishedClassifier
    from worldstate.errors import InvalidArgumentError
    from worldstate.evaluation.features import cross_validate
    from worldstate.evaluation.splits import N_FOLDS, split_for

    if arguments.seeds < 1:
        raise InvalidArgumentError(f"--seeds: expected at least 1, got {arguments.seeds}")
    split = split_for(arguments.protocol)
    n_folds = N_FOLDS if arguments.protocol == "cv" else len(np.unique(table.environments))
    with progress_bar("evaluating", arguments.seeds * n_folds) as bar:
        return [
            cross_validate(
                table,
                split,
                PublishedClassifier,
                np.random.default_rng(seed),
                alpha=arguments.alpha,
                on_fold=bar.advance,
            )
            for seed in range(arguments.seeds)
        ]


def _model_pass(arguments: argparse.Namespace, table: "FeatureTable") -> Passes:
    from worldstate.adapters.model_file import read_model
    from worldstate.evaluation.held_out import predict_held_out

    return [predict_held_out(read_model(arguments.model), table, arguments.alpha)]


def _flat(figures: dict[str, Any]) -> dict[str, object]:
    """One line a junction, for people."""
    flat = {key: value for key, value in figures.items() if not isinstance(value, dict)}
    for environment, values in figures["per_group"].items():
        known = [f"{key} {value:.3g}" for key, value in values.items() if value is not None]
        flat[environment] = "  ".join(known)
    return flat
