"""Options that name a camera's detector, shared by the commands that look at video."""

import argparse
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worldstate.adapters.camera.detections import DetectionFilter
    from worldstate.adapters.camera.onnx_detector import OnnxDetector
    from worldstate.operations.detectors.miss_rate_measurement import MakeDetector


# Background subtraction: its score is no confidence.
MOVING = "motion", "knn"
BUILT_IN = *MOVING, "onnx"


def add_detector_options(parser: argparse.ArgumentParser, default: str | None = "motion") -> None:
    """Declare --detector, --onnx-model and --labels."""
    kinds = "motion, knn: background subtraction by mixtures or neighbours; onnx: a model; or the name of one"
    told = f"{kinds} that an installed package brings (default: {default or 'none'})"
    parser.add_argument("--detector", metavar="NAME", default=default, help=told)
    parser.add_argument("--onnx-model", type=Path, metavar="ONNX", help="model in YOLO's output form")
    parser.add_argument("--labels", nargs="+", default=["car"], metavar="NAME", help="classes of the model")


def detector_maker(arguments: argparse.Namespace) -> "MakeDetector":
    """Return what makes a detector, in any process; a model is opened once in each.

    Raises
    ------
    InvalidArgumentError
        If a model is wanted and none given, or no package brings a detector of that name.
    """
    from worldstate.adapters.camera.motion_detector import MotionDetector
    from worldstate.adapters.own_parts import DetectorPart, load_part
    from worldstate.ground.errors import InvalidArgumentError

    if arguments.detector == "onnx":
        if arguments.onnx_model is None:
            raise InvalidArgumentError("--onnx-model: expected a model for --detector onnx")
        make = partial(_opened, arguments.onnx_model, tuple(arguments.labels))
        make()  # what is wrong with a model is said before the work begins
        return make
    if arguments.detector not in MOVING:
        make_own: DetectorPart = load_part("worldstate.detectors", arguments.detector, "--detector", BUILT_IN)
        return make_own
    return partial(MotionDetector, "knn" if arguments.detector == "knn" else "mog2")


@cache
def _opened(path: Path, labels: tuple[str, ...]) -> "OnnxDetector":
    """Open a model once a process."""
    from worldstate.adapters.camera.onnx_detector import open_onnx

    return open_onnx(path, labels)


def detector_filter(arguments: argparse.Namespace) -> "DetectionFilter":
    """Return which of its boxes count: all of a motion detector's, whose score is no confidence."""
    from worldstate.adapters.camera.camera_channel import any_motion
    from worldstate.adapters.camera.detections import DetectionFilter

    return any_motion() if arguments.detector in MOVING else DetectionFilter()


def detector_name(arguments: argparse.Namespace) -> str:
    """Return the detector's name, with that of its model."""
    model = "" if arguments.onnx_model is None else f" {arguments.onnx_model.name}"
    return f"{arguments.detector}{model}"
