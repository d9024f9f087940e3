"""`worldstate-lab table`: every row of Table I on a data set, as one report.

Every recording is processed once, and every method decides on it: vision alone, radar, track recovery, the
published acoustic classifier, the proposed method at three budgets, and this library's own advisory. Methods
are fitted on other recordings than those on which they are scored: with five folds, with one junction left
out and a fixed classifier, and with one junction left out and a classifier retrained without it.

DATASET is a folder in OVAD's layout: the real data set, or recordings of your own with DataLog.csv. Without
one, streets are simulated into OUT/streets (12 GB), and the report states it. The tested recordings are those
of the official lists if they are in the folder (or --static-ids, --dynamic-ids), else all.

The published classifier is trained on --features, a table of windows such as the released one, without
windows of tested recordings. Without --features it is trained on the recordings that are not tested; for
simulated streets, on other simulated recordings; otherwise on the calibration recordings of each fold.

OUT/report.md has every table and figure beside the paper's, OUT/report_files the same as PNG and CSV.

Streets are kept, and OUT/cache has the results by the content of each recording: an interrupted run
continues, and a second one takes a minute. The minimum is two approaches and two hazard-free recordings, and
for leaving junctions out two junctions with both; the requirements of a protocol are checked first.

Unreadable recordings, and rows of a model for another array, are listed and not scored.

Examples
--------
  worldstate-lab table --smoke --out smoke
  worldstate-lab table --out streets --jobs 2
  worldstate-lab table ovad_dataset --features extracted_features.csv --out report --jobs 2
"""

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from worldstate.adapters.datasets.ovad import choose_array
from worldstate.adapters.files.acoustic_domain import check_array
from worldstate.adapters.files.array_match import microphone_order
from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.output import CommandResult, output_folder, write_report
from worldstate.cli.common.progress import progress_bar, track
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.simulation.dataset.dataset import DatasetSettings, write_dataset
from worldstate.simulation.scene.junction import MOVING_SITES, SITES
from worldstate_lab.degradation.conditions import motion_detectors
from worldstate_lab.degradation.degradation_study import DegradationSettings
from worldstate_lab.evaluation.evaluation import (
    Evaluation,
    EvaluationSettings,
    evaluate,
    lacking_data,
    whole_sweep,
)
from worldstate_lab.evaluation.figures import FIGURES, titles
from worldstate_lab.evaluation.report.contents import evaluation_document
from worldstate_lab.evaluation.report.degradation_section import degradation_record, sweep_tables
from worldstate_lab.evaluation.report.warning_sections import equal_table
from worldstate_lab.report.table import Cell, Table, Value, json_values, write_document
from worldstate_lab.trials import classification as windows
from worldstate_lab.trials.classification import Classifiers, model_from_windows
from worldstate_lab.trials.listening import model_refusal
from worldstate_lab.trials.pass_cache import Hearer
from worldstate_lab.trials.trial import Take, TakeList, find_takes

