"""INPUT: a sound file or recording folder, a file a microphone, or raw samples on standard input."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worldstate.adapters.audio.open_sound import SoundInput

HELP = """\
INPUT is a multichannel sound file (WAV, RF64, W64, FLAC), the folder of one recording in the OVAD layout
(out_multi.wav and, where there is one, camera_baseline_results.json), several files of one channel each in
the order of the microphones, or - for raw samples on standard input with --rate, --channels and --format."""

EXAMPLE = """\
  arecord -D hw:1 -t raw -f S32_LE -r 48000 -c 8 | worldstate {} - --rate 48000 --channels 8 --format s32"""


def add_sound_options(parser: argparse.ArgumentParser) -> None:
    """Declare INPUT, --rate, --channels and --format."""
    parser.description = f"{parser.description}\n\n{HELP}"
    parser.epilog = f"{parser.epilog}\n{EXAMPLE.format(parser.prog.split()[-1])}"
    parser.add_argument("input", type=Path, nargs="+", metavar="INPUT", help="what to listen to")
    add = parser.add_argument_group("raw samples").add_argument
    add("--rate", type=int, metavar="HZ", help="samples a second")
    add("--channels", type=int, metavar="M", help="microphones")
    bits = "little-endian whole numbers of so many bits, or floats (default: %(default)s)"
    add("--format", choices=("s16", "s24", "s32", "f32"), default="s16", help=bits)


def sound_of(arguments: argparse.Namespace) -> "SoundInput":
    """Return what INPUT names."""
    import sys

    from worldstate.adapters.audio.open_sound import RawPcm, as_sound
    from worldstate.ground.errors import InvalidArgumentError

    if Path("-") not in arguments.input:
        return as_sound(tuple(arguments.input))
    if len(arguments.input) > 1 or arguments.rate is None or arguments.channels is None:
        raise InvalidArgumentError("-: expected standard input alone, with --rate and --channels")
    return RawPcm(sys.stdin.buffer, arguments.rate, arguments.channels, arguments.format)
