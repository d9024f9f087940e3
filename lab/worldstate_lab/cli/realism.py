"""`worldstate-lab realism`: distance of simulated feature windows from real ones.

Simulate windows at the junctions of a feature table, in the layout of the released real ones, over three
seeds, and compare them with the table. Each figure is followed by the same figure of real against real:
between groupings of the junctions, and of every junction against the others of its type. A figure outside
that range is marked with "!", and one outside the target range with "x".

  C2ST       separation of two sets by boosting; 0.5 is indistinguishable
  AUROC of   the same for one measure, by class: level, peak, width, prominence, change, position
  transfer   the published classifier trained on one and tested on the other, beside the loudest direction
  medians    of level and shape; within 15 %; and spreads, and the share of variance between sites
  side       share of hidden windows with the right side, by a classifier of other junctions
  positions  loss of classifiers if the features assume permuted microphone positions

FEATURES.csv is a table of labelled windows, such as the one released with OVAD or one of `worldstate model
features`. OUT/realism.json is the report, OUT/windows-SEED.csv the simulated windows, OUT/permuted-SEED.csv
the same with permuted positions; as --simulated and --permuted they are compared again without simulation.
OUT/realism.png shows the measures by junction.

Examples
--------
  worldstate-lab realism extracted_features.csv --jobs 2 --out realism
  worldstate-lab realism extracted_features.csv --sites SA1 SB1 SB2 --measures-only --real-only
  worldstate-lab realism extracted_features.csv --group dynamic --json
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable, read_features, write_features
from worldstate.cli.common.command import add_choice
from worldstate.cli.common.output import CommandResult, output_folder, write_report
from worldstate.cli.common.progress import progress_bar
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.operations.figure_style import CATEGORIES, TRUTH, figure_file
from worldstate_lab.streets.realism import Realism, measure_realism, realism_lines
from worldstate_lab.streets.set_classifiers import FAR_AZIMUTHS_DEG
from worldstate_lab.streets.simulated_windows import (
    CLASS_GROUPS,
    MEASURES,
    describe_windows,
    of_class,
    simulated_window_pair,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


LABELS = {"width_deg": "width (deg)", "position_deg": "position of the peak (deg)"}
COLOURS = {"real": TRUTH, "simulated": CATEGORIES[1]}


def write_realism_figure(
    path: Path, real: FeatureTable, simulated: Mapping[str, FeatureTable], found: Realism
) -> None:
    """Draw a panel for each measure and class, and one for each half of the window with the odd profiles."""
    sites = sorted(set(real.environments.tolist()))
    tables = {"real": [real], "simulated": list(simulated.values())}
    with figure_file(path, 12.0, 2.2 * (len(MEASURES) + 1)) as figure:
        rows = figure.subplots(len(MEASURES) + 1, len(CLASS_GROUPS), squeeze=False)
        for row, name in zip(rows, MEASURES, strict=False):
            for axes, windows in zip(row, CLASS_GROUPS, strict=True):
                _draw_measure(axes, tables, sites, name, windows)
        for axes, windows in zip(rows[0], CLASS_GROUPS, strict=True):
            axes.set_title(f"{windows} windows")
        for half, axes in enumerate(rows[-1][:2]):
            _draw_profiles(axes, found, half)
        key = rows[-1][2]
        for origin, colour in COLOURS.items():
            key.plot([], [], "o-", color=colour, label=origin)
        key.axis("off")
        key.legend(loc="center", title="median, central 50 and 90 % of windows;\none line per junction below")


def _draw_measure(
    axes: "Axes", tables: Mapping[str, list[FeatureTable]], sites: list[str], name: str, windows: str
) -> None:
    """Draw the middle 90 and 50 % and the median at each junction."""
    # All simulated sets are drawn together, because one set of ten windows per side and site is too noisy.
    for place, site in enumerate(sites):
        for shift, (origin, some) in zip((0.18, -0.18), tables.items(), strict=True):
            values = [_values(table, site, windows, name) for table in some]
            if sum(map(len, values)):
                low, left, middle, right, high = np.percentile(np.concatenate(values), (5, 25, 50, 75, 95))
                height = len(sites) - place + shift
                axes.plot([low, high], [height] * 2, color=COLOURS[origin], linewidth=1.0)
                axes.plot([left, right], [height] * 2, color=COLOURS[origin], linewidth=4.0, alpha=0.5)
                axes.plot(middle, height, "o", color=COLOURS[origin], markersize=4.0)
    axes.set(yticks=range(len(sites), 0, -1), yticklabels=sites, xlabel=LABELS.get(name, name))
    if not name.endswith("deg"):
        # A factor of loudness has the same length everywhere.
        axes.set_xscale("log")
        axes.minorticks_off()
        axes.xaxis.set_major_formatter("{x:.3g}")
        # Four ticks of two digits, evenly spaced in the logarithm; decades would give one or none.
        axes.set_xticks([float(f"{value:.1e}") for value in np.geomspace(*axes.get_xlim(), 6)[1:-1]])


def _values(table: FeatureTable, site: str, windows: str, name: str) -> FloatArray:
    chosen = of_class(table, windows) & (table.environments == site)
    return describe_windows(table.features[chosen])[name] if chosen.any() else np.zeros(0)


def _draw_profiles(axes: "Axes", found: Realism, half: int) -> None:
    for origin, by_site in found.profiles.items():
        colour = COLOURS["real" if origin == "real" else "simulated"]
        for profile in by_site.values():
            axes.plot(FAR_AZIMUTHS_DEG, profile[half], color=colour, linewidth=1.0, alpha=0.7)
    axes.axhline(0.0, color="grey", linewidth=0.8)
    axes.set(xlabel="azimuth (deg)", ylabel="far side louder (log)", title=f"half {half + 1} of the window")


Pair = tuple[FeatureTable, FeatureTable | None]

# Windows per side and site; the seeds show the effect of one draw of streets.
WINDOWS = 10
SEEDS = (1, 2, 3)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("features", type=Path, metavar="FEATURES.csv", help="real windows")
    add_choice(parser, "--group", "windows of a standing or a moving ego", "static", "dynamic")
    add("--sites", nargs="+", metavar="SITE", help="only these junctions (default: all of the table)")
    add("--simulated", type=Path, nargs="+", metavar="CSV", help="simulated windows, instead of simulating")
    add("--permuted", type=Path, nargs="+", metavar="CSV", help="the same windows with permuted positions")
    add("--measures-only", action="store_true", help="no classifiers, as in the tuning of streets (a second)")
    add("--real-only", action="store_true", help="only real against real")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--out", type=Path, metavar="DIR", help="write realism.json, realism.png and windows")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    if arguments.out is not None:
        output_folder(arguments.out, "realism.json", "realism.png")
    real = _chosen(arguments.features, arguments)
    pairs = _simulated(arguments, real)
    simulated = {name: right for name, (right, _) in pairs.items()}
    permuted = {name: wrong for name, (_, wrong) in pairs.items() if wrong is not None}
    rng, classifiers = np.random.default_rng(SEEDS[0]), not arguments.measures_only
    found = measure_realism(real, simulated, rng, permuted=permuted, classifiers=classifiers)
    report: dict[str, object] = {"group": arguments.group, **found.to_dict()}
    if arguments.out is not None:
        write_report(arguments.out / "realism.json", report)
        write_realism_figure(arguments.out / "realism.png", real, simulated, found)
    return CommandResult(report, table={"group": arguments.group}, lines=realism_lines(found))


def _chosen(path: Path, arguments: argparse.Namespace) -> FeatureTable:
    table = read_features(path).group(arguments.group)
    if arguments.sites is None:
        return table
    unknown = sorted(set(arguments.sites) - set(table.environments.tolist()))
    if unknown:
        raise InvalidArgumentError(f"--sites: {path} has no windows of {', '.join(unknown)}")
    return table.select(np.isin(table.environments, arguments.sites))


def _simulated(arguments: argparse.Namespace, real: FeatureTable) -> dict[str, Pair]:
    """Return simulated windows by name, each with those of permuted positions if there are any."""
    if arguments.real_only:
        return {}
    if arguments.simulated:
        wrong = arguments.permuted or [None] * len(arguments.simulated)
        if len(wrong) != len(arguments.simulated):
            raise InvalidArgumentError("--permuted: expected as many tables as for --simulated")
        return {
            right.stem: (_chosen(right, arguments), None if other is None else _chosen(other, arguments))
            for right, other in zip(arguments.simulated, wrong, strict=True)
        }
    # The junctions of a moving ego are those of the table; other sites have no real counterpart.
    sites = sorted(set(real.environments.tolist()))
    found: dict[str, Pair] = {}
    with progress_bar("simulating windows", 4 * WINDOWS * len(sites) * len(SEEDS)) as bar:
        for seed in SEEDS:
            options = {"sites": sites, "jobs": arguments.jobs, "progress": bar.advance}
            pair = simulated_window_pair(WINDOWS, seed, **options)
            found[f"seed {seed}"] = pair
            if arguments.out is not None:
                for name, table in zip(("windows", "permuted"), pair, strict=True):
                    write_features(arguments.out / f"{name}-{seed}.csv", table)
    return found
