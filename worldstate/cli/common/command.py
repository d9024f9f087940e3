"""Declare a command: what all of them have in common."""

import argparse
from collections.abc import Callable

Subparsers = argparse._SubParsersAction  # argparse gives it no public name


def add_command(
    subparsers: "Subparsers[argparse.ArgumentParser]",
    run: Callable[[argparse.Namespace], int],
    name: str,
    summary: str,
    document: str | None,
    examples: str,
) -> argparse.ArgumentParser:
    """Return the parser of a command, with --json; its help is the module's document below the first line."""
    parser = subparsers.add_parser(
        name,
        help=summary,
        description=(document or "").partition("\n\n")[2].strip(),
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.set_defaults(run=run)
    return parser
