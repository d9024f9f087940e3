"""Options of the commands that take a table of feature windows, declared once."""

import argparse
from pathlib import Path


def add_table_options(parser: argparse.ArgumentParser) -> None:
    """Declare the table, which part of it counts and what is made of it."""
    parser.add_argument("table", type=Path, metavar="CSV", help="windows: feat0..feat59, Class, ID, ...")
    parser.add_argument(
        "--group",
        choices=("static", "dynamic", "all"),
        default="static",
        help="standing ego, moving ego or both (default: %(default)s)",
    )
    parser.add_argument(
        "--method", choices=("baseline", "worldstate"), default="worldstate", help="(default: %(default)s)"
    )
