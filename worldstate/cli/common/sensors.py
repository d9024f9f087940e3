"""The sensors of a vehicle: --car, or --array with a camera, its detector and the boxes that count."""

import argparse
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import adapters, frontend
from worldstate.ground.errors import InputFileError, InvalidArgumentError

from .inputs import add_array_options, describe, given_array, topics_of, with_channels
from .output import say

if TYPE_CHECKING:
    from worldstate.adapters.audio.sound_file import SoundInput
    from worldstate.adapters.files.odometry_file import OdometryLog
    from worldstate.adapters.vehicle.car_file import CameraSetup, CarSensors
    from worldstate.operations.detectors.miss_rate_measurement import MakeDetector

    Seen = Path | adapters.DetectionLog | None

# Background subtraction: its score is no confidence.
MOVING = "motion", "knn"


def add_sensor_options(parser: argparse.ArgumentParser) -> None:
    """Declare --array, --car and the camera of a recording.

    --detections takes OVAD's JSON, a COCO results list (JSON), MOTChallenge text (.txt) or a folder of YOLO
    text. In the three last the number of an image ("image_id", frame, or the number that the name of a text
    file ends in) counts from 0, MOTChallenge's from 1, at the first sample of the sound, ten a second;
    classes have COCO's numbers (car is 3) and YOLO's (car is 2), and MOTChallenge's boxes are cars. Up to
    the last image with a box, one that lists nothing was searched in vain; of later ones --images tells,
    or the "images" of a COCO object {"images": [{"id": 0}, ...], "annotations": [results]}. Another rate than
    ten a second is stated by --image-rate, or by "image_rate_hz" of the camera.
    """
    add_array_options(parser)
    add_car_option(parser)
    describe(parser, add_sensor_options)
    group = parser.add_argument_group("camera")
    told = "what its detector reported; NAME=PATH of a camera of --car, repeated: all these are asked"
    group.add_argument("--detections", type=Path, action="append", default=[], metavar="PATH", help=told)
    told = "the detector looked at so many images, those without a box included (COCO results, text)"
    group.add_argument("--images", type=int, metavar="N", help=told)
    told = "images a second of --detections, where they carry no stamp (default: of the camera, else 10)"
    group.add_argument("--image-rate", type=float, metavar="HZ", help=told)
    add_lens_options(parser, group)


def add_car_option(parser: argparse.ArgumentParser) -> None:
    """Declare --car.

    --car FILE alone says what a vehicle has, JSON in base_link (x forward, y left, z up), files beside it:
      {"array": {"file": "mics.csv", "position_m": [1.2, 0, 1.6], "pitch_deg": -5},
       "cameras": [{"name": "front", "width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90,
                    "position_m": [1.9, 0, 1.3], "stamp_offset_s": 0.04, "detections": "front.json"}],
       "model": "mine.json", "odometry": "odometry.csv", "measurements": {"radar": "radar.csv"},
       "crossing_m": 9}
    Every key is optional. An option in its place counts before it; --camera NAME names one of its cameras.
    """
    describe(parser, add_car_option)
    add = parser.add_argument_group("vehicle").add_argument
    add("--car", type=Path, metavar="FILE", help="array, cameras and what they reported, odometry, model")


def add_lens_options(parser: argparse.ArgumentParser, group: "argparse._ArgumentGroup") -> None:
    """Declare --camera and --miss-rates.

    --camera takes JSON:
    {"width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90, "position_m": [0, 0, 0]}, the position in
    base_link, metres, or "fx" and "cx" of a calibration in place of the field of view; optional "yaw_deg"
    (left), "pitch_deg" (up), "roll_deg" (left side up), "stamp_offset_s" (added to the stamps of its images:
    the clock of the sound); of its images "image_rate_hz" (10); of its boxes "classes" (["car",
    "motorcycle"; names of other data sets are known), "min_score" (0.75) and "min_box_px" (0.082 of the
    height, as 100 of 1216: boxes must be higher); "miss_rates", as `worldstate model detector` wrote them;
    "labels" (["car"]), the classes of an ONNX model. "cameras" of --car have the same keys.
    """
    describe(parser, add_lens_options)
    lens = "its lens and place (default: OVAD's, with OVAD's array), or the name of one of --car (the first)"
    group.add_argument("--camera", type=Path, metavar="JSON", help=lens)
    told = "how often it misses, as `model detector` wrote it"
    group.add_argument("--miss-rates", type=Path, metavar="JSON", help=told)


