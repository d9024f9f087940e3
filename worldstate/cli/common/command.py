"""Declare a command: what all of them have in common."""

import argparse
from types import ModuleType

Subparsers = argparse._SubParsersAction  # argparse gives it no public name


def add_command(subparsers: "Subparsers[argparse.ArgumentParser]", module: ModuleType) -> None:
    """Declare the command of a module, with --json.

    Its documentation is "`worldstate [GROUP] NAME`: summary.", an empty line, and the description; it has
    `EXAMPLE`, `add_options` and `run`, and `NEEDS`, the optional modules without which it does nothing.
    """
    head, _, description = (module.__doc__ or "").partition("\n\n")
    called, _, summary = head.removeprefix("`").partition("`: ")
    name = called.split()[-1]
    parser = subparsers.add_parser(
        name,
        help=summary.removesuffix("."),
        description=description.strip(),
        epilog=module.EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.set_defaults(run=module.run, needs=getattr(module, "NEEDS", ()))
    module.add_options(parser)


def add_choice(parser: argparse.ArgumentParser, option: str, help_text: str, *choices: str) -> None:
    """Declare an option that takes one of several words; the first is the default, which the help names."""
    told = f"{help_text} (default: {choices[0]})".strip()
    parser.add_argument(option, choices=choices, default=choices[0], help=told)
