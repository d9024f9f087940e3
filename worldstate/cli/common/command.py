"""Declare a command: what all of them have in common."""

import argparse
from collections.abc import Callable

Subparsers = argparse._SubParsersAction  # argparse gives it no public name


def add_command(
    subparsers: "Subparsers[argparse.ArgumentParser]",
    run: Callable[[argparse.Namespace], int],
    name: str,
    summary: str,
    description: str,
    examples: str,
) -> argparse.ArgumentParser:
    """Return the parser of a command that prints what it found, with --json as one object."""
    parser = subparsers.add_parser(
        name,
        help=summary,
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.set_defaults(run=run)
    return parser
