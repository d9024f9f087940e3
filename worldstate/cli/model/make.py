"""`worldstate model make`: an array in, a model for it and what to expect of it out.

Simulate streets for an array, listen to them, learn what a window and what three seconds of windows say, set
the alarm to what hazard-free streets allow, and examine all of it on five other junctions: approaches
detected, lead, alarms an hour, both sides, times to visible. Usable before any microphone is bought.

--sounds FOLDER --kinds TABLE learns kinds of road users and the guard from clips of your own, too. TABLE is a
CSV file with the columns file (below FOLDER), kind, recording and, optionally, road_user: car, van, truck,
tram, motorcycle or bicycle. Every recording counts as much as a simulated clip. Any kind but siren, horn,
reversing beeper, bicycle bell (warning signals) and street is a foreign sound. The model says that it was
learned so.

With several --array every street is rendered once for all of them; --out is then a folder, with NAME.json.gz
of each. Streams that were listened to are kept in --streams and not rendered again: what was interrupted goes
on there. --quick learns from minutes instead of hours; its model is marked as unfit for use.

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
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import adapters, frontend
from worldstate.cli.common import command, inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError

if TYPE_CHECKING:
    from worldstate.commissioning.heard_stream import CommissionSettings
    from worldstate.commissioning.recorded_clips import RecordedClips

# Alarms an hour by what the ego does: its own noise leaves less to be heard of others.
ONSETS = {"standing": 30.0, "moving": 60.0}

NEEDS = ("sklearn",)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    inputs.add_array_options(parser, "OVAD's; repeated, a model for each", "append")
    add("--out", type=Path, required=True, metavar="MODEL", help="exactly this file; of several a folder")
    add("--report", type=Path, metavar="JSON", help="write what the exam found")
    add("--figure", type=Path, metavar="PNG", help="draw what the exam found")
    streams = "keep streams that were listened to, and take those that are there (default: beside MODEL)"
    add("--streams", type=Path, metavar="DIR", help=streams)
    windows = "labelled windows of this array at real junctions, learned too: feat0..feat59, Class, ..."
    add("--labelled", type=Path, metavar="CSV", help=windows)
    ids = "CSV files with a column ID: leave out the recordings of these labelled windows"
    add("--exclude", type=Path, nargs="+", action="extend", default=[], metavar="IDS", help=ids)
    add("--source", metavar="TEXT", help="name of the labelled windows (default: name of the file)")
    licence = "licence of the labelled windows, for the card (default: none stated)"
    add("--licence", default="none stated", metavar="TEXT", help=licence)
    quiet = "recordings without a vehicle: the alarm is set on them"
    add("--quiet", type=Path, nargs="+", default=[], metavar="SOUND", help=quiet)
    add("--sounds", type=Path, metavar="FOLDER", help="clips of your own, which --kinds lists")
    add("--kinds", type=Path, metavar="TABLE", help="file, kind and more of each of --sounds")
    command.add_choice(parser, "--ego", "it stands at the junction, or drives up to it", *ONSETS)
    allowed = "alarms an hour allowed (default: 30, of a moving ego 60)"
    add("--onsets", type=float, metavar="N", help=allowed)
    add(
        "--junctions", type=int, default=12, metavar="N", help="to learn from, of each renderer (default: 12)"
    )
    minutes = "of approaches at each; all other streams and the exam last in proportion (default: 7.2)"
    add("--minutes", type=float, default=7.2, metavar="M", help=minutes)
    add("--leave-out", nargs="+", default=[], metavar="SITE", help="real junctions never to be learned from")
    add("--exam", action=argparse.BooleanOptionalAction, default=True, help="examine it (default: on)")
    wrong = "hear one junction of the exam with a turned array and with wrong positions, too"
    add("--mounting-errors", action="store_true", help=wrong)
    quick = "from minutes of sound: to try the command, not to use the model"
    add("--quick", action="store_true", help=quick)
    add("--seed", type=int, default=1, help="another seed, other streams (default: 1)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from worldstate.commissioning import stream_exam

    arrays = [adapters.read_array(one, arguments.array_axes) for one in arguments.array or ()]
    outs = _outs(arguments, arrays)
    output.check_outputs(arguments, *(() if len(arrays) > 1 else ("out",)), "report", figures=("figure",))
    command.check_beside(arguments, exclude="labelled", source="labelled", figure="exam")
    settings, recorded = _settings(arguments), _recorded(arguments)
    reports, lines = dict[str, dict[str, object]](), list[str]()
    for out, number in zip(outs, count(1)):
        array, *beside = arrays[number - 1 :] or [frontend.ovad_array()]
        reports[array.name] = _made(arguments, settings, array, beside, out, recorded, lines)
    report: dict[str, object] = {"models": reports} if len(arrays) > 1 else next(iter(reports.values()))
    told = {name: one for name, one in report.items() if name != "real_figures"}
    told = {"out": str(arguments.out)} if len(arrays) > 1 else told
    # The figures of the 56 microphones are those of a standing ego.
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
    """Return the file of the model of each array; of several they stand in the folder --out."""
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
    lines: list[str],
) -> dict[str, object]:
    """Make and examine the model of one array; return its report."""
    from worldstate.commissioning import commission, heard_stream, stream_exam

    folder = arguments.streams or arguments.out.with_suffix(".streams")
    minutes = sum(one.minutes for one in heard_stream.learned_streams(settings))
    with progress.progress_bar(f"making {out.name}", minutes + commission.learning_minutes(settings)) as bar:
        model = commission.commission(
            array,
            settings,
            folder,
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
    """Return the labelled windows that are learned, too; None without any."""
    from worldstate.adapters.datasets.feature_table import Group, read_ids

    if arguments.labelled is None:
        return None
    group: Group = "dynamic" if arguments.ego == "moving" else "static"
    table = adapters.read_features(arguments.labelled).group(group)
    return table.without([name for path in arguments.exclude for name in read_ids(path)])


def _recorded(arguments: argparse.Namespace) -> "RecordedClips | None":
    """Hear the clips that are learned, too; None without any."""
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
        leave_out=tuple(arguments.leave_out),
        moving_ego=arguments.ego == "moving",
    )
    return quick_settings(settings) if arguments.quick else settings
