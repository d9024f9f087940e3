"""`worldstate-lab place`: error of a position behind the corner, from spatial spectra.

Follow one vehicle along the crossing street of two known junctions with given walls and array, on recorded
trials (CSV files with spatial spectra and, if known, the position) and on simulated passes. The errors of a
plain grid filter with constant weights of rays, and of the best constant, are printed for comparison.

The junctions and the array are those of M. Jeon et al., "Non-Line-of-Sight Vehicle Localization Based on
Sound", IEEE Transactions on Intelligent Transportation Systems, 2025: facts of the publication's maps. The
distance at which vehicles cross follows from the points at which they come into view, 4.5 m and 4.0 m aside.

Columns of a file of spatial spectra, one row per hop: ``time_s``, ``x_m`` (along the crossing street, right
positive; may be empty) and ``srp_0`` to ``srp_179``, the steered response on `numpy.linspace(-90, 90, 180)`
degrees, right positive.

Examples
--------
  worldstate-lab place --passes 10
  worldstate-lab place trials/*.csv --passes 30 --json
"""

import argparse
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from worldstate.adapters.files.file_io import number, read_rows
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.direction.bearing import srp_phat
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray
from worldstate.ground.values import nanoseconds, seconds
from worldstate.simulation.dataset.recording import simulate_recording
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.settings import SimulationSettings
from worldstate_lab.places.place_filter import PlaceEstimate, PlaceFilter
from worldstate_lab.places.spectrum_model import RayModel, SpectrumModel, StreetWalls
from worldstate_lab.report.table import Table

