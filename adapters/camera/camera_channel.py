"""A camera with a detector and measured miss rates, whose degradation is read from its own images."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import ImageArray
from worldstate.ground.values import nanoseconds

from .camera_health import CameraHealth, DegradationLog, HealthMonitor
from .detections import DetectionFilter, DetectionFrame, DetectionLog
from .detector import Detector
from .image_quality import image_quality
from .miss_rates import MissRates
from .video import Video

# Period of the degradation estimate: it costs as much as a detection, and dirt or dusk take longer.
HEALTH_PERIOD_NS = 400_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """Detections of a camera, with its degradation at the time."""

    detections: DetectionLog  # One entry a frame
    degradation: DegradationLog  # d as last read, on the scale of the measured table


class Watcher:
    """Run a detector on the images of one camera as they come, and estimate the camera's degradation.

    Parameters
    ----------
    detector : Detector
        A new one, if it has a state.
    rates : MissRates
        Measured for this detector and camera, with the scale of its health.

    Raises
    ------
    InvalidArgumentError
        If the rates hold no scale of health.

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

    def __init__(self, detector: Detector, rates: MissRates) -> None:
        self._detector, self._rates = detector, rates
        self._monitor = HealthMonitor(_scale(rates))
        self._stamps_ns: list[int] = []
        self._read_ns: list[int] = []
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
        if not self._read_ns or stamp_ns - self._read_ns[-1] >= HEALTH_PERIOD_NS:
            self._read_ns.append(stamp_ns)
            self._levels.append(self._rates.level(self._monitor.update(stamp_ns, image_quality(frame))))

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
        degradation = DegradationLog(np.array(self._read_ns, dtype=np.int64), np.array(self._levels))
        return Watched(DetectionLog(tuple(self._found), stamps_ns, "watched camera"), degradation)


def video_degradation(video: Video, rates: MissRates) -> DegradationLog:
    """Estimate d from every image of a video that starts with the recording."""
    monitor, stamps_ns, levels = HealthMonitor(_scale(rates)), [], []
    for number, frame in enumerate(video.frames()):
        stamps_ns.append(nanoseconds(number / video.frame_rate_hz))
        levels.append(rates.level(monitor.update(stamps_ns[-1], image_quality(frame))))
    return DegradationLog(np.array(stamps_ns, dtype=np.int64), np.array(levels))


def _scale(rates: MissRates) -> CameraHealth:
    if rates.health is None:
        raise InvalidArgumentError("rates: expected miss rates with the camera's scale of health")
    return rates.health


def any_motion(label: str = "car") -> DetectionFilter:
    """Return the filter that keeps all boxes of a motion detector, whose score is no confidence."""
    return DetectionFilter(frozenset({label}), 0.0, 0.0)
