"""`worldstate-lab staged`: detections of a camera alone on real videos of a corner, clean and degraded.

Blur, darkness, noise and a wet lens (blur and darkness together, without drops) are staged at four levels on
the videos of a folder, and a detector runs on them: NanoDet on three crops of every second image, or the
project's motion detector on every image. Boxes are kept in DIR/DETECTOR-FAMILY-LEVEL/ID.json and reused.

The output has the miss rate beta of the reference vehicle after T0 by state (and, printed, by angle), and the
share of images after T0 with a detected moving vehicle, beside that of hazard-free images. `--timeline ID`
draws one approach into DIR; its images must not be published.

Examples
--------
  worldstate-lab staged ovad-sequences --out staged --json
  worldstate-lab staged ovad-sequences --out staged --detector motion --jobs 2
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from worldstate.adapters.camera.miss_rates import save_miss_rates
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import Step
from worldstate.cli.common.command import add_choice
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.parallel import in_processes
from worldstate.operations.figure_style import figure_file
from worldstate_lab.degradation.beta_curves import BetaCurves
from worldstate_lab.degradation.conditions import FAMILIES, at_level
from worldstate_lab.evaluation.report.approach_panel import approach_figure, approach_images
from worldstate_lab.metrics.intervals import stratified_draws
from worldstate_lab.report.table import Cell, Table, Value, json_values
from worldstate_lab.sequences.hearing import heard, ovad_chain
from worldstate_lab.sequences.recordings import CornerRecording, read_recordings
from worldstate_lab.sequences.staged_looks import (
    VisionRow,
    staged_beta,
    staged_miss_rates,
    vision_row,
)
from worldstate_lab.sequences.staged_video import Staging, milliseconds_a_search, stage_recording, staging_of
from worldstate_lab.trials.trial import Decisions, Trial


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="recordings: truth.csv, video, boxes, detector")
    add("--out", type=Path, metavar="DIR", required=True, help="boxes by state; existing files are reused")
    add_choice(parser, "--detector", "", "nanodet", "motion")
    add("--timeline", metavar="ID", help="draw this approach into DIR")
    add("--seed", type=int, default=0, help="seed of noise and intervals (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    recordings = read_recordings(arguments.folder)
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.timeline is not None:
        return CommandResult({"figure": str(_timeline(arguments, recordings))})
    staging = staging_of(arguments.detector, arguments.folder, arguments.out, arguments.seed)
    _stage(staging, recordings, arguments.jobs)
    approaches = [one for one in recordings if not one.hazard_free]
    draws = stratified_draws([one.junction for one in approaches], np.random.default_rng(arguments.seed))
    curves = staged_beta(staging, approaches, draws)
    rates = staged_miss_rates(staging, approaches)
    save_miss_rates(arguments.out / f"{staging.detector}-miss_rates.json", rates)
    rows = [vision_row(staging, state, recordings, draws) for state in staging.states]
    report = {
        "recordings": len(recordings),
        "beta": _beta_report(curves),
        "vision": {one.state: one for one in rows},
    }
    tables = [*_beta_tables(curves), _vision_table(rows)]
    lines = [line for one in tables for line in ("", *one.lines())]
    return CommandResult(json_values(report), table={}, lines=lines)


def _stage(staging: Staging, recordings: Sequence[CornerRecording], jobs: int) -> None:
    """Process missing states, approaches first, because they are more useful if the work is stopped."""
    missing = sorted((one for one in recordings if staging.missing(one)), key=lambda one: one.hazard_free)
    if missing:
        states = sum(len(staging.missing(one)) for one in missing)
        ms = milliseconds_a_search(staging, missing[0])
        # Ten images per second; staging adds a fifth.
        minutes = 1.2e-3 * ms * states * 10.0 * missing[0].length_s / staging.every / jobs / 60.0
        told = f"staging, {ms:.0f} ms per search, {minutes:.0f} minutes"
        list(track(in_processes(partial(stage_recording, staging), missing, jobs), told, len(missing)))


def _beta_report(curves: BetaCurves) -> dict[str, Any]:
    """Return beta by family and level over all angles."""
    levels = range(curves.looks.shape[2])
    overall = {
        family: [_beta(curves, i, None, level) for level in levels] for i, family in enumerate(FAMILIES)
    }
    return {"overall": overall}


def _beta(curves: BetaCurves, family: int, azimuth: int | None, level: int) -> Value:
    band = curves.overall if azimuth is None else curves.by_azimuth
    at = (family, level) if azimuth is None else (family, azimuth, level)
    value, low, high = (float(part[at]) for part in band)
    return Value(value, low, high)


def _beta_tables(curves: BetaCurves) -> list[Table]:
    bins = range(len(curves.bins))
    rows: list[tuple[Cell, ...]] = [
        (at_level(family, level).name, *(_beta(curves, i, b, level) for b in (None, *bins)))
        for i, family in enumerate(FAMILIES)
        for level in range(0 if i == 0 else 1, curves.looks.shape[2])
    ]
    falls = [(one.along, one.where, Value(one.by, one.low, one.high)) for one in curves.falls]
    return [
        Table("beta", "Miss rate of the reference vehicle after T0", ("state", "all", *curves.bins), rows),
        Table("falls", "Steps at which it falls although it should rise", ("along", "where", "by"), falls),
    ]


def _vision_table(rows: Sequence[VisionRow]) -> Table:
    junctions = tuple(rows[0].hazard_free)
    cells = [(one.state, str(one.looks), one.aware, *map(one.hazard_free.get, junctions)) for one in rows]
    columns = "state", "images", "aware after T0", *(f"hazard-free {name}" for name in junctions)
    return Table("vision", "Share of images with a moving vehicle, camera alone", columns, cells)


def _timeline(arguments: argparse.Namespace, recordings: Sequence[CornerRecording]) -> Path:
    """Draw images, statistic, threshold, advisory and boxes of one approach; return the file."""
    named = {one.name: one for one in recordings if not one.hazard_free}
    if arguments.timeline not in named:
        raise InvalidArgumentError(f"--timeline: expected an approach, got {arguments.timeline}")
    recording, chain = named[arguments.timeline], ovad_chain(read_model(None), path="seven_on_time")
    trial = heard(chain, recording)
    images = approach_images(recording.video, trial)
    title = f"Approach {recording.name} at {recording.junction}, from the {recording.side}"
    figure = approach_figure(title, trial, _decided(trial, chain.steps(recording)), images)
    path: Path = arguments.out / f"timeline-{recording.name}.png"
    with figure_file(path, *figure.size_in) as canvas:
        figure.draw(canvas)
    return path


def _decided(trial: Trial, steps: Iterable[Step]) -> Decisions:
    """Return the statistic of the alarm and its threshold at every hop, both as probabilities."""
    evidence = [
        max((cue.evidence for cue in one.state.cues if cue.evidence), key=lambda terms: terms.compared_nats)
        for one in steps
    ]
    compared, threshold = expit([(one.compared_nats, one.threshold_nats) for one in evidence]).T
    return replace(trial.chains["filtered"], score=compared, threshold=threshold)
