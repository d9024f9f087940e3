"""A signature model trained on labelled streams beside one trained on the truth, scored on the same windows.

Run: python -m worldstate_lab.benchmarks.label_training streams/*-approaches-*.npz [--json]

A recording is the second before one vehicle's T0 with one after it, or an empty second. Labels are those of
`worldstate street label`: boxes are drawn from the truth of the streams, with misses, joined and smoothed.
The true windows are cut by the same rule at the T0 of the simulation. Junctions are left out one by one; both
models are scored on the true windows of the junction that they did not learn. Intervals of 95 % by draws of
recordings. Beside it the error on recordings left out and the bounds of section VI, of either set of labels.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np

from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.operations.labelling.box_tracks import box_tracks
from worldstate.operations.labelling.label_files import window_rows
from worldstate.operations.labelling.pass_labels import label_passes
from worldstate.operations.metrics.roc import auroc, auroc_by_group
from worldstate.operations.training.window_calibration import ABSENT_MISS_RATE
from worldstate.smoothing.smoothed_track import FirstSight
from worldstate_lab.features.methods import method_of
from worldstate_lab.metrics.intervals import middle, recording_draws
from worldstate_lab.paper.identifiability import reach_on_table
from worldstate_lab.passes.stream_camera import stream_detections
from worldstate_lab.passes.world_exam import EVERYBODY


@dataclass(frozen=True)
class TruePass:
    arm: str
    t0: FirstSight


def labelled_windows(stream: HeardStream, seed: int) -> FeatureTable:
    """Windows that `label --windows` lists of a stream before a camera."""
    camera, time_s = PinholeCamera(), stream.hops.time_s
    tracks = box_tracks(stream_detections(stream, np.random.default_rng(seed), camera), camera, EVERYBODY)
    seen = np.zeros(len(time_s), bool)
    for one in tracks:
        seen |= (time_s >= one.time_s[0] - 0.05) & (time_s <= one.time_s[-1] + 0.05)
    return _table(
        stream, window_rows(label_passes(tracks, camera.position_m[0]), seen, time_s, *_names(stream))
    )


def true_windows(stream: HeardStream) -> FeatureTable:
    """Windows that whoever knows all of a stream would list."""
    vehicles, rows, time_s = stream.vehicles, stream.rows, stream.hops.time_s
    came = vehicles.hazard & np.isfinite(vehicles.entry_s)
    passes = [
        TruePass(arm, FirstSight(entry_s, 0.0))
        for arm, entry_s in zip(vehicles.arm[came].tolist(), vehicles.entry_s[came].tolist(), strict=True)
    ]
    seen = np.isin(np.round(10.0 * time_s), np.round(10.0 * rows.time_s[rows.in_view]))
    return _table(stream, window_rows(passes, seen, time_s, *_names(stream)))


def _names(stream: HeardStream) -> tuple[str, str]:
    return stream.site, str(stream.hops.about["seed"])


def _table(stream: HeardStream, rows: Sequence[tuple[object, ...]]) -> FeatureTable:
    ids, labels, sites, recordings, _, ends, frames, _ = zip(*rows, strict=True)
    hops = np.abs(stream.hops.time_s[:, None] - np.array(ends)[None, :]).argmin(axis=0)
    known = tuple(frame if isinstance(frame, int) else None for frame in frames)
    features = stream.hops.feature[hops].astype(np.float64)
    return FeatureTable(features, *map(np.array, (labels, ids, sites, recordings)), known)


def scores_of(train: FeatureTable, exam: FeatureTable, method: str, seed: int) -> np.ndarray:
    """Hazard statistic of every window, by a model that did not learn its junction."""
    chosen = method_of(method)
    learned, asked = chosen.prepare(train), chosen.prepare(exam)
    scores = np.empty(len(exam))
    for site in np.unique(exam.environments):
        rest, here = learned.select(learned.environments != site), asked.environments == site
        classifier = chosen.make(np.random.default_rng(seed))
        classifier.fit(rest.features, rest.labels, rest.environments)
        scores[here] = hazard_statistic(classifier.predict_proba(asked.features[here]), ABSENT_MISS_RATE)
    return scores


def compared(exam: FeatureTable, labels: np.ndarray, truth: np.ndarray, seed: int) -> dict[str, object]:
    """AUROC of both models, their difference on the same draws of recordings, and the worst junction."""
    scored, sites = exam.hazards | exam.hazard_free, exam.environments
    apart = []
    for rows in recording_draws(exam, np.random.default_rng(seed)):
        kept = rows[scored[rows]]
        apart.append(auroc(labels[kept], exam.hazards[kept]) - auroc(truth[kept], exam.hazards[kept]))
    whole = [auroc(one[scored], exam.hazards[scored]) for one in (labels, truth)]
    by_site = [auroc_by_group(one[scored], exam.hazards[scored], sites[scored]) for one in (labels, truth)]
    worst = min(by_site[1], key=lambda site: by_site[0][site] - by_site[1][site])
    return {
        "auroc_labels": whole[0],
        "auroc_truth": whole[1],
        "difference": [whole[0] - whole[1], *middle(np.array(apart))],
        "worst_junction": [worst, by_site[0][worst], by_site[1][worst]],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("streams", type=Path, nargs="+", metavar="NPZ", help="of two junctions or more")
    parser.add_argument("--seed", type=int, default=0, help="draws misses, folds and recordings")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    streams = [HeardStream.load(path) for path in options.streams]
    tables = {
        "labels": reduce(FeatureTable.joined, [labelled_windows(one, options.seed) for one in streams]),
        "truth": reduce(FeatureTable.joined, map(true_windows, streams)),
    }
    told: dict[str, object] = {}
    for name, table in tables.items():
        told[f"{name}: recordings"] = len(np.unique(table.recording_keys))
        told[f"{name}: with a vehicle"] = int(table.hazards.sum())
    for method in ("worldstate", "baseline"):
        scores = {name: scores_of(one, tables["truth"], method, options.seed) for name, one in tables.items()}
        for key, value in compared(tables["truth"], **scores, seed=options.seed).items():
            told[f"{method}: {key}"] = value
        for name, table in tables.items():
            reach = reach_on_table(table, method, np.random.default_rng(options.seed))
            told[f"{method}, {name}: error, bounds"] = [reach.error, reach.fano, reach.sharp_fano]
    lines = (f"{key:40s} {_rounded(value)}" for key, value in told.items())
    print(json.dumps(told, indent=2) if options.json else "\n".join(lines))


def _rounded(value: object) -> object:
    if isinstance(value, list):
        return ", ".join(str(_rounded(one)) for one in value)
    return round(value, 4) if isinstance(value, float) else value


if __name__ == "__main__":
    main()
