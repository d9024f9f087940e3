"""`worldstate-lab ablations`: what absence, calibration and looming each contribute.

Evaluate recordings with everything on ("full") and with one part changed at a time: the signature alone,
whatever the camera answered; the raw statistic read as the risk; looming added. Thresholds, risk map and the
weight of looming are set on other recordings, in five folds that are the same in every row.

INPUT is a data set in the OVAD layout or hop streams that `worldstate model threshold --save-streams` wrote;
approaches need a T0, and there have to be hazard-free recordings.
"""

import argparse
from pathlib import Path

from worldstate.cli.common.array_options import add_array_options, given_array
from worldstate.cli.common.output import CommandResult

EXAMPLE = """\
examples:
  worldstate sim make --out sim --static 40 && worldstate-lab ablations sim
  worldstate model threshold sim --out model.json --save-streams sim.npz
  worldstate-lab ablations sim.npz --json"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("inputs", type=Path, nargs="+", metavar="INPUT", help="data set or hop streams")
    add_array_options(parser)
    add("--model", type=Path, help="model file (default: the one that ships)")
    add("--alpha", type=float, default=0.02, help="false-positive budget (default: 0.02)")
    add("--seed", type=int, default=0, help="deals the folds (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from dataclasses import asdict

    from worldstate.adapters.files.model_file import load_model
    from worldstate.cli.common.listening import read_streams
    from worldstate_lab.paper.ablations import AblationSwitches, ablation_table

    policy = load_model(arguments.model)[1].policies[0]
    switches = AblationSwitches(alpha=arguments.alpha, sustain_hops=policy.sustain_hops)
    streams = read_streams(arguments.inputs, given_array(arguments), arguments.model)
    table = ablation_table(streams, policy.reference_prior, arguments.seed, switches)
    rows = {name: asdict(row) for name, row in table.items()}
    lines = [f"{'':24}" + "".join(f"{name:>16}" for name in rows)]
    for figure in rows["full"]:
        values = [row[figure] for row in rows.values()]
        lines.append(
            f"{figure:24}" + "".join(f"{'-' if v is None else format(v, '.3g'):>16}" for v in values)
        )
    report = {"recordings": len(streams), "alpha": arguments.alpha, "rows": rows}
    return CommandResult(report, table={}, lines=lines)
