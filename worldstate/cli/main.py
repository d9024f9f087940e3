"""Entry point: one module per command, each with `add_parser` and `run`."""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

from worldstate.ground.errors import WorldstateError
from worldstate.ground.version import __version__

# Modules are imported when the parser is built; each keeps its heavy imports inside `run`.
COMMANDS = (
    "users.demo",
    "users.run",
    "users.doctor",
    "users.bounds",
    "users.simulate",
    "users.train",
    "users.calibrate",
    "users.measure_absence",
    "studies.evaluate_degradation",
    "studies.evaluate_features",
    "users.extract_features",
    "studies.twin",
    "studies.ablations",
    "studies.identifiability",
    "users.bench",
)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="worldstate",
        description="Keep a structured world-state alive from sound when vision fails.",
        epilog="example: worldstate demo --out out/demo",
    )
    parser.add_argument("--version", action="version", version=f"worldstate {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name in COMMANDS:
        import_module(f"worldstate.cli.{name}").add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code: 0, or 2 and one line on standard error for bad input."""
    arguments = build_parser().parse_args(argv)
    try:
        return int(arguments.run(arguments))
    except WorldstateError as error:
        print(f"worldstate: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
