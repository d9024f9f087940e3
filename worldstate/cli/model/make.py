"""`worldstate model make`: make a model for an array, with its expected performance.

Simulate streets for an array, train the window model and the sequence model (three seconds of windows), set
the alarm on hazard-free streets, and examine the result on five other junctions: detected approaches, lead,
false alarms per hour, both sides, times to visible. The array need not exist yet.

--sounds FOLDER --kinds TABLE adds clips of your own to the training of the road-user classifier and the
guard. TABLE is a CSV file with the columns file (below FOLDER), kind, recording and, optionally, road_user:
car, van, truck, tram, motorcycle or bicycle. Each recording has the weight of one simulated clip. Every kind
except the warning signals (siren, horn, reversing beeper, bicycle bell) and street is a foreign sound. The
card of the model states such clips.

With several --array each street is rendered once for all of them, and --out is a folder with NAME.json.gz for
each. --streams keeps the processed streams, and an interrupted run continues from them. --quick trains on
minutes instead of hours, and its model is marked as unfit for use.

Examples
--------
  worldstate model make --array mics.csv --out my_model.json --streams streams --jobs 2
  worldstate model make --array uma-8 --array mics.csv --out models --streams streams --jobs 2
  worldstate model make --array mics.csv --out my_model.json --streams streams --quiet night.wav
  worldstate model make --array mics.csv --out my_model.json --streams streams --mounting-errors
  worldstate model make --array mics.csv --out my_model.json --sounds my_sounds --kinds my_sounds/clips.csv
  worldstate model make --array mics.csv --out moving.json --streams streams --ego moving --jobs 2
  worldstate model make --array mics.csv --out try.json --quick
"""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import adapters, frontend
from worldstate.cli.common import command, inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError

if TYPE_CHECKING:
    from worldstate.commissioning.heard_stream import CommissionSettings
    from worldstate.commissioning.recorded_clips import RecordedClips

# False alarms per hour by ego motion, because a moving ego is louder itself.
ONSETS = {"standing": 30.0, "moving": 60.0}

NEEDS = ("sklearn",)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    inputs.add_array_options(parser, "OVAD's; repeated, a model for each", "append")
    add("--out", type=Path, required=True, metavar="MODEL", help="file to write; a folder for several arrays")
    add("--report", type=Path, metavar="JSON", help="write the results of the exam")
    add("--figure", type=Path, metavar="PNG", help="draw the results of the exam")
    streams = "folder of processed streams, which are reused (default: beside MODEL)"
    add("--streams", type=Path, metavar="DIR", help=streams)
    windows = "labelled windows of this array at real junctions for training: feat0..feat59, Class, ..."
    add("--labelled", type=Path, metavar="CSV", help=windows)
    ids = "CSV files with a column ID: recordings to leave out of the labelled windows"
    add("--exclude", type=Path, nargs="+", action="extend", default=[], metavar="IDS", help=ids)
    add("--source", metavar="TEXT", help="name of the labelled windows (default: name of the file)")
    licence = "licence of the labelled windows, for the card (default: %(default)s)"
    add("--licence", default="none stated", metavar="TEXT", help=licence)
    quiet = "recordings without a vehicle, to set the alarm"
    add("--quiet", type=Path, nargs="+", default=[], metavar="SOUND", help=quiet)
    add("--sounds", type=Path, metavar="FOLDER", help="folder of your own clips")
    add("--kinds", type=Path, metavar="TABLE", help="list of the clips in --sounds")
    command.add_choice(parser, "--ego", "it stands at the junction, or drives up to it", *ONSETS)
    allowed = "allowed false alarms per hour (default: 30, for a moving ego 60)"
    add("--onsets", type=float, metavar="N", help=allowed)
    told = "junctions for training, per renderer (default: 12)"
    add("--junctions", type=int, default=12, metavar="N", help=told)
    minutes = "minutes of approaches per junction; other streams and the exam in proportion (default: 7.2)"
    add("--minutes", type=float, default=7.2, metavar="M", help=minutes)
    add("--exam", action=argparse.BooleanOptionalAction, default=True, help="examine the model (default: on)")
    wrong = "examine one junction with a rotated array and with wrong positions as well"
    add("--mounting-errors", action="store_true", help=wrong)
    quick = "train on minutes of sound, to try the command; the model is unfit for use"
    add("--quick", action="store_true", help=quick)
    add("--seed", type=int, default=1, help="seed of the streams (default: 1)")
    add("--jobs", type=int, default=1, help="number of processes (default: 1)")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.commissioning import stream_exam

    arrays = [adapters.read_array(one) for one in arguments.array or ()]
    outs = _outs(arguments, arrays)
    output.check_outputs(arguments, *(() if len(arrays) > 1 else ("out",)), "report", figures=("figure",))
    command.check_beside(arguments, exclude="labelled", source="labelled", figure="exam")
    settings, recorded = _settings(arguments), _recorded(arguments)
    arguments.streams = arguments.streams or arguments.out.with_suffix(".streams")
    reports, lines = dict[str, dict[str, object]](), list[str]()
    for number, out in enumerate(outs):
        array, *beside = arrays[number:] or [frontend.ovad_array()]
        model = _made(arguments, settings, array, beside, out, recorded)
        reports[array.name] = _examined(arguments, settings, array, beside, out, model, lines)
    report: dict[str, object] = {"models": reports} if len(arrays) > 1 else next(iter(reports.values()))
    told = {name: one for name, one in report.items() if name != "real_figures"}
    told = {"out": str(arguments.out)} if len(arrays) > 1 else told
    # The figures of the 56 microphones apply to a standing ego.
    if not settings.moving_ego:
        reference = adapters.read_model().provenance.exam
        told, report["reference"] = stream_exam.beside_reference(told, reference), dict(reference)
    if len(arrays) > 1 and arguments.exam:
        lines += ["", *stream_exam.exam_lines("array", reports)]
    if arguments.report is not None:
        output.write_report(arguments.report, report)
    lines += [] if recorded is None else ["", recorded.told]
    lines += ["", "unfit for use: learned from minutes of sound"] if settings.quick else []
    return output.CommandResult(report, told, lines)


