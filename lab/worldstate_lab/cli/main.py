"""Entry point of `worldstate-lab`: one module per study, each with `EXAMPLE`, `add_options` and `run`."""

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from worldstate.cli.common.command import CommandParser, Program, run_program
from worldstate.cli.common.output import CommandResult
from worldstate_lab.report.results import keep_results, read_results

BENCH = "worldstate_lab.cli.bench"
STUDIES = {
    name: f"worldstate_lab.cli.{name}"
    for name in (
        "table",
        "windows",
        "streams",
        "corpora",
        "planner",
        "ablations",
        "realism",
        "reach",
        "foreign",
        "kinds",
        "place",
    )
}
BENCHES = {
    "bench": f"{BENCH}.cost",
    "bench cost": f"{BENCH}.cost",
    "bench ego-noise": f"{BENCH}.ego_noise",
    "bench gospa": f"{BENCH}.gospa",
    "bench import": f"{BENCH}.imports",
    "bench label-training": f"{BENCH}.label_training",
    "bench labels": f"{BENCH}.labels",
    "bench street": f"{BENCH}.street",
}
DESCRIPTION = "The evaluation of the paper, and studies of our own."
EPILOG = "example: worldstate-lab table --smoke --out smoke"
GROUPS = {"bench": "costs and accuracies of parts of the library, beside peers"}
PROGRAM = Program("worldstate-lab", DESCRIPTION, EPILOG, STUDIES | BENCHES, GROUPS, hidden=("bench",))

Run = Callable[[argparse.Namespace], CommandResult]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one study; return its exit code: 0, or 2 and one line on standard error for bad input."""
    words = sys.argv[1:] if argv is None else argv
    return run_program(PROGRAM, words, prepare=partial(_keep_figures, words))


def _keep_figures(words: Sequence[str], study: CommandParser) -> None:
    """Let a study keep its figures in a results file."""
    study.add_argument("--results", type=Path, metavar="FILE", help="merge the figures into this file")
    study.set_defaults(run=partial(_run, study.get_default("run"), words))


def _run(run: Run, words: Sequence[str], arguments: argparse.Namespace) -> CommandResult:
    """Run a study and keep its figures, in a file that is read before the work begins."""
    if arguments.results is None:
        return run(arguments)
    read_results(arguments.results)
    result = run(arguments)
    keep_results(arguments.results, words, arguments, result.report)
    return result


if __name__ == "__main__":
    sys.exit(main())
