"""Options of the camera that is asked about what is heard: its detections, its lens, which boxes count."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .array_options import given_array

if TYPE_CHECKING:
    from worldstate.adapters.audio.open_sound import SoundInput
    from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog
    from worldstate.adapters.camera.pinhole import PinholeCamera
    from worldstate.adapters.listen import Source

DETECTIONS_HELP = """\
--detections takes OVAD's JSON, a COCO results list (JSON) or a folder of YOLO text. In the two last the
number of an image ("image_id", or the number that the name of a text file ends in) counts from 0 at the first
sample of the sound, --image-rate a second; classes have COCO's numbers (car is 3) and YOLO's (car is 2). Up
to the last image with a box, one that lists nothing was searched in vain; later ones were not asked."""
LENS_HELP = """\
--camera takes JSON:
{"width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90}, or "fx" and "cx" of a calibration in place of
the field of view; optional "yaw_deg" (left), "pitch_deg" (up), "roll_deg" (left side up), "position_m":
[x, y, z] in base_link, "stamp_offset_s" (added to the stamps of its images: the clock of the sound)."""


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Declare --detections, --image-rate, --camera, --miss-rates and which boxes count."""
    parser.description = f"{parser.description}\n\n{DETECTIONS_HELP} {LENS_HELP}"
    group = parser.add_argument_group("camera")
    group.add_argument("--detections", type=Path, metavar="PATH", help="what its detector reported")
    rate = "images a second, where they carry no stamp (default: 10)"
    group.add_argument("--image-rate", type=float, metavar="HZ", help=rate)
    add_lens_options(group)


def add_lens_options(group: "argparse._ArgumentGroup") -> None:
    """Declare --camera, --miss-rates and which boxes count."""
    add = group.add_argument
    add("--camera", type=Path, metavar="JSON", help="its lens (default: OVAD's camera)")
    add("--min-box-px", type=float, default=100.0, metavar="PX", help="boxes must be higher (100)")
    add("--min-score", type=float, default=0.75, metavar="P", help="lowest score (0.75)")
    classes = "classes that count as road users (car motorcycle)"
    add("--classes", nargs="+", default=["car", "motorcycle"], metavar="NAME", help=classes)
    add("--miss-rates", type=Path, metavar="JSON", help="how often it misses, as measure-absence wrote it")


def boxes_of(arguments: argparse.Namespace) -> "DetectionFilter":
    """Return which boxes count."""
    from worldstate.adapters.camera.detections import DetectionFilter

    return DetectionFilter(frozenset(arguments.classes), arguments.min_score, arguments.min_box_px)


def given_detections(
    arguments: argparse.Namespace, camera: "Path | PinholeCamera | None"
) -> "Path | DetectionLog | None":
    """Return what --detections names, read where --image-rate says how fast its images came."""
    from worldstate.adapters.camera.detection_formats import read_any_detections
    from worldstate.adapters.camera.pinhole import PinholeCamera, read_camera
    from worldstate.ground.errors import InvalidArgumentError

    path: Path | None = arguments.detections
    if arguments.image_rate is None:
        return path
    if path is None:
        raise InvalidArgumentError("--image-rate: expected --detections with it")
    lens = read_camera(camera) if isinstance(camera, Path) else camera or PinholeCamera()
    return read_any_detections(path, arguments.image_rate, (lens.width_px, lens.height_px))


def camera_source(arguments: argparse.Namespace, sound: "SoundInput") -> "tuple[Source, DetectionLog]":
    """Return a recording of which boxes and camera are used, and no model has to fit the array; the boxes.

    Raises
    ------
    InputFileError
        If there are no boxes of a camera.
    """
    from worldstate.adapters.listen import ListenSettings, open_source
    from worldstate.ground.errors import InputFileError

    source = open_source(
        sound,
        array=given_array(arguments),
        detections=given_detections(arguments, arguments.camera),
        camera=arguments.camera,
        settings=ListenSettings(boxes=boxes_of(arguments), uncalibrated=True),
    )
    if source.detections is None:
        problem = "expected boxes of a camera beside it, or --detections with what a detector reported"
        raise InputFileError(source.audio_path, problem)
    return source, source.detections


def box_counts(source: "Source", *, as_json: bool) -> object:
    """Say how many boxes count and why the others do not; None without a camera."""
    from dataclasses import asdict

    from worldstate.adapters.camera.box_linking import count_boxes

    if source.detections is None:
        return None
    counts = count_boxes(source.detections, source.settings.boxes)
    return asdict(counts) if as_json else str(counts)
