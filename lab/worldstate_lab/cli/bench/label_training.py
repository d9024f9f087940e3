"""`worldstate-lab bench label-training`: a model trained on labelled streams beside one trained on the truth.

A recording is the second before one vehicle's T0 with one after it, or an empty second. Labels are those of
`worldstate street label`: boxes are drawn from the truth of the streams, with misses, joined and smoothed.
The true windows are cut by the same rule at the T0 of the simulation. Junctions are left out one by one; both
models are scored on the true windows of the junction that they did not learn. Intervals of 95 % by draws of
recordings. Beside it the error on recordings left out and the bounds of section VI, of either set of labels.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import cast

import numpy as np

from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.cli.common.output import CommandResult
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.operations.labelling.box_tracks import box_tracks
from worldstate.operations.labelling.label_files import window_rows
from worldstate.operations.labelling.pass_labels import PassLabel, label_passes
from worldstate.operations.metrics.roc import auroc
from worldstate.operations.training.window_calibration import ABSENT_MISS_RATE
from worldstate.smoothing.observations import FirstSight
from worldstate_lab.features.methods import method_of
from worldstate_lab.metrics.by_group import auroc_by_group
from worldstate_lab.metrics.intervals import middle, recording_draws
from worldstate_lab.paper.identifiability import reach_on_table
from worldstate_lab.passes.followed_stream import EVERYBODY
from worldstate_lab.passes.stream_camera import stream_detections

EXAMPLE = "example: worldstate-lab bench label-training streams/*-approaches-*.npz"


@dataclass(frozen=True)
class TruePass:
    """What `window_rows` reads of a pass."""

    arm: str
    t0: FirstSight


def windows_of_labels(stream: HeardStream, seed: int) -> FeatureTable:
    """Return the windows that `label --windows` lists of a stream before a camera."""
    camera, time_s = PinholeCamera(), stream.hops.time_s
    tracks = box_tracks(stream_detections(stream, np.random.default_rng(seed), camera), camera, EVERYBODY)
    seen = np.zeros(len(time_s), bool)
    for one in tracks:
        seen |= (time_s >= one.time_s[0] - 0.05) & (time_s <= one.time_s[-1] + 0.05)
    return _table(stream, label_passes(tracks, camera.position_m[0]), seen)


def windows_of_truth(stream: HeardStream) -> FeatureTable:
    """Return the windows that follow from the truth of a stream."""
    vehicles, rows, time_s = stream.vehicles, stream.rows, stream.hops.time_s
    came = vehicles.hazard & np.isfinite(vehicles.entry_s)
    passes = [
        TruePass(arm, FirstSight(entry_s, 0.0))
        for arm, entry_s in zip(vehicles.arm[came].tolist(), vehicles.entry_s[came].tolist(), strict=True)
    ]
    seen = np.isin(np.round(10.0 * time_s), np.round(10.0 * rows.time_s[rows.in_view]))
    return _table(stream, cast("list[PassLabel]", passes), seen)


def _table(stream: HeardStream, passes: Sequence[PassLabel], seen: BoolArray) -> FeatureTable:
    rows = window_rows(passes, seen, stream.hops.time_s, stream.site, str(stream.hops.about["seed"]))
    ids, labels, sites, recordings, _, ends, frames, _ = zip(*rows, strict=True)
    hops = np.abs(stream.hops.time_s[:, None] - np.array(ends)[None, :]).argmin(axis=0)
    known = tuple(frame if isinstance(frame, int) else None for frame in frames)
    features, about = stream.hops.feature[hops].astype(np.float64), (labels, ids, sites, recordings)
    kinds, names, places, keys = map(np.array, about)
    return FeatureTable(features, kinds, names, places, keys, known)


def held_out_scores(train: FeatureTable, exam: FeatureTable, method: str, seed: int) -> FloatArray:
    """Return the hazard statistic of every window, by a model that did not learn its junction."""
    chosen = method_of(method)
    learned, asked = chosen.prepare(train), chosen.prepare(exam)
    scores = np.empty(len(exam))
    for site in np.unique(exam.environments):
        rest, here = learned.select(learned.environments != site), asked.environments == site
        classifier = chosen.make(np.random.default_rng(seed))
        classifier.fit(rest.features, rest.labels, rest.environments)
        scores[here] = hazard_statistic(classifier.predict_proba(asked.features[here]), ABSENT_MISS_RATE)
    return scores


def compared(exam: FeatureTable, labels: FloatArray, truth: FloatArray, seed: int) -> dict[str, object]:
    """Return the areas of both models, their difference on the same draws, and the worst junction."""
    scored, sites = exam.hazards | exam.hazard_free, exam.environments
    draws = [rows[scored[rows]] for rows in recording_draws(exam, np.random.default_rng(seed))]
    apart = [_area(exam, labels, rows) - _area(exam, truth, rows) for rows in draws]
    whole = [_area(exam, one, np.flatnonzero(scored)) for one in (labels, truth)]
    by_site = [auroc_by_group(one[scored], exam.hazards[scored], sites[scored]) for one in (labels, truth)]
    worst = min(by_site[1], key=lambda site: by_site[0][site] - by_site[1][site])
    return {
        "auroc_labels": whole[0],
        "auroc_truth": whole[1],
        "difference": [whole[0] - whole[1], *middle(np.array(apart))],
        "worst_junction": [worst, by_site[0][worst], by_site[1][worst]],
    }


def _area(exam: FeatureTable, score: FloatArray, rows: IndexArray) -> float:
    area = auroc(score[rows], exam.hazards[rows])
    return np.nan if area is None else area


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("streams", type=Path, nargs="+", metavar="NPZ", help="of two junctions or more")
    parser.add_argument("--seed", type=int, default=0, help="of misses, folds, draws (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the benchmark; return what it found."""
    streams, seed = [HeardStream.load(path) for path in arguments.streams], arguments.seed
    tables = {
        "labels": reduce(FeatureTable.joined, [windows_of_labels(one, seed) for one in streams]),
        "truth": reduce(FeatureTable.joined, map(windows_of_truth, streams)),
    }
    told: dict[str, object] = {}
    for name, table in tables.items():
        told[f"{name}: recordings"] = len(np.unique(table.recording_keys))
        told[f"{name}: with a vehicle"] = int(table.hazards.sum())
    for method in ("worldstate", "baseline"):
        scores = {name: held_out_scores(one, tables["truth"], method, seed) for name, one in tables.items()}
        for key, value in compared(tables["truth"], **scores, seed=seed).items():
            told[f"{method}: {key}"] = value
        for name, table in tables.items():
            reach = reach_on_table(table, method, np.random.default_rng(seed))
            told[f"{method}, {name}: error, bounds"] = [reach.error, reach.fano, reach.sharp_fano]
    return CommandResult(told)
