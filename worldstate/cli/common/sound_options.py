"""INPUT: a sound file or recording folder, a file a microphone, a bag, or raw samples on standard input."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worldstate.adapters.audio.open_sound import SoundInput

HELP = """\
INPUT is a multichannel sound file (WAV, RF64, W64, FLAC), the folder of one recording in the OVAD layout
(out_multi.wav and, where there is one, camera_baseline_results.json), several files of one channel each in
the order of the microphones, a bag of ROS 2 (its folder, .mcap or .db3), or - for raw samples on standard
input with --rate, --channels and --format."""

EXAMPLE = """\
  arecord -D hw:1 -t raw -f S32_LE -r 48000 -c 8 | worldstate {} - --rate 48000 --channels 8 --format s32"""


def add_sound_options(parser: argparse.ArgumentParser) -> None:
    """Declare INPUT, --audio-topic, --rate, --channels and --format."""
    parser.description = f"{parser.description}\n\n{HELP}"
    parser.epilog = f"{parser.epilog}\n{EXAMPLE.format(parser.prog.split()[-1])}"
    parser.add_argument("input", type=Path, nargs="+", metavar="INPUT", help="what to listen to")
    topic = "topic of a bag that holds the sound (default: the only one of its type)"
    parser.add_argument("--audio-topic", metavar="TOPIC", help=topic)
    add = parser.add_argument_group("raw samples").add_argument
    add("--rate", type=int, metavar="HZ", help="samples a second")
    add("--channels", type=int, metavar="M", help="microphones")
    bits = "little-endian whole numbers of so many bits, or floats (default: %(default)s)"
    add("--format", choices=("s16", "s24", "s32", "f32"), default="s16", help=bits)


def sound_of(arguments: argparse.Namespace) -> "SoundInput":
    """Return what INPUT names."""
    import sys

    from worldstate.adapters.audio.open_sound import RawPcm, as_sound
    from worldstate.adapters.ros.bag_input import read_sound
    from worldstate.ground.errors import InvalidArgumentError

    bag = bag_of(arguments)
    if bag is not None:
        return read_sound(bag, arguments.audio_topic)[0]
    if Path("-") not in arguments.input:
        return as_sound(tuple(arguments.input))
    if len(arguments.input) > 1 or arguments.rate is None or arguments.channels is None:
        raise InvalidArgumentError("-: expected standard input alone, with --rate and --channels")
    return RawPcm(sys.stdin.buffer, arguments.rate, arguments.channels, arguments.format)


def bag_of(arguments: argparse.Namespace) -> Path | None:
    """Return the bag that INPUT names, None where it is none."""
    from worldstate.adapters.ros.bag_reader import is_bag

    alone = arguments.input[0] if len(arguments.input) == 1 else None
    return alone if alone is not None and is_bag(alone) else None
