"""`worldstate model list`: the models that ship.

Print array, microphones, spacing, the ego's motion, and what each was made of. The first two are those of the
roof array. One for a board is found by the board's --array; --model takes the name of any but the first two.

Examples
--------
  worldstate model list
  worldstate model list --json
"""

import argparse

from worldstate import adapters
from worldstate.cli.common import output

from .show import model_card

_SHOWN = ("array", "microphones", "spacing_mm", "ego_motion", "data")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare no option but --json."""


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from worldstate.adapters.files.array_file import shipped_models

    models = {name: adapters.read_model(moving_ego=name == "moving") for name in ("standing", "moving")}
    models |= {name: adapters.read_model(name) for name in shipped_models()}
    cards = {name: model_card(model) for name, model in models.items()}
    rows = {name: {key: card[key] for key in _SHOWN} for name, card in cards.items()}
    line = "{array}, {microphones} microphones, {spacing_mm:g} mm apart; {ego_motion} ego; of {data}"
    return output.CommandResult(rows, {name: line.format(**row) for name, row in rows.items()})
