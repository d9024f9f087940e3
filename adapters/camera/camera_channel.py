"""Detections of a video with measured miss rates, and the camera's degradation estimated from its images."""

from collections.abc import Callable

import numpy as np

from worldstate.ground.typing import ImageArray
from worldstate.ground.values import nanoseconds

from .camera_health import DegradationLog, HealthMonitor, image_quality
from .detections import DetectionFilter, DetectionFrame, DetectionLog, Detector
from .miss_rates import MissRates
from .video import Video

# Period of the degradation estimate, which costs as much as a detection; soiling and dusk are slower.
HEALTH_PERIOD_NS = 400_000_000


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


def any_motion() -> DetectionFilter:
    """Return a filter that keeps all boxes of a motion detector, because its score is no confidence."""
    return DetectionFilter(frozenset({"car"}), 0.0, 0.0)
