"""`worldstate array check`: which microphones of a recording misbehave, and what to do about it.

Listen to a recording and say what is wrong with its microphones: dead, intermittent, noisy, swapped, inverted
or clipped ones, offsets, levels, gusts, cards that are late or have a clock of their own, missing or repeated
samples, the sample rate. Channels are counted from 1.

Exit code 0 where nothing is wrong, 1 where something is, 2 for bad input. Swapped, inverted, noisy
and late microphones show only in sound that all of them hear: two seconds of traffic do for large arrays,
ten for small ones; levels and gusts take six seconds, drifts twenty.

Examples
--------
  worldstate array check some.wav --array mics.xml
  worldstate array check some.wav --array mics.xml --duration 600.02 --duration-error 0.001 --json
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import frontend
from worldstate.cli.common import inputs, output, progress

if TYPE_CHECKING:
    from worldstate.adapters.audio.sound_file import Audio
    from worldstate.operations.recordings.channel_report import RecordingHealth


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_sound_options(parser)
    inputs.add_array_options(parser)
    inputs.add_search_options(parser)
    add = parser.add_argument
    add("--duration", type=float, metavar="S", help="its length by another clock, seconds")
    add("--duration-error", type=float, default=0.01, metavar="S", help="of that (default: %(default)s s)")
    add("--figure", type=Path, metavar="PNG", help="draw the array with its faults")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from dataclasses import replace

    from worldstate.operations.recordings import channel_report

    output.check_outputs(arguments, figures=("figure",))
    with inputs.opened_front_end(arguments) as (audio, front_end):
        array, health = front_end.array, examine(audio, front_end)
        if arguments.duration is not None:
            rate = channel_report.rate_from_duration(
                audio.frames, arguments.duration, arguments.duration_error, float(audio.sample_rate_hz)
            )
            health = replace(health, sample_rate=rate)
        heard = health, audio, array, inputs.stance(array)
        report, lines = channel_report.as_json(*heard), list(channel_report.as_text(*heard))
    if arguments.figure is not None:
        channel_report.write_array_figure(array, health, arguments.figure)
    return output.CommandResult(report, table={}, lines=lines, code=0 if health.is_healthy else 1)


def examine(audio: "Audio", front_end: "frontend.FrontEnd") -> "RecordingHealth":
    """Listen to an open recording to its end."""
    from worldstate.operations.recordings.channel_report import HealthLog

    log = HealthLog()
    with progress.sound_bar(audio) as bar:
        for block in audio.blocks(audio.sample_rate_hz):
            for frame in front_end.process(block):
                log.add(frame)
            bar.advance()
    return log.summary()
