"""`worldstate model show`: the card of a model file.

Say what a model was made of and made for: data, recordings, array, sample rates, band, feature, ego's motion,
thresholds, limits, licence.

Examples
--------
  worldstate model
  worldstate model my_model.json --json
"""

import argparse
from pathlib import Path

from worldstate import adapters
from worldstate.cli.common import output


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("file", type=Path, nargs="?", metavar="FILE", help="model file (default: the one that ships)")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from worldstate.operations.training.model_card import model_card

    card = model_card(adapters.read_model(arguments.file))
    return output.CommandResult(card, table=_readable(card))


def _readable(card: dict[str, object]) -> dict[str, object]:
    """Return the card with one line a threshold and a limit."""
    lines: dict[str, object] = {}
    for key, value in card.items():
        if isinstance(value, list) and key in ("thresholds", "limits"):
            lines |= {f"{key[:-1]} {number}": _words(one) for number, one in enumerate(value, start=1)}
        else:
            lines[key] = _words(value)
    return lines


def _words(value: object) -> object:
    if isinstance(value, dict):
        return "  ".join(f"{key} {part:.4g}" for key, part in value.items())
    return value