def add_detector_option(parser: argparse.ArgumentParser, default: str | None = "motion") -> None:
    """Declare --detector."""
    moving = "motion, knn: background subtraction by mixtures or neighbours"
    other = "FILE.onnx: a model in YOLO's output form; or the name of one that an installed package brings"
    told = f"{moving}; {other} (default: {default or 'none'})"
    parser.add_argument("--detector", metavar="NAME", default=default, help=told)


@dataclass(frozen=True, slots=True)
class GivenSensors:
    """What --car names, or the single options in its place; None for what is not given."""

    arguments: argparse.Namespace
    car: "CarSensors"
    camera: "adapters.PinholeCamera | None"  # The one that is asked
    setup: "CameraSetup"  # Of that camera

    def __post_init__(self) -> None:
        boxes = self.arguments.detections or self.setup.detections
        for option in ("images", "image_rate"):
            if getattr(self.arguments, option, None) is not None and (not boxes or self.several()):
                name = option.replace("_", "-")
                raise InvalidArgumentError(f"--{name}: expected --detections with it, of one camera")

    @property
    def model(self) -> Path | None:
        """The model file, None for the one that ships."""
        model: Path | None = self.arguments.model or self.car.model
        return model

    @property
    def miss_rates(self) -> Path | None:
        """The file that tells how often the camera's detector misses."""
        rates: Path | None = self.arguments.miss_rates or self.setup.miss_rates
        return rates

    def unasked(self) -> str:
        """Return what was given of a camera, for a notice if nothing was detected by it; "" for nothing."""
        rates = "--miss-rates" if self.arguments.miss_rates else ""
        return "--camera" if self.arguments.camera else rates or "cameras of --car" * bool(self.car.cameras)

    def boxes(self) -> "adapters.DetectionFilter":
        """Return which boxes count: all of a motion detector's, whose score is no confidence."""
        from worldstate.adapters.camera.camera_channel import any_motion

        return any_motion() if self.arguments.detector in MOVING else self.setup.boxes

    def detector(self) -> "MakeDetector | None":
        """Return what makes the detector of --detector, None without it."""
        name = self.arguments.detector
        return None if name is None else detector_maker(name, self.setup.labels)

    def named(self) -> dict[str, str]:
        """Return what --detections has for several cameras of --car, by their names; empty for one camera."""
        from worldstate.adapters.own_parts import part_and_target

        given = list(map(str, self.arguments.detections))
        if self.arguments.car is None or not any("=" in text for text in given):
            if len(given) > 1:
                problem = "expected one, or --car with NAME=... of its cameras"
                raise InvalidArgumentError(f"--detections: {problem}")
            return {}
        pairs = [part_and_target("--detections", text) for text in given]
        if len(dict(pairs)) < len(pairs) or self.arguments.camera is not None:
            problem = "expected NAME=... of different cameras, without --camera"
            raise InvalidArgumentError(f"--detections: {problem}, got {' '.join(given)}")
        return dict(pairs)

    def several(self) -> dict[str, Path]:
        """Return what several cameras of --car reported, by their names; empty where one is asked."""
        if self.arguments.detections or self.arguments.camera is not None:
            return {name: Path(path) for name, path in self.named().items()}
        known = {name: one.detections for name, one in self.car.setups.items()}
        files = {name: path for name, path in known.items() if path is not None}
        return files if len(files) > 1 else {}

    def detections(self) -> "Path | adapters.DetectionLog | None":
        """Return what the one camera that is asked reported, read where its images do not come at 10 Hz."""
        given, n_images = self.arguments.detections, self.arguments.images
        path = given[0] if given else self.setup.detections
        stated_hz = self.arguments.image_rate
        rate_hz = self.setup.image_rate_hz if stated_hz is None else stated_hz
        if path is None or (n_images, rate_hz) == (None, None):
            return path
        lens = self.camera or adapters.PinholeCamera.ovad()
        log = adapters.read_any_detections(path, rate_hz, (lens.width_px, lens.height_px), n_images)
        if stated_hz is not None and log.counted_hz is None:
            raise InvalidArgumentError(f"--image-rate: expected images without stamps, {path} has them")
        return log


def given_sensors(arguments: argparse.Namespace) -> GivenSensors:
    """Return the sensors that --car, or --array and --camera, name."""
    from worldstate.adapters.vehicle.car_file import CameraSetup, CarSensors, read_camera_setup, read_car

    if arguments.car is None:
        setup, camera = CameraSetup(), None
        if arguments.camera is not None:
            camera, setup = read_camera_setup(arguments.camera)
        return GivenSensors(arguments, CarSensors(given_array(arguments)), camera, setup)
    if arguments.array is not None:
        raise InvalidArgumentError("--car: expected no --array with it, it holds the array")
    car = read_car(arguments.car)
    car = replace(car, array=with_channels(arguments, car.array))
    name = next(iter(car.cameras), None) if arguments.camera is None else str(arguments.camera)
    setup = CameraSetup() if name is None else car.setups.get(name, CameraSetup())
    return GivenSensors(arguments, car, None if name is None else car.camera(name), setup)


