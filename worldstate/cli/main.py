"""Keep a structured world-state alive from sound when vision fails.

example: worldstate demo --out out/demo

exit codes: 0 done, 1 `array check` found a fault, 2 bad input (one line on
standard error says what came and what was expected), 130 after Ctrl-C, 143
after SIGTERM; unfinished files are removed, but for the logs of `live`
"""

import json
import sys
from collections.abc import Sequence
from importlib.resources import files

from worldstate.cli.common.command import Program, run_program
from worldstate.ground.errors import InvalidArgumentError

# A group is a folder, a command is a module in it, with `add_options` and `run` and a docstring that ends in
# examples; each keeps its heavy imports inside `run`.
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
    "array": "an array of microphones: its health, what it allows, where it points",
    "model": "a model for an array: made, fitted, set to a budget, shown",
    "street": "a street: learned from the vehicles that pass, labelled",
    "log": "the snapshots of a run: drawn, viewed, replayed, upgraded",
    "sim": "simulated streets",
}
# Former names of commands and options, read through the next minor version, and what stands in their place;
# studies are commands of `worldstate-lab`, which the wheel of the library does not hold.
_NAMES = (files("worldstate") / "data" / "former_names.json").read_text("utf-8")
FORMER, STUDIES, FORMER_OPTIONS = json.loads(_NAMES).values()
DESCRIPTION, _, EPILOG = (__doc__ or "").strip().partition("\n\n")

_MODULES = {words: "worldstate.cli." + words.replace(" ", ".").replace("-", "_") for words in COMMANDS}
PROGRAM = Program("worldstate", DESCRIPTION, EPILOG, _MODULES, GROUPS, ("completion",), FORMER_OPTIONS)


def current_words(words: Sequence[str]) -> list[str]:
    """Return the words of a call with the former name of a command replaced; a study is refused."""
    first, *rest = words or [""]
    if first in STUDIES:
        successor = f"`worldstate-lab {STUDIES[first]}`, of the distribution worldstate-lab"
        raise InvalidArgumentError(f"{first}: expected {successor}")
    if first in FORMER:
        print(f"worldstate: `{first}` is now `{FORMER[first]}`", file=sys.stderr)
        return [*FORMER[first].split(), *rest]
    # `model FILE` shows a card, as it did before there were groups; `model` that of the model that ships.
    if first == "model" and not {*rest[:1]} & {*PROGRAM.members("model"), "-h", "--help"}:
        return ["model", "show", *rest]
    return list(words)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code: 0, or 2 and one line on standard error for bad input."""
    return run_program(PROGRAM, sys.argv[1:] if argv is None else argv, current=current_words)


if __name__ == "__main__":
    sys.exit(main())
