"""`worldstate-lab card`: figures of the simulated exam and of real recordings, for a model's card.

With --streams, MODEL is examined as by `worldstate model make`: on streams of its array, of junctions and
seeds that are not in its training, with and without hazards. --real takes the AUROC one second before T0 and
the share of announced approaches, both by sound alone, from the results of `worldstate-lab sequences` over
both paths. The figures of seven microphones belong to a model of the roof array with a standing ego; every
model gets the gap of the pair between simulated exam and recordings.

Examples
--------
  worldstate-lab card roof.json --streams exam/*.npz --real docs/evidence/results.json --out roof.json
  worldstate-lab card uma-8.json.gz --real docs/evidence/results.json --out uma-8.json.gz
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from functools import partial, reduce
from operator import getitem
from pathlib import Path
from typing import Any

from worldstate.adapters.files.array_match import microphone_order
from worldstate.adapters.files.model_file import Model, RealFigure, read_model, save_model
from worldstate.cli.common.output import CommandResult, check_outputs
from worldstate.cli.common.progress import track
from worldstate.cli.model.show import model_card, readable
from worldstate.commissioning.commission import examine_stream
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.stream_exam import ExaminedStream, exam_figures, with_exam
from worldstate.frontend import ovad_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.parallel import in_processes
from worldstate_lab.cli.main import read_results

ROOF = "a real car's roof (OVAD)"
# Microphones of each path, and whether they belong to the roof array.
PATHS = {"seven_on_time": (7, True), "pair": (2, False)}
# Keys in an exam, in the record of the pair's exam, and in the record of a path.
FIGURES = {
    "AUROC one second before T0": (
        *("auroc_1s_before", "auroc_1"),
        *(("scores", "product, sound alone", "leads", "1"), "auroc"),
    ),
    "share of approaches warned of": (
        *("detected", "warned"),
        *(("rows", "world-state advisory, sound alone"), "warned"),
    ),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("model", type=Path, metavar="MODEL", help="model file")
    add("--out", type=Path, required=True, metavar="FILE", help="model file with the card; may be MODEL")
    add("--streams", type=Path, nargs="+", default=[], metavar="NPZ", help="streams for an exam")
    add("--real", type=Path, metavar="JSON", help="results of `worldstate-lab sequences`")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    model = read_model(arguments.model)
    if arguments.out != arguments.model:
        check_outputs(arguments, "out")
    results = {} if arguments.real is None else read_results(arguments.real)
    if arguments.streams:
        found = in_processes(partial(_examined, model), arguments.streams, arguments.jobs)
        model = with_exam(model, exam_figures([*track(found, "examining", len(arguments.streams))]))
    if arguments.real is not None:
        model = with_real(model, results)
    save_model(arguments.out, model)
    card = {name: model_card(model)[name] for name in ("simulated_exam", "real_figures", "kinds")}
    return CommandResult(card, table=readable(card))


def _examined(model: Model, path: Path) -> ExaminedStream:
    return examine_stream(model, HeardStream.load(path))


def with_real(model: Model, results: Mapping[str, Any]) -> Model:
    """Return a model whose card has the real-corner results of its array, and of the pair."""
    found = [one["figures"] for one in results.values()]
    whole = [one.keys() >= PATHS.keys() and "exam" in one["pair"] and one["start_s"] == 0.0 for one in found]
    if sum(whole) != 1:
        expected = f"one run of `sequences` with {' and '.join(PATHS)}, without --start"
        raise InvalidArgumentError(f"real: expected {expected}, got {sum(whole)}")
    record = [*results.values()][whole.index(True)]
    domain, rows = model.domain, list[RealFigure]()
    roof = domain is not None and microphone_order(domain.positions_m, ovad_array()) is not None
    source = f"{record['command']}, {(record['commit'] or 'no commit')[:9]}"
    for path, (microphones, own) in PATHS.items():
        if own and not (roof and domain is not None and domain.ego_motion == "standing"):
            continue
        figures = record["figures"][path]
        for figure, (in_exam, in_record, places, name) in FIGURES.items():
            simulated = model.provenance.exam.get(in_exam) if own else figures["exam"][in_record]
            if simulated is None:
                raise InvalidArgumentError("streams: expected those of an exam; the model's card has none")
            real = reduce(getitem, places, figures)
            low, high = real[f"{name}_interval"]
            made = (ROOF, microphones, int(figures["recordings"]))
            rows.append(RealFigure(figure, simulated, real[name], low, high, *made, source, own))
    return replace(model, provenance=replace(model.provenance, real=tuple(rows)))
