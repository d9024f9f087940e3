"""`worldstate sim to-bag`: convert a recording to a bag of ROS 2.

Write sound, array, detections, the poses of both in base_link and, if known, the speed of the ego as
messages. The bag shows the topics and types that `worldstate run BAG` reads; the documentation has the
definitions.

Examples
--------
  worldstate sim to-bag ovad_dataset/SA1/left/1_00_0002 street_bag
  worldstate sim to-bag out/demo/recording/SB1/right/3_02_0000 street_bag --ros-storage sqlite3
"""

import argparse
from pathlib import Path

from worldstate import adapters, ground
from worldstate.cli.common import command, inputs, output, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("recording", type=Path, metavar="RECORDING", help="folder of a recording in the OVAD layout")
    add("out", type=Path, metavar="BAG", help="folder to write; it must not exist")
    start = "time of the first sample, seconds since 1970 in a real bag (default: %(default)g)"
    add("--start", type=float, default=0.0, metavar="S", help=start)
    command.add_choice(parser, "--ros-storage", "storage of the bag that is written", "mcap", "sqlite3")
    inputs.add_array_options(parser)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.datasets.ovad import choose_array
    from worldstate.adapters.ros.bag_writer import check_bag_target, odometry_of, write_bag

    check_bag_target(arguments.out)
    start_ns = ground.nanoseconds(ground.in_range("--start", arguments.start, 0.0, 4e9))
    recording = adapters.Recording.open(arguments.recording)
    array, seen = choose_array(recording.path, inputs.given_array(arguments)), recording.read_detections()
    ego = odometry_of(recording)
    written = write_bag(
        arguments.out, recording.audio_path, array, seen, ego, start_ns=start_ns,
        camera=None if seen is None else adapters.PinholeCamera.ovad(), storage=arguments.ros_storage,
    )  # fmt: skip
    sound_s = list(progress.track(written, f"writing {arguments.out.name}"))[-1]
    summary = {
        "bag": str(arguments.out),
        "sound_s": round(sound_s, 3),
        "microphones": array.n_microphones,
        "images": None if seen is None else len(seen),
        "odometry": ego is not None,
    }
    return output.CommandResult(summary)
