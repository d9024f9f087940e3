"""`worldstate array list`: list the boards that --array takes by name.

Print microphones, spacing, whether a model ships for the board, and the source of the positions. For a board
without a shipped model, `worldstate model make --array NAME` makes one.

Examples
--------
  worldstate array list
  worldstate array list --json
"""

import argparse

from worldstate import adapters
from worldstate.cli.common import output


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.files.array_file import named_arrays, shipped_models

    rows: dict[str, dict[str, object]] = {}
    for name, board in named_arrays().items():
        array, ships = adapters.read_array(name), name in shipped_models()
        spacing_mm = round(1e3 * array.mean_spacing_m, 1)
        rows[name] = {"microphones": array.n_microphones, "spacing_mm": spacing_mm, "model": ships}
        rows[name]["source"] = board["source"]
    line = "{microphones} microphones, {spacing_mm:g} mm apart; {0}; {source}"
    ways = "no model ships", "a model ships"
    table = {name: line.format(ways[bool(row["model"])], **row) for name, row in rows.items()}
    return output.CommandResult(rows, table)
