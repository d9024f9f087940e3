"""`worldstate-lab planner`: the gain of a planner that reads the probabilities of the state.

A simulated car approaches blind corners in a closed loop while the states of recorded streams are replayed;
their vehicles cross as recorded and do not react. Four planners drive the same car under the same stopping
law. The first has no prior information and brakes for visible vehicles. The second always assumes a vehicle
behind both corners. The third remembers the visible area and assumes a vehicle in the rest. The fourth
assumes one above a probability of the state, which is set on streams of other seeds (`--set-on`). The output
has collisions, unnecessary braking, and time.

Examples
--------
  worldstate-lab planner streams/*-200[23]*.npz --set-on streams/*-approaches-2001*.npz --figure planner.png
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.output import CommandResult, check_outputs
from worldstate.cli.common.progress import track
from worldstate.ground.parallel import in_processes
from worldstate_lab.planner.encounters import FROM_STANDING, BelievedStream, EgoVehicle, believed_stream
from worldstate_lab.planner.planner_exam import (
    THRESHOLDS,
    approaches_drawn,
    draw_corners,
    drives_of,
    every_planner,
    planner_figures,
    safe_threshold,
    write_planner_figure,
)
from worldstate_lab.report.table import figure_lines

COUNT = 1000  # Approaches, and corners without one


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("streams", type=Path, nargs="+", metavar="NPZ", help="streams with and without approaches")
    of_others = "streams of other seeds, for the threshold: a step below the largest without a collision"
    add("--set-on", type=Path, nargs="+", required=True, metavar="NPZ", help=of_others)
    add("--model", type=Path, metavar="JSON", help="model with a sequence (default: the shipped one)")
    standing = (
        "the car starts at rest 3.5 m before the line, where the states were recorded, not 30 m at 25 km/h"
    )
    add("--from-standing", action="store_true", help=standing)
    add("--seed", type=int, default=0, help="seed of the replays (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--figure", type=Path, metavar="PNG", help="draw one approach, one empty corner, and all thresholds")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    check_outputs(arguments, figures=("figure",))
    ego = FROM_STANDING if arguments.from_standing else EgoVehicle()
    rng = np.random.default_rng(arguments.seed)
    loud, quiet = approaches_drawn(_believed(arguments, arguments.set_on), COUNT, ego, rng)
    chance, for_loud = safe_threshold([loud, quiet], ego), safe_threshold([loud], ego)
    corners = draw_corners(_believed(arguments, arguments.streams), COUNT, ego, rng)
    planners = every_planner(corners, chance, for_loud, ego)
    named = {f"{one:g}": drives_of(corners, one, ego) for one in THRESHOLDS[::2]}
    told = planner_figures(corners, planners | named, rng)
    figures, curve = {name: told[name] for name in planners}, {name: told[name] for name in named}
    if arguments.figure is not None:
        write_planner_figure(corners, planners, list(curve.values()), figures, ego, arguments.figure)
    report = {"threshold": chance, "threshold_loud": for_loud, "planners": figures, "thresholds": curve}
    lines = [f"thresholds {chance:g}, {for_loud:g} (loud)", *figure_lines(figures, ".4g")]
    return CommandResult(report, table={}, lines=lines)


def _believed(arguments: argparse.Namespace, paths: list[Path]) -> list[BelievedStream]:
    follow = partial(believed_stream, model=read_model(arguments.model))
    return list(track(in_processes(follow, paths, arguments.jobs), "following", len(paths)))
