"""Keep a structured world-state from sound when vision fails.

example: worldstate demo --out out/demo

exit codes: 0 done, 1 `array check` found a fault, 2 bad input (one line on
standard error states what was given and what was expected), 130 after Ctrl-C,
143 after SIGTERM; unfinished files are removed, except the logs of `live`
"""

import json
import sys
from collections.abc import Sequence
from importlib.resources import files

from worldstate.cli.common.command import Program, run_program
from worldstate.ground.errors import InvalidArgumentError

# A group is a folder, and a command is a module in it with `run`, `add_options` if it has options, and a
# docstring that ends in examples. Slow imports are inside `run`.
COMMANDS = (
    *("demo", "run", "live", "hear", "explain"),
    *("array check", "array bounds", "array bearings", "array align", "array list"),
    *("model make", "model fit", "model threshold", "model features", "model detector"),
    *("model show", "model list"),
    *("street learn", "street label"),
    *("log plot", "log view", "log replay", "log upgrade"),
    *("sim make", "sim to-bag"),
    "completion",
)
GROUPS = {
    "array": "check a microphone array, its limits and its bearings",
    "model": "make, fit, calibrate and show models for an array",
    "street": "learn and label a street from passing vehicles",
    "log": "draw, view, replay and upgrade the snapshots of a run",
    "sim": "simulated streets",
}
# Former commands and options with their successors, for the error.
_NAMES = (files("worldstate") / "data" / "former_names.json").read_text("utf-8")
FORMER, FORMER_OPTIONS = json.loads(_NAMES).values()
DESCRIPTION, _, EPILOG = (__doc__ or "").strip().partition("\n\n")

_MODULES = {words: "worldstate.cli." + words.replace(" ", ".").replace("-", "_") for words in COMMANDS}
PROGRAM = Program("worldstate", DESCRIPTION, EPILOG, _MODULES, GROUPS, ("completion",), FORMER_OPTIONS)


def current_words(words: Sequence[str]) -> list[str]:
    """Return the words of a call, `help run` as `run --help`; refuse a former command."""
    first, *rest = words or [""]
    if first in FORMER:
        raise InvalidArgumentError(f"{first}: expected `{FORMER[first]}` in its place")
    return [*rest, "--help"] if first == "help" else list(words)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code: 0, or 2 and one line on standard error for bad input."""
    return run_program(PROGRAM, sys.argv[1:] if argv is None else argv, current=current_words)


if __name__ == "__main__":
    sys.exit(main())
