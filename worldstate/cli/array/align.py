"""`worldstate array align`: estimate offset and yaw of a camera against the array, from vehicles in view.

Compare the bearings of the sound with the boxes of vehicles that turn through the view of a standing camera,
and print the corrections of its time stamps and its yaw. Vehicles from both sides separate the two.

Each interval is a bootstrap over the vehicles. It does not include errors common to all vehicles: the source
of the sound is assumed a third of the length behind the front (a tenth more or less is 0.1 s of offset), at a
distance of 10 m (3 ms per metre).

Examples
--------
  worldstate array align drives/* --car car.json --camera front --out aligned.json
  worldstate array align ovad_dataset --json
"""

import argparse
from dataclasses import asdict
from pathlib import Path

from worldstate.cli.common import command, inputs, output, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    told = "data sets, recording folders, or a sound file with --detections"
    add("input", type=Path, nargs="+", metavar="RECORDING", help=told)
    inputs.add_sensor_options(parser)
    inputs.add_search_options(parser)
    add("--out", type=Path, metavar="FILE", help="the file of --car with both corrections, in its folder")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.vehicle.car_file import write_aligned
    from worldstate.operations.alignment.camera_alignment import LARGEST_OFFSET_S, align, heard_passes
    from worldstate.operations.calibration.cueing_calibration import find_inputs

    output.check_outputs(arguments, "out")
    command.check_beside(arguments, out="car")
    recordings = [found for path in arguments.input for found in find_inputs(path)]
    inputs.check_boxes(arguments, len(recordings))
    bare = {"settings": inputs.search_of(arguments), "uncalibrated": True}
    passes = [
        one
        for path in progress.track(recordings, "listening", len(recordings))
        for one in heard_passes(inputs.recorded(arguments, path, **bare), LARGEST_OFFSET_S)
    ]
    found = align(passes)
    if arguments.out is not None:
        name = None if arguments.camera is None else str(arguments.camera)
        write_aligned(arguments.car, arguments.out, name, found.offset_s, found.yaw_deg)
    return output.CommandResult({"recordings": len(recordings)} | asdict(found))
