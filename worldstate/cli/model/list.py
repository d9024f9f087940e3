"""`worldstate model list`: the models that ship.

Print array, microphones, spacing, the ego's motion, and what each was made of. The first two are those of the
roof array. One for a board is found by the board's --array; --model takes the name of any but the first two.

Examples
--------
  worldstate model list
  worldstate model list --json
"""

import argparse

from worldstate import adapters, frontend
from worldstate.cli.common import output


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare no option but --json."""


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from worldstate.adapters.files.array_file import shipped_models

    roof = {name: adapters.read_model(moving_ego=name == "moving") for name in ("standing", "moving")}
    rows: dict[str, dict[str, object]] = {}
    for name, model in (roof | {name: adapters.read_model(name) for name in shipped_models()}).items():
        if (domain := model.domain) is None:
            continue
        spacing_mm = round(1e3 * frontend.MicrophoneArray(domain.positions_m).mean_spacing_m, 1)
        rows[name] = {"array": domain.array, "microphones": len(domain.positions_m), "spacing_mm": spacing_mm}
        rows[name] |= {"ego_motion": domain.ego_motion, "data": model.provenance.dataset}
    line = "{array}, {microphones} microphones, {spacing_mm:g} mm apart; {ego_motion} ego; of {data}"
    return output.CommandResult(rows, {name: line.format(**row) for name, row in rows.items()})
