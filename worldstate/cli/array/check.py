"""`worldstate array check`: which microphones of a recording misbehave, and what to do about it.

Listen to a recording and say what is wrong with its microphones: dead, intermittent, noisy, swapped, inverted
or clipped ones, offsets, levels, gusts, cards that are late or have a clock of their own, missing or repeated
samples, the sample rate. Channels are counted from 1. It also compares the sound with the positions: channels
exchanged or in another order, an array of another size.

No sound tells whether an array is mirrored or turned: --heard-from DEG says where one sound came from, in
degrees, left positive.

--fit offers positions that explain the sound better than those of --array, whatever their order and size, up
to a turn and a mirror image: it prints them as CSV, and states by how much, on quarters of a second that were
not fitted. --fit FILE writes them, as XML or CSV by its name. What the sound does not show is named and stays
as given. Sound from many sides is needed, that of one is refused: --also names further recordings.

Exit code 0 where nothing is wrong, 1 where something is, 2 for bad input. Swapped, inverted, noisy
and late microphones show only in sound that all of them hear: two seconds of traffic do for large arrays,
ten for small ones; levels and gusts take six seconds, drifts twenty.

Examples
--------
  worldstate array check some.wav --array mics.xml
  worldstate array check clapping.wav --array mics.xml --heard-from 40
  worldstate array check some.wav --array mics.csv --fit
  worldstate array check some.wav --array mics.csv --fit fitted.csv --also other.wav third.wav
  worldstate array check some.wav --array mics.xml --duration 600.02 --duration-error 0.001 --json
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate import frontend
from worldstate.cli.common import inputs, output, progress
from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.serialisation import encode

if TYPE_CHECKING:
    from worldstate.adapters.audio.sound_file import Audio
    from worldstate.frontend.health.position_check import PositionCheck
    from worldstate.operations.recordings.channel_report import RecordingHealth

# Least extent in shortest waves; what metres are divided by where they are taken for another unit; extents of
# arrays that are built, metres.
_LEAST_WAVE = 0.1
_UNITS = {"inches": 39.37, "millimetres": 1000.0}
_USUAL_M = (0.03, 1.5)
_PRINTED = Path()  # Positions are printed alone


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_sound_options(parser)
    inputs.add_array_options(parser)
    inputs.add_search_options(parser)
    add = parser.add_argument
    add("--duration", type=float, metavar="S", help="its length by another clock, seconds")
    add("--duration-error", type=float, default=0.01, metavar="S", help="of that (default: %(default)s s)")
    add("--heard-from", type=float, metavar="DEG", help="azimuth of the only source, left positive")
    told = "offer positions that explain the sound better, and write them (.csv or .xml)"
    add("--fit", type=Path, nargs="?", const=_PRINTED, metavar="FILE", help=told)
    add("--also", type=Path, nargs="+", default=[], metavar="SOUND", help="for --fit: further recordings")
    add("--figure", type=Path, metavar="PNG", help="draw the array with its faults")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from worldstate.adapters.files.array_file import array_csv, write_array_xml
    from worldstate.adapters.files.file_io import write_text
    from worldstate.frontend.health.fitted_positions import fit_positions
    from worldstate.operations.recordings import channel_report

    output.check_outputs(arguments, *([] if arguments.fit == _PRINTED else ["fit"]), figures=("figure",))
    if arguments.fit not in (None, _PRINTED) and arguments.fit.suffix not in (".csv", ".xml"):
        raise InvalidArgumentError(f"--fit: expected a name that ends in .csv or .xml, got {arguments.fit}")
    if arguments.also and arguments.fit is None:
        raise InvalidArgumentError("--also: expected --fit, which alone hears further recordings")
    if arguments.heard_from is not None:
        in_range("--heard-from", arguments.heard_from, -360.0, 360.0)
    with inputs.opened_front_end(arguments) as (audio, front_end):
        array = front_end.array
        check_extent(array, front_end.settings.srp_band_hz[1])
        health, check = examine(audio, front_end, arguments.heard_from)
        if arguments.duration is not None:
            lasted, rate_hz = (arguments.duration, arguments.duration_error), float(audio.sample_rate_hz)
            rate = channel_report.rate_from_duration(audio.frames, *lasted, rate_hz)
            health = replace(health, sample_rate=rate)
        heard = health, audio, array, inputs.stance(array)
        report, lines = channel_report.as_json(*heard), list(channel_report.as_text(*heard))
    if arguments.fit is not None:
        checks = [check, *(_heard(path, array) for path in arguments.also)]
        fit = fit_positions(checks, health.hears_waves(array.n_microphones))
        offered = replace(array, positions_m=fit.positions_m.round(4))
        text = array_csv(offered)
        if arguments.fit.suffix == ".csv":
            write_text(arguments.fit, text)
        elif arguments.fit != _PRINTED:
            write_array_xml(arguments.fit, offered)
        moved_mm = 1e3 * np.linalg.norm(fit.positions_m - array.positions_m, axis=1)
        better = f"explain {fit.explained:.3f} of the coherent sound, those given {fit.explained_before:.3f}"
        far = f"channel {moved_mm.argmax() + 1} moves farthest, by {moved_mm.max():.0f} mm"
        lines += [f"fit: these positions {better}; {far}", *text.splitlines()]
        lines += [f"not fitted: {one}" for one in fit.unjudged]
        report = report | {"fit": encode(fit)}
    if arguments.figure is not None:
        channel_report.write_array_figure(array, health, arguments.figure)
    return output.CommandResult(report, table={}, lines=lines, code=0 if health.is_healthy else 1)


def check_extent(array: "frontend.MicrophoneArray", highest_hz: float) -> None:
    """Refuse an array that the shortest waves hardly notice, and name the unit that its numbers had."""
    from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S

    extent_m, least_m = array.widest_m, _LEAST_WAVE * SPEED_OF_SOUND_M_S / highest_hz
    if extent_m < least_m:
        units = [unit for unit, factor in _UNITS.items() if _USUAL_M[0] < factor * extent_m < _USUAL_M[1]]
        expected = f"at least {least_m:.2g} m across, a tenth of the shortest wave ({highest_hz:g} Hz)"
        cause = f"metres divided once more, as if they were {' or '.join(units or _UNITS)}?"
        raise InvalidArgumentError(f"--array: expected {expected}, got {extent_m:.2g} m: {cause}")


def examine(
    audio: "Audio", front_end: "frontend.FrontEnd", heard_from_deg: float | None = None
) -> "tuple[RecordingHealth, PositionCheck]":
    """Listen to an open recording to its end; return what was found, and the check of positions."""
    from worldstate.frontend.health.position_check import PositionCheck
    from worldstate.operations.recordings.channel_report import HealthLog

    log, check = HealthLog(), PositionCheck(front_end.array, audio.sample_rate_hz)
    with progress.sound_bar(audio) as bar:
        for block in audio.blocks(audio.sample_rate_hz):
            check.push(block)
            for frame in front_end.process(block):
                log.add(frame)
            bar.advance()
    health = log.summary()
    heard_from_rad = None if heard_from_deg is None else math.radians(heard_from_deg)
    usable = health.hears_waves(front_end.array.n_microphones)
    return replace(health, positions=check.verdict(usable, heard_from_rad)), check


def _heard(path: Path, array: "frontend.MicrophoneArray") -> "PositionCheck":
    from worldstate.adapters.audio.sound_file import open_sound
    from worldstate.frontend.health.position_check import PositionCheck

    with open_sound(path, array.n_microphones, channels=array.channels, strict=False) as audio:
        check = PositionCheck(array, audio.sample_rate_hz)
        for block in audio.blocks(audio.sample_rate_hz):
            check.push(block)
    return check
