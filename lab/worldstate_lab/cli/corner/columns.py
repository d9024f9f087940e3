"""`worldstate-lab columns`: distance of the simulated inputs of a sequence from real recordings.

FOLDER has real recordings of a corner in the layout of `worldstate-lab sequences`. Streams in --streams have
the array of --path; for `seven` they have all 56 microphones, which changes evidence, prominence and bearing
but not levels and bands. Streams whose names begin alike belong to one renderer. A few junctions of each
renderer are enough, because the work grows with the square of the number of excerpts. Window evidence is too
good on streams in the training of --model.

Each row is one column: the squared energy distance of real junctions from one another, of the halves of one
of them (chance), and of simulated junctions from real ones, with the ratio of the distances. --statistics
adds medians and quartiles of every statistic.

Examples
--------
  worldstate-lab columns ovad-sequences --streams pair/S*.npz pair/T*.npz
  worldstate-lab columns ovad-sequences --path seven_on_time --streams streams/*.npz --statistics
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.commissioning.commission import parts_of, stream_evidence
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate_lab.report.table import Cell, Table, Value, json_values
from worldstate_lab.sequences.hearing import PathName, corner_chain, heard
from worldstate_lab.sequences.recordings import read_recordings
from worldstate_lab.streets.column_distances import (
    COMPARED,
    Distances,
    Excerpt,
    column_distances,
    stream_excerpts,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="recordings of street corners")
    add("--streams", type=Path, nargs="+", required=True, metavar="NPZ", help="processed simulated streams")
    add("--path", choices=get_args(PathName), default="pair", help="sound input (default: %(default)s)")
    add("--model", type=Path, metavar="FILE", help="of --path (default: pair/model.json or the shipped one)")
    add("--statistics", action="store_true", help="also print medians and quartiles")
    add("--seed", type=int, default=1, help="seed of halves and intervals (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    recordings = read_recordings(arguments.folder)
    if len({one.junction for one in recordings}) < 2:
        raise InvalidArgumentError("recordings: expected two junctions or more")
    chain = corner_chain(arguments.path, arguments.folder, arguments.model, None)
    parts: dict[str, list[Excerpt]] = {"real": []}
    for one in track(recordings, f"listening, {chain.path}", len(recordings)):
        hops = heard(chain, one).hops
        parts["real"].append(Excerpt.of(one.junction, one.side, one.t0_s, hops.time_s, hops.inputs))
    model, _ = parts_of(chain.model)
    for path in track(arguments.streams, "streams", len(arguments.streams)):
        stream = HeardStream.load(path)
        parts.setdefault(stream.site[0], []).extend(stream_excerpts(stream, stream_evidence(model, stream)))
    rng = np.random.default_rng(arguments.seed)
    simulated = {name: some for name, some in parts.items() if name != "real"}
    found = {name: column_distances(parts["real"], some, rng) for name, some in simulated.items()}
    tables = {"distances": _distance_table(found)}
    if arguments.statistics:
        tables["statistics"] = _statistics_table(parts)
    counts = {name: [sum(one.hazard for one in some), len(some)] for name, some in parts.items()}
    lines = [line for table in tables.values() for line in (*table.lines(), "")]
    return CommandResult(json_values({"excerpts": counts, **tables}), table={}, lines=lines)


def _distance_table(found: Mapping[str, Distances]) -> Table:
    first = next(iter(found.values()))
    rows: list[tuple[Cell, ...]] = []
    for i, name in enumerate(COMPARED):
        cells = (cell for one in found.values() for cell in (one.simulated[i].item(), one.ratios[i]))
        rows.append((name, first.real[i].item(), first.halves[i].item(), *cells))
    means = (cell for one in found.values() for cell in (one.simulated.mean().item(), one.mean))
    rows.append(("mean", first.real.mean().item(), first.halves.mean().item(), *means))
    rows.append(("median", None, None, *(cell for one in found.values() for cell in (None, one.median))))
    heads = (cell for name in found for cell in (f"{name} to real", f"ratio, {name}"))
    columns = ("column", "real to real", "halves", *heads)
    return Table("distances", "Squared distances, and ratios of distances", columns, rows)


def _statistics_table(parts: Mapping[str, Sequence[Excerpt]]) -> Table:
    names = dict.fromkeys(name for some in parts.values() for one in some for name in one.statistics)
    rows = [
        (column, name, *(_quartiles(some, name, i) for some in parts.values()))
        for i, column in enumerate(COMPARED)
        for name in names
    ]
    title = "Medians and quartiles; levels in dB above the quiet street, evidence in nats, bearing in rad"
    return Table("statistics", title, ("column", "statistic", *parts), rows)


def _quartiles(some: Sequence[Excerpt], name: str, column: int) -> Value | None:
    rows: list[FloatArray] = [one.statistics[name][:, column] for one in some if name in one.statistics]
    values = np.concatenate([np.zeros(0), *rows])
    if not values.size:
        return None
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75)).tolist()
    return Value(median, low, high)
