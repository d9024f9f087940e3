"""Options of the commands that take a table of feature windows, declared once."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .command import add_choice

if TYPE_CHECKING:
    from worldstate.abduction.signature.ensemble_training import SimulatedWindows
    from worldstate.adapters.datasets.feature_table import FeatureTable


def add_table_options(parser: argparse.ArgumentParser) -> None:
    """Declare the table, which part of it counts and what is made of it."""
    parser.add_argument("table", type=Path, metavar="CSV", help="windows: feat0..feat59, Class, ID, ...")
    add_group(parser, "standing ego, moving ego or both")
    simulated = "simulated windows of the same sites, learned too: what `realism --out` writes"
    parser.add_argument("--simulated", type=Path, nargs="+", metavar="CSV", help=simulated)
    streams = "simulated streams that were listened to: windows of them, and of sources in the open, too"
    parser.add_argument("--streams", type=Path, nargs="+", metavar="NPZ", help=streams)


def read_beside(arguments: argparse.Namespace, table: "FeatureTable") -> "SimulatedWindows | None":
    """Return the simulated windows that are to be learned beside a table, None without any."""
    import numpy as np

    from worldstate.adapters.datasets.feature_table import read_features
    from worldstate.commissioning.heard_stream import HeardStream
    from worldstate.commissioning.simulated_windows import (
        N_OPEN,
        learned_beside,
        open_field_features,
        open_field_windows,
    )
    from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
    from worldstate.operations.training.site_references import simulated_beside

    tables = [read_features(path).group(arguments.group) for path in arguments.simulated or ()]
    streams = [HeardStream.load(path) for path in arguments.streams or ()]
    if not streams:
        return simulated_beside(tables) if tables else None
    # A table that does not say, as the released one, is OVAD's.
    array = ovad_array() if table.domain is None else MicrophoneArray(table.domain.positions_m)
    moves = any(one.ego_moves for one in streams)
    features = open_field_features(array, N_OPEN, np.random.default_rng(0), moving_ego=moves)
    in_the_open = open_field_windows(features)
    return learned_beside(streams, in_the_open, tables).beside(table.environments)


def add_group(parser: argparse.ArgumentParser, of: str) -> None:
    """Declare --group."""
    add_choice(parser, "--group", of, "static", "dynamic", "all")
