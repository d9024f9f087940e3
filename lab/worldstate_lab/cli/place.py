"""`worldstate-lab place`: error of a place behind the corner, from spatial spectra.

Follow one vehicle along the crossing street of two known junctions with walls and array given, on recorded
trials (CSV files with spatial spectra, and the place where it is known) and on simulated passes. The error is
printed beside that of a plain grid filter with constant weights of rays, and of the best constant.
"""

import argparse
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import nanoseconds
from worldstate_lab.places.junctions import (
    AZIMUTHS_RAD,
    SIMULATED,
    WALLS,
    SpectrumTable,
    place_models,
    read_spectra,
    simulated_pass,
)
from worldstate_lab.places.place_filter import PlaceEstimate, PlaceFilter, PlaceMeasurements
from worldstate_lab.places.spectrum_model import RayModel, StreetWalls

_NAME = re.compile(r"(Site[12])_([LR])_(\d+)_Trial\d+")


@dataclass(frozen=True, slots=True)
class PlaceFigures:
    """Figures of one pass; None where nothing is known to score against."""

    name: str
    hops: int
    hidden_hops: int
    side_right: int  # Hidden hops in which the likelier side is the right one
    stated: float  # Share of hops in which a place is stated
    rmse_m: float | None = None
    hidden_rmse_m: float | None = None
    coverage: float | None = None  # Of the 90 % interval
    ray_rmse_m: float | None = None
    ray_hidden_rmse_m: float | None = None
    constant_rmse_m: float | None = None
    constant_hidden_rmse_m: float | None = None


@dataclass(frozen=True, slots=True)
class PlaceExam:
    """Real trials, simulated passes, and what a hop costs."""

    trials: tuple[PlaceFigures, ...]
    passes: tuple[PlaceFigures, ...]
    ms_a_hop: float


def place_exam(
    trials: Sequence[Path], passes: int, seed: int, on_pass: Callable[[], None] = lambda: None
) -> PlaceExam:
    """Score the place on recorded trials, and on passes simulated before the same junctions.

    The name of a trial tells its junction to the method, and its side and speed to the scoring alone.
    """
    ours = {name: PlaceFilter(model) for name, model in place_models().items()}
    plain = {
        name: PlaceFilter(RayModel.of(walls, AZIMUTHS_RAD, ours[name].model.along_m))
        for name, walls in WALLS.items()
    }
    found, spent_s, hops = [], 0.0, 0
    for name, site, table, right in _recordings(trials, passes, seed):
        began = time.process_time()
        said = followed_places(ours[site], table)
        spent_s, hops = spent_s + time.process_time() - began, hops + len(said)
        figures = _figures(name, said, right)
        if np.isfinite(table.along_m).any():
            beside = followed_places(plain[site], table)
            figures = _with_errors(figures, table.along_m, said, beside, WALLS[site])
        found.append(figures)
        on_pass()
    return PlaceExam(tuple(found[: len(trials)]), tuple(found[len(trials) :]), 1e3 * spent_s / max(hops, 1))


def _recordings(
    trials: Sequence[Path], passes: int, seed: int
) -> Iterator[tuple[str, str, SpectrumTable, FloatArray]]:
    """Yield name, junction and spectra, and the side by hop: 1 left, -1 right, 0 where it may be in view."""
    for path in sorted(trials):
        site, side, speed = _told(path)
        table = read_spectra(path)
        known = np.isfinite(table.along_m).any()
        right = _true_sides(table, site) if known else _likely_sides(table, side, speed, WALLS[site])
        yield path.stem, site, table, right
    for one in range(passes):
        site = sorted(SIMULATED)[one % len(SIMULATED)]
        side, table = simulated_pass(site, np.random.default_rng([seed, one]))
        yield f"{site} {side}", site, table, _true_sides(table, site)


def followed_places(places: PlaceFilter, table: SpectrumTable) -> list[PlaceEstimate]:
    """Return what is said after every spectrum of a recording."""
    adapter, said = PlaceMeasurements(places), []
    for time_s, spectrum in zip(table.time_s.tolist(), table.spectra, strict=True):
        adapter.measure(nanoseconds(time_s), spectrum)
        said.append(adapter.estimate)
    return said


def _told(path: Path) -> tuple[str, str, float]:
    """Return junction, side and nominal speed that the name of a trial tells."""
    found = _NAME.fullmatch(path.stem)
    if not found:
        raise InputFileError(path, "expected a name such as Site1_L_15_Trial2.csv")
    return found[1], {"L": "left", "R": "right"}[found[2]], float(found[3]) / 3.6


def _true_sides(table: SpectrumTable, site: str) -> FloatArray:
    return np.asarray(np.where(_hidden(table.along_m, WALLS[site]), np.sign(table.along_m), 0.0))


def _hidden(along_m: FloatArray, walls: StreetWalls) -> BoolArray:
    return (along_m < walls.sight_m[0]) | (along_m > walls.sight_m[1])


def _likely_sides(table: SpectrumTable, side: str, speed_mps: float, walls: StreetWalls) -> FloatArray:
    """Return the sides of a trial without places."""
    # It crosses the axis where the loudest directions within the mouth change sides most clearly.
    within = np.abs(AZIMUTHS_RAD) < np.arctan2(min(walls.left_m, walls.right_m), walls.corner_ahead_m)
    loudest = AZIMUTHS_RAD[within][table.spectra[:, within].argmax(axis=1)]
    first = 1.0 if side == "left" else -1.0
    before = np.cumsum(np.sign(loudest) * first)
    crossed_s = table.time_s[before.argmax()]
    hidden = np.abs(table.time_s - crossed_s) * speed_mps > walls.sight_m[1]
    return np.asarray(np.where(table.time_s < crossed_s, first, -first) * hidden)


def _figures(name: str, said: Sequence[PlaceEstimate], right: FloatArray) -> PlaceFigures:
    left = np.array([one.left_probability for one in said])
    hidden = right != 0.0
    stated = float(np.mean([one.stated for one in said]))
    as_said = np.where(left > 0.5, 1.0, -1.0) == right
    return PlaceFigures(name, len(said), int(hidden.sum()), int(as_said[hidden].sum()), stated)


def _with_errors(
    figures: PlaceFigures,
    along_m: FloatArray,
    said: Sequence[PlaceEstimate],
    beside: Sequence[PlaceEstimate],
    walls: StreetWalls,
) -> PlaceFigures:
    """Add errors and coverage; the best constants are one place, and one distance while hidden."""
    known, hidden = np.isfinite(along_m), _hidden(along_m, walls)
    ends = np.array([one.interval_m for one in said])
    covered = (ends[:, 0] <= along_m) & (along_m <= ends[:, 1])
    ours, rays = (np.array([one.mean_m for one in each]) - along_m for each in (said, beside))
    whole, apart = along_m - along_m[known].mean(), np.abs(along_m) - np.abs(along_m[hidden]).mean()
    return replace(
        figures,
        rmse_m=_rms(ours[known]),
        hidden_rmse_m=_rms(ours[hidden]),
        coverage=float(covered[known].mean()),
        ray_rmse_m=_rms(rays[known]),
        ray_hidden_rmse_m=_rms(rays[hidden]),
        constant_rmse_m=_rms(whole[known]),
        constant_hidden_rmse_m=_rms(apart[hidden]),
    )


def _rms(errors_m: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors_m**2)))


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
