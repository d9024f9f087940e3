"""`worldstate model features`: compute feature windows of labelled recordings.

Compute the published feature of 60 values for labelled one-second windows, to train a model for your own
array. The list of labels is a CSV file with the columns ID, Class (front, left, none, right), Environment
(S.. for a standing ego, D.. for a moving one, then the junction) and Recording ID. Optional columns are File,
relative to DATASET, End, the end of the window in seconds from the start of the file (default: its last
second), and T0. Without File, the sound is DATASET/Environment/Class/ID/out_multi.wav or DATASET/ID.wav.

Without --labels, DATASET has the OVAD layout with DataLog.csv: windows of left, right and none end at T0, for
a moving ego 0.5 s later, and front windows 1.5 s after that.

Examples
--------
  worldstate sim make --out sim --static 40 && worldstate model features sim --out features.csv
  worldstate model features recordings --labels labels.csv --array mics.xml --out features.csv
  worldstate model fit features.csv --out model.json
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import adapters
from worldstate.cli.common import inputs, output, progress
from worldstate.ground.errors import InputFileError

if TYPE_CHECKING:
    from worldstate.adapters.datasets.feature_extraction import LabelledWindow


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder of the recordings")
    parser.add_argument("--labels", type=Path, metavar="CSV", help="list of windows (default: see above)")
    parser.add_argument("--out", type=Path, required=True, metavar="CSV", help="file to write")
    inputs.add_array_options(parser)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    import numpy as np

    from worldstate.adapters.datasets.feature_extraction import feature_table
    from worldstate.adapters.datasets.ovad import choose_array
    from worldstate.frontend.direction.feature import FEATURE_VERSION

    output.check_outputs(arguments, "out")
    array = choose_array(arguments.dataset, inputs.given_array(arguments))
    windows, left_out = _windows(arguments)
    extracted = adapters.extract_features(windows, array)
    features = list(progress.track(extracted, "extracting", len(windows)))
    table = feature_table(windows, features, array)
    adapters.write_features(arguments.out, table)
    summary = {
        "out": str(arguments.out),
        "array": inputs.stance(array),
        "feature": FEATURE_VERSION,
        "n_windows": len(table),
        "n_left_out": left_out,
        "n_recordings": len(np.unique(table.recording_keys)),
        "n_hazard": int(table.hazards.sum()),
        "n_hazard_free": int(table.hazard_free.sum()),
    }
    return output.CommandResult(summary)


def _windows(arguments: argparse.Namespace) -> "tuple[list[LabelledWindow], int]":
    from worldstate.adapters.datasets.feature_extraction import read_labels, sample_windows
    from worldstate.adapters.datasets.ovad import LOG_NAME

    if arguments.labels is not None:
        return read_labels(arguments.labels, arguments.dataset), 0
    windows, left_out = sample_windows(arguments.dataset)
    if not windows:
        problem = f"expected a recording with a second of sound before T0, found none; {left_out} are cut off"
        raise InputFileError(arguments.dataset / LOG_NAME, problem)
    return windows, left_out
