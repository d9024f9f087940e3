"""Declare a command: what all of them have in common."""

import argparse
from collections.abc import Callable

Subparsers = argparse._SubParsersAction  # argparse gives it no public name


def add_command(
    subparsers: "Subparsers[argparse.ArgumentParser]",
    run: Callable[[argparse.Namespace], int],
    document: str | None,
    examples: str,
) -> argparse.ArgumentParser:
    """Return the parser of a command, with --json.

    `document` is its module's: "`worldstate NAME`: summary.", an empty line, and the description.
    """
    head, _, description = (document or "").partition("\n\n")
    name, _, summary = head.removeprefix("`worldstate ").partition("`: ")
    parser = subparsers.add_parser(
        name,
        help=summary.removesuffix("."),
        description=description.strip(),
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.set_defaults(run=run)
    return parser
