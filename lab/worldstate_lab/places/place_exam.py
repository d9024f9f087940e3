"""Errors of a place behind the corner, beside a plain grid filter and the best constant."""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import nanoseconds

from .estimate import KnownPlace, PlaceEstimate
from .junctions import SIMULATED, WALLS, place_models
from .place_filter import PlaceFilter
from .place_measurements import PlaceMeasurements, SpatialSpectrum
from .ray_model import RayModel
from .simulated_passes import simulated_pass
from .spatial_spectra import AZIMUTHS_RAD, SpectrumTable, read_spectra
from .street_walls import StreetWalls

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
    models = {name: PlaceFilter(model) for name, model in place_models().items()}
    plain = {
        name: PlaceFilter(RayModel.of(walls, models[name].model.along_m)) for name, walls in WALLS.items()
    }
    real, simulated, spent_s, hops = [], [], 0.0, 0
    for path in sorted(trials):
        site, side, speed = _told(path)
        table = read_spectra(path)
        said, cost_s = _timed(models[site], table)
        spent_s, hops = spent_s + cost_s, hops + len(said)
        if table.has_places:
            beside = followed_places(plain[site], table)
            real.append(_with_truth(path.stem, table, said, beside, WALLS[site]))
        else:
            right = _sides(table, side, speed, WALLS[site])
            real.append(_figures(path.stem, said, right))
        on_pass()
    for one in range(passes):
        site = sorted(SIMULATED)[one % len(SIMULATED)]
        side, table = simulated_pass(site, np.random.default_rng([seed, one]))
        said, cost_s = _timed(models[site], table)
        spent_s, hops = spent_s + cost_s, hops + len(said)
        beside = followed_places(plain[site], table)
        simulated.append(_with_truth(f"{site} {side}", table, said, beside, WALLS[site]))
        on_pass()
    return PlaceExam(tuple(real), tuple(simulated), 1e3 * spent_s / max(hops, 1))


def followed_places(places: PlaceFilter, table: SpectrumTable) -> list[PlaceEstimate]:
    """Return what is said after every spectrum of a recording."""
    adapter, said = PlaceMeasurements(places), []
    for time_s, spectrum in zip(table.time_s.tolist(), table.spectra, strict=True):
        adapter.measure(SpatialSpectrum(nanoseconds(time_s), spectrum))
        said.append(adapter.estimate)
    return said


def _timed(places: PlaceFilter, table: SpectrumTable) -> tuple[list[PlaceEstimate], float]:
    began = time.process_time()
    return followed_places(places, table), time.process_time() - began


def _told(path: Path) -> tuple[str, str, float]:
    """Return junction, side and nominal speed that the name of a trial tells."""
    found = _NAME.fullmatch(path.stem)
    if not found:
        raise InputFileError(path, "expected a name such as Site1_L_15_Trial2.csv")
    return found[1], {"L": "left", "R": "right"}[found[2]], float(found[3]) / 3.6


def _sides(table: SpectrumTable, side: str, speed_mps: float, walls: StreetWalls) -> FloatArray:
    """Side by hop of a trial without places, 1 left, -1 right, 0 where the vehicle may be in view."""
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
    stated = float(np.mean([isinstance(one.place, KnownPlace) for one in said]))
    as_said = np.where(left > 0.5, 1.0, -1.0) == right
    return PlaceFigures(name, len(said), int(hidden.sum()), int(as_said[hidden].sum()), stated)


def _with_truth(
    name: str,
    table: SpectrumTable,
    said: Sequence[PlaceEstimate],
    beside: Sequence[PlaceEstimate],
    walls: StreetWalls,
) -> PlaceFigures:
    along, known = table.along_m, np.isfinite(table.along_m)
    hidden = known & ((along < walls.sight_m[0]) | (along > walls.sight_m[1]))
    ends = np.array([one.interval_m for one in said])
    covered = (ends[:, 0] <= along) & (along <= ends[:, 1])
    ours, rays = (np.array([one.mean_m for one in each]) - along for each in (said, beside))
    # The best constants: one place for the whole run, one distance on the right side while hidden.
    whole, apart = along - along[known].mean(), np.abs(along) - np.abs(along[hidden]).mean()
    return replace(
        _figures(name, said, np.where(hidden, np.sign(along), 0.0)),
        rmse_m=_rms(ours, known),
        hidden_rmse_m=_rms(ours, hidden),
        coverage=float(covered[known].mean()),
        ray_rmse_m=_rms(rays, known),
        ray_hidden_rmse_m=_rms(rays, hidden),
        constant_rmse_m=_rms(whole, known),
        constant_hidden_rmse_m=_rms(apart, hidden),
    )


def _rms(errors_m: FloatArray, chosen: BoolArray) -> float:
    return float(np.sqrt(np.mean(errors_m[chosen] ** 2)))
