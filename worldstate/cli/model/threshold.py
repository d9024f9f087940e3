"""`worldstate model threshold`: thresholds of a model from a user's own hazard-free hours.

Set the thresholds gamma(alpha) of a model on hazard-free sound of your own, and keep its signature as it is.

INPUT is a data set in the OVAD layout, the folder of one recording, a multichannel sound file, or hop streams
that --save-streams wrote with the same signature. Recordings labelled none and sound files count as
hazard-free. Approaches with a T0, where there are some, give the risk map (Platt for few, isotonic for many);
without them the model's own is kept. If few false alarms were counted, a warning names the hours that would
count enough.

Examples
--------
  worldstate model threshold night.wav morning.wav --array mics.xml --alpha 0.02 --out my_model.json
  worldstate model threshold my_dataset --alpha 0.01 0.05 --out my_model.json
"""

import argparse
from pathlib import Path

from worldstate import adapters, operations
from worldstate.cli.common import inputs, listening, output

NEEDS = ("sklearn",)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("inputs", type=Path, nargs="+", metavar="INPUT", help="data set, recordings, sound")
    inputs.add_array_options(parser)
    add("--model", type=Path, help="model file to start from (default: the one that ships)")
    add("--out", type=Path, required=True, metavar="MODEL", help="exactly this file")
    budgets = "budgets: share of hazard-free windows in alarm (default: 0.01 0.02 0.05)"
    add("--alpha", type=float, nargs="+", default=[0.01, 0.02, 0.05], metavar="A", help=budgets)
    add("--sustain-hops", type=int, default=3, help="k of the sustained rule (default: 3)")
    add("--save-streams", type=Path, metavar="NPZ", help="keep what was heard for next time")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from dataclasses import replace

    from worldstate.operations.recordings.hop_table import save_tables

    output.check_outputs(arguments, "out", "save_streams")
    settings = operations.CueingSettings(
        alphas=tuple(arguments.alpha),
        sustain_hops=arguments.sustain_hops,
    )
    array = inputs.given_array(arguments)
    model = adapters.read_model(arguments.model, array=array)
    streams = listening.read_streams(arguments.inputs, array, arguments.model)
    if arguments.save_streams is not None:
        save_tables(arguments.save_streams, streams)
    done = operations.calibrate_cueing(streams, model.signature.reference_prior, model.policies, settings)
    figures = dict(model.provenance.figures or {}) | {"calibration_hours": done.hours}
    provenance = replace(model.provenance, figures=figures)
    adapters.save_model(arguments.out, replace(model, policies=done.policies, provenance=provenance))
    for warning in done.warnings:
        output.say(f"warning: {warning}")
    return _result(arguments, done)


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
