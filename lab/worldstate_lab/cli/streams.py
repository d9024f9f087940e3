"""`worldstate-lab streams`: what the whole world-state makes of simulated streams, vehicle by vehicle.

Streams that were listened to, as `worldstate model make` keeps them, go through the filter hop by hop, with
boxes of a camera drawn from their truth. Printed for every junction and for all: approaches warned of and how
early, onsets an hour where no vehicle comes, whether both of two are found, whether a vehicle keeps its
identity when it comes into view, what is warned of after it has passed, and how true times and bearings are.

The streams must be of other seeds, and for an honest figure of other junctions, than the model learned from.
"""

import argparse
from functools import partial
from pathlib import Path

from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.simulation.parallel import in_processes
from worldstate_lab.passes.followed_stream import PassedStream, passed_stream
from worldstate_lab.passes.pass_outcomes import pass_figures
from worldstate_lab.report.table import figure_lines

EXAMPLE = """\
examples:
  worldstate-lab streams streams/*-2001-*.npz --model my_model.json
  worldstate-lab streams streams/SA1-*.npz --model my_model.json --camera none --json"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("streams", type=Path, nargs="+", metavar="NPZ", help="streams that were listened to")
    add("--model", type=Path, metavar="JSON", help="with a sequence; the one that ships otherwise")
    cameras = "boxes of everybody, of cars above 100 pixels, none; dead from every T0 on"
    add("--camera", choices=("all", "cars", "none", "dies"), default="all", help=cameras)
    add(
        "--sides", action=argparse.BooleanOptionalAction, default=True,
        help="learn what either arm sounds like from vehicles that come into view (default: on)",
    )  # fmt: skip
    add("--seed", type=int, default=0, help="of the camera's misses (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    model = read_model(arguments.model)
    given = {"camera": arguments.camera, "seed": arguments.seed, "learns": arguments.sides}
    follow = partial(passed_stream, model=model, **given)
    streams: dict[str, list[PassedStream]] = {}
    passed = in_processes(follow, arguments.streams, arguments.jobs)
    for one in track(passed, "following", len(arguments.streams)):
        streams.setdefault(one.heard.site, []).append(one)
    figures = {site: pass_figures(streams[site]) for site in sorted(streams)}
    figures["all"] = pass_figures([one for every in streams.values() for one in every])
    report = {**given, "junctions": figures}
    return CommandResult(report, table={}, lines=figure_lines(figures, ".3f"))
