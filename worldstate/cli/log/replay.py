"""`worldstate log replay`: the snapshots of a log again, as they were written.

Read the snapshots of an MCAP file, of a bag of ROS 2 or of JSON lines, and write or serve them anew. --out of
an MCAP file or a bag that `worldstate run` wrote holds the same bytes as the --out of that run.
"""

import argparse
from pathlib import Path

from worldstate.cli.common.exports import CROSSING_M, add_output_options, open_exports
from worldstate.cli.common.output import CommandResult, check_outputs

EXAMPLE = """\
examples:
  worldstate log replay out.mcap --out states.jsonl
  worldstate log replay states.jsonl --export mcap=out.mcap
  worldstate log replay states.jsonl --export foxglove
  worldstate log replay states.jsonl --export osi=out.osi --export autoware=objects.jsonl
  worldstate log replay states.jsonl --export odas=127.0.0.1:9000"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="what `worldstate run` wrote by --export mcap, rosbag or --out")
    add_output_options(parser)
    crossing = "metres ahead of the lane in which other stacks find what is only heard (default: 9)"
    add("--crossing", type=float, default=CROSSING_M, metavar="M", help=crossing)


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from worldstate.adapters.state_log import read_log, states_writer
    from worldstate.cli.common.progress import progress_bar
    from worldstate.ground.checks import in_range
    from worldstate.ground.values import seconds
    from worldstate.operations.recordings.recording_report import WarningMeter

    check_outputs(arguments, "out")
    crossing_m = in_range("--crossing", arguments.crossing, 1.0, 100.0)
    meter = WarningMeter(t0_s=None)
    with (
        states_writer(arguments.out) as write,
        open_exports(arguments, crossing_m=crossing_m) as exports,
        progress_bar(f"reading {arguments.log.name}", None) as bar,
    ):
        for line, state in read_log(arguments.log):
            write(line)
            exports.state(state)
            meter.update(state)
            bar.advance()
    summary = {
        "states": meter.states,
        "first_s": seconds(meter.first_ns),
        "last_s": seconds(meter.last_ns),
        "peak_risk": meter.peak_risk,
        "advisory_onsets_s": list(meter.summary().advisory_onsets_s),
    }
    return CommandResult(summary)
