"""`worldstate-lab place`: error of a place behind the corner, from spatial spectra.

Follow one vehicle along the crossing street of two known junctions with walls and array given, on recorded
trials (CSV files with spatial spectra, and the place where it is known) and on simulated passes. The error is
printed beside that of a plain grid filter with constant weights of rays, and of the best constant.
"""

import argparse
from pathlib import Path

from worldstate.cli.common.output import CommandResult

EXAMPLE = """\
examples:
  worldstate-lab place --passes 10
  worldstate-lab place trials/*.csv --passes 30 --json"""

_COLUMNS = {
    "hops": "hops",
    "hidden_hops": "hidden",
    "side_right": "side",
    "stated": "stated",
    "rmse_m": "error",
    "hidden_rmse_m": "hidden",
    "coverage": "in 90 %",
    "ray_rmse_m": "rays",
    "ray_hidden_rmse_m": "hidden",
    "constant_rmse_m": "const.",
    "constant_hidden_rmse_m": "hidden",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add(
        "trials", type=Path, nargs="*", metavar="CSV", help="spatial spectra, Site1_L_15_Trial2.csv and so on"
    )
    add("--passes", type=int, default=30, help="simulated passes (default: %(default)s)")
    add("--seed", type=int, default=0, help="draws the passes (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from dataclasses import asdict

    from worldstate.cli.common.progress import progress_bar
    from worldstate_lab.places.place_exam import place_exam

    with progress_bar("following", len(arguments.trials) + arguments.passes) as bar:
        exam = place_exam(arguments.trials, arguments.passes, arguments.seed, bar.advance)
    lines = [f"{'':24}" + "".join(f"{name:>8}" for name in _COLUMNS.values())]
    for title, figures in (("trials", exam.trials), ("simulated", exam.passes)):
        rows = [asdict(one) for one in figures]
        if title == "trials":
            lines += [_line(row["name"], row) for row in rows]
        scored = [row for row in rows if row["rmse_m"] is not None]
        if scored:
            means = {name: sum(row[name] for row in scored) / len(scored) for name in _COLUMNS}
            lines.append(_line(f"{title}, mean of {len(scored)}", means))
    lines.append(f"{exam.ms_a_hop:.2f} ms a hop")
    return CommandResult(asdict(exam), table={}, lines=lines)


def _line(name: str, row: dict[str, float | None]) -> str:
    values = (row[column] for column in _COLUMNS)
    return f"{name:24}" + "".join(f"{'-' if v is None else format(v, '.3g'):>8}" for v in values)
