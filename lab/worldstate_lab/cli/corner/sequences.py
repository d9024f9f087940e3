"""`worldstate-lab sequences`: performance of the product on real recordings of a corner.

FOLDER has `truth.csv`, `srp.npz`, `sound/`, `boxes/` and, for the second path, `pair/`. Every recording runs
through the product's own chain, with the camera and by sound alone: on the path *seven* from the spectra of
seven microphones and one channel of sound, with the shipped model; on the path *pair* from two channels, with
a model made for them, whose simulated exam is printed with the figures. A row of the spectra covers the
second that begins with it: without correction, a hop of *seven* uses sound up to 0.9 s after it. The path
*seven_on_time* computes half seconds from the rows and uses each when it has ended.

The output has for each path: the hazard AUROC at times before T0; the announced approaches and the cost of
the alarm beside the rows of Table I (thresholds from five folds over recordings); the best thresholds at
given numbers of false onsets (chosen afterwards); calibration; and the same for parts of the product. Boxes
have a score of at least 0.3 and a height of at least 60 pixels; vehicles parked throughout a recording are
excluded.

The published classifier is trained on --features without the windows of all recordings in --lists.

Examples
--------
  worldstate-lab sequences ovad-sequences --path seven --jobs 2
  worldstate-lab sequences ovad-sequences --features extracted_features.csv --lists static.csv dynamic.csv
  worldstate-lab sequences ovad-sequences --path pair --boxes none --start 1 --json
"""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args

import numpy as np

from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate_lab.report.table import json_values
from worldstate_lab.sequences.hearing import PAIR, SPECTRA, Chain, PathName, corner_chain
from worldstate_lab.sequences.path_figures import (
    SEEDS,
    PathRun,
    classifiers_of,
    front_end_figures,
    heard_every_way,
    path_figures,
    score_figures,
    simulated_exam,
)
from worldstate_lab.sequences.path_tables import FOLLOWED, path_lines, scores_table
from worldstate_lab.sequences.recordings import CornerRecording, read_recordings
from worldstate_lab.sequences.summed_scores import LevelReading, summed_scores
from worldstate_lab.sequences.tracking import tracking_figures
from worldstate_lab.trials.pass_cache import Failed, attempted

EXAM = "exam.json"
_LONGEST_CUT_S = 2.0  # T0 is 7 s in most recordings and 2 s in one: the rest must contain a hop before it


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="recordings of street corners")
    add("--path", choices=get_args(PathName), help="source of the sound (default: all with a model)")
    add("--boxes", default="boxes", metavar="NAME", help="folder of boxes; none: no camera (%(default)s)")
    add("--model", type=Path, metavar="FILE", help="of --path (default: the shipped one or pair/model.json)")
    add("--exam", type=Path, metavar="FILE", help="simulated exam of the pair's model (default: beside it)")
    add("--features", type=Path, metavar="CSV", help="training windows of the published classifier")
    add("--lists", type=Path, nargs="+", default=[], metavar="CSV", help="recordings left out of training")
    add("--streams", type=Path, nargs="+", default=[], metavar="NPZ", help="of the pair, for the summed rows")
    add("--start", type=float, default=0.0, metavar="S", help="cut off at the start (default: %(default)s)")
    add("--seed", type=int, default=1, help="seed of folds and intervals (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    _check(arguments)
    boxes = None if arguments.boxes == "none" else arguments.boxes
    arguments.seeds = range(arguments.seed, arguments.seed + SEEDS)
    start_s = round(in_range("--start", arguments.start, 0.0, _LONGEST_CUT_S), 1)
    recordings = [one.cut(start_s) for one in read_recordings(arguments.folder)]
    _check_kinds(recordings, "found one kind")
    paths = (arguments.path,) if arguments.path is not None else SPECTRA
    if arguments.path is None and (arguments.folder / PAIR / "model.json").exists():
        paths = get_args(PathName)
    chains = [corner_chain(path, arguments.folder, arguments.model, boxes) for path in paths]
    report: dict[str, Any] = {"start_s": start_s, "boxes": arguments.boxes}
    lines, heard = list[str](), dict[PathName, PathRun]()
    for chain in chains:
        heard[chain.path], failed = _heard(chain, recordings, arguments.jobs)
        report[chain.path] = _figures(arguments, chain, heard[chain.path]) | {"failed": failed}
        lines += [*path_lines(chain.path, report[chain.path]), ""]
    if arguments.streams:
        report["sums"] = _sums(arguments, heard, chains[0])
        for path, sums in report["sums"].items():
            lines += scores_table(sums, f"{path}: sums that are not shipped, sound alone").lines()
    return CommandResult(json_values(report), table={}, lines=lines)


def _check(arguments: argparse.Namespace) -> None:
    if bool(arguments.features) != bool(arguments.lists):
        raise InvalidArgumentError("--features: expected together with --lists, to exclude test recordings")
    if arguments.model is not None and arguments.path is None:
        raise InvalidArgumentError("--model: expected --path, for which it was made")
    if arguments.streams and arguments.path is not None:
        raise InvalidArgumentError("--streams: expected no --path, because sums use all of them")


def _check_kinds(recordings: Sequence[CornerRecording], found: str) -> None:
    if len({one.hazard_free for one in recordings}) < 2:
        raise InvalidArgumentError(f"recordings: expected approaches and hazard-free ones; {found}")


def _heard(chain: Chain, recordings: Sequence[CornerRecording], jobs: int) -> tuple[PathRun, dict[str, str]]:
    work = attempted(partial(heard_every_way, chain), recordings, jobs, attrgetter("name"))
    done = list(track(work, f"listening, {chain.path}", len(recordings)))
    heard = [(one, *two) for one, two in zip(recordings, done, strict=True) if not isinstance(two, Failed)]
    failed = {one.name: one.problem for one in done if isinstance(one, Failed)}
    _check_kinds([one for one, *_ in heard], next(iter(failed.values()), ""))
    return PathRun(*zip(*heard, strict=True)), failed


def _figures(arguments: argparse.Namespace, chain: Chain, heard: PathRun) -> dict[str, Any]:
    published = chain.path in SPECTRA and arguments.features
    classifiers = classifiers_of(arguments.features, arguments.lists) if published else None
    found = path_figures(heard, classifiers, arguments.seed)
    exam = arguments.exam or arguments.folder / PAIR / EXAM
    if chain.path == "pair" and exam.exists():
        found["exam"] = simulated_exam(exam)
    # Measurements of other modules on the same recordings are merged here.
    rng = np.random.default_rng(arguments.seed)
    followed = [one for one in heard.followed if one is not None]
    found |= tracking_figures(followed, rng) if followed else dict.fromkeys(FOLLOWED)
    return found | {"front_end": front_end_figures(heard.seen, heard.recordings, rng)}


def _sums(arguments: argparse.Namespace, heard: Mapping[PathName, PathRun], seven: Chain) -> dict[str, Any]:
    """Return by path the performance of sums of parts on recordings of all paths."""
    levels = LevelReading.learned([HeardStream.load(one) for one in arguments.streams], seven.model)
    found = dict[str, Any]()
    for path in SPECTRA:
        trials, rng = heard[path].alone, np.random.default_rng(arguments.seed)
        sums = summed_scores(trials, heard["pair"].alone, levels, seven.model)
        found[path] = {name: score_figures(trials, scores, None, rng) for name, scores in sums.items()}
    return found
