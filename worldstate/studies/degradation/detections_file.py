"""What a camera saw in every staged state, as a file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.camera.camera_channel import Watched
from worldstate.adapters.camera.camera_health import DegradationLog
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.files.npz_file import load_npz, save_npz
from worldstate.ground.errors import InvalidArgumentError

MAX_BYTES = 64 << 20
MAX_FRAMES = 500_000


def save_staged_detections(path: str | Path, staged: Mapping[str, Watched], origin: str) -> None:
    """Write detections as npz without objects, whole or not at all."""
    frames = [frame for one in staged.values() for frame in one.detections.frames]
    logs = [one.degradation for one in staged.values()]
    values = {
        "states": np.array(list(staged)),
        "stamps_ns": np.stack([one.detections.stamps_ns for one in staged.values()]),
        "counts": np.array([len(frame) for frame in frames], dtype=np.int64),
        "boxes_px": np.concatenate([frame.boxes_px for frame in frames]).reshape(-1, 4),
        "scores": np.concatenate([frame.scores for frame in frames]),
        "labels": np.array([label for frame in frames for label in frame.labels], dtype=np.str_),
        "read_ns": np.stack([log.stamps_ns for log in logs]),
        "degradation": np.stack([log.degradation for log in logs]),
    }
    save_npz(path, {"origin": np.array(origin), **values})


def load_staged_detections(path: str | Path, origin: str) -> dict[str, Watched] | None:
    """Return what `save_staged_detections` wrote; None where nothing of this origin stands there."""
    if not Path(path).is_file():
        return None
    return load_npz(path, "staged detections", MAX_BYTES, lambda values: _read(values, origin))


def _read(values: dict[str, np.ndarray], origin: str) -> dict[str, Watched] | None:
    if str(values["origin"]) != origin:
        return None
    states, stamps_ns = values["states"].tolist(), values["stamps_ns"]
    frames = _frames(values)
    if len(frames) != stamps_ns.size:
        raise InvalidArgumentError(f"counts: expected one a frame, got {len(frames)} for {stamps_ns.size}")
    n = stamps_ns.shape[1]
    return {
        state: Watched(
            DetectionLog(tuple(frames[i * n : (i + 1) * n]), stamps_ns[i], "watched camera"),
            DegradationLog(values["read_ns"][i], values["degradation"][i]),
        )
        for i, state in enumerate(states)
    }


def _frames(values: dict[str, Any]) -> list[DetectionFrame]:
    counts = values["counts"]
    if counts.size > MAX_FRAMES:
        raise InvalidArgumentError(f"counts: expected at most {MAX_FRAMES} frames, got {counts.size}")
    if (counts < 0).any() or not counts.sum() == len(values["boxes_px"]) == len(values["scores"]):
        raise InvalidArgumentError("counts: expected those of the boxes")
    edges = np.cumsum(counts)[:-1]
    parts = zip(*(np.split(values[name], edges) for name in ("boxes_px", "scores", "labels")), strict=True)
    return [DetectionFrame(boxes, scores, tuple(labels.tolist())) for boxes, scores, labels in parts]
