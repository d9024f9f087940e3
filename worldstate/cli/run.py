"""`worldstate run`: compute the states of a recording, one per hop.

Compute the world-state of a recording.

Without detections the camera gives no evidence, neither of presence nor of absence. --save-state saves the
belief and the learned site. --resume continues from it: with the same recording after the part that was
used before, or with a later recording that begins at --start.

Examples
--------
  worldstate run some.wav --array mics.csv --detections d.json --camera camera.json --out states.jsonl
  worldstate run ovad_dataset/SA1/left/1_00_0002 --figure timeline.png
  worldstate run ovad_dataset/SB1/left/2_00_0005 --context elm_street.json
  worldstate run second.wav --resume state.json --start 60 --save-state state2.json
  worldstate run drive.wav --car car.json
  worldstate run street_bag --export rosbag=states_bag
"""

import argparse
from pathlib import Path

from worldstate import adapters
from worldstate.cli.common import exports, inputs, output, progress
from worldstate.ground.extras import check_extra


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_sound_options(parser)
    inputs.add_sensor_options(parser)
    inputs.add_listen_options(parser)
    inputs.add_memory_options(parser, "0")
    moves = "columns time_s, speed_mps; optional yaw_rate_rad_s, and x_m, y_m, yaw_rad in a map"
    parser.add_argument("--odometry", type=Path, metavar="CSV", help=moves)
    inputs.add_detector_option(parser, default=None)
    exports.add_output_options(parser, pages=False)
    parser.add_argument("--figure", type=Path, metavar="PNG", help="draw the timeline")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    output.check_outputs(arguments, "out", "save_state", figures=("figure",))
    check_extra(*exports.needed_extras(arguments))
    from worldstate.operations.viewing.state_figure import drawn_run

    asked = {name: vars(arguments)[name] for name in ("detector", "odometry", "resume")}
    asked |= inputs.listen_parts(arguments) | {"start_s": arguments.start or 0.0}
    source = inputs.recorded(arguments, arguments.input, **asked)
    with (
        drawn_run(arguments.figure, source, str(source.audio_path)) as draw,
        exports.exported_hops(arguments, source) as export,
    ):

        def on_hop(step: "adapters.Step") -> None:
            export(step)
            draw(step)

        report = progress.listen_with_progress(source, states_path=arguments.out, on_hop=on_hop)
    if arguments.save_state is not None and report.end is not None:
        adapters.save_checkpoint(arguments.save_state, report.end)
    boxes = output.box_counts(source, as_json=arguments.json)
    if boxes is None and (unasked := inputs.described_camera(arguments)):
        output.say(f"{unasked} without --detections: the camera gives no evidence")
    if source.before is not None and not report.hops:
        output.say("--resume: all of this sound was used before; --start states when other sound begins")
    beside = {"array": inputs.stance(source.array), "detections": boxes}
    return output.CommandResult(report.to_dict() | beside)
