"""What a command listens to, and by which microphones: INPUT, --array, where a bearing is looked for."""

import argparse
import io
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from inspect import getdoc
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast

from worldstate import adapters, frontend
from worldstate.ground.errors import InvalidArgumentError

if TYPE_CHECKING:
    from worldstate.adapters.audio.plain_samples import Encoding
    from worldstate.adapters.audio.sound_file import Audio, SoundInput

_EXAMPLE = "  arecord -D hw:1 -t raw -f S32_LE -r 48000 -c 8 | {} pcm:48000:8:s32"
_RAW = "pcm:"
_TOPICS = "audio", "detections", "odometry"
# Below this a coordinate does not spread, metres.
_FLAT_M = 0.005


def describe(parser: argparse.ArgumentParser, declare: Callable[..., object]) -> None:
    """Add to a command's description what stands below the first line of a function's docstring."""
    _, _, told = (getdoc(declare) or "").partition("\n\n")
    parser.description = f"{parser.description}\n\n{told}"


def add_sound_options(parser: argparse.ArgumentParser) -> None:
    """Declare INPUT, --topic and --audio-format.

    INPUT is a multichannel sound file (WAV, RF64, W64, FLAC), the folder of one recording in the OVAD layout
    (out_multi.wav and, where there is one, camera_baseline_results.json), several files of one channel each
    in the order of the microphones, a bag of ROS 2 (its folder, .mcap or .db3), or raw samples on standard
    input: pcm:RATE:CHANNELS:FORMAT, with s16, s24, s24_32 (24 bits in four bytes, arecord's S24_LE), s32
    (little-endian whole numbers) or f32 (floats) as FORMAT.
    """
    describe(parser, add_sound_options)
    parser.epilog = f"{parser.epilog}\n{_EXAMPLE.format(parser.prog)}"
    what = "sound file, recording folder, a file a microphone, bag, or pcm:RATE:CHANNELS:FORMAT"
    parser.add_argument("input", type=Path, nargs="+", metavar="INPUT", help=what)
    topic = "audio=, detections= or odometry=TOPIC of a bag (default: the only one of its type); repeated"
    parser.add_argument("--topic", action="append", default=[], metavar="NAME=TOPIC", help=topic)
    told = "RATE:CHANNELS:FORMAT of the sound of a bag whose messages do not state it (no AudioInfo)"
    parser.add_argument("--audio-format", metavar="FORMAT", help=told)
    add_channel_option(parser)


def add_channel_option(parser: argparse.ArgumentParser) -> None:
    """Declare --channels."""
    told = "channels of the microphones, from 1: 2-5 or 1,3,5-8, where there are more (default: the array's)"
    parser.add_argument("--channels", metavar="LIST", help=told)


def add_array_options(
    parser: argparse.ArgumentParser,
    default: str = "the data set's, OVAD's where it names none",
    action: str = "store",
) -> None:
    """Declare --array and --array-axes.

    --array FILE holds one microphone a channel, in the order of the channels, in metres:
      XML   Acoular's and OVAD's <pos x= y= z= />: the array plane seen from behind, x right, y up, z forward
      CSV   x,y,z a line, with or without header and names: base_link, x forward, y left, z up
      JSON  [[x, y, z], ...] or {"positions_m": [[x, y, z], ...], "axes": "base_link"}: base_link, too;
            "channels": [2, 3, 4, 5] of a card with more channels than microphones
      .cfg  a configuration of ODAS: mics = ( { mu = ( x, y, z ); ... }, ... ), its map as the channels
    (other units: a header x_mm,y_mm,z_mm, or "positions_mm"),
    or is the name of a board that lies flat, x forward: respeaker-4, respeaker-6, respeaker-usb, uma-8, xmos,
    or that stands upright and faces forward: uma-16
    """
    describe(parser, add_array_options)
    add = parser.add_argument
    told = f"microphone positions (default: {default})"
    add("--array", type=Path, action=action, metavar="FILE", help=told)
    axes = "x right, y up, z forward, or x forward, y left, z up (default: by the form of the file)"
    add("--array-axes", choices=("acoular", "base_link"), help=axes)


