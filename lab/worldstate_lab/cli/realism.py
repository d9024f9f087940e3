"""`worldstate-lab realism`: how far simulated feature windows are from real ones.

Simulate windows at the junctions of a feature table, laid out as the released real ones, over three seeds,
and hold them against the table. Beside every figure stands the same figure of real against real: between
groupings of the junctions, and of every junction against the others of its type. A figure outside that range
is marked with "!", one that is not where simulated streets are asked to be with "x".

  C2ST       how well boosting tells two sets apart; .5 would be indistinguishable
  AUROC of   the same of one measure alone, by class: level, peak, width, prominence, change, position
  transfer   the published classifier trained on one and tested on the other, beside the loudest direction
  medians    of level and shape; within 15 %; and spreads, and the share of variance between sites
  side       how often left is told from right of hidden windows by a classifier of other junctions
  positions  what classifiers lose when the features take the microphones to be at permuted positions

FEATURES.csv is a table of labelled windows, such as the one released with OVAD, or one that extract-features
wrote of a folder in its layout. OUT/realism.json is the report, OUT/windows-SEED.csv what was simulated,
OUT/permuted-SEED.csv the same with permuted positions: given as --simulated and --permuted, they are held
against the table again without simulating. OUT/realism.png shows the measures junction by junction.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.common.command import add_choice
from worldstate.cli.common.output import CommandResult, write_report
from worldstate.cli.common.outputs import output_folder
from worldstate.cli.common.progress import progress_bar

if TYPE_CHECKING:
    from worldstate.adapters.datasets.feature_table import FeatureTable

    Pair = tuple[FeatureTable, FeatureTable | None]

# Windows from either side at every site; the seeds show what one draw of streets changes.
WINDOWS = 10
SEEDS = (1, 2, 3)

EXAMPLE = """\
examples:
  worldstate-lab realism extracted_features.csv --jobs 2 --out realism
  worldstate-lab realism extracted_features.csv --sites SA1 SB1 SB2 --measures-only --real-only
  worldstate-lab realism extracted_features.csv --group dynamic --json"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("features", type=Path, metavar="FEATURES.csv", help="real windows")
    add_choice(parser, "--group", "windows of a standing or a moving ego", "static", "dynamic")
    add("--sites", nargs="+", metavar="SITE", help="only these junctions (default: all of the table)")
    add("--preset", metavar="NAME", help="levels of the simulation (default: the newest)")
    add("--simulated", type=Path, nargs="+", metavar="CSV", help="simulated windows, instead of simulating")
    add("--permuted", type=Path, nargs="+", metavar="CSV", help="the same windows, positions permuted")
    add("--measures-only", action="store_true", help="no classifier: what streets are tuned on (a second)")
    add("--real-only", action="store_true", help="real against real alone")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--out", type=Path, metavar="DIR", help="write realism.json, realism.png and windows")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    import numpy as np

    from worldstate_lab.streets.realism import measure_realism, realism_lines
    from worldstate_lab.streets.realism_figure import write_realism_figure

    if arguments.out is not None:
        output_folder(arguments.out, "realism.json", "realism.png")
    real = _chosen(arguments.features, arguments)
    pairs = _simulated(arguments, real)
    simulated = {name: right for name, (right, _) in pairs.items()}
    permuted = {name: wrong for name, (_, wrong) in pairs.items() if wrong is not None}
    found = measure_realism(
        real,
        simulated,
        np.random.default_rng(SEEDS[0]),
        permuted=permuted,
        classifiers=not arguments.measures_only,
    )
    report: dict[str, object] = {"group": arguments.group, **found.to_dict()}
    if arguments.out is not None:
        write_report(arguments.out / "realism.json", report)
        write_realism_figure(arguments.out / "realism.png", real, simulated, found)
    return CommandResult(report, table={"group": arguments.group}, lines=realism_lines(found))


def _chosen(path: Path, arguments: argparse.Namespace) -> "FeatureTable":
    import numpy as np

    from worldstate.adapters.datasets.feature_table import read_features
    from worldstate.ground.errors import InvalidArgumentError

    table = read_features(path).group(arguments.group)
    if arguments.sites is None:
        return table
    unknown = sorted(set(arguments.sites) - set(table.environments.tolist()))
    if unknown:
        raise InvalidArgumentError(f"--sites: {path} has no windows of {', '.join(unknown)}")
    return table.select(np.isin(table.environments, arguments.sites))


def _simulated(arguments: argparse.Namespace, real: "FeatureTable") -> "dict[str, Pair]":
    """Return simulated windows by name, each with those of permuted positions where there are any."""
    from itertools import zip_longest

    from worldstate.adapters.datasets.feature_table import write_features
    from worldstate.ground.errors import InvalidArgumentError
    from worldstate.simulation.scene.presets import DEFAULT_PRESET, preset
    from worldstate_lab.streets.simulated_windows import simulated_window_pair

    if arguments.real_only:
        return {}
    if arguments.simulated:
        if len(arguments.permuted or arguments.simulated) != len(arguments.simulated):
            raise InvalidArgumentError("--permuted: expected as many tables as --simulated has")
        tables = zip_longest(arguments.simulated, arguments.permuted or ())
        return {
            right.stem: (_chosen(right, arguments), None if wrong is None else _chosen(wrong, arguments))
            for right, wrong in tables
        }
    # A moving ego's junctions come as they are in the table; a site that it lacks has nothing to be held to.
    sites = sorted(set(real.environments.tolist()))
    levels = preset(arguments.preset or DEFAULT_PRESET)
    found: dict[str, Pair] = {}
    with progress_bar("simulating windows", 4 * WINDOWS * len(sites) * len(SEEDS)) as bar:
        for seed in SEEDS:
            pair = simulated_window_pair(
                WINDOWS, seed, sites=sites, jobs=arguments.jobs, levels=levels, progress=bar.advance
            )
            found[f"seed {seed}"] = pair
            if arguments.out is not None:
                for name, table in zip(("windows", "permuted"), pair, strict=True):
                    write_features(arguments.out / f"{name}-{seed}.csv", table)
    return found
