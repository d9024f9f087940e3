"""Stage the camera of every recording of a data set, keep its detections, and run the filter."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.camera_channel import Watched
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME, Video, open_video
from worldstate.adapters.datasets.ovad import OvadDataset, Recording
from worldstate.adapters.listen import open_source
from worldstate.ground.errors import InputFileError
from worldstate.ground.parallel import in_processes
from worldstate.studies.origin import origin_of

from .degraded_detections import CameraState, Staging, detect_in_states
from .detections_file import load_staged_detections, save_staged_detections
from .staged_degradation import StagedHops, filter_in_states

# What is detected depends on this code: a change of it is another number.
VERSION = 2


@dataclass(frozen=True, slots=True)
class StagedDataset:
    """What to stage, and how."""

    staging: Staging  # What detects; its camera is resized to each video
    detector: str  # Name of the detector, with its model
    states: tuple[CameraState, ...]  # Of the camera
    seed: int = 0  # Draws the staged noise
    model: Path | None = None  # Model file; the one that ships where not given

    def origin(self, recording: Recording) -> str:
        """Name everything that the detections of a recording depend on, in a few characters."""
        video = (recording.path / VIDEO_NAME).stat()
        made_of = {
            "version": VERSION,
            "recording": recording.recording_id,
            "video": (video.st_size, video.st_mtime_ns),
            "rates": self.staging.rates.to_dict(),
            "detector": self.detector,
            "states": [str(state) for state in self.states],
            "seed": self.seed,
        }
        return origin_of(made_of)


def filmed_recordings(root: Path, most: int | None = None) -> list[Recording]:
    """Return the recordings of a data set that have a video and detections."""
    recordings = OvadDataset(root).recordings
    filmed = [r for r in recordings if (r.path / VIDEO_NAME).is_file() and r.detections_path]
    if not filmed:
        raise InputFileError(root, f"expected recordings with {VIDEO_NAME} and detections")
    return filmed[:most]


def stage_dataset(
    folder: Path, recordings: Sequence[Recording], settings: StagedDataset, jobs: int = 1
) -> Iterator[StagedHops]:
    """Yield the recordings in their order; what the camera saw lies in `folder` and is not staged again."""
    yield from in_processes(partial(_stage, folder, settings), recordings, jobs)


def _stage(folder: Path, settings: StagedDataset, recording: Recording) -> StagedHops:
    video = open_video(recording.path / VIDEO_NAME)
    camera = PinholeCamera(width_px=video.width_px, height_px=video.height_px)
    staging = replace(settings.staging, camera=camera)
    detections = _detections(folder, settings, recording, video)
    source = open_source(recording.path, model=settings.model)
    label = recording.label or "none"
    return filter_in_states(source, detections, staging, name=recording.recording_id, label=label)


def _detections(
    folder: Path, settings: StagedDataset, recording: Recording, video: Video
) -> dict[str, Watched]:
    path, origin = folder / f"{recording.recording_id}.npz", settings.origin(recording)
    kept = load_staged_detections(path, origin)
    if kept is None:
        # A generator of its own: no recording depends on which others were staged before.
        key = int.from_bytes(hashlib.sha256(recording.recording_id.encode()).digest()[:8], "big")
        rng = np.random.default_rng((settings.seed, key))
        kept = detect_in_states(video, settings.staging, settings.states, rng)
        save_staged_detections(path, kept, origin)
    return kept
