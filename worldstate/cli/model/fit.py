"""`worldstate model fit`: fit a model to a table of feature windows.

Train a signature classifier on labelled feature windows, and set its thresholds gamma(alpha) and risk maps on
out-of-fold scores. The model file is JSON with the coefficients and the origin of the windows: array, sample
rate, band and ego motion. It holds no row of the data. A table without these is taken as OVAD's, unless
--array and --sample-rate state others.

The classifier is a mirror-symmetric ensemble on windows relative to their site, for unseen junctions. Its
thresholds are half-way between those for left-out recordings and those for left-out junctions. --simulated
adds simulated windows to the training, and --streams also the classes both and direct, for a standing ego.

Examples
--------
  worldstate model fit features.csv --group static --exclude testset.csv --out model.json
  worldstate model fit features.csv --labels recordings/labels.csv --out model.json
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import adapters, frontend, operations
from worldstate.cli.common import command, output, progress

if TYPE_CHECKING:
    from worldstate.abduction.signature.ensemble_training import SimulatedWindows


NEEDS = ("sklearn",)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add_table_options(parser)
    add("--out", type=Path, required=True, metavar="MODEL", help="file to write")
    labels = "windows of your own recordings for training, as `street label --windows` writes them"
    add("--labels", type=Path, nargs="+", default=[], metavar="CSV", help=labels)
    ids = "CSV files with a column ID: recordings to leave out"
    add("--exclude", type=Path, nargs="+", action="extend", default=[], metavar="IDS", help=ids)
    add("--array", type=Path, metavar="FILE", help="array of the windows")
    add("--sample-rate", type=float, metavar="HZ", help="sample rate of the windows (default: 47998)")
    add("--source", metavar="TEXT", help="name of the data set (default: name of the file)")
    add("--seed", type=int, default=0, help="seed of the folds (default: %(default)s)")


def add_table_options(parser: argparse.ArgumentParser) -> None:
    """Declare the table, its group and the simulated windows."""
    parser.add_argument("table", type=Path, metavar="CSV", help="windows: feat0..feat59, Class, ID, ...")
    add_group(parser, "standing ego, moving ego or both")
    simulated = "simulated windows of the same sites for training, as `realism --out` writes them"
    parser.add_argument("--simulated", type=Path, nargs="+", metavar="CSV", help=simulated)
    streams = "processed simulated streams; windows of them and of sources in the open are trained on"
    parser.add_argument("--streams", type=Path, nargs="+", metavar="NPZ", help=streams)


def add_group(parser: argparse.ArgumentParser, of: str) -> None:
    """Declare --group."""
    command.add_choice(parser, "--group", of, "static", "dynamic", "all")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.datasets.feature_table import read_ids

    output.check_outputs(arguments, "out")
    command.check_beside(arguments, sample_rate="array")
    table = _with_domain(arguments, adapters.read_features(arguments.table)).group(arguments.group)
    labelled = [_heard_windows(path, table) for path in arguments.labels]
    for one in labelled:
        table = table.joined(one.group(arguments.group))
    kept = table.without([name for path in arguments.exclude for name in read_ids(path)])
    settings = operations.TrainingSettings(seed=arguments.seed)
    with progress.progress_bar("training", settings.steps) as bar:
        model = operations.train_model(
            kept,
            settings,
            dataset=arguments.source or arguments.table.name,
            group=arguments.group,
            excluded_lists=[path.name for path in arguments.exclude],
            simulated=read_beside(arguments, kept),
            on_step=bar.advance,
        )
    adapters.save_model(arguments.out, model)
    summary = {
        "out": str(arguments.out),
        "n_windows": len(kept),
        "n_recordings": len(model.provenance.training_recordings),
        "n_excluded_windows": len(table) - len(kept),
        **(model.provenance.figures or {}),
    }
    if labelled:
        summary["n_labelled"] = sum(map(len, labelled))
    return output.CommandResult(summary)


def read_beside(arguments: argparse.Namespace, table: "adapters.FeatureTable") -> "SimulatedWindows | None":
    """Return the simulated windows for training beside a table, None without any."""
    import numpy as np

    from worldstate.commissioning import heard_stream, simulated_windows
    from worldstate.operations.training.site_references import simulated_beside

    tables = [adapters.read_features(path).group(arguments.group) for path in arguments.simulated or ()]
    streams = [heard_stream.HeardStream.load(path) for path in arguments.streams or ()]
    if not streams:
        return simulated_beside(tables) if tables else None
    array = _array_of(table)
    moves = any(one.ego_moves for one in streams)
    rng, count = np.random.default_rng(0), simulated_windows.N_OPEN
    features = simulated_windows.open_field_features(array, count, rng, moving_ego=moves)
    in_the_open = simulated_windows.open_field_windows(features)
    return simulated_windows.learned_beside(streams, in_the_open, tables).beside(table.environments)


def _array_of(table: "adapters.FeatureTable") -> "frontend.MicrophoneArray":
    # A table without a domain, such as the released one, is OVAD's.
    domain = table.domain
    return frontend.ovad_array() if domain is None else frontend.MicrophoneArray(domain.positions_m)


def _heard_windows(labels: Path, table: "adapters.FeatureTable") -> "adapters.FeatureTable":
    """Return the features of labelled windows, for the array of the table."""
    from worldstate.adapters.datasets.feature_extraction import feature_table, read_labels

    array = _array_of(table)
    windows = read_labels(labels, labels.parent)
    features = list(progress.track(adapters.extract_features(windows, array), "listening", len(windows)))
    return feature_table(windows, features, array)


def _with_domain(arguments: argparse.Namespace, table: "adapters.FeatureTable") -> "adapters.FeatureTable":
    """Return the table with its domain: its own, that of the options, or OVAD's."""
    from worldstate.adapters.files.acoustic_domain import check_array, domain_of, ovad_domain
    from worldstate.frontend.direction.feature import FEATURE_RATE_HZ

    environments = table.environments.tolist()
    array = None if arguments.array is None else adapters.read_array(arguments.array)
    if table.domain is not None:
        if array is not None:
            check_array(table.domain, array)
        return table
    if array is None:
        output.say(f"{arguments.table} states no array: taken as OVAD's")
        return replace(table, domain=ovad_domain(environments))
    return replace(table, domain=domain_of(array, [arguments.sample_rate or FEATURE_RATE_HZ], environments))
