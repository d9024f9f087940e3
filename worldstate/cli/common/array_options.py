"""The option --array, the same for every command that takes one."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .sound_options import bag_of, sound_of

if TYPE_CHECKING:
    from worldstate.adapters.audio.open_sound import SoundInput
    from worldstate.adapters.listen import ListenSettings
    from worldstate.frontend.array.microphone_array import MicrophoneArray

HELP = """\
--array FILE holds one microphone a channel, in the order of the channels, in metres:
  XML   Acoular's and OVAD's <pos x= y= z= />: the array plane seen from behind, x right, y up, z forward
  CSV   x,y,z a line, with or without header and names: base_link, x forward, y left, z up
  JSON  [[x, y, z], ...] or {"positions_m": [[x, y, z], ...], "axes": "base_link"}: base_link, too"""

# Below this a coordinate does not spread, metres.
_FLAT_M = 0.005


def add_array_options(
    parser: argparse.ArgumentParser, default: str = "the data set's, OVAD's where it names none"
) -> None:
    """Declare --array and --array-axes, and say in the help what the files look like."""
    parser.description = f"{parser.description}\n\n{HELP}"
    add = parser.add_argument
    add("--array", type=Path, metavar="FILE", help=f"microphone positions (default: {default})")
    axes = "x right, y up, z forward, or x forward, y left, z up (default: by the form of the file)"
    add("--array-axes", choices=("acoular", "base_link"), help=axes)


def add_search_options(parser: argparse.ArgumentParser) -> None:
    """Declare --band and --azimuth-span: where a bearing is looked for."""
    add = parser.add_argument
    band = "band of the bearing, Hz (default: by the spacing of the microphones; 300 to 1800 for the roof)"
    add("--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help=band)
    span = "sector ahead that is searched, 360 for all round (default: %(default)g)"
    add("--azimuth-span", type=float, default=180.0, metavar="DEG", help=span)


def given_array(arguments: argparse.Namespace) -> "MicrophoneArray | None":
    """Return the array that --array names, None without it: a recording may then bring its own."""
    from worldstate.adapters.files.array_file import read_array

    return None if arguments.array is None else read_array(arguments.array, arguments.array_axes)


def search_of(arguments: argparse.Namespace) -> "ListenSettings":
    """Return where a bearing is looked for, all else by default."""
    from worldstate.adapters.listen import ListenSettings

    band = arguments.band
    return ListenSettings(
        band_hz=None if band is None else (band[0], band[1]), azimuth_span_deg=arguments.azimuth_span
    )


def sound_and_array(arguments: argparse.Namespace) -> "tuple[SoundInput, MicrophoneArray]":
    """Return what INPUT and --array name, or the array that belongs to the sound."""
    from worldstate.adapters.audio.open_sound import path_of
    from worldstate.adapters.datasets.array_choice import choose_array
    from worldstate.adapters.datasets.ovad import Recording

    bag = bag_of(arguments)
    if bag is not None:
        return _bag_and_array(arguments, bag)
    sound = sound_of(arguments)
    array = choose_array(path_of(sound), given_array(arguments))
    if isinstance(sound, Path) and sound.is_dir():
        sound = Recording.open(sound).audio_path
    return sound, array


def _bag_and_array(arguments: argparse.Namespace, path: Path) -> "tuple[SoundInput, MicrophoneArray]":
    from worldstate.adapters.ros.bag_input import needed_array, read_sound

    sound, own = read_sound(path, arguments.audio_topic)
    return sound, needed_array(path, given_array(arguments) or own)


def stance(array: "MicrophoneArray") -> str:
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
