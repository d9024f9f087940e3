"""Options that several commands share: recording, array, camera, model, place."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import getdoc
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldstate import adapters, frontend
from worldstate.ground.errors import InputFileError, InvalidArgumentError

if TYPE_CHECKING:
    from worldstate.abduction.sequence.street_sides import SidePatterns
    from worldstate.adapters.audio.sound_file import Audio, SoundInput
    from worldstate.state import Context

_EXAMPLE = "  arecord -D hw:1 -t raw -f S32_LE -r 48000 -c 8 | {} pcm:48000:8:s32"
# An array with a smaller extent along an axis is flat, metres.
_FLAT_M = 0.005


def describe(parser: argparse.ArgumentParser, declare: Callable[..., object]) -> None:
    """Append the docstring of a function, except its first line, to the description of a command."""
    _, _, text = (getdoc(declare) or "").partition("\n\n")
    parser.description = f"{parser.description}\n\n{text}"


def add_sound_options(parser: argparse.ArgumentParser) -> None:
    """Declare INPUT and --topic.

    INPUT is one of
      a multichannel sound file (WAV, RF64, W64, FLAC), or one file per microphone in their order
      a folder with one recording in the OVAD layout (out_multi.wav)
      a bag of ROS 2 (folder, .mcap or .db3)
      pcm:RATE:CHANNELS:FORMAT, raw samples on standard input: s16, s24, s24_32 (24 bits in four bytes, as
      arecord's S24_LE), s32 or f32, little-endian
    """
    describe(parser, add_sound_options)
    parser.epilog = f"{parser.epilog}\n{_EXAMPLE.format(parser.prog)}"
    what = "sound file, recording folder, one file per microphone, bag, or pcm:RATE:CHANNELS:FORMAT"
    parser.add_argument("input", type=Path, nargs="+", metavar="INPUT", help=what)
    topic = (
        "audio=, detections= or odometry=TOPIC of a bag, if it has several of a type; may be repeated; "
        "audio=TOPIC:RATE:CHANNELS:FORMAT if the messages do not state the format"
    )
    parser.add_argument("--topic", action="append", default=[], metavar="NAME=TOPIC", help=topic)


def add_array_options(
    parser: argparse.ArgumentParser,
    default: str = "the data set's, or OVAD's",
    action: str = "store",
) -> None:
    """Declare --array.

    --array takes a file with one microphone per channel, in metres, x forward, y left, z up:
      CSV   x,y,z per line; a header such as x_mm,y_mm,z_mm states another unit
      JSON  [[x, y, z], ...] or {"positions_m": [[x, y, z], ...]}; optional "channels": [2, 3, 4, 5] for a
            sound card with more channels, "axes": "acoular"
      XML   of Acoular and OVAD, in their axes (x right, y up, z forward)
      .cfg  of ODAS
    or a board: respeaker-4, respeaker-6, respeaker-usb, uma-8, xmos (flat, x forward), uma-16 (upright)
    """
    describe(parser, add_array_options)
    text = f"microphone positions, or a board (default: {default})"
    parser.add_argument("--array", type=Path, action=action, metavar="FILE", help=text)


def add_search_options(parser: argparse.ArgumentParser) -> None:
    """Declare --band and --azimuth-span, the range of the search for a bearing."""
    add = parser.add_argument
    band = "frequency band of the bearing, Hz (default: by the spacing of the microphones)"
    add("--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help=band)
    span = "width of the searched sector ahead, degrees (default: by the array)"
    add("--azimuth-span", type=float, metavar="DEG", help=span)


def add_sensor_options(parser: argparse.ArgumentParser) -> None:
    """Declare --array, --car, --detections and --camera.

    --detections takes OVAD's JSON, COCO results (a list, or an object with "images" and "annotations"),
    MOTChallenge text (.txt) or a folder of YOLO text. The time of the first image is that of the first
    sample.
    """
    add_array_options(parser)
    add_car_options(parser)
    describe(parser, add_sensor_options)
    text = "detections of the camera; NAME=PATH for a camera of --car, may be repeated"
    parser.add_argument("--detections", type=Path, action="append", default=[], metavar="PATH", help=text)


def add_car_options(parser: argparse.ArgumentParser) -> None:
    """Declare --car and --camera.

    --car takes JSON, x forward, y left, z up; every key is optional:
      {"array": {"file": "mics.csv", "position_m": [1.2, 0, 1.6], "pitch_deg": -5},
       "cameras": [{"name": "front", "width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90,
                    "position_m": [1.9, 0, 1.3], "detections": "front.json", "miss_rates": "beta.json"}],
       "model": "mine.json", "odometry": "odometry.csv", "measurements": {"radar": "radar.csv"}}
    --camera takes JSON with the keys of one of these cameras, or its name. Further keys: "fx" and "cx" in
    place of the field of view; "yaw_deg", "pitch_deg", "roll_deg"; "stamp_offset_s"; "image_rate_hz" (10)
    for images without time stamps; "classes", "min_score" and "min_box_px" of the boxes that are used;
    "labels" of an ONNX model.
    """
    describe(parser, add_car_options)
    add = parser.add_argument
    add("--car", type=Path, metavar="FILE", help="array, cameras, odometry, model and sensors of a vehicle")
    lens = "the camera, or its name in --car (default: the first of --car; OVAD's for OVAD's array)"
    add("--camera", type=Path, metavar="JSON", help=lens)


def add_detector_option(parser: argparse.ArgumentParser, default: str | None = "motion") -> None:
    """Declare --detector."""
    text = (
        "detector for the video: motion or knn (background subtraction), FILE.onnx (YOLO), or the name of "
        f"an installed one (default: {default or 'none'})"
    )
    parser.add_argument("--detector", metavar="NAME", default=default, help=text)


def add_listen_options(parser: argparse.ArgumentParser) -> None:
    """Declare --model, --budget, --alpha, --uncalibrated and --context.

    --context takes a file of `street learn`, or JSON:
      {"arms": [{"direction": "left", "corner_m": [5.0, 3.2], "crossing_m": 9.0}, ...]}
    with the corner that hides the arm (x ahead, y left) and the distance of the lane behind it, metres, or
    "open": true; optional "speed_mps" and "corner_std_m" of an arm, "rates", "priors", "ego_speed_mps",
    "site", "view_half_angle_deg".
    """
    describe(parser, add_listen_options)
    add = parser.add_argument
    add("--model", type=Path, help="model file, or the name of a shipped model (default: by the array)")
    add_budget_options(parser)
    text = "use a model that was made for another array or sample rate; cues then state no budget"
    add("--uncalibrated", action="store_true", help=text)
    text = "corners, lanes and rates of this place (default: a usual blind junction)"
    add("--context", type=Path, metavar="FILE", help=text)


def listen_parts(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `open_source` that `add_listen_options` declares."""
    context, sides = place_of(arguments.context)
    same = {name: vars(arguments)[name] for name in ("model", "budget", "alpha", "uncalibrated")}
    return same | {"context": context, "sides": sides}


def add_budget_options(parser: argparse.ArgumentParser) -> None:
    """Declare --budget and --alpha, which set the threshold of the alarm."""
    add = parser.add_mutually_exclusive_group().add_argument
    add("--budget", type=float, metavar="ONSETS", help="false alarms per hour (default: the model's)")
    add("--alpha", type=float, metavar="SHARE", help="or the share of hazard-free time in alarm")


def add_memory_options(parser: argparse.ArgumentParser, start: str) -> None:
    """Declare --resume, --start and --save-state; `start` describes the default of --start."""
    add = parser.add_argument
    add("--resume", type=Path, metavar="STATE", help="continue from a file of --save-state")
    first = f"time of the first sample on the clock of the states (default: {start})"
    add("--start", type=float, metavar="S", help=first)
    add("--save-state", type=Path, metavar="STATE", help="save belief and site for --resume")


def named(option: str, texts: list[str]) -> dict[str, str]:
    """Return the values of a repeated option NAME=VALUE.

    Examples
    --------
    >>> named("--topic", ["audio=/front"])
    {'audio': '/front'}
    """
    if not texts:
        return {}
    from worldstate.adapters.own_parts import part_and_target

    pairs = [part_and_target(option, text) for text in texts]
    if len(dict(pairs)) < len(pairs):
        raise InvalidArgumentError(f"{option}: expected different names, got {' '.join(texts)}")
    return dict(pairs)


def reported(arguments: argparse.Namespace) -> str | dict[str, str] | None:
    """Return the values of --detections: of one camera, or by the names of several cameras of --car."""
    given = [str(one) for one in arguments.detections]
    if arguments.car is not None and any("=" in text for text in given):
        return named("--detections", given)
    if len(given) > 1:
        raise InvalidArgumentError("--detections: expected one, or --car with NAME=... of its cameras")
    return next(iter(given), None)


def described_camera(arguments: argparse.Namespace) -> str:
    """Return the option that describes a camera, "" without one."""
    from worldstate.adapters.source import SourceSensors

    known = SourceSensors.of(None, arguments.car, arguments.camera).camera
    return "" if known is None else "cameras of --car" if arguments.camera is None else "--camera"


def place_of(path: Path | None) -> "tuple[Context | None, SidePatterns | None]":
    """Return the context of a file, and the sound of its arms if `street learn` wrote it."""
    from worldstate.adapters.files.context_file import read_context
    from worldstate.adapters.files.file_io import read_json

    if path is None:
        return None, None
    content = read_json(path, "a context file")
    if not (isinstance(content, dict) and "schema" in content):
        return read_context(path), None
    from worldstate.operations.labelling.street_passes import read_street  # Slow to import
    from worldstate.smoothing.learned_street import context_of

    street = read_street(path)
    return context_of(street), street.patterns


def given_array(arguments: argparse.Namespace) -> "frontend.MicrophoneArray | None":
    """Return the array of --array, None without it."""
    return None if arguments.array is None else adapters.read_array(arguments.array)


@contextmanager
def opened_front_end(arguments: argparse.Namespace) -> "Iterator[tuple[Audio, frontend.FrontEnd]]":
    """Open the recording of INPUT and the front-end for its array."""
    from worldstate.adapters.audio.sound_file import open_sound, path_of
    from worldstate.adapters.datasets.ovad import choose_array
    from worldstate.adapters.ros.bag_input import BagSound, needed_array
    from worldstate.adapters.source import sound_of

    sound, own = sound_of(arguments.input, named("--topic", arguments.topic))
    if isinstance(sound, BagSound):
        array = needed_array(sound, given_array(arguments) or own)
    else:
        array = choose_array(path_of(sound), given_array(arguments))
        if isinstance(sound, Path) and sound.is_dir():
            sound = adapters.Recording.open(sound).audio_path
    with open_sound(sound, array.n_microphones, channels=array.channels, strict=False) as audio:
        settings = search_of(arguments).front_end(array, audio.sample_rate_hz)
        yield audio, frontend.FrontEnd(array, audio.sample_rate_hz, settings)


def search_of(arguments: argparse.Namespace) -> "adapters.ListenSettings":
    """Return the settings with --band and --azimuth-span."""
    band = None if arguments.band is None else (arguments.band[0], arguments.band[1])
    return adapters.ListenSettings(band_hz=band, azimuth_span_deg=arguments.azimuth_span)


def check_boxes(arguments: argparse.Namespace, recordings: int) -> None:
    """Refuse several recordings with --detections or the boxes of --car, which belong to one recording."""
    from worldstate.adapters.source import SourceSensors

    sensors = SourceSensors.of(None, arguments.car, arguments.camera)
    if recordings > 1 and (arguments.detections or sensors.setup.detections):
        problem = "expected one recording with --detections or --car, because folders hold their own boxes"
        raise InvalidArgumentError(f"{problem}, got {recordings}")


def recorded(
    arguments: argparse.Namespace, path: "SoundInput | list[Path]", **more: Any
) -> "adapters.Source":
    """Return a recording with its sound and the boxes of its camera; `more` is passed to `open_source`."""
    return adapters.open_source(
        path,
        arguments.array,
        car=arguments.car,
        camera=arguments.camera,
        detections=reported(arguments),
        topics=named("--topic", getattr(arguments, "topic", [])),
        **more,
    )


def camera_source(
    arguments: argparse.Namespace, path: "SoundInput | list[Path]"
) -> "tuple[adapters.Source, adapters.DetectionLog]":
    """Return a recording, with any array, and the boxes of its camera.

    Raises
    ------
    InputFileError
        If there are no boxes of a camera.
    """
    source = recorded(arguments, path, uncalibrated=True)
    if source.detections is None:
        raise InputFileError(source.audio_path, "expected boxes of a camera beside it, or --detections")
    return source, source.detections


def stance(array: "frontend.MicrophoneArray") -> str:
    """Describe an array in one line: microphones, extent and ambiguity.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> stance(MicrophoneArray([[0, 0.2, 1.4], [0, -0.2, 1.4]]))
    '2 microphones, 0.00 m along x (forward), 0.40 m along y (left), 0.00 m along z (up); front-back ...'
    """
    x, y, z = array.aperture_m.tolist()
    extent = f"{x:.2f} m along x (forward), {y:.2f} m along y (left), {z:.2f} m along z (up)"
    return f"{array.n_microphones} microphones, {extent}; {_apart(x, y, array.ambiguity)}"


def _apart(x: float, y: float, ambiguity: str) -> str:
    if ambiguity in ("none", "up-down"):
        return "distinguishes all azimuths"
    if x < _FLAT_M:
        return "front-back ambiguous"
    if y < _FLAT_M:
        return (
            "left-right ambiguous: no extent across the vehicle; if that is wrong, check the axes of the file"
        )
    return "each direction has a mirror image in the array"
