"""`worldstate array check`: find faulty microphones in a recording, with the way to correct them.

Check the microphones of a recording: dead, intermittent, noisy, exchanged, inverted or clipped channels,
offsets, levels, wind, sound cards with a delay or a clock of their own, missing or repeated samples, and the
sample rate. Channels are counted from 1. The sound is also compared with the positions, which shows exchanged
channels, another order or an array of another size.

Sound alone cannot show that an array is mirrored or rotated: give the true azimuth of one sound with
--heard-from DEG, in degrees, left positive.

--fit estimates positions that explain the sound better than those of --array, in any order and of any size,
up to a rotation and a mirror image. It prints them as CSV with the improvement on quarters of a second that
were not fitted. --fit FILE writes them as XML or CSV. Positions that the sound does not determine stay
unchanged, and the output lists them. The fit needs sound from many sides; --also adds recordings.

Exit code 0 without a fault, 1 with a fault, 2 for bad input. Exchanged, inverted, noisy and delayed
microphones show only in sound that reaches all of them: two seconds of traffic are enough for large arrays,
ten for small ones. Levels and wind take six seconds, drifts twenty.

Examples
--------
  worldstate array check some.wav --array mics.xml
  worldstate array check clapping.wav --array mics.xml --heard-from 40
  worldstate array check some.wav --array mics.csv --fit
  worldstate array check some.wav --array mics.csv --fit fitted.csv --also other.wav third.wav
  worldstate array check some.wav --array mics.xml --duration 600.02 --json
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from worldstate import frontend
from worldstate.adapters.audio.sound_file import Audio, open_sound
from worldstate.adapters.files.array_file import array_csv, write_array_xml
from worldstate.adapters.files.file_io import write_text
from worldstate.cli.common import inputs, output, progress
from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S
from worldstate.frontend.health.position_check import PositionCheck
from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.serialisation import encode
from worldstate.operations.recordings import channel_report

# Least extent in shortest wavelengths; units that are taken for metres; extents of usual arrays, m.
_LEAST_WAVE = 0.1
_UNITS = {"inches": 39.37, "millimetres": 1000.0}
_USUAL_M = (0.03, 1.5)
_DURATION_ERROR_S = 0.01  # A stopwatch, or the time stamps of a recorder
_PRINTED = Path()  # --fit without a file prints the positions


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_sound_options(parser)
    inputs.add_array_options(parser)
    inputs.add_search_options(parser)
    add = parser.add_argument
    told = "length of the recording by another clock, seconds, to 0.01 s"
    add("--duration", type=float, metavar="S", help=told)
    add("--heard-from", type=float, metavar="DEG", help="azimuth of the only source, left positive")
    told = "estimate positions from the sound, and write them (.csv or .xml)"
    add("--fit", type=Path, nargs="?", const=_PRINTED, metavar="FILE", help=told)
    add("--also", type=Path, nargs="+", default=[], metavar="SOUND", help="for --fit: further recordings")
    add("--figure", type=Path, metavar="PNG", help="draw the array with its faults")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.frontend.health.fitted_positions import fit_positions

    output.check_outputs(arguments, *([] if arguments.fit == _PRINTED else ["fit"]), figures=("figure",))
    if arguments.fit not in (None, _PRINTED) and arguments.fit.suffix not in (".csv", ".xml"):
        raise InvalidArgumentError(f"--fit: expected a name that ends in .csv or .xml, got {arguments.fit}")
    if arguments.also and arguments.fit is None:
        raise InvalidArgumentError("--also: expected --fit with it")
    if arguments.heard_from is not None:
        in_range("--heard-from", arguments.heard_from, -360.0, 360.0)
    with inputs.opened_front_end(arguments) as (audio, front_end):
        array = front_end.array
        check_extent(array, front_end.settings.srp_band_hz[1])
        health, check = examine(audio, front_end, arguments.heard_from)
        if arguments.duration is not None:
            lasted, rate_hz = (arguments.duration, _DURATION_ERROR_S), float(audio.sample_rate_hz)
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
        lines += [f"not determined: {one}" for one in fit.unjudged]
        report = report | {"fit": encode(fit)}
    if arguments.figure is not None:
        channel_report.write_array_figure(array, health, arguments.figure)
    return output.CommandResult(report, table={}, lines=lines, code=0 if health.is_healthy else 1)


def check_extent(array: "frontend.MicrophoneArray", highest_hz: float) -> None:
    """Refuse an array much smaller than the shortest wave, and suggest the unit of its numbers."""
    extent_m, least_m = array.widest_m, _LEAST_WAVE * SPEED_OF_SOUND_M_S / highest_hz
    if extent_m < least_m:
        units = [unit for unit, factor in _UNITS.items() if _USUAL_M[0] < factor * extent_m < _USUAL_M[1]]
        expected = f"at least {least_m:.2g} m across, a tenth of the shortest wave ({highest_hz:g} Hz)"
        cause = f"metres divided once more, as if they were {' or '.join(units or _UNITS)}?"
        raise InvalidArgumentError(f"--array: expected {expected}, got {extent_m:.2g} m: {cause}")


def examine(
    audio: Audio, front_end: "frontend.FrontEnd", heard_from_deg: float | None = None
) -> tuple[channel_report.RecordingHealth, PositionCheck]:
    """Process an open recording; return the health of its channels, and the check of positions."""
    log, check = channel_report.HealthLog(), PositionCheck(front_end.array, audio.sample_rate_hz)
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


def _heard(path: Path, array: "frontend.MicrophoneArray") -> PositionCheck:
    with open_sound(path, array.n_microphones, channels=array.channels, strict=False) as audio:
        check = PositionCheck(array, audio.sample_rate_hz)
        for block in audio.blocks(audio.sample_rate_hz):
            check.push(block)
    return check
