"""`worldstate run`: a recording in, one snapshot a hop out.

Listen to a recording and keep the world-state.

Without detections the camera counts as not asked, which is neither presence nor absence.

--save-state keeps belief and site, --resume goes on from them: with the same recording after what was heard
before, with the recording that follows it by --start, its first sample's time on the state's clock (which is
that of detections with stamps, too).

--context says what stands at this place:
  {"arms": [{"direction": "left", "corner_m": [5.0, 3.2], "crossing_m": 9.0}, ...]}
the corner that hides the arm (x ahead, y left of the ego) and the lane behind it, metres, or "open": true of
an arm that hides nobody; optional "speed_mps" and "corner_std_m" of an arm, "rates", "priors",
"ego_speed_mps", "site", "view_half_angle_deg". With --odometry corners move as the ego does.

--gating compares the bearings with the moving boxes of the camera: what is gained in accuracy, and lost in
coverage, where only prominent peaks are kept.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.common.array_options import (
    add_array_options,
    add_search_options,
    stance,
)
from worldstate.cli.common.bag_options import add_topic_options, topics_of
from worldstate.cli.common.camera_options import add_camera_options, box_counts, boxes_of, given_detections
from worldstate.cli.common.car_options import (
    add_car_options,
    add_several_cameras,
    given_sensors,
    with_several_cameras,
)
from worldstate.cli.common.detector_options import (
    MOVING,
    add_detector_options,
    detector_filter,
    detector_maker,
)
from worldstate.cli.common.listen_options import (
    add_listen_options,
    add_memory_options,
    given_context,
    given_sides,
    listen_settings,
)
from worldstate.cli.common.log_options import LOG_FILES, add_log_options, log_hops
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.outputs import check_outputs
from worldstate.cli.common.sound_options import add_sound_options, bag_of, sound_of
from worldstate.ground.errors import InputFileError

if TYPE_CHECKING:
    from worldstate.adapters.audio.open_sound import SoundInput
    from worldstate.adapters.camera.detections import DetectionLog
    from worldstate.adapters.files.odometry_file import EngineSpeed, OdometryLog
    from worldstate.adapters.listen import Source
    from worldstate.frontend.array.microphone_array import MicrophoneArray

EXAMPLE = """\
examples:
  worldstate run some.wav --array mics.csv --detections d.json --camera camera.json --out states.jsonl
  worldstate run ovad_dataset/SA1/left/1_00_0002 --figure timeline.png
  worldstate run ovad_dataset/SB1/left/2_00_0005 --context elm_street.json
  worldstate run second.wav --resume state.json --start 60 --save-state state2.json
  worldstate run drive.wav --ego-noise --engine-rpm rpm.csv
  worldstate run ovad_dataset/SA1/left/1_00_0002 --mcap out.mcap
  worldstate run street_bag --ros-bag states_bag"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_sound_options(parser)
    add_array_options(parser)
    add_car_options(parser)
    add_search_options(parser)
    add_listen_options(parser)
    add_memory_options(parser, "0")
    _add_recording_options(parser)
    add_camera_options(parser)
    add_several_cameras(parser)
    add_detector_options(parser, default=None)
    add_topic_options(parser)
    _add_output_options(parser)
    add_log_options(parser)


