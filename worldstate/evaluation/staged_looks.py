"""What a camera saw of one recording in every staged state: the part that costs, and knows no sound."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.atomic import atomic_path
from worldstate.adapters.camera import PinholeCamera
from worldstate.adapters.camera_health import DegradationLog
from worldstate.adapters.degradation import LEVELS, Family, degrade
from worldstate.adapters.detections import DetectionFrame, DetectionLog
from worldstate.adapters.detector import Detector
from worldstate.adapters.miss_rates import MissRates
from worldstate.adapters.video import Video
from worldstate.adapters.vision import VisionSettings
from worldstate.adapters.watched_camera import Watched, Watcher
from worldstate.errors import InputFileError, InvalidArgumentError
from worldstate.values import nanoseconds

MAX_BYTES = 64 << 20
# States that every sweep has: the camera as it is, and no camera at all.
CLEAN, OFF = "clean", "off"


@dataclass(frozen=True, slots=True)
class CameraState:
    """One staged state of the camera.

    Parameters
    ----------
    family : {"blur", "darkness", "noise", "all"}
        What is staged.
    degradation : float
        d in [0, 1]; 0 is the clean camera, whatever the family.

    Examples
    --------
    >>> str(CameraState("blur", 0.5)), str(CameraState("all", 0.0))
    ('blur 0.5', 'clean')
    """

    family: Family
    degradation: float

    def __str__(self) -> str:
        return f"{self.family} {self.degradation:g}" if self.degradation else CLEAN


def camera_states(families: Sequence[Family] = ("blur", "darkness", "noise")) -> tuple[CameraState, ...]:
    """Return the clean camera and every level of every family.

    Examples
    --------
    >>> len(camera_states()), [str(state) for state in camera_states(("noise",))][:3]
    (13, ['clean', 'noise 0.25', 'noise 0.5'])
    """
    staged = (CameraState(family, d) for family in families for d in LEVELS if d > 0.0)
    return CameraState("all", 0.0), *staged


@dataclass(frozen=True, slots=True)
class Staging:
    """Who looks at the staged frames.

    Parameters
    ----------
    make_detector : callable
        Makes a detector for each state.
    rates : MissRates
        Measured with the same detector, on other recordings.
    camera : PinholeCamera
        That took the video.
    settings : VisionSettings
        How it is asked.
    """

    make_detector: Callable[[], Detector]
    rates: MissRates
    camera: PinholeCamera
    settings: VisionSettings


@dataclass(frozen=True, slots=True, eq=False)
class StagedLooks:
    """The detections and the health of one camera, state by state.

    Parameters
    ----------
    states : tuple of str
        Names.
    watched : tuple of Watched
        One a state, of the same frames.

    Raises
    ------
    InvalidArgumentError
        If there is none, or not one a state.
    """

    states: tuple[str, ...]
    watched: tuple[Watched, ...]

    def __post_init__(self) -> None:
        if not self.states or len(self.states) != len(self.watched):
            got = f"{len(self.watched)} for {len(self.states)} states"
            raise InvalidArgumentError(f"watched: expected one a state and at least one, got {got}")


def stage_looks(
    video: Video,
    staging: Staging,
    states: Sequence[CameraState],
    rng: np.random.Generator,
    on_frame: Callable[[], None] = lambda: None,
) -> StagedLooks:
    """Decode once, degrade and look in every state.

    The degradation is staged on the frames and nobody is told: the detector sees degraded frames, and d is
    estimated from them.

    Parameters
    ----------
    video : Video
        Clean frames, the first one at the start of the sound.
    staging : Staging
        Who looks.
    states : sequence of CameraState
        At least one.
    rng : numpy.random.Generator
        Draws the staged noise.
    on_frame : callable
        Called after each frame, all states of it done.

    Raises
    ------
    InputFileError
        If the video is damaged.
    InvalidArgumentError
        If the miss rates hold no scale of health, or there is no state.
    """
    watchers = [Watcher(staging.make_detector(), staging.rates) for _ in states]
    for number, frame in enumerate(video.frames()):
        stamp_ns = nanoseconds(number / video.frame_rate_hz)
        for watcher, state in zip(watchers, states, strict=True):
            watcher.look(stamp_ns, degrade(frame, state.family, state.degradation, rng))
        on_frame()
    return StagedLooks(tuple(map(str, states)), tuple(watcher.watched() for watcher in watchers))


def save_looks(path: str | Path, looks: StagedLooks, origin: str) -> None:
    """Write looks as npz without objects, whole or not at all.

    Parameters
    ----------
    path : str or Path
        In an existing folder.
    looks : StagedLooks
        What to keep; the miss rates are not kept.
    origin : str
        What they were made by; `load_looks` takes them back for the same origin only.

    Raises
    ------
    InputFileError
        If the folder is missing.
    """
    frames = [frame for one in looks.watched for frame in one.detections.frames]
    logs = [one.degradation for one in looks.watched]
    values = {
        "states": np.array(looks.states),
        "stamps_ns": np.stack([one.detections.stamps_ns for one in looks.watched]),
        "counts": np.array([len(frame) for frame in frames], dtype=np.int64),
        "boxes_px": np.concatenate([frame.boxes_px for frame in frames]).reshape(-1, 4),
        "scores": np.concatenate([frame.scores for frame in frames]),
        "labels": np.array([label for frame in frames for label in frame.labels], dtype=np.str_),
        "read_ns": np.stack([log.stamps_ns for log in logs]),
        "degradation": np.stack([log.degradation for log in logs]),
    }
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, origin=np.array(origin), **values)  # type: ignore[arg-type]


def load_looks(path: str | Path, origin: str, rates: MissRates) -> StagedLooks | None:
    """Return what `save_looks` wrote; None where nothing of this origin stands there.

    Parameters
    ----------
    path : str or Path
        The file.
    origin : str
        As for `save_looks`.
    rates : MissRates
        That d was read on the scale of.

    Raises
    ------
    InputFileError
        If the file is too large or damaged.
    """
    source = Path(path)
    if not source.is_file():
        return None
    if source.stat().st_size > MAX_BYTES:
        raise InputFileError(path, f"expected staged looks of at most {MAX_BYTES >> 20} MiB")
    try:
        with np.load(source, allow_pickle=False) as file:
            values = {name: file[name] for name in file.files}
        return _read(values, rates) if str(values["origin"]) == origin else None
    except (OSError, InvalidArgumentError) as error:
        raise InputFileError(path, f"expected staged looks ({error})") from error
    except Exception as error:  # zipfile, zlib and numpy each have errors of their own for damaged bytes
        raise InputFileError(path, f"expected staged looks, they do not read: {error}") from error


def _read(values: dict[str, np.ndarray], rates: MissRates) -> StagedLooks:
    states, stamps_ns = tuple(values["states"].tolist()), values["stamps_ns"]
    frames = _frames(values)
    if len(frames) != stamps_ns.size:
        raise InvalidArgumentError(f"counts: expected one a frame, got {len(frames)} for {stamps_ns.size}")
    n = stamps_ns.shape[1]
    watched = [
        Watched(
            DetectionLog(tuple(frames[i * n : (i + 1) * n]), stamps_ns[i], "watched camera"),
            DegradationLog(values["read_ns"][i], values["degradation"][i]),
            rates,
        )
        for i in range(len(states))
    ]
    return StagedLooks(states, tuple(watched))


def _frames(values: dict[str, Any]) -> list[DetectionFrame]:
    counts = values["counts"]
    if (counts < 0).any() or not counts.sum() == len(values["boxes_px"]) == len(values["scores"]):
        raise InvalidArgumentError("counts: expected those of the boxes")
    edges = np.cumsum(counts)[:-1]
    parts = zip(*(np.split(values[name], edges) for name in ("boxes_px", "scores", "labels")), strict=True)
    return [DetectionFrame(boxes, scores, tuple(labels.tolist())) for boxes, scores, labels in parts]
