"""Stage the camera of every recording of a data set, and remember those done."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from worldstate.adapters.camera import PinholeCamera
from worldstate.adapters.listen import open_source
from worldstate.adapters.model_file import model_to_dict, read_model
from worldstate.adapters.ovad import OvadDataset, Recording
from worldstate.adapters.video import VIDEO_NAME, open_video
from worldstate.errors import InputFileError
from worldstate.evaluation.staged_degradation import CameraState, Staging, stage_recording
from worldstate.evaluation.staged_recording import StagedRecording, load_staged, save_staged

# What is kept of a recording depends on this code: a change of it is another number.
VERSION = 1


@dataclass(frozen=True, slots=True)
class StagedDataset:
    """What to stage, and how.

    Parameters
    ----------
    staging : Staging
        Who looks; its camera is resized to each video.
    detector : str
        Name of the detector, with its model.
    states : tuple of CameraState
        Of the camera.
    seed : int
        Draws the staged noise.
    model : Path, optional
        Model file; the one that ships where not given.
    """

    staging: Staging
    detector: str
    states: tuple[CameraState, ...]
    seed: int = 0
    model: Path | None = None

    def origin(self, recording: Recording) -> str:
        """Name everything that the result for a recording depends on, in a few characters."""
        files = [recording.audio_path, recording.path / VIDEO_NAME, recording.detections_path]
        made_of = {
            "version": VERSION,
            "recording": recording.recording_id,
            "files": [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in files if f is not None],
            "rates": self.staging.rates.to_dict(),
            "detector": self.detector,
            "states": [str(state) for state in self.states],
            "seed": self.seed,
            "model": model_to_dict(read_model(self.model)),
        }
        return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:32]


def filmed_recordings(root: Path, most: int | None = None) -> list[Recording]:
    """Return the recordings of a data set that have a video and detections.

    Parameters
    ----------
    root : Path
        Folder with ``DataLog.csv``.
    most : int, optional
        The first so many.

    Raises
    ------
    InputFileError
        If the log is missing or damaged, or no recording has both.
    """
    recordings = OvadDataset(root).recordings
    filmed = [r for r in recordings if (r.path / VIDEO_NAME).is_file() and r.detections_path]
    if not filmed:
        raise InputFileError(root, f"expected recordings with {VIDEO_NAME} and detections")
    return filmed[:most]


def stage_dataset(
    folder: Path,
    recordings: Sequence[Recording],
    settings: StagedDataset,
    on_frame: Callable[[float], None] = lambda frames: None,
) -> Iterator[StagedRecording]:
    """Yield the recordings in their order; those in `folder` are not staged again.

    Parameters
    ----------
    folder : Path
        Existing; one small file a recording.
    recordings : sequence of Recording
        With video and detections.
    settings : StagedDataset
        What to stage.
    on_frame : callable
        Called with the number of frames that were done.

    Raises
    ------
    InputFileError
        If a file is damaged.
    """
    for recording in recordings:
        path, origin = folder / f"{recording.recording_id}.npz", settings.origin(recording)
        kept = load_staged(path, origin)
        if kept is None:
            kept = _stage(recording, settings, lambda: on_frame(1))
            save_staged(path, kept, origin)
        else:
            on_frame(open_video(recording.path / VIDEO_NAME).count)
        yield kept


def _stage(recording: Recording, settings: StagedDataset, on_frame: Callable[[], None]) -> StagedRecording:
    video = open_video(recording.path / VIDEO_NAME)
    camera = PinholeCamera(width_px=video.width_px, height_px=video.height_px)
    # A generator of its own: no recording depends on which others were staged before.
    key = int.from_bytes(hashlib.sha256(recording.recording_id.encode()).digest()[:8], "big")
    return stage_recording(
        open_source(recording.path, model=settings.model),
        video,
        replace(settings.staging, camera=camera),
        settings.states,
        np.random.default_rng((settings.seed, key)),
        name=recording.recording_id,
        label=recording.label or "none",
        on_frame=on_frame,
    )
