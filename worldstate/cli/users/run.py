"""`worldstate run`: a recording in, one snapshot a hop out."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.common.array_options import (
    add_array_options,
    add_search_options,
    given_array,
    search_of,
    stance,
)
from worldstate.cli.common.camera_options import add_camera_options, box_counts, boxes_of
from worldstate.cli.common.output import print_summary
from worldstate.cli.common.outputs import check_outputs
from worldstate.cli.common.sound_options import add_sound_options, sound_of
from worldstate.ground.errors import InputFileError

if TYPE_CHECKING:
    from worldstate.adapters.listen import Source

DESCRIPTION = """\
Listen to a recording and keep the world-state.

Without detections the camera counts as
not asked, which is neither presence nor absence.

--gating compares the bearings with the moving boxes of the camera: what is gained in accuracy, and lost in
coverage, where only prominent peaks are kept."""

EXAMPLE = """\
examples:
  worldstate run some.wav --array mics.csv --detections d.json --camera camera.json --out states.jsonl
  worldstate run ovad_dataset/SA1/left/1_00_0002 --figure timeline.png"""


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the command and its options."""
    parser = subparsers.add_parser(
        "run",
        help="sound in, one world-state a hop out",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_sound_options(parser)
    add_array_options(parser)
    add_search_options(parser)
    _add_model_options(parser)
    add_camera_options(parser)
    _add_output_options(parser)
    parser.set_defaults(run=run)


def _add_model_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", type=Path, help="model file (default: the one that ships)")
    parser.add_argument(
        "--alpha", type=float, default=0.02, help="false-positive budget (default: %(default)s)"
    )
    parser.add_argument(
        "--mask-dead", action="store_true", help="leave silent channels out instead of refusing the recording"
    )
    parser.add_argument(
        "--site-adaptation", action=argparse.BooleanOptionalAction, default=True,
        help="learn what the site is like while listening (default: on)",
    )  # fmt: skip
    parser.add_argument(
        "--forgetting", type=float, metavar="S", help="time constant of that, seconds (default: 300)"
    )
    parser.add_argument(
        "--uncalibrated", action="store_true",
        help="go on where the model was made for another array or rate; no cue states an alpha then",
    )  # fmt: skip
    parser.add_argument(
        "--grounded", action="store_true",
        help="weigh the signature with bearing and approach, eq. (5) (default: off)",
    )  # fmt: skip
    parser.add_argument(
        "--ego-noise", action="store_true",
        help="learn the own vehicle's noise while nothing is there and hear past it (default: off)",
    )  # fmt: skip


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument("--out", type=Path, metavar="JSONL", help="write one snapshot a line")
    group.add_argument("--figure", type=Path, metavar="PNG", help="draw the timeline")
    group.add_argument(
        "--gating", type=Path, metavar="PNG", help="bearing error against the share kept by prominence"
    )
    group.add_argument("--json", action="store_true", help="print the summary as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; return its exit code."""
    from worldstate.adapters.audio.sound_file import SilentChannelsError
    from worldstate.cli.common.listening import listen_with_progress
    from worldstate.operations.recordings.bearing_gating import bearing_figures, write_gating_figure
    from worldstate.operations.recordings.timeline import write_timeline

    check_outputs(arguments, "out", figures=("figure", "gating"))
    source = _source(arguments)
    try:
        report = listen_with_progress(source, title=str(source.audio_path), states_path=arguments.out)
    except SilentChannelsError as error:
        if arguments.mask_dead:
            raise
        raise InputFileError(error.path, f"{error.problem}; --mask-dead leaves them out") from error
    if arguments.figure is not None:
        write_timeline(report.timeline, arguments.figure)
    summary = report.to_dict() | {
        "array": stance(source.array),
        "detections": box_counts(source, as_json=arguments.json),
    }
    if arguments.gating is not None:
        write_gating_figure(report.bearings, arguments.gating, title=str(source.audio_path))
        summary |= bearing_figures(report.bearings)
    print_summary(summary, as_json=arguments.json)
    return 0


def _source(arguments: argparse.Namespace) -> "Source":
    from dataclasses import replace

    from worldstate.adapters.acoustic_grounding import Grounding
    from worldstate.adapters.listen import open_source

    settings = replace(
        search_of(arguments),
        alpha=arguments.alpha,
        mask_dead=arguments.mask_dead,
        site_adaptation=arguments.site_adaptation,
        forgetting_s=arguments.forgetting,
        grounding=Grounding() if arguments.grounded else None,
        ego_noise=arguments.ego_noise,
        boxes=boxes_of(arguments),
        uncalibrated=arguments.uncalibrated,
    )
    return open_source(
        sound_of(arguments),
        array=given_array(arguments),
        detections=arguments.detections,
        camera=arguments.camera,
        miss_rates=arguments.miss_rates,
        model=arguments.model,
        settings=settings,
    )