def check_boxes(arguments: argparse.Namespace, recordings: int) -> None:
    """Refuse the boxes of one recording, by --detections or by the camera of --car, for several."""
    if recordings > 1 and (arguments.detections or given_sensors(arguments).setup.detections):
        problem = "expected one recording with boxes of --detections or --car, folders bring their own"
        raise InvalidArgumentError(f"{problem}, got {recordings}")


def with_bag(
    given: GivenSensors, sound: "SoundInput", seen: "Seen"
) -> "tuple[frontend.MicrophoneArray | None, Seen, OdometryLog | None]":
    """Return array and detections as given, of a bag those that it holds in their place; and its odometry."""
    from worldstate.adapters.ros.bag_input import BagSound, needed_array, read_beside

    if not isinstance(sound, BagSound):
        return given.car.array, seen, None
    topics = {name: topic for name, topic in topics_of(given.arguments).items() if name != "audio"}
    held = read_beside(sound, **topics)
    array = needed_array(sound, given.car.array or held.array)
    return array, held.detections if seen is None else seen, held.ego


def recorded(
    arguments: argparse.Namespace, sound: "SoundInput", settings: "adapters.ListenSettings"
) -> "adapters.Source":
    """Return a recording of which sound, boxes and camera are used, and no model has to fit the array."""
    given = given_sensors(arguments)
    array, seen, _ = with_bag(given, sound, given.detections())
    heard = replace(settings, boxes=given.setup.boxes, uncalibrated=True)
    return adapters.open_source(sound, array=array, detections=seen, camera=given.camera, settings=heard)


def camera_source(
    arguments: argparse.Namespace, sound: "SoundInput"
) -> "tuple[adapters.Source, adapters.DetectionLog]":
    """Return a recording, and the boxes of its camera.

    Raises
    ------
    InputFileError
        If there are no boxes of a camera.
    """
    source = recorded(arguments, sound, adapters.ListenSettings())
    if source.detections is None:
        problem = "expected boxes of a camera beside it, or --detections with what a detector reported"
        raise InputFileError(source.audio_path, problem)
    return source, source.detections


def box_counts(source: "adapters.Source", *, as_json: bool) -> object:
    """Say how many boxes count and why the others do not, of several cameras each; None without a camera."""
    from worldstate.adapters.camera.detections import count_boxes, told_counts

    keep = replace(source.settings.boxes, image_height_px=source.camera.height_px)
    held = {} if source.detections is None else {"": (source.detections, keep)}
    if source.co_evidence is not None:
        held = {f"{name}: ": (one.detections, one.keep) for name, one in source.co_evidence.cameras.items()}
    each = {name: count_boxes(*one) for name, one in held.items()}
    for name, counts in each.items():
        if not counts["frames"]:
            say(f"{name}no image was looked at, so that the camera counts as not asked (--images N)")
        elif not counts["empty"] and not counts["parked"]:
            question = "are those missing in which nothing was found (--images N)?"
            say(f"{name}no image is without a box: {question}")
    if source.co_evidence is not None:
        named = {name.removesuffix(": "): counts for name, counts in each.items()}
        return named if as_json else [name + told_counts(counts) for name, counts in each.items()]
    return next((counts if as_json else told_counts(counts) for counts in each.values()), None)


def detector_maker(name: str, labels: tuple[str, ...] = ("car",)) -> "MakeDetector":
    """Return what makes a detector, in any process; a model, with the labels of its classes, is opened once.

    Raises
    ------
    InvalidArgumentError
        If no package brings a detector of that name.
    """
    from worldstate.adapters.own_parts import DetectorPart, OwnDetector, load_part

    if name.endswith(".onnx"):
        make = partial(_opened, Path(name), labels)
        make()  # what is wrong with a model is said before the work begins
        return make
    if name not in MOVING:
        known = (*MOVING, "FILE.onnx")
        make_own: DetectorPart = load_part("worldstate.detectors", name, "--detector", known)
        return partial(OwnDetector.of, name, make_own)
    return partial(adapters.MotionDetector, "knn" if name == "knn" else "mog2")


@cache
def _opened(path: Path, labels: tuple[str, ...]) -> "adapters.OnnxDetector":
    """Open a model once a process."""
    return adapters.open_onnx(path, labels)


def detector_name(name: str) -> str:
    """Return the name of a detector in reports: of a model that of its file, too."""
    return f"onnx {Path(name).name}" if name.endswith(".onnx") else name
