"""Entry point of `worldstate-lab`: one module per study, as in `worldstate`."""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from worldstate.adapters.files.file_io import check_target, read_json, write_text
from worldstate.cli.common.command import CommandParser, Program, run_program
from worldstate.cli.common.output import CommandResult
from worldstate.ground.errors import InputFileError
from worldstate_lab.report.table import json_values

BENCH = "worldstate_lab.cli.bench"
STUDIES = {
    name: f"worldstate_lab.cli.{name.replace('-', '_')}"
    for name in (
        *(
            "table",
            "windows",
            "streams",
            "scenarios",
            "left-out",
            "bearings",
            "corpora",
            "planner",
            "realism",
        ),
        *("reach", "card", "clips", "foreign", "kinds", "place", "street"),
    )
}
CORNER = {
    name: f"worldstate_lab.cli.corner.{name}"
    for name in ("sequences", "junctions", "staged", "columns", "four", "ablations")
}
BENCHES = {"bench": f"{BENCH}.cost", "bench cost": f"{BENCH}.cost", "bench gospa": f"{BENCH}.gospa"}
DESCRIPTION = "The evaluation of the paper, and further studies."
EPILOG = "example: worldstate-lab table --smoke --out smoke"
GROUPS = {"bench": "costs and accuracies of parts of the library, compared with peers"}
PROGRAM = Program(
    "worldstate-lab", DESCRIPTION, EPILOG, STUDIES | CORNER | BENCHES, GROUPS, hidden=("bench",)
)

Run = Callable[[argparse.Namespace], CommandResult]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one study; return its exit code: 0, or 2 with one line on standard error for invalid input."""
    words = sys.argv[1:] if argv is None else argv
    return run_program(PROGRAM, words, prepare=partial(_keep_figures, words))


def _keep_figures(words: Sequence[str], study: CommandParser) -> None:
    """Add the option that stores a study's figures in a results file."""
    study.add_argument("--results", type=Path, metavar="FILE", help="merge the figures into this file")
    study.set_defaults(run=partial(_run, study.get_default("run"), words))


def _run(run: Run, words: Sequence[str], arguments: argparse.Namespace) -> CommandResult:
    """Run a study and store its figures in a file that is read before the work begins."""
    if arguments.results is None:
        return run(arguments)
    read_results(arguments.results)
    result = run(arguments)
    keep_results(arguments.results, words, arguments, result.report)
    return result


# Options for the place of work and of output, which change no figure.
_NO_FIGURE = ("--results", "--out", "--jobs", "--cache", "--figure")


def result_key(words: Sequence[str]) -> str:
    """Return a command line as the key of its figures: names of paths only, independent of the machine.

    All files of a folder are joined, in the given order.

    Examples
    --------
    >>> result_key(["windows", "data/features.csv", "--protocol", "lojo", "--jobs", "2", "--json"])
    'windows features.csv --protocol lojo'
    """
    kept, skip = [], False
    for word in words:
        option, _, value = word.partition("=")
        if option in _NO_FIGURE:
            skip = not value
        elif skip or word == "--json":
            skip = False
        else:
            kept.append(word)
    return " ".join(word for place, some in groupby(kept, _place) for word in _named(place, list(some)))


def _place(word: str) -> tuple[Path, str]:
    return Path(word).parent, Path(word).suffix


def _named(place: tuple[Path, str], words: Sequence[str]) -> list[str]:
    folder, suffix = place
    if suffix and len(words) > 1 and len(words) == len(list(folder.glob(f"*{suffix}"))):
        return [f"{folder.name}/*{suffix}"]
    return [word if word.startswith("--") else Path(word).name for word in words]


def read_results(path: Path) -> dict[str, Any]:
    """Return the results by key; empty if the file does not exist."""
    check_target(path)
    found = read_json(path, "results of worldstate-lab") if path.exists() else {}
    if not isinstance(found, dict):
        raise InputFileError(path, "expected results of worldstate-lab by key")
    return found


def keep_results(
    path: Path, words: Sequence[str], arguments: argparse.Namespace, figures: Mapping[str, object]
) -> None:
    """Merge the figures of one command into a results file, under the key of its words."""
    found, key = read_results(path), result_key(words)
    found[key] = {
        "command": f"worldstate-lab {key}",
        "commit": _commit(),
        "seeds": _seeds(arguments),
        "smoke": bool(getattr(arguments, "smoke", False)),
        "figures": json_values(figures),
    }
    write_text(path, json.dumps(found, allow_nan=False, indent=1, sort_keys=True) + "\n")


def _seeds(arguments: argparse.Namespace) -> list[int]:
    """Return the seeds of a command: `seeds` is their number or a list."""
    seeds = getattr(arguments, "seeds", None)
    if seeds is None:
        return [arguments.seed] if hasattr(arguments, "seed") else []
    return list(range(seeds) if isinstance(seeds, int) else seeds)


def _commit() -> str | None:
    """Return the commit of this checkout, or None outside a checkout."""
    words = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


if __name__ == "__main__":
    sys.exit(main())
