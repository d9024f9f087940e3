"""`worldstate realism`: how far simulated feature windows are from real ones.

Simulate windows at the junctions of a feature table, laid out as the released real ones, over three seeds,
and compare them with the table:

  medians    of level and shape by junction type and class; within 15 %, as real junctions of one type agree
  transfer   the published classifier trained on one and tested on the other, beside the loudest direction
  C2ST       how well boosting tells the two sets apart; .5 would be indistinguishable

FEATURES.csv is a table of labelled windows, such as the one released with OVAD, or one that extract-features
wrote of a folder in its layout. OUT/realism.json is the report.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.common.command import add_choice
from worldstate.cli.common.output import CommandResult, write_report
from worldstate.cli.common.outputs import output_folder
from worldstate.cli.common.progress import progress_bar

if TYPE_CHECKING:
    from worldstate.studies.streets.realism import Realism

# Windows from either side at every site; the seeds show what one draw of streets changes.
WINDOWS = 10
SEEDS = (1, 2, 3)

EXAMPLE = """\
examples:
  worldstate realism extracted_features.csv --jobs 2 --out realism
  worldstate realism extracted_features.csv --group dynamic --json"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("features", type=Path, metavar="FEATURES.csv", help="real windows")
    add_choice(parser, "--group", "windows of a standing or a moving ego", "static", "dynamic")
    add("--preset", metavar="NAME", help="levels of the simulation (default: the newest)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--out", type=Path, metavar="DIR", help="write realism.json")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    if arguments.out is not None:
        output_folder(arguments.out, "realism.json")
    found = _compared(arguments)
    report: dict[str, object] = {
        "group": arguments.group,
        "realism": {str(seed): one.to_dict() for seed, one in found.items()},
    }
    if arguments.out is not None:
        write_report(arguments.out / "realism.json", report)
    lines = [f"\nseed {seed}\n{one.table()}" for seed, one in found.items()]
    return CommandResult(report, table={"group": arguments.group}, lines=lines)


def _compared(arguments: argparse.Namespace) -> "dict[int, Realism]":
    from functools import partial

    from worldstate.adapters.datasets.feature_table import read_features
    from worldstate.adapters.simulation.scene.presets import DEFAULT_PRESET, preset
    from worldstate.studies.streets.realism import realism_over_seeds
    from worldstate.studies.streets.simulated_windows import simulated_windows

    real = read_features(arguments.features).group(arguments.group)
    # A moving ego's junctions come as they are in the table; a site that it lacks has nothing to be held to.
    sites = sorted(set(real.environments.tolist()))
    levels = preset(arguments.preset or DEFAULT_PRESET)
    with progress_bar("simulating windows", 4 * WINDOWS * len(sites) * len(SEEDS)) as bar:
        simulate = partial(
            simulated_windows,
            WINDOWS,
            sites=sites,
            jobs=arguments.jobs,
            levels=levels,
            progress=bar.advance,
        )
        return realism_over_seeds(real, simulate, SEEDS)