def _add_recording_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--mask-dead", action="store_true", help="leave silent channels out instead of refusing the recording"
    )
    moves = "columns time_s, speed_mps; optional yaw_rate_rad_s, and x_m, y_m, yaw_rad where corners stand"
    add("--odometry", type=Path, metavar="CSV", help=moves)
    rpm = "columns time_s, rpm of the own engine: cancel its lines, with --ego-noise"
    add("--engine-rpm", type=Path, metavar="CSV", help=rpm)
    firings = "firings a turn: half the cylinders (default: %(default)g)"
    add("--engine-lines", type=float, default=2.0, metavar="N", help=firings)
    other = "what another sensor recorded, by a reader that an installed package brings; may be repeated"
    add("--measurements", action="append", default=[], metavar="NAME=FILE", help=other)


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("output").add_argument
    add("--out", type=Path, metavar="JSONL", help="write one snapshot a line")
    add("--figure", type=Path, metavar="PNG", help="draw the timeline")
    add("--gating", type=Path, metavar="PNG", help="bearing error against the share kept by prominence")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from worldstate.adapters.audio.sound_file import SilentChannelsError
    from worldstate.adapters.files.checkpoint_file import save_checkpoint
    from worldstate.cli.common.listening import listen_with_progress
    from worldstate.operations.recordings.bearing_gating import bearing_figures, write_gating_figure
    from worldstate.operations.recordings.timeline import write_timeline

    check_outputs(arguments, "out", "save_state", *LOG_FILES, figures=("figure", "gating"))
    source = _source(arguments)
    try:
        with log_hops(arguments, source) as log:
            report = listen_with_progress(
                source, title=str(source.audio_path), states_path=arguments.out, on_hop=log
            )
    except SilentChannelsError as error:
        if arguments.mask_dead:
            raise
        raise InputFileError(error.path, f"{error.problem}; --mask-dead leaves them out") from error
    if arguments.save_state is not None and report.end is not None:
        save_checkpoint(arguments.save_state, report.end)
    if arguments.figure is not None:
        write_timeline(report.timeline, arguments.figure)
    summary = report.to_dict() | {
        "array": stance(source.array),
        "detections": box_counts(source, as_json=arguments.json),
    }
    if arguments.gating is not None:
        write_gating_figure(report.bearings, arguments.gating, title=str(source.audio_path))
        summary |= bearing_figures(report.bearings)
    return CommandResult(summary)


def _source(arguments: argparse.Namespace) -> "Source":
    from dataclasses import replace

    from worldstate.adapters.listen import open_source
    from worldstate.adapters.own_parts import other_modality

    boxes = detector_filter(arguments) if arguments.detector in MOVING else boxes_of(arguments)
    settings = replace(listen_settings(arguments), mask_dead=arguments.mask_dead, boxes=boxes)
    detector = None if arguments.detector is None else detector_maker(arguments)()
    given, camera = given_sensors(arguments)
    sound, array, detections, ego = _input(arguments, given, given_detections(arguments, camera))
    source = open_source(
        sound,
        array=array,
        detections=detections,
        ego=ego,
        camera=camera,
        miss_rates=arguments.miss_rates,
        model=arguments.model,
        context=given_context(arguments),
        sides=given_sides(arguments),
        resume=arguments.resume,
        start_s=arguments.start or 0.0,
        detector=detector,
        others=[other_modality("--measurements", text) for text in arguments.measurements],
        engine=_engine(arguments),
        settings=settings,
    )
    return with_several_cameras(arguments, source)


def _input(
    arguments: argparse.Namespace, array: "MicrophoneArray | None", seen: "Path | DetectionLog | None"
) -> "tuple[SoundInput, MicrophoneArray | None, Path | DetectionLog | None, OdometryLog | None]":
    """Return sound, array, detections and odometry: options, or what a bag holds."""
    from worldstate.adapters.files.odometry_file import read_odometry
    from worldstate.adapters.ros.bag_input import needed_array, read_bag
    from worldstate.ground.errors import InvalidArgumentError

    bag = bag_of(arguments)
    if bag is None:
        told = None if arguments.odometry is None else read_odometry(arguments.odometry)
        return sound_of(arguments), array, seen, told
    if arguments.start:
        raise InvalidArgumentError("--start: expected none with a bag, whose messages have stamps")
    held = read_bag(bag, topics_of(arguments))
    seen = held.detections if seen is None else seen
    return held.sound, needed_array(bag, array or held.array), seen, held.ego


def _engine(arguments: argparse.Namespace) -> "EngineSpeed | None":
    from worldstate.adapters.files.odometry_file import read_engine
    from worldstate.ground.checks import in_range

    if arguments.engine_rpm is None:
        return None
    return read_engine(arguments.engine_rpm, in_range("--engine-lines", arguments.engine_lines, 0.1, 100.0))
