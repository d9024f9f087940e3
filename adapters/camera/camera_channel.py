"""A camera with a detector and measured miss rates, whose degradation is read from its own images."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import ImageArray
from worldstate.ground.values import nanoseconds

from .camera_health import DegradationLog, HealthMonitor, image_quality
from .detections import DetectionFilter, DetectionFrame, DetectionLog, Detector
from .miss_rates import MissRates
from .video import Video

# Period of the degradation estimate: it costs as much as a detection, and dirt or dusk take longer.
HEALTH_PERIOD_NS = 400_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """Detections of a camera, with its degradation at the time."""

    detections: DetectionLog  # One entry a frame
    degradation: DegradationLog  # d as last read, on the scale of the measured table


class ImageHealth:
    """Degradation d of a camera, read from its images once a period; 0 without a scale of its health."""

    def __init__(self, rates: MissRates | None, period_ns: int = HEALTH_PERIOD_NS) -> None:
        self._rates, self._period_ns = rates, period_ns
        self._monitor = None if rates is None or rates.health is None else HealthMonitor(rates.health)
        self._read_ns: int | None = None
        self.level = 0.0

    def read(self, stamp_ns: int, frame: ImageArray) -> float:
        """Take the next image; return d as last read."""
        due = self._read_ns is None or stamp_ns - self._read_ns >= self._period_ns
        if due and self._monitor is not None and self._rates is not None:
            self._read_ns = stamp_ns
            self.level = self._rates.level(self._monitor.update(stamp_ns, image_quality(frame)))
        return self.level


class Watcher:
    """Run a detector on the images of one camera as they come, and estimate the camera's degradation.

    Parameters
    ----------
    detector : Detector
        A new one, if it has a state.
    rates : MissRates or None
        Measured for this detector and camera. Without the scale of its health d is 0.
    source : str
        Where the images come from, for messages.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.adapters.camera.camera_health import CameraHealth
    >>> from worldstate.adapters.camera.detections import DetectionFrame
    >>> from worldstate.adapters.camera.miss_rates import FamilyCounts
    >>> class Blind:
    ...     def detect(self, frame): return DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    >>> clean = CameraHealth(100.0, (5.0, 2.6, 1.6, 1.2, 1.0), (2.0, 10.0, 25.0, 50.0, 90.0))
    >>> counts = FamilyCounts(((10,) * 5,), ((0, 1, 2, 5, 10),), (99,) * 5, (0,) * 5)
    >>> rates = MissRates((0.0, 30.0), {"noise": counts}, health=clean)
    >>> watcher = Watcher(Blind(), rates)
    >>> watcher.look(100_000_000, np.full((48, 64, 3), 100, np.uint8)) is None
    True
    """

    def __init__(self, detector: Detector, rates: MissRates | None, source: str = "watched camera") -> None:
        self._detector, self._health, self._source = detector, ImageHealth(rates), source
        self._stamps_ns: list[int] = []
        self._levels: list[float] = []
        self._found: list[DetectionFrame] = []

    def look(self, stamp_ns: int, frame: ImageArray) -> None:
        """Take the next image.

        Parameters
        ----------
        stamp_ns : int
            Capture time, nanoseconds, increasing.
        frame : ndarray of uint8, shape (height, width, 3)
            Blue first.
        """
        self._stamps_ns.append(stamp_ns)
        self._found.append(self._detector.detect(frame))
        self._levels.append(self._health.read(stamp_ns, frame))

    def watched(self) -> Watched:
        """Return the detections and degradation so far.

        Returns
        -------
        Watched
            From the first image to the last.

        Raises
        ------
        InvalidArgumentError
            If there was no image.
        """
        stamps_ns = np.array(self._stamps_ns, dtype=np.int64)
        degradation = DegradationLog(stamps_ns, np.array(self._levels))
        return Watched(DetectionLog(tuple(self._found), stamps_ns, self._source), degradation)


def video_degradation(video: Video, rates: MissRates) -> DegradationLog:
    """Estimate d from every image of a video that starts with the recording."""
    health, stamps_ns, levels = ImageHealth(rates, period_ns=0), [], []
    for number, frame in enumerate(video.frames()):
        stamps_ns.append(nanoseconds(number / video.frame_rate_hz))
        levels.append(health.read(stamps_ns[-1], frame))
    return DegradationLog(np.array(stamps_ns, dtype=np.int64), np.array(levels))


def any_motion() -> DetectionFilter:
    """Return the filter that keeps all boxes of a motion detector, whose score is no confidence."""
    return DetectionFilter(frozenset({"car"}), 0.0, 0.0)
