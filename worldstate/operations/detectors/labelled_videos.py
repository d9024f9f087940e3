"""Videos with reference boxes, for the measurement of miss rates."""

from pathlib import Path

from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.datasets.ovad import OvadDataset, Recording
from worldstate.adapters.datasets.ovad_layout import LOG_NAME
from worldstate.ground.errors import InputFileError


def find_videos(path: Path, most: int | None = None) -> list[tuple[Path, Path | None]]:
    """Return videos with the files of their reference boxes, None for a video that stands alone."""
    # Of a data set the recordings with a vehicle count that have both.
    if path.is_file():
        return [(path, None)]
    if not path.is_dir():
        raise InputFileError(path, "expected a video, a recording folder or a data set")
    if not (path / LOG_NAME).is_file():
        return [_of_recording(Recording.open(path))]
    approaches = [r for r in OvadDataset(path).recordings if r.label != "none"]
    found = [_of_recording(r) for r in approaches if (r.path / VIDEO_NAME).is_file() and r.detections_path]
    if not found:
        raise InputFileError(path, f"expected recordings of a vehicle with {VIDEO_NAME} and detections")
    return found[:most]


def _of_recording(recording: Recording) -> tuple[Path, Path | None]:
    video = recording.path / VIDEO_NAME
    if not video.is_file():
        raise InputFileError(recording.path, f"expected a recording with {VIDEO_NAME}")
    return video, recording.detections_path