def _outs(arguments: argparse.Namespace, arrays: "list[frontend.MicrophoneArray]") -> list[Path]:
    """Return the model file of each array; for several arrays in the folder --out."""
    if len(arrays) <= 1:
        return [arguments.out]
    for option in ("labelled", "quiet", "figure", "mounting_errors"):
        if getattr(arguments, option):
            name = option.replace("_", "-")
            raise InvalidArgumentError(f"--{name}: expected one --array with it, got {len(arrays)}")
    names = [f"{Path(array.name).stem}.json.gz" for array in arrays]
    if len({*names}) < len(names):
        raise InvalidArgumentError(f"--array: expected each name once, got {', '.join(names)}")
    return [output.output_folder(arguments.out, *names) / name for name in names]


def _made(
    arguments: argparse.Namespace,
    settings: "CommissionSettings",
    array: "frontend.MicrophoneArray",
    beside: "list[frontend.MicrophoneArray]",
    out: Path,
    recorded: "RecordedClips | None",
) -> "adapters.Model":
    """Make and write the model of one array."""
    from worldstate.commissioning import commission, heard_stream

    minutes = sum(one.minutes for one in heard_stream.learned_streams(settings))
    with progress.progress_bar(f"making {out.name}", minutes + commission.learning_minutes(settings)) as bar:
        model = commission.commission(
            array,
            settings,
            arguments.streams,
            table=_labelled(arguments),
            source=arguments.source or getattr(arguments.labelled, "name", ""),
            licence=arguments.licence,
            excluded_lists=[path.name for path in arguments.exclude],
            quiet=arguments.quiet,
            recorded=recorded,
            beside=beside,
            jobs=arguments.jobs,
            on_step=bar.go_on,
        )
    adapters.save_model(out, model)
    return model


def _examined(
    arguments: argparse.Namespace,
    settings: "CommissionSettings",
    array: "frontend.MicrophoneArray",
    beside: "list[frontend.MicrophoneArray]",
    out: Path,
    model: "adapters.Model",
    lines: list[str],
) -> dict[str, object]:
    """Examine a model; return its report, and add its lines."""
    from worldstate.commissioning import commission, heard_stream, stream_exam

    folder = arguments.streams
    report: dict[str, object] = {"out": str(out), "fit_for_use": model.provenance.fit_for_use}
    report["real_figures"] = [asdict(one) for one in model.provenance.real]
    lines += [one.sentence for one in model.provenance.real if one.sentence not in lines]
    if arguments.exam:
        exam = heard_stream.exam_streams(settings)
        with progress.progress_bar(f"exam of {out.name}", sum(one.minutes for one in exam)) as bar:
            examined = commission.exam_of(
                array, model, settings, folder, beside=beside, jobs=arguments.jobs, on_step=bar.advance
            )
        report |= (figures := stream_exam.exam_figures(examined))
        adapters.save_model(out, stream_exam.with_exam(model, figures))
        if arguments.figure is not None:
            first = [one for one in examined if one.heard.renderer == "paths"]
            stream_exam.write_exam_figure(first, arguments.figure)
    if arguments.mounting_errors:
        heard = commission.exam_of_mountings(array, model, settings, folder, arguments.jobs)
        every = list(progress.track(heard, "mounting", len(heard_stream.mounting_streams(settings))))
        mounted = {name: stream_exam.exam_figures([one[name] for one in every]) for name in every[0]}
        report["mounting"] = mounted
        lines += ["", *stream_exam.mounting_lines(mounted)]
    return report


def _labelled(arguments: argparse.Namespace) -> "adapters.FeatureTable | None":
    """Return the labelled windows for training; None without any."""
    from worldstate.adapters.datasets.feature_table import Group, read_ids

    if arguments.labelled is None:
        return None
    group: Group = "dynamic" if arguments.ego == "moving" else "static"
    table = adapters.read_features(arguments.labelled).group(group)
    return table.without([name for path in arguments.exclude for name in read_ids(path)])


def _recorded(arguments: argparse.Namespace) -> "RecordedClips | None":
    """Process the clips for training; None without any."""
    from worldstate.adapters.files.file_io import read_rows
    from worldstate.commissioning.recorded_clips import read_recorded

    folder, table = arguments.sounds, arguments.kinds
    if (folder is None) != (table is None):
        raise InvalidArgumentError("--sounds, --kinds: expected both or none of them")
    if table is None:
        return None
    with progress.progress_bar("hearing", len(list(read_rows(table, ("file",))))) as bar:
        return read_recorded(folder, table, bar.advance)


def _settings(arguments: argparse.Namespace) -> "CommissionSettings":
    from worldstate.commissioning.heard_stream import CommissionSettings, quick_settings

    minutes: float = arguments.minutes
    settings = CommissionSettings(
        junctions=arguments.junctions,
        approach_minutes=minutes,
        hazard_free_minutes=minutes / 1.2,
        exam_minutes=minutes / 0.3,
        onsets_per_hour=ONSETS[arguments.ego] if arguments.onsets is None else arguments.onsets,
        seed=arguments.seed,
        moving_ego=arguments.ego == "moving",
    )
    return quick_settings(settings) if arguments.quick else settings
