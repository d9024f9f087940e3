"""A camera with a detector and a measured miss rate, whose health is read from its own frames."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldstate.adapters.camera import PinholeCamera
from worldstate.adapters.camera_health import DegradationLog, HealthMonitor, degradation_log
from worldstate.adapters.detections import DetectionFilter, DetectionFrame, DetectionLog
from worldstate.adapters.detector import Detector
from worldstate.adapters.image_quality import image_quality
from worldstate.adapters.miss_rates import MissRates
from worldstate.adapters.sector import Sector
from worldstate.adapters.video import Video
from worldstate.adapters.vision import VisionQuery, VisionSettings
from worldstate.errors import InvalidArgumentError
from worldstate.values import nanoseconds

Frame = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """What a camera reported, and how far it could be trusted while it did.

    Parameters
    ----------
    detections : DetectionLog
        One entry a frame.
    degradation : DegradationLog
        d of every frame, on the scale of the measured table.
    rates : MissRates
        Miss and clutter rates of the same detector behind the same camera.
    """

    detections: DetectionLog
    degradation: Callable[[int], float]
    rates: MissRates

    def query(
        self,
        camera: PinholeCamera,
        settings: VisionSettings | None = None,
        line_of_sight: Sector | None = None,
    ) -> VisionQuery:
        """Return the channel to be asked: beta and clutter follow d, which nobody had to tell.

        Parameters
        ----------
        camera : PinholeCamera
            That took the frames.
        settings, line_of_sight
            As for `VisionQuery`.

        Raises
        ------
        InputFileError
            If a box lies outside the image.
        """
        return VisionQuery(
            camera,
            self.detections,
            self.rates.table,
            self.degradation,
            settings,
            line_of_sight,
            self.rates.clutter_rate,
        )


def watch(frames: Iterable[tuple[int, Frame]], detector: Detector, rates: MissRates) -> Watched:
    """Run a detector over stamped frames and read the camera's health from the same frames.

    Parameters
    ----------
    frames : iterable of (int, ndarray of uint8)
        Stamp on the stream's clock, nanoseconds, and image, in the order of time.
    detector : Detector
        A fresh one, where it keeps a state.
    rates : MissRates
        Of this detector and camera, with the scale of its health.

    Raises
    ------
    InvalidArgumentError
        If there is no frame, or the rates hold no scale of health.
    """
    if rates.health is None:
        raise InvalidArgumentError("rates: expected miss rates with the camera's scale of health")
    monitor = HealthMonitor(rates.health)
    stamps: list[int] = []
    levels: list[float] = []
    found: list[DetectionFrame] = []
    for stamp_ns, frame in frames:
        stamps.append(stamp_ns)
        found.append(detector.detect(frame))
        levels.append(rates.level(monitor.update(stamp_ns, image_quality(frame))))
    stamps_ns = np.array(stamps, dtype=np.int64)
    log = DetectionLog(tuple(found), stamps_ns, "watched camera")
    return Watched(log, DegradationLog(stamps_ns, np.array(levels)), rates)


def video_degradation(video: Video, rates: MissRates) -> DegradationLog:
    """Read d from every frame of a video that starts with the recording.

    Raises
    ------
    InputFileError
        If no frame can be decoded.
    InvalidArgumentError
        If the rates hold no scale of health.
    """
    if rates.health is None:
        raise InvalidArgumentError("rates: expected miss rates with the camera's scale of health")
    stamped = ((nanoseconds(i / video.frame_rate_hz), frame) for i, frame in enumerate(video.frames()))
    return degradation_log(stamped, rates.health, rates.level)


def any_motion(label: str = "car") -> DetectionFilter:
    """Return the filter that lets all of a motion detector's boxes through: their score is no confidence.

    Examples
    --------
    >>> any_motion().min_score
    0.0
    """
    return DetectionFilter(frozenset({label}), 0.0, 0.0)
