"""`worldstate evaluate-degradation`: hazard awareness while the camera fails, beside vision alone.

Stage blur, darkness and sensor noise, four levels each, on the video of every recording of a data set, and
print for every state of the camera: hazard awareness, the share of hops after line-of-sight entry, vehicle in
view, in which it is detected or P(hidden) + P(visible) is above its threshold; vision alone, one minus the
share of misses: a detection of the vehicle and not of anything else; any detection at all; and false alarms
per hour of the hazard-free recordings, whose camera is degraded alike. Nobody is told the degradation: d is
read from the frames, and beta from the table that measure-absence wrote on other recordings.

Thresholds are gamma(alpha) on the hazard-free recordings of other folds. A last row, "off", has no camera.

DATASET is in the OVAD layout with video, as `worldstate simulate --video` writes it. What the camera saw of
each recording lies in OUT/staged and is not staged again: an interrupted run goes on where it stopped, and
another model costs a few seconds a recording. The model that ships has heard the real junctions only: at
simulated ones listen with a model that was trained on other simulated recordings, as below.

OUT/degradation.json is the report, OUT/degradation.png the figure.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.common.detector_options import (
    add_detector_options,
    detector_filter,
    detector_maker,
    detector_name,
)
from worldstate.cli.common.output import CommandResult, write_report
from worldstate.cli.common.outputs import output_folder
from worldstate.cli.common.progress import track

if TYPE_CHECKING:
    from worldstate.adapters.datasets.ovad import Recording
    from worldstate.studies.degradation.staged_dataset import StagedDataset
    from worldstate.studies.degradation.staged_degradation import StagedHops

EXAMPLE = """\
example:
  worldstate simulate --out others --static 40 --seed 1 --video --jobs 2
  worldstate measure-absence others --most 6 --detector motion --out beta.json
  worldstate extract-features others --out others.csv && worldstate train others.csv --out street.json
  worldstate simulate --out sim --static 48 --seed 2 --video --jobs 2
  worldstate evaluate-degradation sim --miss-rates beta.json --model street.json --jobs 2 --out sweep"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("dataset", type=Path, metavar="DATASET", help="recordings with video")
    of_others = "of the same detector, on other recordings"
    add("--miss-rates", type=Path, required=True, metavar="JSON", help=of_others)
    add_detector_options(parser)
    add("--model", type=Path, help="model file (default: the one that ships)")
    add("--alpha", type=float, default=0.02, help="false-positive budget (default: %(default)s)")
    add("--most", type=int, metavar="N", help="use the first N recordings")
    add("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    add("--seed", type=int, default=0, help="noise, folds, intervals (default: %(default)s)")
    add("--out", type=Path, default=Path("degradation"), metavar="DIR", help="(default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    import numpy as np

    from worldstate.adapters.files.model_file import load_model
    from worldstate.studies.degradation.degradation_report import (
        sweep_report,
        sweep_table,
        write_sweep_figure,
    )
    from worldstate.studies.degradation.degradation_sweep import SweepSettings, degradation_sweep
    from worldstate.studies.degradation.staged_dataset import filmed_recordings

    output_folder(arguments.out, "degradation.json", "degradation.png")
    settings = _settings(arguments)
    found = filmed_recordings(arguments.dataset, arguments.most)
    policy = load_model(arguments.model)[1].policies[0]
    judged_by = SweepSettings(policy.reference_prior, arguments.alpha, policy.sustain_hops)
    recordings = _stage(arguments.out / "staged", found, settings, arguments.jobs)
    rows = degradation_sweep(recordings, judged_by, np.random.default_rng(arguments.seed))
    report = _origin(arguments, recordings) | sweep_report(rows)
    write_report(arguments.out / "degradation.json", report)
    write_sweep_figure(rows, arguments.out / "degradation.png")
    shown = {key: value for key, value in report.items() if key != "states"}
    return CommandResult(report, table=shown, lines=[sweep_table(rows)])


def _settings(arguments: argparse.Namespace) -> "StagedDataset":
    from worldstate.adapters.camera.miss_rates import load_miss_rates
    from worldstate.adapters.camera.pinhole import PinholeCamera
    from worldstate.adapters.camera.vision_query import VisionSettings
    from worldstate.studies.degradation.degraded_detections import Staging, camera_states
    from worldstate.studies.degradation.staged_dataset import StagedDataset

    staging = Staging(
        detector_maker(arguments),
        load_miss_rates(arguments.miss_rates),
        PinholeCamera(),
        VisionSettings(keep=detector_filter(arguments)),
    )
    return StagedDataset(staging, detector_name(arguments), camera_states(), arguments.seed, arguments.model)


def _stage(
    folder: Path, found: "list[Recording]", settings: "StagedDataset", jobs: int
) -> "list[StagedHops]":
    from worldstate.studies.degradation.staged_dataset import stage_dataset

    folder.mkdir(parents=True, exist_ok=True)
    return list(track(stage_dataset(folder, found, settings, jobs), "staging the camera", len(found)))


def _origin(arguments: argparse.Namespace, recordings: "list[StagedHops]") -> dict[str, object]:
    from worldstate.operations.recordings.advisories import caution
    from worldstate.operations.recordings.hop_stream import HOP_S
    from worldstate.studies.degradation.degraded_detections import CLEAN

    clean = [one[CLEAN] for one in recordings]
    free = [one for one in clean if one.hazard_free]
    return {
        "out": str(arguments.out),
        "data": arguments.dataset.name,
        "detector": detector_name(arguments),
        "model": "default" if arguments.model is None else arguments.model.name,
        "caution": caution(len(recordings)),
        "approaches": len(recordings) - len(free),
        "hops_in_view": int(sum(one.after_sight().sum() for one in clean)),
        "hazard_free": len(free),
        "hazard_free_hours": sum(map(len, free)) * HOP_S / 3600.0,
        "alpha": arguments.alpha,
        "seed": arguments.seed,
    }
