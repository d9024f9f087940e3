"""Entry point: one module per command, each with `EXAMPLE`, `add_options` and `run`."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module

from worldstate.cli.common.command import add_command
from worldstate.cli.common.output import CommandResult, print_result
from worldstate.ground.errors import WorldstateError
from worldstate.ground.version import __version__

# Modules are imported when the parser is built; each keeps its heavy imports inside `run`.
COMMANDS = (
    "users.demo",
    "users.run",
    "vehicle.live",
    "vehicle.align",
    "logs.explain",
    "logs.replay",
    "logs.plot",
    "users.bearings",
    "users.doctor",
    "users.bounds",
    "users.simulate",
    "users.to_bag",
    "users.label",
    "users.learn_street",
    "users.train",
    "users.model",
    "users.calibrate",
    "users.commission",
    "users.measure_absence",
    "studies.evaluate",
    "studies.evaluate_features",
    "studies.evaluate_signatures",
    "studies.evaluate_planner",
    "studies.evaluate_streams",
    "studies.foreign_sounds",
    "studies.road_users",
    "users.extract_features",
    "studies.place",
    "studies.realism",
    "studies.ablations",
    "studies.identifiability",
    "users.bench",
    "completion",
)

EPILOG = """\
example: worldstate demo --out out/demo

exit codes: 0 done, 1 doctor found a fault, 2 bad input (one line on standard error says what came and what
was expected), 130 after Ctrl-C, 143 after SIGTERM; unfinished files are removed in each of these cases"""


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="worldstate",
        description="Keep a structured world-state alive from sound when vision fails.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"worldstate {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name in COMMANDS:
        add_command(subparsers, import_module(f"worldstate.cli.{name}"))
    return parser


def execute(argv: Sequence[str] | None) -> int:
    """Run one command and print what it found; return its exit code."""
    arguments = build_parser().parse_args(argv)
    result: CommandResult = arguments.run(arguments)
    print_result(result, as_json=arguments.json)
    return result.code


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code: 0, or 2 and one line on standard error for bad input."""
    try:
        with _orderly_termination():
            code = execute(argv)
            sys.stdout.flush()
            return code
    except WorldstateError as error:
        return _refused(str(error))
    except BrokenPipeError:
        # Else the interpreter writes what is left to the closed pipe once more, and complains.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        return _refused(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except MemoryError:
        return _refused("expected more memory than this machine has left")
    except KeyboardInterrupt:
        return 130


@contextmanager
def _orderly_termination() -> Iterator[None]:
    """Turn SIGTERM into an exception, so that unfinished files are removed on the way out; exit code 143."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: object) -> None:
    raise SystemExit(128 + number)


def _refused(problem: str) -> int:
    line = " ".join(problem.split())
    print(f"worldstate: {line}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