# Recordings of the simulated streets: 42 approaches and 41 hazard-free ones, and 59 of a moving ego.
STATIC, DYNAMIC = 83, 59
SMOKE_STATIC, SMOKE_WINDOWS, SMOKE_S = 4, 2, 6.0
# Images of OVAD's size take more than half of the time of a simulated recording.
SMOKE_VIDEO_PX, SMOKE_WIDTH_PX = 480, 160
FULL_SEEDS = 5
# Options for the place of work and the printed output.
_NO_FIGURE = ("run", "needs", "json", "results", "dataset", "out", "jobs", "seeds")
SHOWN = ("lead_s", "detection", "random_detection", "bearing_deg")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("dataset", type=Path, nargs="?", metavar="DATASET", help="recordings (default: simulated streets)")
    add("--out", type=Path, default=Path("evaluation"), metavar="DIR", help="(default: %(default)s)")
    add("--features", type=Path, metavar="CSV", help="training windows of the published classifier")
    add("--model", type=Path, metavar="FILE", help="this library's model (default: the shipped one)")
    add("--static-ids", type=Path, metavar="CSV", help="test recordings of a standing ego")
    add("--dynamic-ids", type=Path, metavar="CSV", help="test recordings of a moving ego")
    add("--seed", type=int, default=1, help="seed of streets, folds, intervals (default: %(default)s)")
    add("--full", action="store_true", help=f"{FULL_SEEDS} draws of folds, sweep over all videos")
    add("--smoke", action="store_true", help="quick check on four recordings, one minute")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    add("--jobs", type=int, default=cores, help="processes (default: one per core)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    if arguments.dataset is not None and arguments.smoke:
        raise InvalidArgumentError("--smoke: expected no DATASET, because it simulates four recordings")
    output_folder(arguments.out, "evaluation.json")
    if arguments.model is not None:
        _check_model(arguments.model, arguments.dataset)
    root = arguments.dataset or _simulated(arguments)
    takes = find_takes(root, static_ids=arguments.static_ids, dynamic_ids=arguments.dynamic_ids)
    lacking_data(takes)
    classifiers = _classifiers(arguments, takes)
    arguments.seeds = tuple(range(arguments.seed, arguments.seed + (FULL_SEEDS if arguments.full else 1)))
    settings = EvaluationSettings(arguments.seeds, degradation=_degradation(arguments, classifiers, takes))
    hearing = Hearer(arguments.out / "cache", arguments.model)
    found = evaluate(takes, hearing, classifiers, arguments.jobs, track, settings)
    report = _report(found)
    write_report(arguments.out / "evaluation.json", report)
    write_document(evaluation_document(found, _configuration(arguments)), arguments.out)
    shown = {"out": str(arguments.out), "data": takes.origin, "windows": classifiers.told}
    return CommandResult(report, table=shown, lines=_lines(found))


def _degradation(
    arguments: argparse.Namespace, classifiers: Classifiers, takes: TakeList
) -> DegradationSettings:
    """Return the sweep over camera states; in a smoke test with one detector on small images.

    It uses --model, else the shipped model, and for another array a model that is trained on the training
    windows.
    """
    detectors, model, seed = motion_detectors(), arguments.model, arguments.seed
    foreign = any(_is_foreign(take) for take in takes.static if take.filmed)
    if foreign and model is None and classifiers.windows is not None and not arguments.smoke:
        model = model_from_windows(classifiers.windows, arguments.out / "cache", seed)
    if arguments.smoke:
        return DegradationSettings(detectors[:1], model, width_px=SMOKE_WIDTH_PX, seed=seed)
    settings = DegradationSettings(detectors, model, seed=seed)
    return whole_sweep(takes, settings) if arguments.full else settings


def _is_foreign(take: Take) -> bool:
    """Return whether the shipped model does not apply to the sound of a recording."""
    try:
        return model_refusal(take, read_model(None)) is not None
    except InputFileError:
        # Unreadable recordings are listed when all recordings are processed.
        return False


def _configuration(arguments: argparse.Namespace) -> list[tuple[str, str]]:
    """Return the options that figures may depend on, given or by default."""
    given = {name: one for name, one in vars(arguments).items() if name not in _NO_FIGURE}
    return [
        (
            f"--{name.replace('_', '-')}",
            "none" if one is None else one.name if isinstance(one, Path) else str(one),
        )
        for name, one in given.items()
    ]


def _check_model(model: Path, dataset: Path | None) -> None:
    """Refuse a model for another array, whose rows would have no meaning."""
    domain = read_model(model).domain
    if domain is not None:
        # Streets are simulated with OVAD's array: a mismatch is found before a quarter of an hour of work.
        check_array(domain, ovad_array() if dataset is None else choose_array(dataset))


def _simulated(arguments: argparse.Namespace) -> Path:
    """Simulate the streets that are missing or have other settings."""
    root: Path = arguments.out / ("smoke" if arguments.smoke else "streets")
    static, dynamic, length_s = (SMOKE_STATIC, 0, SMOKE_S) if arguments.smoke else (STATIC, DYNAMIC, 10.0)
    # A moving ego has no video, because its camera moves, and every box with it.
    streets = DatasetSettings(static, seed=arguments.seed, duration_s=length_s, video=True)
    parts = [replace(streets, video_width_px=SMOKE_VIDEO_PX) if arguments.smoke else streets]
    if dynamic:
        parts.append(DatasetSettings(n_static=0, n_dynamic=dynamic, seed=arguments.seed + 1))
    with progress_bar("simulating streets", static + dynamic) as bar:
        for part in parts:
            write_dataset(root, part, jobs=arguments.jobs, progress=lambda row: bar.advance(), go_on=True)
    return root


def _classifiers(arguments: argparse.Namespace, takes: TakeList) -> Classifiers:
    folder = arguments.out / "cache"
    folder.mkdir(parents=True, exist_ok=True)
    if arguments.features is not None:
        return Classifiers(*windows.windows_from_table(arguments.features, takes))
    found = windows.windows_from_recordings(takes, folder)
    # Windows are simulated with OVAD's array; those of another array would be another feature.
    usual = microphone_order(ovad_array().positions_m, choose_array(takes.root)) is not None
    if found is None and takes.simulated and usual:
        count = SMOKE_WINDOWS if arguments.smoke else windows.PER_APPROACH
        sites = sorted({take.site for take in (*takes.static, *takes.dynamic)} & {*SITES, *MOVING_SITES})
        with progress_bar("simulating windows", 4 * count * len(sites)) as bar:
            options = {"per_approach": count, "jobs": arguments.jobs, "progress": bar.advance}
            found = windows.windows_from_simulation(folder, arguments.seed, sites=sites, **options)
    return Classifiers(*(found or (None, "the calibration recordings of each fold")))


def _report(found: Evaluation) -> dict[str, Any]:
    study = found.front_end
    report = {
        "data": found.takes.origin,
        "recordings": len(found.trials),
        "failed": {one.name: one.problem for one in found.failed},
        "stands_on": {name: run.stands_on for name, run in found.runs.items()},
        "refused": {name: refused for name, refused in found.refused.items() if refused},
        "lacking": found.lacking,
        "cautions": {name: run.cautions for name, run in found.runs.items()},
        "protocols": {
            name: {
                method: score.figures() | {"false_alarms_upper_90": score.poisson_upper()}
                for method, score in scores.items()
            }
            for name, scores in found.scores.items()
        },
        "equal_detection": found.equal,
        "degradation": None if found.degradation is None else degradation_record(found.degradation),
        "front_end": None if study is None else {**study.figures, "bearing_srp_by_junction": study.by_site},
    }
    return dict(json_values(report))


def _lines(found: Evaluation) -> list[str]:
    lines = [f"not processed: {one.name}: {one.problem}" for one in found.failed]
    lines += [f"not run: {name} {what}" for name, what in found.lacking.items()]
    for name, run in found.runs.items():
        lines += ["", *_warnings(found, name).lines(), *run.cautions]
        lines += [f"not scored: {method}: {why}" for method, why in found.refused.get(name, {}).items()]
        lines += equal_table(found, name).lines() if found.equal.get(name) else []
    tables = [] if found.degradation is None else sweep_tables(found.degradation)
    return [*lines, *(line for table in tables for line in ("", *table.lines()))]


def _warnings(found: Evaluation, protocol: str) -> Table:
    """Return the warning figures of every method, with the exact interval of its false alarms."""
    rows: list[tuple[Cell, ...]] = []
    for method, score in found.scores[protocol].items():
        figures = score.figures()
        cells = [Value(figures[name], digits=FIGURES[name].digits) for name in SHOWN]
        rate = Value(figures["false_alarms_per_hour"], *score.poisson(), digits=0)
        rows.append((method, *cells, rate, Value(score.poisson_upper(), digits=0)))
    run = found.runs[protocol]
    heads = ("method", *titles(SHOWN), "false alarms (1/h)", "at most (90 %)")
    return Table("warnings", f"{run.protocol.title}: {run.basis}", heads, rows)
