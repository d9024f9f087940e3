"""`worldstate-lab bench import`: duration of the imports.

Each statement runs in a new interpreter; the best of several runs gives seconds of wall and processor time.

example: worldstate-lab bench import
"""

import argparse
import subprocess
import sys

from worldstate.cli.common.output import CommandResult

STATEMENTS = (
    "import worldstate",
    "import worldstate; worldstate.WorldFilter",
    "import worldstate; worldstate.WorldFilter().predict(0.1).state",
    "import worldstate.adapters; worldstate.adapters.AcousticAdapter",
    "import worldstate; worldstate.listen",
    "import worldstate.cli.main",
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--rounds", type=int, default=7, help="runs; the best counts (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return seconds of wall and processor time by statement."""
    return CommandResult({statement: _best_s(statement, arguments.rounds) for statement in STATEMENTS})


def _best_s(statement: str, rounds: int) -> list[float]:
    """Return the shortest wall and processor time of a statement, without the interpreter's start."""
    timed = (
        f"import time; t, c = time.perf_counter(), time.process_time(); {statement}; "
        "print(time.perf_counter() - t, time.process_time() - c)"
    )
    command = [sys.executable, "-c", timed]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(rounds)]
    return [min(float(run.stdout.split()[k]) for run in runs) for k in range(2)]
