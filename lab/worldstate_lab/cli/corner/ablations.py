"""`worldstate-lab ablations`: the contributions of absence, calibration and looming.

Evaluate recordings with all parts ("full") and with one part changed at a time: the signature alone without
the camera; the raw statistic as the risk; looming added. Thresholds, risk map and the weight of looming are
set on other recordings, in five folds that are the same in every row.

INPUT is a data set in the OVAD layout or hop streams of `worldstate model threshold --save-streams`. It needs
approaches with a T0 and hazard-free recordings. A folder of the real corner (see `worldstate-lab sequences`)
is evaluated on its spectra: with the camera trusted fully, with eq. (5), and by the published risk of the
whole product, for each folder of boxes in --boxes, which `worldstate-lab staged` writes.

Examples
--------
  worldstate sim make --out sim --static 40 && worldstate-lab ablations sim
  worldstate model threshold sim --out model.json --save-streams sim.npz
  worldstate-lab ablations sim.npz --json
  worldstate-lab ablations ovad-sequences --boxes boxes staged/nanodet-blur-4 --miss-rates beta.json
"""

import argparse
from pathlib import Path

from worldstate.adapters.camera.camera_health import LEVELS
from worldstate.adapters.camera.miss_rates import load_miss_rates
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.cli.common.inputs import add_array_options, given_array
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import read_streams, track
from worldstate_lab.evaluation.ablation_rows import AblationSwitches, ablation_table
from worldstate_lab.report.table import figure_lines
from worldstate_lab.sequences.camera_rows import corner_rows
from worldstate_lab.sequences.hearing import SPECTRA, ovad_chain
from worldstate_lab.sequences.recordings import TRUTH, read_recordings


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("inputs", type=Path, nargs="+", metavar="INPUT", help="data set or hop streams")
    add_array_options(parser)
    add("--model", type=Path, help="model file (default: the shipped one)")
    add("--alpha", type=float, default=0.02, help="false-positive budget (default: 0.02)")
    add("--boxes", nargs="+", default=["boxes"], metavar="DIR", help="at a real corner (default: boxes)")
    add("--path", choices=SPECTRA, default=SPECTRA[0], help="path at a real corner (default: %(default)s)")
    add("--miss-rates", type=Path, metavar="JSON", help="of the detector; adds a row")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--seed", type=int, default=0, help="seed of the folds (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    model = read_model(arguments.model)
    policy = model.policies.policies[0]
    switches = AblationSwitches(alpha=arguments.alpha, sustain_hops=policy.sustain_hops)
    if (arguments.inputs[0] / TRUTH).is_file():
        return _corner(arguments, model, switches)
    streams = read_streams(arguments.inputs, given_array(arguments), arguments.model)
    table = ablation_table(streams, policy.reference_prior, arguments.seed, switches)
    report = {"recordings": len(streams), "alpha": arguments.alpha, "rows": table}
    return CommandResult(report, table={}, lines=figure_lines(table))


def _corner(arguments: argparse.Namespace, model: Model, switches: AblationSwitches) -> CommandResult:
    """Return the rows of a real corner, one table per folder of boxes."""
    recordings = read_recordings(arguments.inputs[0])
    measured = None if arguments.miss_rates is None else load_miss_rates(arguments.miss_rates)
    states, lines = {}, list[str]()
    for boxes in track(arguments.boxes, "cameras"):
        folder = boxes if (arguments.inputs[0] / boxes).is_dir() else str(Path(boxes).absolute())
        chain = ovad_chain(model, folder, arguments.path)
        d = LEVELS[int(Path(boxes).name[-1])] if Path(boxes).name[-2:-1] == "-" else 0.0
        rows = corner_rows(chain, recordings, measured, d, switches, arguments.seed, arguments.jobs)
        states[Path(boxes).name] = rows
        for kind, some in rows.items():
            lines += ["", f"{Path(boxes).name}, {kind}:", *figure_lines(some)]
    report = {"recordings": len(recordings), "alpha": arguments.alpha, "states": states}
    return CommandResult(report, table={}, lines=lines)
