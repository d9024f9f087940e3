"""`worldstate run`: a recording in, one snapshot a hop out.

Listen to a recording and keep the world-state; --help-all shows every option.

Without detections the camera counts as not asked, which is neither presence nor absence.

--save-state keeps belief and site, --resume goes on from them: with the same recording after what was heard
before, with the recording that follows it by --start, its first sample's time on the state's clock (which is
that of detections with stamps, too).

--context says what stands at this place:
  {"arms": [{"direction": "left", "corner_m": [5.0, 3.2], "crossing_m": 9.0}, ...]}
the corner that hides the arm (x ahead, y left of the ego) and the lane behind it, metres, or "open": true of
an arm that hides nothing; optional "speed_mps" and "corner_std_m" of an arm, "rates", "priors",
"ego_speed_mps", "site", "view_half_angle_deg". Corners move as the ego does, by --odometry or this speed.

Examples
--------
  worldstate run some.wav --array mics.csv --detections d.json --camera camera.json --out states.jsonl
  worldstate run ovad_dataset/SA1/left/1_00_0002 --figure timeline.png
  worldstate run ovad_dataset/SB1/left/2_00_0005 --context elm_street.json
  worldstate run second.wav --resume state.json --start 60 --save-state state2.json
  worldstate run drive.wav --car car.json
  worldstate run ovad_dataset/SA1/left/1_00_0002 --export mcap=out.mcap
  worldstate run street_bag --export rosbag=states_bag
"""

import argparse
from pathlib import Path

from worldstate import adapters
from worldstate.cli.common import exports, inputs, listening, output, sensors
from worldstate.ground.errors import InputFileError, InvalidArgumentError

# What a first user needs.
FIRST_OPTIONS = (
    *("--array", "--car", "--model", "--budget", "--alpha", "--uncalibrated", "--context", "--street"),
    *("--detections", "--camera", "--odometry", "--out", "--figure", "--export"),
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_sound_options(parser)
    sensors.add_sensor_options(parser)
    inputs.add_search_options(parser)
    listening.add_listen_options(parser)
    listening.add_memory_options(parser, "0")
    add = parser.add_argument
    silent = "leave silent channels out instead of refusing the recording"
    add("--mask-dead", action="store_true", help=silent)
    moves = "columns time_s, speed_mps; optional yaw_rate_rad_s, and x_m, y_m, yaw_rad where corners stand"
    add("--odometry", type=Path, metavar="CSV", help=moves)
    other = "what another sensor recorded, by a reader that an installed package brings; may be repeated"
    add("--measurements", action="append", default=[], metavar="NAME=FILE", help=other)
    sensors.add_detector_option(parser, default=None)
    group = exports.add_output_options(parser, pages=False)
    group.add_argument("--figure", type=Path, metavar="PNG", help="draw the timeline")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    output.check_outputs(arguments, "out", "save_state", figures=("figure",))
    given = listening.checked_sensors(arguments, arguments.input if inputs.bag_of(arguments) is None else [])
    from worldstate.adapters.audio.sound_file import SilentChannelsError
    from worldstate.operations.viewing.state_figure import drawn_run

    source = _source(arguments, given)
    try:
        with (
            drawn_run(arguments.figure, source, str(source.audio_path)) as draw,
            exports.exported_hops(arguments, source, given.car.crossing_m) as export,
        ):

            def on_hop(step: "adapters.Step") -> None:
                export(step)
                draw(step)

            report = listening.listen_with_progress(source, states_path=arguments.out, on_hop=on_hop)
    except SilentChannelsError as error:
        if arguments.mask_dead:
            raise
        raise InputFileError(error.path, f"{error.problem}; --mask-dead leaves them out") from error
    if arguments.save_state is not None and report.end is not None:
        adapters.save_checkpoint(arguments.save_state, report.end)
    boxes = sensors.box_counts(source, as_json=arguments.json)
    if boxes is None and (unasked := given.unasked()):
        output.say(f"{unasked} without --detections: the camera counts as not asked")
    if source.before is not None and not report.hops:
        output.say("--resume: all of the sound was heard before, --start tells when other sound begins")
    beside = {"array": inputs.stance(source.array), "detections": boxes}
    return output.CommandResult(report.to_dict() | beside)


def _source(arguments: argparse.Namespace, given: sensors.GivenSensors) -> "adapters.Source":
    from worldstate.adapters.files.odometry_file import read_odometry
    from worldstate.adapters.own_parts import other_modality
    from worldstate.operations.recordings.car_cameras import with_cameras

    several, detector, car = given.several(), given.detector(), given.car
    sound, moves = inputs.sound_of(arguments), arguments.odometry or car.odometry
    if arguments.start and inputs.bag_of(arguments) is not None:
        raise InvalidArgumentError("--start: expected none with a bag, whose messages have stamps")
    array, detections, ego = sensors.with_bag(given, sound, None if several else given.detections())
    measured = [f"{name}={path}" for name, path in car.measurements.items()] + arguments.measurements
    source = listening.open_given(
        given,
        sound,
        boxes=given.boxes(),
        mask_dead=arguments.mask_dead,
        array=array,
        detections=detections,
        ego=ego if moves is None else read_odometry(moves),
        resume=arguments.resume,
        start_s=arguments.start or 0.0,
        detector=None if detector is None else detector(),
        others=[other_modality("--measurements", text) for text in measured],
    )
    return with_cameras(source, car, several) if several else source
