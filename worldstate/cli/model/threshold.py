"""`worldstate model threshold`: set the thresholds of a model on your own hazard-free hours.

Set the thresholds gamma(alpha) of a model on your own hazard-free sound; its signature does not change.

INPUT is a data set in the OVAD layout, the folder of one recording, a multichannel sound file, hop streams of
--save-streams with the same signature, or a folder of `hear --hops`. Recordings labelled none, sound files
and recordings of `hear` are taken as hazard-free. Approaches with a T0 give the risk map (Platt for few,
isotonic for many); without them the model keeps its own. With few false alarms a warning states the hours
that would be enough.

For a folder of `hear` and a model with a sequence, the curve from false alarms per hour to the threshold is
measured as well, and --budget sets its default.

Examples
--------
  worldstate model threshold night.wav morning.wav --array mics.xml --alpha 0.02 --out my_model.json
  worldstate model threshold heard --model mine.json --budget 10 --out my_model.json
  worldstate model threshold my_dataset --alpha 0.01 0.05 --out my_model.json
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from worldstate import adapters, operations
from worldstate.cli.common import inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError

NEEDS = ("sklearn",)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("inputs", type=Path, nargs="+", metavar="INPUT", help="data set, recordings, sound")
    inputs.add_array_options(parser)
    add("--model", type=Path, help="model to start from (default: the shipped one)")
    add("--out", type=Path, required=True, metavar="MODEL", help="file to write")
    budgets = "shares of hazard-free windows in alarm (default: 0.01 0.02 0.05)"
    add("--alpha", type=float, nargs="+", default=[0.01, 0.02, 0.05], metavar="A", help=budgets)
    own = "default false alarms per hour, for a corpus (default: the model's)"
    add("--budget", type=float, metavar="ONSETS", help=own)
    add("--save-streams", type=Path, metavar="NPZ", help="save the processed streams for a later run")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.operations.recordings.hop_table import save_tables

    output.check_outputs(arguments, "out", "save_streams")
    settings = operations.CueingSettings(alphas=tuple(arguments.alpha))
    array = inputs.given_array(arguments)
    model = adapters.read_model(arguments.model, array=array)
    streams = progress.read_streams(arguments.inputs, array, arguments.model)
    if arguments.save_streams is not None:
        save_tables(arguments.save_streams, streams)
    done = operations.calibrate_cueing(streams, model.signature.reference_prior, model.policies, settings)
    figures = dict(model.provenance.figures or {}) | {"calibration_hours": done.hours}
    provenance = replace(model.provenance, figures=figures)
    made = replace(model, policies=done.policies, provenance=provenance)
    if any("level_left" in stream.columns for stream in streams):
        made = _with_curve(made, streams, arguments.budget)
    elif arguments.budget is not None:
        raise InvalidArgumentError("--budget: expected a corpus as INPUT, of `hear --hops`")
    adapters.save_model(arguments.out, made)
    for warning in done.warnings:
        output.say(f"warning: {warning}")
    return _result(arguments, done)


def _with_curve(
    model: "adapters.Model", streams: Sequence["operations.HopTable"], budget: float | None
) -> "adapters.Model":
    """Return a model with the curve of a corpus; a model without a sequence is unchanged."""
    import numpy as np

    from worldstate.commissioning.alarm_curve import check_hours, measured_curve
    from worldstate.commissioning.commission import with_curve

    if model.sequence is None or model.sequence.alarm is None:
        return model
    quiet = [
        (one.about["site"], np.nan_to_num(np.column_stack([one.level_left, one.level_right]), nan=-np.inf))
        for one in streams
        if "level_left" in one.columns
    ]
    curve, onsets = measured_curve(quiet), budget or model.sequence.alarm.onsets_per_hour
    check_hours("budget", curve.hours, onsets)
    return with_curve(model, curve, onsets)


def _result(arguments: argparse.Namespace, done: "operations.CueingCalibration") -> output.CommandResult:
    summary: dict[str, object] = {
        "out": str(arguments.out),
        "hazard_free_hours": done.hours,
        "windows": done.windows,
        "recordings": done.recordings,
        "correlation_time_s": done.correlation_time_s,
        "risk_map": done.risk,
    }
    detail = {"budgets": [report.to_dict() for report in done.budgets], "warnings": list(done.warnings)}
    lines = {}
    for report in done.budgets:
        rates = report.counted.false_alarms()
        lines[f"alpha {report.alpha:g}, beta {report.miss_rate:g}"] = (
            f"gamma {report.gamma:.4f}  {rates['onsets_per_hour']:.3g} false alarms/h "
            f"[{rates['onsets_low']:.3g}, {rates['onsets_high']:.3g}], "
            f"one is {1.0 / report.counted.hours:.3g}/h"
        )
    return output.CommandResult(summary | detail, table=summary | lines)
