"""Options that name a camera's detector, shared by the commands that look at video."""

import argparse
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from .command import add_choice

if TYPE_CHECKING:
    from worldstate.adapters.camera.detections import DetectionFilter
    from worldstate.adapters.camera.onnx_detector import OnnxDetector, OnnxSettings
    from worldstate.operations.detectors.miss_rate_measurement import MakeDetector


def add_detector_options(parser: argparse.ArgumentParser) -> None:
    """Declare --detector, --onnx-model and --labels."""
    kinds = "background subtraction by mixtures or neighbours, or a model"
    add_choice(parser, "--detector", kinds, "motion", "knn", "onnx")
    parser.add_argument("--onnx-model", type=Path, metavar="ONNX", help="model in YOLO's output form")
    parser.add_argument("--labels", nargs="+", default=["car"], metavar="NAME", help="classes of the model")


def detector_maker(arguments: argparse.Namespace) -> "MakeDetector":
    """Return what makes a detector, in any process; a model is opened once in each.

    Raises
    ------
    InvalidArgumentError
        If a model is wanted and none given.
    """
    from worldstate.adapters.camera.motion_detector import MotionDetector, MotionSettings
    from worldstate.adapters.camera.onnx_detector import OnnxSettings
    from worldstate.ground.errors import InvalidArgumentError

    if arguments.detector == "onnx":
        if arguments.onnx_model is None:
            raise InvalidArgumentError("--onnx-model: expected a model for --detector onnx")
        make = partial(_opened, arguments.onnx_model, OnnxSettings(labels=tuple(arguments.labels)))
        make()  # what is wrong with a model is said before the work begins
        return make
    settings = MotionSettings(background="knn" if arguments.detector == "knn" else "mog2")
    return partial(MotionDetector, settings)


@cache
def _opened(path: Path, settings: "OnnxSettings") -> "OnnxDetector":
    """Open a model once a process."""
    from worldstate.adapters.camera.onnx_detector import open_onnx

    return open_onnx(path, settings)


def detector_filter(arguments: argparse.Namespace) -> "DetectionFilter":
    """Return which of its boxes count: all of a motion detector's, whose score is no confidence."""
    from worldstate.adapters.camera.camera_channel import any_motion
    from worldstate.adapters.camera.detections import DetectionFilter

    return DetectionFilter() if arguments.detector == "onnx" else any_motion()


def detector_name(arguments: argparse.Namespace) -> str:
    """Return the detector's name, with that of its model."""
    model = "" if arguments.onnx_model is None else f" {arguments.onnx_model.name}"
    return f"{arguments.detector}{model}"