N_AZIMUTHS = 180
AZIMUTHS_RAD = np.radians(np.linspace(90.0, -90.0, N_AZIMUTHS))  # Azimuths of the columns, left positive
_SPECTRUM = tuple(f"srp_{i}" for i in range(N_AZIMUTHS))
_ASIDE_M, _AHEAD_M = (0.338, 0.162, -0.162, -0.338), (-0.192, -0.06, 0.06, 0.192)
ROOF_ARRAY = MicrophoneArray(np.array([[x, y, 0.0] for x in _AHEAD_M for y in _ASIDE_M]), "roof array of 16")
# 50 to 2000 Hz with frames of 512 samples at 48 kHz, and of 64 at 6 kHz, the rate of simulated passes.
RATE_HZ, NFFT, BINS = 6000.0, 64, range(1, 22)
FREQUENCIES_HZ: FloatArray = np.array(BINS) * RATE_HZ / NFFT
HOP_S = 0.1
# The simulated truth is the front bumper; real positions are the middle of the car.
HALF_LENGTH_M = 2.0
WALLS: Mapping[str, StreetWalls] = MappingProxyType(
    {"Site1": StreetWalls(4.45, 2.8, 2.8, 7.15, facing_m=9.9), "Site2": StreetWalls(4.5, 2.78, 2.78, 6.5)}
)
# Both lanes are 0.75 m beside the middle that the model uses.
SIMULATED: Mapping[str, Site] = MappingProxyType(
    {
        "Site1": Site("Site1", 2.8, 2.8, 4.45, 9.9, 2.8, 2.8, 3.0, verge_m=1.2, side_order=8),
        "Site2": Site("Site2", 2.78, 2.78, 4.5, None, 2.78, 2.78, 3.0, verge_m=0.5, side_order=8),
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumTable:
    """Spatial spectra of one recording, with the position of the vehicle if it is known."""

    time_s: FloatArray  # shape (T,)
    along_m: FloatArray  # shape (T,): Left positive; NaN if unknown
    spectra: FloatArray  # shape (T, N_AZIMUTHS)


def place_models() -> dict[str, SpectrumModel]:
    """Return the models of expected spectra at both junctions."""
    return {
        name: SpectrumModel.of(walls, ROOF_ARRAY, AZIMUTHS_RAD, FREQUENCIES_HZ)
        for name, walls in WALLS.items()
    }


def read_spectra(path: Path) -> SpectrumTable:
    r"""Read one recording; raise `InputFileError` for a missing column or an invalid number.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     table = Path(folder) / "pass.csv"
    ...     _ = table.write_text(f"time_s,x_m,{','.join(_SPECTRUM)}\n0,2.5{',0.1' * N_AZIMUTHS}\n")
    ...     read_spectra(table).along_m
    array([-2.5])
    """
    rows = list(read_rows(path, ("time_s", "x_m", *_SPECTRUM)))
    if not rows:
        raise InputFileError(path, "expected at least one row")
    return SpectrumTable(
        np.array([number(path, line, row, "time_s") for line, row in rows]),
        np.array([-number(path, line, row, "x_m") if row["x_m"] else np.nan for line, row in rows]),
        np.array([[number(path, line, row, name) for name in _SPECTRUM] for line, row in rows]),
    )


def simulated_pass(site: str, rng: np.random.Generator) -> tuple[str, SpectrumTable]:
    """Draw and render one pass; return its side and its spectra."""
    side = ("left", "right")[int(rng.integers(2))]
    speed = rng.uniform(2.0, 7.0)
    duration = float(np.clip(rng.uniform(18.0, 30.0) / speed, 4.0, 14.0))
    entry = duration * rng.uniform(0.25, 0.5)
    plan = replace(
        SIMULATED[site],
        side_reflection=rng.uniform(0.7, 0.97),
        facade_reflection=rng.uniform(0.6, 0.97),
        surface_db=rng.uniform(0.0, 10.0),
    )
    settings = SimulationSettings(plan, side, duration, entry, speed, sample_rate_hz=RATE_HZ)
    recording = simulate_recording(settings, rng, ROOF_ARRAY)
    spectra = _spectra(recording.audio)
    front = np.array([frame["position_m"][1] for frame in recording.truth["frames"]])[: len(spectra)]
    along = front + HALF_LENGTH_M * (1.0 if side == "left" else -1.0)
    return side, SpectrumTable(HOP_S * np.arange(1.0, len(along) + 1.0), along, spectra[: len(along)])


def _spectra(audio: Float32Array) -> FloatArray:
    """Return the SRP-PHAT of every hop, shape (hops, azimuths)."""
    steering = Steering.towards(ROOF_ARRAY, FREQUENCIES_HZ, AZIMUTHS_RAD)
    frames = StreamingStft(ROOF_ARRAY.n_microphones, NFFT, BINS).push(audio)
    hop = round(RATE_HZ * HOP_S)
    ends = NFFT + np.arange(len(frames)) * (NFFT // 2)
    edges = np.searchsorted(ends, np.arange(len(audio) // hop + 1) * hop, side="right")
    return np.array([srp_phat(frames[a:b], steering) for a, b in pairwise(edges)])


_NAME = re.compile(r"(Site[12])_([LR])_(\d+)_Trial\d+")


# Figures of one pass, and their column heads; errors are None if no position is known.
_COLUMNS = {
    "hops": "hops",
    "hidden_hops": "hidden",
    "side_right": "side",  # Hidden hops in which the likelier side is correct
    "stated": "stated",  # Share of hops with a stated position
    "rmse_m": "error",
    "hidden_rmse_m": "hidden",
    "coverage": "in 90 %",
    "ray_rmse_m": "rays",
    "ray_hidden_rmse_m": "hidden",
    "constant_rmse_m": "const.",
    "constant_hidden_rmse_m": "hidden",
}
PlaceFigures = dict[str, Any]


def place_exam(
    trials: Sequence[Path], passes: int, seed: int, on_pass: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Score positions on recorded trials and on passes simulated at the same junctions; cost of a hop.

    The method uses the junction in the name of a trial; its side and speed are used for scoring only.
    """
    ours = {name: PlaceFilter(model) for name, model in place_models().items()}
    plain = {
        name: PlaceFilter(RayModel.of(walls, AZIMUTHS_RAD, ours[name].model.along_m))
        for name, walls in WALLS.items()
    }
    found, spent_s, hops = list[PlaceFigures](), 0.0, 0
    for name, site, table, right in _recordings(trials, passes, seed):
        began = time.process_time()
        said = followed_places(ours[site], table)
        spent_s, hops = spent_s + time.process_time() - began, hops + len(said)
        left = np.array([one.left_probability for one in said])
        hidden, as_said = right != 0.0, np.where(left > 0.5, 1.0, -1.0) == right
        figures = dict.fromkeys(_COLUMNS) | {
            "name": name,
            "hops": len(said),
            "hidden_hops": int(hidden.sum()),
            "side_right": int(as_said[hidden].sum()),
            "stated": float(np.mean([one.stated for one in said])),
        }
        if np.isfinite(table.along_m).any():
            figures |= _errors(table.along_m, said, followed_places(plain[site], table), WALLS[site])
        found.append(figures)
        on_pass()
    of = {"trials": found[: len(trials)], "passes": found[len(trials) :]}
    return {**of, "ms_a_hop": 1e3 * spent_s / max(hops, 1)}


def _recordings(
    trials: Sequence[Path], passes: int, seed: int
) -> Iterator[tuple[str, str, SpectrumTable, FloatArray]]:
    """Yield name, junction and spectra, and the side by hop: 1 left, -1 right, 0 if it may be in view."""
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
    """Return the estimate after every spectrum of a recording."""
    belief, said = places.unknown, []
    # Whole nanoseconds, so that equal hops share one transition of the filter.
    stamps_ns = [nanoseconds(time_s) for time_s in table.time_s.tolist()]
    before_ns = stamps_ns[:1] + stamps_ns[:-1]
    for stamp_ns, last_ns, spectrum in zip(stamps_ns, before_ns, table.spectra, strict=True):
        belief = places.update(places.predict(belief, seconds(stamp_ns - last_ns)), spectrum)
        said.append(places.estimate(belief))
    return said


def _told(path: Path) -> tuple[str, str, float]:
    """Return the junction, side and nominal speed in the name of a trial."""
    found = _NAME.fullmatch(path.stem)
    if not found:
        raise InputFileError(path, "expected a name such as Site1_L_15_Trial2.csv")
    return found[1], {"L": "left", "R": "right"}[found[2]], float(found[3]) / 3.6


def _true_sides(table: SpectrumTable, site: str) -> FloatArray:
    return np.asarray(np.where(_hidden(table.along_m, WALLS[site]), np.sign(table.along_m), 0.0))


def _hidden(along_m: FloatArray, walls: StreetWalls) -> BoolArray:
    return (along_m < walls.sight_m[0]) | (along_m > walls.sight_m[1])


def _likely_sides(table: SpectrumTable, side: str, speed_mps: float, walls: StreetWalls) -> FloatArray:
    """Return the sides of a trial without positions."""
    # The vehicle crosses the axis when the loudest directions within the mouth change side most clearly.
    within = np.abs(AZIMUTHS_RAD) < np.arctan2(min(walls.left_m, walls.right_m), walls.corner_ahead_m)
    loudest = AZIMUTHS_RAD[within][table.spectra[:, within].argmax(axis=1)]
    first = 1.0 if side == "left" else -1.0
    before = np.cumsum(np.sign(loudest) * first)
    crossed_s = table.time_s[before.argmax()]
    hidden = np.abs(table.time_s - crossed_s) * speed_mps > walls.sight_m[1]
    return np.asarray(np.where(table.time_s < crossed_s, first, -first) * hidden)


def _errors(
    along_m: FloatArray, said: Sequence[PlaceEstimate], beside: Sequence[PlaceEstimate], walls: StreetWalls
) -> PlaceFigures:
    """Return errors and coverage; the best constants are one position, and one distance while hidden."""
    known, hidden = np.isfinite(along_m), _hidden(along_m, walls)
    ends = np.array([one.interval_m for one in said])
    covered = (ends[:, 0] <= along_m) & (along_m <= ends[:, 1])
    ours, rays = (np.array([one.mean_m for one in each]) - along_m for each in (said, beside))
    whole, apart = along_m - along_m[known].mean(), np.abs(along_m) - np.abs(along_m[hidden]).mean()
    return {
        "rmse_m": _rms(ours[known]),
        "hidden_rmse_m": _rms(ours[hidden]),
        "coverage": float(covered[known].mean()),
        "ray_rmse_m": _rms(rays[known]),
        "ray_hidden_rmse_m": _rms(rays[hidden]),
        "constant_rmse_m": _rms(whole[known]),
        "constant_hidden_rmse_m": _rms(apart[hidden]),
    }


def _rms(errors_m: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors_m**2)))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("trials", type=Path, nargs="*", metavar="CSV", help="spatial spectra, such as Site1_L_15_Trial2.csv")
    add("--passes", type=int, default=30, help="simulated passes (default: %(default)s)")
    add("--seed", type=int, default=0, help="seed of the passes (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    with progress_bar("following", len(arguments.trials) + arguments.passes) as bar:
        report = place_exam(arguments.trials, arguments.passes, arguments.seed, bar.advance)
    rows = [_row(one["name"], one) for one in report["trials"]]
    for title, figures in (("trials", report["trials"]), ("simulated", report["passes"])):
        scored = [one for one in figures if one["rmse_m"] is not None]
        if scored:
            means = {name: sum(one[name] for one in scored) / len(scored) for name in _COLUMNS}
            report[f"mean_of_{title}"] = means | {"worst_rmse_m": max(one["rmse_m"] for one in scored)}
            rows.append(_row(f"{title}, mean of {len(scored)}", means))
    table = Table("places", f"{report['ms_a_hop']:.2f} ms per hop", ("pass", *_COLUMNS.values()), rows)
    return CommandResult(report, table={}, lines=table.lines())


def _row(name: str, found: PlaceFigures) -> tuple[str, ...]:
    values = (found[column] for column in _COLUMNS)
    return name, *("-" if one is None else format(one, ".3g") for one in values)
