"""Videos, read with OpenCV (extra `vision`): their frames, detections in them, degradation of the camera."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.ground.errors import InputFileError
from worldstate.ground.extras import optional
from worldstate.ground.typing import ImageArray
from worldstate.ground.values import nanoseconds

from .camera_health import DegradationLog, HealthMonitor, image_quality
from .detections import MAX_FRAMES, DetectionFrame, DetectionLog, Detector
from .miss_rates import MissRates

# OVAD's file name of the video beside a recording's audio.
VIDEO_NAME = "ueye_stereo_vid.mp4"
# Limits the memory of one decoded image to 200 MB.
MAX_SIDE_PX = 8192
# Period of the degradation estimate, which costs as much as a detection; soiling and dusk are slower.
HEALTH_PERIOD_NS = 400_000_000


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


class ImageHealth:
    """Degradation d of a camera, estimated from its images once per period; 0 without a health scale."""

    def __init__(self, rates: MissRates | None, period_ns: int = HEALTH_PERIOD_NS) -> None:
        self._rates, self._period_ns = rates, period_ns
        self._monitor = None if rates is None or rates.health is None else HealthMonitor(rates.health)
        self._read_ns: int | None = None
        self.level = 0.0

    def read(self, stamp_ns: int, frame: ImageArray) -> float:
        """Process the next image; return the latest d."""
        due = self._read_ns is None or stamp_ns - self._read_ns >= self._period_ns
        if due and self._monitor is not None and self._rates is not None:
            self._read_ns = stamp_ns
            self.level = self._rates.level(self._monitor.update(stamp_ns, image_quality(frame)))
        return self.level


def seen_in(
    video: Video, detector: Detector, rates: MissRates | None, start_ns: int = 0
) -> tuple[DetectionLog, DegradationLog]:
    """Return a detector's detections in a video and the latest d per image; each image is decoded once.

    The rates must have been measured with this detector and camera. Without a health scale d is 0.
    """
    health, found = ImageHealth(rates), list[DetectionFrame]()

    def look(stamp_ns: int, image: ImageArray) -> float:
        found.append(detector.detect(image))
        return health.read(stamp_ns, image)

    degradation = _levels(video, look, start_ns)
    return DetectionLog(tuple(found), degradation.stamps_ns, str(video.path)), degradation


def video_degradation(video: Video, rates: MissRates, start_ns: int = 0) -> DegradationLog:
    """Estimate d from every image of a video that starts with the recording."""
    return _levels(video, ImageHealth(rates, period_ns=0).read, start_ns)


def _levels(video: Video, read: Callable[[int, ImageArray], float], start_ns: int) -> DegradationLog:
    stamps_ns, levels = list[int](), list[float]()
    for number, image in enumerate(video.frames()):
        stamps_ns.append(start_ns + nanoseconds(number / video.frame_rate_hz))
        levels.append(read(stamps_ns[-1], image))
    return DegradationLog(np.array(stamps_ns, dtype=np.int64), np.array(levels))
