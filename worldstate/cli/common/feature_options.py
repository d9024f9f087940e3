"""Options of the commands that take a table of feature windows, declared once."""

import argparse
from pathlib import Path

from .command import add_choice


def add_table_options(parser: argparse.ArgumentParser) -> None:
    """Declare the table, which part of it counts and what is made of it."""
    parser.add_argument("table", type=Path, metavar="CSV", help="windows: feat0..feat59, Class, ID, ...")
    add_which_windows(parser, "standing ego, moving ego or both")


def add_which_windows(parser: argparse.ArgumentParser, of: str) -> None:
    """Declare --group and --method."""
    add_choice(parser, "--group", of, "static", "dynamic", "all")
    add_choice(parser, "--method", "", "worldstate", "baseline")
