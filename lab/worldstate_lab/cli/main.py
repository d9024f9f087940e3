"""Entry point of `worldstate-lab`: one module per study, each with `EXAMPLE`, `add_options` and `run`."""

import sys
from collections.abc import Sequence

from worldstate.cli.common.entry import build_parser, run_command

COMMANDS = {
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
        "bench",
    )
}
DESCRIPTION = "The evaluation of the paper, and studies of our own."
EPILOG = "example: worldstate-lab table --smoke --out smoke"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one study; return its exit code: 0, or 2 and one line on standard error for bad input."""
    words = sys.argv[1:] if argv is None else argv
    return run_command(lambda: build_parser("worldstate-lab", DESCRIPTION, EPILOG, COMMANDS), words)


if __name__ == "__main__":
    sys.exit(main())
