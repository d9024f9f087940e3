"""Results of commands in print and in files, and checks of the output files before a command runs."""

import argparse
import json
import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from worldstate import adapters
from worldstate.ground.errors import InputFileError
from worldstate.ground.extras import check_extra

from .exports import exported_files

_SINCE_1970_S = 1e9


@dataclass(frozen=True, slots=True)
class CommandResult:
    """Result of a command."""

    report: Mapping[str, object]  # One JSON object
    table: Mapping[str, object] | None = None  # Readable form, if it differs from the report
    lines: Iterable[str] = ()  # Readable lines below the table
    code: int = 0  # Exit code


def printable(text: str) -> str:
    r"""Return text with every invisible character escaped, except line ends and tabs.

    File names, labels and reasons may contain control sequences of a terminal.

    Examples
    --------
    >>> print(printable("a\x1b[2Jb.wav: 63 ± 52"))
    a\x1b[2Jb.wav: 63 ± 52
    """
    return "".join(one if one.isprintable() or one in "\n\t" else ascii(one)[1:-1] for one in text)


def say(text: str) -> None:
    """Print a notice on standard error."""
    print(f"worldstate: {printable(text)}", file=sys.stderr, flush=True)


def print_result(result: CommandResult, *, as_json: bool) -> None:
    """Print a result on standard output; None shows as a dash in the table, as null in JSON.

    Examples
    --------
    >>> print_result(CommandResult({"lead_time_s": 1.75, "t0_s": None}), as_json=False)
    lead_time_s  1.75
    t0_s         -
    """
    if as_json:
        print(json.dumps(result.report, allow_nan=False))
        return
    table = result.report if result.table is None else result.table
    width = max(map(len, table), default=0)
    for key, value in table.items():
        print(printable(f"{key:<{width}}  {_readable(value)}"))
    for line in result.lines:
        print(printable(line))


def box_counts(source: "adapters.Source", *, as_json: bool) -> object:
    """Return how many boxes are used and why the others are not, per camera; None without a camera."""
    from worldstate.adapters.camera.detections import count_boxes, told_counts

    keep = replace(source.settings.boxes, image_height_px=source.camera.height_px)
    held = {} if source.detections is None else {"": (source.detections, keep)}
    if source.co_evidence is not None:
        held = {f"{name}: ": (one.detections, one.keep) for name, one in source.co_evidence.cameras.items()}
    each: Mapping[str, Mapping[str, int]] = {name: count_boxes(*one) for name, one in held.items()}
    images = 'COCO results list them as "images"'
    for name, counts in each.items():
        if not counts["frames"]:
            say(f"{name}the detector searched no image, so that the camera gives no evidence ({images})")
        elif not counts["empty"] and not counts["parked"]:
            say(f"{name}each image has a box: are images without a box missing ({images})?")
    if source.co_evidence is not None:
        by_name = {name.removesuffix(": "): counts for name, counts in each.items()}
        return by_name if as_json else [name + told_counts(counts) for name, counts in each.items()]
    return next((counts if as_json else told_counts(counts) for counts in each.values()), None)


def write_report(path: Path, report: Mapping[str, object]) -> None:
    """Write a report as JSON, whole or not at all."""
    from worldstate.adapters.files.file_io import write_json

    write_json(path, report, indent=1)


def _readable(value: object) -> str:
    if value is None or value in ((), []):
        return "-"
    if isinstance(value, float):
        # Times since 1970 are printed to 0.1 s, the length of a hop.
        return f"{value:.4g}" if abs(value) < _SINCE_1970_S else f"{value:.1f}"
    return ", ".join(_readable(item) for item in value) if isinstance(value, tuple | list) else str(value)


def check_outputs(arguments: argparse.Namespace, *options: str, figures: tuple[str, ...] = ()) -> None:
    """Refuse outputs that cannot be written, replace an input or coincide, including those of --export.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     sound = Path(folder, "a.wav")
    ...     sound.touch()
    ...     check_outputs(argparse.Namespace(input=sound, out=Path(folder, "b.jsonl")), "out")
    """
    from worldstate.adapters.files.file_io import check_target
    from worldstate.operations.figure_style import check_suffix

    given = vars(arguments)
    outputs = {name: given[name] for name in (*options, *figures) if given[name] is not None}
    outputs |= exported_files(arguments) if "export" in given else {}
    others = (value for name, value in given.items() if name not in outputs)
    lists = [value if isinstance(value, list) else [value] for value in others]
    inputs = [value for values in lists for value in values if isinstance(value, Path)]
    taken: dict[Path, str] = {}
    for name, path in outputs.items():
        if name in figures:
            check_suffix(path)
            check_extra("matplotlib")
        target = check_target(path)
        if any(_is_read(target, source) for source in inputs):
            raise InputFileError(path, "expected another file to write, because this one is an input")
        if target in taken:
            raise InputFileError(path, f"expected another file for --{name} than for --{taken[target]}")
        taken[target] = name


def output_folder(folder: Path, *files: str) -> Path:
    """Make the output folder of a command; refuse a folder in which its files cannot be written."""
    from worldstate.adapters.files.file_io import check_target

    folder.mkdir(parents=True, exist_ok=True)
    for name in files:
        check_target(folder / name)
    return folder


def _is_read(target: Path, source: Path) -> bool:
    """Return whether an output is an input file, or a file of an input in the OVAD layout."""
    from worldstate.adapters.camera.video import VIDEO_NAME
    from worldstate.adapters.datasets import ovad

    if source.is_dir():
        sound_and_log = ovad.ARRAY_NAME, ovad.AUDIO_NAME, ovad.LOG_NAME, ovad.TRUTH_NAME
        names = (*sound_and_log, VIDEO_NAME, *ovad.DETECTION_NAMES)
        return target.name in names and target.is_relative_to(os.path.realpath(source))
    return target.exists() and source.exists() and target.samefile(source)
