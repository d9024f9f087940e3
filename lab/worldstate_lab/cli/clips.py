"""`worldstate-lab clips`: verdicts of the guard and the kinds of a model on single clips of real sound.

TABLE.csv has the columns file, kind, recording and road_user. Files have one channel or more (the first is
used) at any rate of 8 kHz and above; clips of one recording belong together; road_user is the true class
(car, van, truck, tram, motorcycle, bicycle) or empty. A clip shorter than the memory of the features is
extended by its mirror image. With --numbers the features are read from an archive (`character`, `clip`: the
row of the table).

The output has, by kind, the shares of hops that are familiar, foreign or a warning signal, the mean
probability of each class of road users, and the largest change of any of these if the recorder's response
rises or falls by 6 dB over the band. For clips with a road_user it has the log-loss of the model, corrected
to the shares of the classes in the table, and the log-loss of these shares alone. Every recording has the
same weight.

Examples
--------
  worldstate-lab clips clips.csv --numbers numbers.npz
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.abduction.road_users import DomainGuard, Familiar, Foreign, RoadUserModel
from worldstate.adapters.files.file_io import load_npz, read_rows
from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.commissioning.recorded_clips import heard_clip
from worldstate.commissioning.road_user_training import tilted
from worldstate.frontend.spectra.sound_character import BANDS, MEASURES
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray, IndexArray, TextArray
from worldstate_lab.report.table import Table, cell_text

MOST_BYTES = 1 << 30
NUMBERS = len(MEASURES) + len(BANDS)
SAID, TILT_DB = 0.9, 6.0


@dataclass(frozen=True, slots=True, eq=False)
class ClipNumbers:
    """Hops of all clips."""

    measures: FloatArray  # shape (n, 49): From `SoundCharacter`
    clip: IndexArray  # shape (n,): Row of the table
    kinds: TextArray  # shape (clips,), like the others
    recordings: TextArray
    road_users: TextArray  # Empty for clips without a road user

    def by_recording(self, values: FloatArray, hops: BoolArray) -> FloatArray:
        """Return the mean over recordings of the means over their hops, shape of `values[0]`."""
        names = self.recordings[self.clip]
        means = [values[hops & (names == name)].mean(axis=0) for name in np.unique(names[hops])]
        return np.asarray(np.mean(means, axis=0))


def read_clips(
    table: Path, numbers: Path | None, advance: Callable[[], object] = lambda: None
) -> ClipNumbers:
    """Read a table of clips and compute their features, or read the features."""
    needed = ("kind", "recording") if numbers is not None else ("file", "kind", "recording")
    rows = [row for _, row in read_rows(table, needed, optional=("road_user",))]
    said = {
        name: np.array([row.get(name, "") for row in rows]) for name in ("kind", "recording", "road_user")
    }
    if numbers is not None:
        measures, clip = _archived(numbers, len(rows))
    else:
        heard = []
        for row in rows:
            heard.append(heard_clip(table.parent / row["file"]))
            advance()
        measures, clip = np.concatenate(heard), np.repeat(np.arange(len(rows)), list(map(len, heard)))
    return ClipNumbers(measures, clip, said["kind"], said["recording"], said["road_user"])


def _archived(path: Path, clips: int) -> tuple[FloatArray, IndexArray]:
    def read(arrays: dict[str, AnyArray]) -> tuple[FloatArray, IndexArray]:
        measures, clip = (np.asarray(arrays[name]) for name in ("character", "clip"))
        if measures.shape != (len(clip), NUMBERS) or not 0 <= clip.min() <= clip.max() < clips:
            raise InvalidArgumentError(
                f"expected {NUMBERS} numbers per hop of the clips in the table, got {measures.shape}"
            )
        return measures.astype(np.float64), clip.astype(np.intp)

    return load_npz(path, "numbers of clips", MOST_BYTES, read)


def judged(clips: ClipNumbers, guard: DomainGuard, model: RoadUserModel) -> dict[str, Any]:
    """Return the verdicts of guard and kinds on the clips."""
    verdicts = [guard.judge(one) for one in clips.measures[:, : len(MEASURES)]]
    familiar, foreign = (
        np.array([isinstance(one, kind) for one in verdicts], float) for kind in (Familiar, Foreign)
    )
    shares = np.column_stack([familiar, foreign, 1.0 - familiar - foreign])
    said, kinds = model.probabilities(clips.measures), {}
    moved = [model.probabilities(tilted(clips.measures, one)) for one in (-TILT_DB, TILT_DB)]
    for kind in dict.fromkeys(clips.kinds.tolist()):
        hops = (clips.kinds == kind)[clips.clip]
        told, users = (clips.by_recording(values, hops).tolist() for values in (shares, said))
        kinds[kind] = {
            "recordings": len(np.unique(clips.recordings[clips.kinds == kind])),
            **dict(zip(("familiar", "foreign", "signal"), told, strict=True)),
            "road_users": dict(zip(model.classes, users, strict=True)),
            "moved_by_tilt": max(np.abs(clips.by_recording(one - said, hops)).max() for one in moved),
        }
    return {"kinds": kinds, **_calibration(clips, model)}


def _calibration(clips: ClipNumbers, model: RoadUserModel) -> dict[str, Any]:
    known = clips.road_users != ""
    if not known.any():
        return {"kinds_log_loss": None, "kinds_log_loss_prior": None, "said_90": None}
    strange = set(clips.road_users[known].tolist()) - set(model.classes)
    if strange:
        raise InvalidArgumentError(
            f"road_user: expected one of {', '.join(model.classes)}, got {min(strange)!r}"
        )
    recordings = dict(zip(clips.recordings[known].tolist(), clips.road_users[known].tolist(), strict=True))
    counts = np.array([sum(user == name for user in recordings.values()) for name in model.classes])
    prior = counts / counts.sum()
    hops = known[clips.clip]
    truth = np.array([model.classes.index(user) if user else 0 for user in clips.road_users.tolist()])
    truth = truth[clips.clip]
    said = model.with_shares(prior).probabilities(clips.measures)
    losses = -np.log(np.maximum(said[np.arange(len(truth)), truth], np.finfo(float).tiny))
    sure, right = said.max(axis=1) >= SAID, (said.argmax(axis=1) == truth).astype(float)
    named = hops & sure
    return {
        "kinds_log_loss": float(clips.by_recording(losses, hops)),
        "kinds_log_loss_prior": float(-(prior * np.log(np.where(prior > 0.0, prior, 1.0))).sum()),
        "said_90": {
            "share": float(clips.by_recording(sure.astype(float), hops)),
            "right": float(clips.by_recording(right, named)) if named.any() else None,
        },
    }


def clip_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the report as text."""
    kinds, names = report["kinds"], ("recordings", "familiar", "foreign", "signal")
    rows = [
        (kind, *(one[name] for name in names), *one["road_users"].values(), one["moved_by_tilt"])
        for kind, one in kinds.items()
    ]
    heads = ("kind", *names, *next(iter(kinds.values()))["road_users"], "moved by a tilt")
    lines = Table(
        "clips", "Shares of the hops, and mean probabilities of the road users", heads, rows
    ).lines()
    if report["kinds_log_loss"] is None:
        return [*lines, "road users: the table contains none"]
    losses, said = [report["kinds_log_loss"], report["kinds_log_loss_prior"]], report["said_90"]
    told = "log-loss {:.3f}, by the table's shares {:.3f}".format(*losses)
    right = cell_text(said["right"])
    return [
        *lines,
        f"road users: {told}; probability {SAID} or more in {said['share']:.3f} of the hops, right {right}",
    ]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("table", type=Path, metavar="TABLE.csv", help="file, kind, recording, road_user")
    add("--numbers", type=Path, metavar="NPZ", help="stored numbers of the clips, instead of their files")
    add("--model", type=Path, metavar="FILE", help="(default: the shipped model)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    model = read_model(arguments.model)
    if model.guard is None or model.road_users is None:
        raise InvalidArgumentError("--model: expected a model with guard and road users, got one without")
    total = 0 if arguments.numbers else len(list(read_rows(arguments.table, ("kind",))))
    with progress_bar("hearing", total) as bar:
        clips = read_clips(arguments.table, arguments.numbers, bar.advance)
    report = judged(clips, model.guard, model.road_users)
    return CommandResult(report, table={}, lines=clip_lines(report))
