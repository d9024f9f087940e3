"""`worldstate-lab junctions`: transfer of classifiers and thresholds to a junction that is left out.

FOLDER has real recordings of a corner in the layout of `worldstate-lab sequences`. The chain runs on the
spectra of seven microphones, with the camera. All thresholds are set on the other junctions. The published
classifier and the shipped ensemble are trained on the released windows in --features, without the recordings
in --lists: first on every junction, then without the tested junction. The ensemble is trained on these real
windows alone, because simulating further windows takes hours. Sequence and filter are left out, because no
real junction is in the training of the sequence. "shipped scores" are those of the shipped model, whose
training contains windows of every junction.

Each row has the announced approaches, the lead, alarms per hour, the hazard AUROC one and two seconds before
T0, and the worst junction of each; --json has all of them by junction.

Examples
--------
  worldstate-lab junctions ovad-sequences --features extracted_features.csv --lists static.csv dynamic.csv
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.parallel import in_processes
from worldstate_lab.evaluation.figures import paper_value
from worldstate_lab.evaluation.protocols import (
    FIXED,
    GROUNDED,
    METHODS,
    RETRAINED,
    Protocol,
    junctions_with_both,
    run_protocol,
)
from worldstate_lab.metrics.intervals import worst_group
from worldstate_lab.report.table import Cell, Table, Value, json_values
from worldstate_lab.sequences.hearing import SPECTRA, Chain, heard, ovad_chain
from worldstate_lab.sequences.path_figures import classifiers_of
from worldstate_lab.sequences.path_tables import alarm_table
from worldstate_lab.sequences.recordings import CornerRecording, read_recordings
from worldstate_lab.sequences.scores import alarm_row, leads
from worldstate_lab.trials.classification import Classifiers
from worldstate_lab.trials.trial import Decisions, Trial

_NAMES = (
    *("published", "published, sustained", "proposed .01", "proposed .02", "proposed .05"),
    *("proposed .02 + looming", "ensemble, sustained", "ensemble .02", "ensemble .05", "shipped scores .02"),
)
_ROWS = tuple(one for one in (*METHODS, *GROUNDED) if one.name in _NAMES)
_LEADS = ("1", "2")
_PAPER = ("detection", "false_alarms_per_hour")
_WORSE: Mapping[str, Literal["low", "high"]] = {"warned": "low", "alarms_per_hour": "high"}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="recordings of street corners")
    add("--features", type=Path, required=True, metavar="CSV", help="training windows of the classifiers")
    add("--lists", type=Path, nargs="+", required=True, metavar="CSV", help="recordings left out of training")
    add("--model", type=Path, metavar="FILE", help="for the chain (default: the shipped one)")
    add("--path", choices=SPECTRA, default=SPECTRA[0], help="reading of the spectra (default: %(default)s)")
    add("--seed", type=int, default=1, help="seed of classifiers and intervals (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    recordings = read_recordings(arguments.folder)
    if len(junctions_with_both([(one.junction, one.hazard_free) for one in recordings])) < 2:
        raise InvalidArgumentError("recordings: expected approaches and hazard-free ones at two junctions")
    classifiers = classifiers_of(arguments.features, arguments.lists)
    hear = partial(_heard, ovad_chain(read_model(arguments.model), path=arguments.path))
    work = in_processes(hear, recordings, arguments.jobs)
    trials = list(track(work, "listening", len(recordings)))
    found = {one.name: across(one, trials, classifiers, arguments.seed) for one in (FIXED, RETRAINED)}
    tables = [table for one in (FIXED, RETRAINED) for table in _tables(one, found[one.name])]
    report = {"recordings": len(trials), "windows": len(classifiers.windows or ()), "protocols": found}
    lines = [line for table in tables for line in (*table.lines(), "")]
    return CommandResult(json_values(report), table={}, lines=lines)


def _heard(chain: Chain, recording: CornerRecording) -> Trial:
    trial = heard(chain, recording)
    about = {**trial.hops.about, "leads_from_s": recording.t0_s}
    return replace(trial, hops=trial.hops.replace(about=about))


def across(
    protocol: Protocol, trials: Sequence[Trial], classifiers: Classifiers, seed: int
) -> dict[str, Any]:
    """Return the figures of every method at junctions that set no threshold, and of each junction."""
    found = run_protocol(protocol, trials, _ROWS, classifiers, [seed])
    rng = np.random.default_rng(seed)
    rows: dict[str, Any] = {}
    for name, (said,) in found.decisions.items():
        rows[name] = _row(found.trials, said, rng)
        stated = {figure: paper_value(protocol.name, name, figure) for figure in _PAPER}
        rows[name]["paper"] = {figure: one.value for figure, one in stated.items() if one is not None}
    return rows


def _row(trials: Sequence[Trial], said: Sequence[Decisions], rng: np.random.Generator) -> dict[str, Any]:
    """Return the figures of one method, by junction, too."""
    areas = leads(trials, [one.score for one in said], None, rng)
    found = alarm_row(trials, [[one.alarm for one in said]], rng)
    by_site = {}
    for site in sorted({one.site for one in trials}):
        here = [(trial, one.alarm) for trial, one in zip(trials, said, strict=True) if trial.site == site]
        by_site[site] = alarm_row([trial for trial, _ in here], [[alarm for _, alarm in here]], rng)
    worst = {
        name: worst_group({site: one[name] for site, one in by_site.items()}, worse)
        for name, worse in _WORSE.items()
    }
    worst |= {f"auroc_{lead}": worst_group(areas[lead]["auroc_by_junction"], "low") for lead in _LEADS}
    return found | {"leads": {lead: areas[lead] for lead in _LEADS}, "by_junction": by_site, "worst": worst}


def _tables(protocol: Protocol, rows: Mapping[str, Any]) -> list[Table]:
    worst = (f"worst {name}" for name in next(iter(rows.values()))["worst"])
    heads = ("row", "auroc 1 s", "auroc 2 s", *worst, "paper")
    cells = [(name, *_cells(row)) for name, row in rows.items()]
    title = f"{protocol.title}: hazard, and the worst junction"
    return [alarm_table(rows, "row", protocol.title), Table("junctions", title, heads, cells)]


def _cells(row: Mapping[str, Any]) -> tuple[Cell, ...]:
    areas = [Value(row["leads"][lead]["auroc"], *row["leads"][lead]["auroc_interval"]) for lead in _LEADS]
    worst = (
        Value(value, digits=0 if name == "alarms_per_hour" else 2, note=site)
        for name, (site, value) in row["worst"].items()
    )
    return *areas, *worst, " at ".join(f"{value:g}" for value in row["paper"].values())
