"""Files of labels: trajectories in the layout of ASAM OpenLABEL, and windows for `--labels`."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.adapters.datasets.feature_extraction import FRONT, window_ends_s
from worldstate.adapters.datasets.ovad import AUDIO_NAME, ENVIRONMENT, FRAME_RATE_HZ
from worldstate.adapters.ros.bag_input import STORAGE_SUFFIXES
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.version import __version__
from worldstate.operations.corpus.corpus_inputs import LOG_SUFFIX
from worldstate.operations.corpus.corpus_tables import (
    SINCE_1970_S,
    HeardApproach,
    HeardRecording,
    corpus_rows,
)
from worldstate.smoothing.observations import FirstSight

from .pass_labels import PassLabel

# Columns of windows for `model features --labels` and `model fit --labels`.
COLUMNS = ("ID", "Class", "Environment", "Recording ID", "File", "End", "T0", "T0 std")
# Largest standard deviation of T0 for a window: a window that is off by half a second contains sound of the
# next class.
SUREST_STD_S = 0.3
# Standard deviation of T0 from a hand-over. In the demo the hand-over is 0.16 s late: one image and one hop.
HANDED_OVER_STD_S = 0.2
_NO_FILES = {LOG_SUFFIX, *STORAGE_SUFFIXES}  # Logs have no sound, and `model features` cannot read bags
_LOOKED = 0.9  # Smallest share of hops with a look of a camera; with less, no window is known to be empty
# The rules of streams: a window is empty if no vehicle comes within `CALM_S` after it, and none is in view
# from `GONE_S` before it on.
CALM_S, GONE_S, NONE_EVERY_S, TOGETHER_S = 5.0, 2.0, 10.0, 2.5


def open_label(recording: str, passes: Sequence[PassLabel]) -> dict[str, Any]:
    """Return the passes as an OpenLABEL document: objects with T0, and a frame every 0.1 s."""
    objects, frames = {}, dict[str, dict[str, Any]]()
    smoother = next((one.track.smoother for one in passes), "fixed-lag smoother")
    for number, one in enumerate(passes):
        objects[str(number)] = {
            "name": f"{one.arm}-{number}",
            "type": one.label,
            "coordinate_system": "base_link",
            "object_data": {
                "num": [_named("t0_s", one.t0.time_s), _named("t0_std_s", one.t0.std_s)],
                "text": [{"name": "arm", "val": one.arm}],
            },
        }
        track = one.track
        for time_s, state, spread in zip(track.time_s, track.states, track.covariance, strict=True):
            empty = {"frame_properties": {"timestamp": round(float(time_s), 3)}, "objects": {}}
            frame = frames.setdefault(str(round(time_s * FRAME_RATE_HZ)), empty)
            placed = _placed(state, spread, bool(time_s >= one.t0.time_s))
            frame["objects"][str(number)] = {"object_data": placed}
    return {
        "openlabel": {
            "metadata": {
                "schema_version": "1.0.0",
                "annotator": f"worldstate {__version__}, {smoother}",
                "tagged_file": recording,
            },
            "coordinate_systems": {"base_link": {"type": "local_cs", "parent": ""}},
            "objects": objects,
            "frames": {key: frames[key] for key in sorted(frames, key=int)},
        }
    }


class SeenPass(NamedTuple):
    """A vehicle that came into view from an arm."""

    arm: str
    t0: FirstSight


def corpus_windows(corpus: Path) -> Iterator[tuple[object, ...]]:
    """Yield windows from the vehicles that cameras saw in a corpus; recordings without looks are skipped."""
    seen = defaultdict[str, list[HeardApproach]](list)
    for row in corpus_rows(corpus, HeardApproach):
        seen[row.recording] += [row] if row.seen else []
    for one in corpus_rows(corpus, HeardRecording):
        no_file = Path(one.recording).suffix in _NO_FILES or (one.start_s or 0.0) >= SINCE_1970_S
        if no_file or not one.hops or one.looked < _LOOKED * one.hops:
            continue
        time_s = np.arange(10, round(10.0 * (one.end_s or 0.0)) + 1) / 10.0
        in_view, passes = np.zeros(len(time_s), np.bool_), list[SeenPass]()
        for row in seen[one.recording]:
            first_s, last_s = row.seen_s or 0.0, row.gone_s or 0.0
            in_view |= (time_s >= first_s - 0.05) & (time_s <= last_s + 0.05)
            if row.side in SIDES:
                passes.append(SeenPass(row.side, FirstSight(first_s, HANDED_OVER_STD_S)))
        file = one.recording if Path(one.recording).suffix else f"{one.recording}/{AUDIO_NAME}"
        site = one.site if ENVIRONMENT.fullmatch(one.site) else f"S{one.site}"
        yield from pass_windows(passes, in_view, time_s, site, file)


def pass_windows(
    passes: Sequence[SeenPass | PassLabel],
    in_view: BoolArray,
    time_s: FloatArray,
    environment: str,
    file: str,
) -> list[tuple[object, ...]]:
    """Return the windows of one recording: per pass one at T0 and one in view, and windows without vehicles.

    Shapes: in_view (n,), one value per time, time_s (n,).
    """
    rows: list[tuple[object, ...]] = []

    def add(label: str, number: str, unit: str, end_s: float, *entry: object) -> None:
        """Add a window; for one without a vehicle the number is a time."""
        recording = f"{file}:{number}{unit}"
        rows.append((f"{number}{label}", label, environment, recording, file, round(end_s, 2), *entry))

    sure = [one for one in passes if one.t0.std_s <= SUREST_STD_S]
    # Each pass is a recording of its own, because data sets are split by recording.
    for number, one in enumerate(sure):
        near = [abs(one.t0.time_s - two.t0.time_s) for two in passes if two is not one]
        if min(near, default=np.inf) < TOGETHER_S:
            continue
        for label, end_s in window_ends_s(one.arm, one.t0.time_s, moving_ego=False).items():
            if label == FRONT and not in_view[np.abs(time_s - end_s) < 0.5].any():
                continue
            frame, std_s = round(one.t0.time_s * FRAME_RATE_HZ), round(one.t0.std_s, 3)
            add(label, str(number), "", end_s, frame, std_s)
    entries = np.array([one.t0.time_s for one in passes])
    last = -np.inf
    for end_s in time_s.tolist():
        coming = ((entries >= end_s - 1.0) & (entries <= end_s + CALM_S)).any()
        # The sound of a vehicle may precede its detection, even without a pass.
        busy = in_view[(time_s > end_s - 1.0 - GONE_S) & (time_s <= end_s + CALM_S)].any()
        if end_s - last >= NONE_EVERY_S and end_s <= time_s[-1] - CALM_S and not (coming or busy):
            add("none", f"{end_s:.0f}", "s", end_s, "", "")
            last = end_s
    return rows


def file_below(sound: Path, labels: Path) -> str:
    """Return the path of a recording relative to the folder of its list of labels.

    Raises
    ------
    InputFileError
        If the recording is not in this folder or below.
    """
    try:
        return sound.resolve().relative_to(labels.resolve().parent).as_posix()
    except ValueError as error:
        problem = f"expected it in the folder of {sound.name} or above, from where its path is relative"
        raise InputFileError(labels, problem) from error


def _placed(state: FloatArray, spread: FloatArray, in_sight: bool) -> dict[str, Any]:
    return {
        "vec": [
            {"name": "position_m", "val": state[:2].round(3).tolist()},
            {"name": "velocity_mps", "val": state[2:].round(3).tolist()},
            {"name": "covariance", "val": spread.round(5).ravel().tolist()},
        ],
        "boolean": [{"name": "in_line_of_sight", "val": in_sight}],
    }


def _named(name: str, value: float) -> dict[str, Any]:
    return {"name": name, "val": round(value, 4)}
