"""The option --car: array and cameras of a vehicle in one file, in place of --array and --camera."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .array_options import given_array

if TYPE_CHECKING:
    from worldstate.adapters.camera.pinhole import PinholeCamera
    from worldstate.adapters.listen import Source
    from worldstate.frontend.array.microphone_array import MicrophoneArray

HELP = """\
--car FILE stands for --array and --camera, JSON in base_link (x forward, y left, z up):
  {"array": {"file": "mics.csv", "position_m": [1.2, 0, 1.6], "pitch_deg": -5},
   "cameras": [{"name": "front", "width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90,
                "position_m": [1.9, 0, 1.3], "stamp_offset_s": 0.04}]}"""


def add_car_options(parser: argparse.ArgumentParser) -> None:
    """Declare --car and --camera-name."""
    parser.description = f"{parser.description}\n\n{HELP}"
    add = parser.add_argument_group("vehicle").add_argument
    add("--car", type=Path, metavar="FILE", help="array and cameras, where they are mounted")
    add("--camera-name", metavar="NAME", help="which of its cameras is asked (default: the first)")


def add_several_cameras(parser: argparse.ArgumentParser) -> None:
    """Declare --camera-detections."""
    told = "what each of several cameras of --car reported, in place of --detections: all are asked"
    parser.add_argument("--camera-detections", nargs="+", default=[], metavar="NAME=PATH", help=told)


def with_several_cameras(arguments: argparse.Namespace, source: "Source") -> "Source":
    """Return what is listened to with the cameras that --camera-detections names, as it is without."""
    from worldstate.adapters.vehicle.car_file import read_car
    from worldstate.ground.errors import InvalidArgumentError
    from worldstate.operations.recordings.car_cameras import with_cameras

    pairs = [text.partition("=")[::2] for text in arguments.camera_detections]
    if not pairs:
        return source
    if arguments.car is None or arguments.detections is not None or arguments.camera_name is not None:
        problem = "expected --car with it, and neither --detections nor --camera-name"
        raise InvalidArgumentError(f"--camera-detections: {problem}")
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names) or not all(name and path for name, path in pairs):
        got = " ".join(arguments.camera_detections)
        raise InvalidArgumentError(f"--camera-detections: expected NAME=PATH of different cameras, got {got}")
    return with_cameras(source, read_car(arguments.car), {name: Path(path) for name, path in pairs})


def given_sensors(
    arguments: argparse.Namespace,
) -> "tuple[MicrophoneArray | None, PinholeCamera | Path | None]":
    """Return the array and the camera that --car, or --array and --camera, name; None where none is given."""
    from worldstate.adapters.vehicle.car_file import read_car
    from worldstate.ground.errors import InvalidArgumentError

    if arguments.car is None:
        if arguments.camera_name is not None:
            raise InvalidArgumentError("--camera-name: expected --car with it, which holds the cameras")
        return given_array(arguments), arguments.camera
    if arguments.array is not None or arguments.camera is not None:
        raise InvalidArgumentError("--car: expected no --array and no --camera with it, it holds both")
    car = read_car(arguments.car)
    return car.array, car.camera(arguments.camera_name)
