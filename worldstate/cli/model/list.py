"""`worldstate model list`: list the shipped models.

Print array, microphones, spacing, ego motion and training data of each model. The first two are those of the
roof array, selected by the ego motion. --array NAME selects the model of a board, and --model takes a name.

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


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.files.array_file import shipped_models

    models = {name: adapters.read_model(name) for name in shipped_models()}
    cards = {name: model_card(model) for name, model in models.items()}
    rows = {name: {key: card[key] for key in _SHOWN} for name, card in cards.items()}
    line = "{array}, {microphones} microphones, {spacing_mm:g} mm apart; {ego_motion} ego; of {data}"
    return output.CommandResult(rows, {name: line.format(**row) for name, row in rows.items()})
