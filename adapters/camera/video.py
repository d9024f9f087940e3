"""Frames of a video file, read with OpenCV (extra `vision`)."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from worldstate.ground.errors import InputFileError
from worldstate.ground.extras import optional
from worldstate.ground.typing import ImageArray

from .detections import MAX_FRAMES

# OVAD's file name of the video beside a recording's audio.
VIDEO_NAME = "ueye_stereo_vid.mp4"
# Limits the memory of one decoded image to 200 MB.
MAX_SIDE_PX = 8192


@dataclass(frozen=True, slots=True)
class Video:
    """A video file that was readable when opened."""

    path: Path  # The file
    width_px: int  # Size of a frame
    height_px: int
    frame_rate_hz: float  # From the header of the file
    count: int  # From the header, which may be wrong; `frames` yields what can be decoded

    def frames(self) -> Iterator[ImageArray]:
        """Yield all frames, blue first, as uint8 of shape (height, width, 3)."""
        capture = _open(self.path)
        number = 0
        try:
            while True:
                found, frame = capture.read()
                if not found:
                    break
                number += 1
                if number > MAX_FRAMES:
                    raise InputFileError(self.path, f"expected a video of at most {MAX_FRAMES} frames")
                yield frame
        finally:
            capture.release()
        if not number:
            raise InputFileError(self.path, "expected a video, but no frame can be decoded")


def open_video(path: str | Path) -> Video:
    """Open a video file.

    Parameters
    ----------
    path : str or Path
        Any container format that OpenCV reads.

    Raises
    ------
    InputFileError
        If the file is missing or not a video, or its frames are larger than 8192 px.
    MissingExtraError
        If OpenCV is not installed.

    Examples
    --------
    >>> try:
    ...     open_video("missing.mp4")
    ... except InputFileError as error:
    ...     print(error.path)
    missing.mp4
    """
    name = Path(path)
    capture = _open(name)
    try:
        cv2 = optional("cv2")
        width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        rate, count = (float(capture.get(p)) for p in (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT))
    finally:
        capture.release()
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise InputFileError(name, f"expected frames of at most {MAX_SIDE_PX} px, got {width} x {height}")
    if not 0.0 < rate <= 1000.0:
        raise InputFileError(name, f"expected a frame rate up to 1000 Hz, got {rate}")
    return Video(name, width, height, rate, max(int(count), 0))


def _open(path: Path) -> Any:
    if not path.is_file():
        raise InputFileError(path, "expected a video file, but it does not exist")
    capture = optional("cv2").VideoCapture(str(path))
    if not capture.isOpened():
        capture.release()
        raise InputFileError(path, "expected a video file, but it cannot be opened")
    return capture