def add_search_options(parser: argparse.ArgumentParser) -> None:
    """Declare --band and --azimuth-span: where a bearing is looked for."""
    add = parser.add_argument
    band = "band of the bearing, Hz (default: by the spacing of the microphones; 300 to 1800 for the roof)"
    add("--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help=band)
    span = "sector ahead that is searched, 360 for all round (default: by the array, or its model)"
    add("--azimuth-span", type=float, metavar="DEG", help=span)


def topics_of(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the topics that were asked for, by what they hold."""
    from worldstate.adapters.own_parts import part_and_target

    named = dict(part_and_target("--topic", text) for text in arguments.topic)
    if not named.keys() <= {*_TOPICS}:
        raise InvalidArgumentError(f"--topic: expected {', '.join(_TOPICS)}, got {', '.join(named)}")
    return named


def sound_of(arguments: argparse.Namespace) -> "SoundInput":
    """Return what INPUT names."""
    return _sound_and_own_array(arguments)[0]


def _sound_and_own_array(
    arguments: argparse.Namespace,
) -> "tuple[SoundInput, frontend.MicrophoneArray | None]":
    """Return what INPUT names, and the array that a bag holds."""
    from worldstate.adapters.audio.sound_file import as_sound
    from worldstate.adapters.ros.bag_input import read_sound

    stated = vars(arguments).get("audio_format")  # Not an option of what draws a log
    if (bag := bag_of(arguments)) is not None:
        pcm = None if stated is None else _pcm("--audio-format", stated, io.BytesIO(), str(bag))
        return read_sound(bag, topics_of(arguments).get("audio"), pcm)
    if stated is not None or arguments.topic:
        option = "--topic" if stated is None else "--audio-format"
        raise InvalidArgumentError(f"{option}: expected a bag as INPUT; samples without one are {_RAW}...")
    names = [str(path) for path in arguments.input]
    raw = next((name for name in names if name == "-" or name.startswith(_RAW)), None)
    if raw is None:
        return as_sound(tuple(arguments.input)), None
    if len(names) > 1 or raw == "-":
        raise InvalidArgumentError(f"{raw}: expected standard input alone, as {_RAW}RATE:CHANNELS:FORMAT")
    return _pcm(raw, raw.removeprefix(_RAW), sys.stdin.buffer), None


def _pcm(name: str, text: str, stream: BinaryIO, path: str = "/dev/stdin") -> "adapters.RawPcm":
    told = text.split(":")
    if not (len(told) in (2, 3) and told[0].isdecimal() and told[1].isdecimal()):
        raise InvalidArgumentError(f"{name}: expected RATE:CHANNELS:FORMAT, such as 48000:8:s32")
    rate, channels, kind = [*told, "s16"][:3]
    return adapters.RawPcm(stream, int(rate), int(channels), cast("Encoding", kind), path)


def bag_of(arguments: argparse.Namespace) -> Path | None:
    """Return the bag that INPUT names, None where it is none."""
    from worldstate.adapters.ros.bag_input import is_bag

    alone = arguments.input[0] if len(arguments.input) == 1 else None
    return alone if alone is not None and is_bag(alone) else None


def given_array(arguments: argparse.Namespace) -> "frontend.MicrophoneArray | None":
    """Return the array that --array names, None without it: a recording may then bring its own."""
    given = None if arguments.array is None else adapters.read_array(arguments.array, arguments.array_axes)
    return with_channels(arguments, given)


def with_channels(
    arguments: argparse.Namespace, array: "frontend.MicrophoneArray | None"
) -> "frontend.MicrophoneArray | None":
    """Return the array, its channels those of --channels where that is given."""
    text = getattr(arguments, "channels", None)
    if text is None:
        return array
    if array is None:
        raise InvalidArgumentError("--channels: expected --array, or --car with an array, that they are of")
    parts = [re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", part.strip()) for part in text.split(",")]
    ranges = [range(int(one[1]), int(one[2] or one[1]) + 1) for one in parts if one is not None]
    if len(ranges) < len(parts) or not all(ranges):
        raise InvalidArgumentError(f"--channels: expected such as 2-5 or 1,3,5-8, got {text!r:.40}")
    return replace(array, channels=tuple(chain(*ranges)))


def search_of(arguments: argparse.Namespace) -> "adapters.ListenSettings":
    """Return where a bearing is looked for, all else by default."""
    band = None if arguments.band is None else (arguments.band[0], arguments.band[1])
    return adapters.ListenSettings(band_hz=band, azimuth_span_deg=arguments.azimuth_span)


def _sound_and_array(arguments: argparse.Namespace) -> "tuple[SoundInput, frontend.MicrophoneArray]":
    """Return what INPUT and --array name, or the array that belongs to the sound."""
    from worldstate.adapters.audio.sound_file import path_of
    from worldstate.adapters.datasets.ovad import choose_array
    from worldstate.adapters.ros.bag_input import BagSound, needed_array

    sound, own = _sound_and_own_array(arguments)
    if isinstance(sound, BagSound):
        return sound, needed_array(sound, given_array(arguments) or own)
    array = choose_array(path_of(sound), given_array(arguments))
    if isinstance(sound, Path) and sound.is_dir():
        sound = adapters.Recording.open(sound).audio_path
    return sound, array


@contextmanager
def opened_front_end(arguments: argparse.Namespace) -> "Iterator[tuple[Audio, frontend.FrontEnd]]":
    """Open what INPUT and --array name, and the front-end that hears it."""
    from worldstate.adapters.audio.sound_file import open_sound

    sound, array = _sound_and_array(arguments)
    with open_sound(sound, array.n_microphones, channels=array.channels, strict=False) as audio:
        settings = search_of(arguments).front_end(array, audio.sample_rate_hz)
        yield audio, frontend.FrontEnd(array, audio.sample_rate_hz, settings)


def stance(array: "frontend.MicrophoneArray") -> str:
    """Say in one line how an array stands on the vehicle: microphones, extent, what it tells apart.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> stance(MicrophoneArray([[0, 0.2, 1.4], [0, -0.2, 1.4]]))
    '2 microphones, 0.00 m along x (forward), 0.40 m along y (left), 0.00 m along z (up); hears front as back'
    """
    x, y, z = array.aperture_m.tolist()
    extent = f"{x:.2f} m along x (forward), {y:.2f} m along y (left), {z:.2f} m along z (up)"
    return f"{array.n_microphones} microphones, {extent}; {_apart(x, y, array.ambiguity)}"


def _apart(x: float, y: float, ambiguity: str) -> str:
    if ambiguity in ("none", "up-down"):
        return "tells all azimuths apart"
    if x < _FLAT_M:
        return "hears front as back"
    if y < _FLAT_M:
        return "hears left as right: no extent across the vehicle; if that is wrong, see --array-axes"
    return "hears a direction as its mirror image in the array"
