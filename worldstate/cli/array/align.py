"""`worldstate array align`: offset and yaw of a camera against the array, from vehicles in view.

Compare the bearings of the sound with the boxes of vehicles that turn through the view of a standing camera,
and say what has to be added to the stamps of its images and to its yaw. Vehicles from both sides tell the two
apart.

Each interval is a bootstrap over the vehicles, and does not hold what all vehicles share: where a vehicle is
heard, taken as a third of its length behind the front (a tenth more or less is 0.1 s of offset), and 10 m for
the way of the sound (3 ms a metre).

Examples
--------
  worldstate array align drives/* --car car.json --camera front --out aligned.json
  worldstate array align ovad_dataset --json
"""

import argparse
from pathlib import Path

from worldstate.cli.common import command, inputs, output, progress, sensors


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    told = "data sets, recording folders, or a sound file with --detections"
    add("input", type=Path, nargs="+", metavar="RECORDING", help=told)
    sensors.add_sensor_options(parser)
    inputs.add_search_options(parser)
    add("--out", type=Path, metavar="FILE", help="the file of --car, with both added, beside it")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from dataclasses import asdict, replace

    from worldstate.adapters.vehicle.car_file import write_aligned
    from worldstate.operations.alignment.camera_alignment import LARGEST_OFFSET_S, align, heard_passes
    from worldstate.operations.calibration.cueing_calibration import find_inputs

    output.check_outputs(arguments, "out")
    command.check_beside(arguments, out="car")
    recordings = [found for path in arguments.input for found in find_inputs(path)]
    sensors.check_boxes(arguments, len(recordings))
    settings = replace(inputs.search_of(arguments), mask_dead=True)
    passes = [
        one
        for path in progress.track(recordings, "listening", len(recordings))
        for one in heard_passes(sensors.recorded(arguments, path, settings), LARGEST_OFFSET_S)
    ]
    found = align(passes)
    if arguments.out is not None:
        name = None if arguments.camera is None else str(arguments.camera)
        write_aligned(arguments.car, arguments.out, name, found.offset_s, found.yaw_deg)
    return output.CommandResult({"recordings": len(recordings)} | asdict(found))
