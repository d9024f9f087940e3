"""`worldstate log replay`: send the snapshots of a log to a file, a viewer or another stack.

Read the snapshots of an MCAP file, a bag of ROS 2 or JSON lines, and write or serve them again. For an MCAP
file or a bag of `worldstate run`, --out is equal to the --out of that run, byte for byte.

Examples
--------
  worldstate log replay out.mcap --out states.jsonl
  worldstate log replay states.jsonl --export mcap=out.mcap
  worldstate log replay states.jsonl --export foxglove
  worldstate log replay states.jsonl --export osi=out.osi --export autoware=objects.jsonl
  worldstate log replay states.jsonl --export odas=127.0.0.1:9000
"""

import argparse
from pathlib import Path

from worldstate import ground
from worldstate.cli.common import exports, output, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="log of `worldstate run`, by --out or --export mcap or rosbag")
    exports.add_output_options(parser)
    crossing = "distance of the lane of vehicles without a known range, metres (default: 9)"
    add("--crossing", type=float, default=9.0, metavar="M", help=crossing)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.files.file_io import line_writer
    from worldstate.adapters.state_log import read_log
    from worldstate.operations.recordings.recording_report import WarningMeter

    output.check_outputs(arguments, "out")
    crossing_m = ground.in_range("--crossing", arguments.crossing, 1.0, 100.0)
    meter = WarningMeter(t0_s=None)
    with (
        line_writer(arguments.out) as write,
        exports.open_exports(arguments, crossing_m=crossing_m) as opened,
    ):
        for line, state in progress.track(read_log(arguments.log), f"reading {arguments.log.name}"):
            write(line)
            opened.state(state)
            meter.update(state)
    summary = {
        "states": meter.states,
        "first_s": ground.seconds(meter.first_ns),
        "last_s": ground.seconds(meter.last_ns),
        "peak_risk": meter.peak_risk,
        **meter.words,
        "advisory_onsets_s": list(meter.summary().advisory_onsets_s),
    }
    return output.CommandResult(summary)
