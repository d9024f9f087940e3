"""Options of the commands that take a table of feature windows, declared once."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .command import add_choice

if TYPE_CHECKING:
    from worldstate.abduction.signature.ensemble_training import SimulatedWindows
    from worldstate.adapters.datasets.feature_table import Group


def add_table_options(parser: argparse.ArgumentParser) -> None:
    """Declare the table, which part of it counts and what is made of it."""
    parser.add_argument("table", type=Path, metavar="CSV", help="windows: feat0..feat59, Class, ID, ...")
    add_which_windows(parser, "standing ego, moving ego or both")
    simulated = "simulated windows of the same sites, learned too: what `realism --out` writes"
    parser.add_argument("--simulated", type=Path, nargs="+", metavar="CSV", help=simulated)


def read_simulated(paths: Sequence[Path] | None, group: "Group") -> "SimulatedWindows | None":
    """Return the simulated windows that are to be learned beside a table, None without any."""
    from worldstate.adapters.datasets.feature_table import read_features
    from worldstate.operations.training.site_references import simulated_beside

    return simulated_beside([read_features(path).group(group) for path in paths]) if paths else None


def add_which_windows(parser: argparse.ArgumentParser, of: str) -> None:
    """Declare --group and --method."""
    add_choice(parser, "--group", of, "static", "dynamic", "all")
    add_choice(parser, "--method", "", "worldstate", "baseline")
