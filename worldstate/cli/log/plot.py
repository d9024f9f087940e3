"""`worldstate log plot`: draw a log over time, from above, or as an animation.

Draw the belief over time (--out), from above at one time (--birds-eye with --time), or as an animation from
above (--animate). --recording adds the spatial power of the sound below the azimuths.

Examples
--------
  worldstate log plot states.jsonl --out states.png
  worldstate log plot out.mcap --out states.png --recording some.wav --array mics.csv
  worldstate log plot states.jsonl --birds-eye above.png --time 5.2
  worldstate log plot states.jsonl --animate above.gif
"""

import argparse
from pathlib import Path

from worldstate import ground, operations
from worldstate.cli.common import command, inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="log of `worldstate run`, by --out or --export mcap")
    add("--out", type=Path, metavar="PNG", help="draw the run over time")
    add("--recording", type=Path, action="append", metavar="WAV", help="sound of the run, for --out")
    add("--birds-eye", type=Path, metavar="PNG", help="draw the snapshot nearest to --time from above")
    told = "seconds on the clock of the states (default: the largest risk)"
    add("--time", type=float, metavar="S", help=told)
    add("--animate", type=Path, metavar="GIF", help="draw every snapshot from above")
    parser.set_defaults(topic=[])
    inputs.add_array_options(parser)
    inputs.add_search_options(parser)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.state_log import read_log
    from worldstate.operations import figure_style
    from worldstate.operations.viewing import state_figure

    asked = arguments.out, arguments.birds_eye, arguments.animate
    if not any(asked):
        raise InvalidArgumentError("plot: expected one of --out, --birds-eye and --animate")
    output.check_outputs(arguments, "animate", figures=("out", "birds_eye"))
    command.check_beside(arguments, recording="out", time="birds_eye")
    if arguments.animate is not None:
        figure_style.check_suffix(arguments.animate, *figure_style.ANIMATION)
    states, title = [state for _, state in read_log(arguments.log)], arguments.log.name
    shown = max(states, key=lambda state: state.risk or 0.0)
    if arguments.time is not None:
        shown = min(states, key=lambda state: abs(state.stamp_ns - ground.nanoseconds(arguments.time)))
    if arguments.out is not None:
        arguments.input, sound = arguments.recording, None
        if arguments.recording:
            with (
                inputs.opened_front_end(arguments) as (audio, front_end),
                progress.progress_bar("listening", audio.duration_s) as bar,
            ):
                sound = state_figure.sound_power(audio, front_end, states, on_second=bar.advance)
        operations.write_state_figure(states, arguments.out, title=title, sound=sound)
    if arguments.birds_eye is not None:
        state_figure.write_birds_eye(shown, arguments.birds_eye, title=title)
    if arguments.animate is not None:
        with progress.progress_bar("drawing", len(states)) as bar:
            state_figure.write_animation(states, arguments.animate, title=title, on_frame=bar.advance)
    written = [str(path) for path in asked if path is not None]
    shown_s = ground.seconds(shown.stamp_ns)
    return output.CommandResult({"states": len(states), "birds_eye_s": shown_s, "written": written})
