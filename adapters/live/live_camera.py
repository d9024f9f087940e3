"""A camera that runs: its images through a detector, its looks as the channel that is asked."""

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from worldstate.abduction.co_evidence import CoEvidence
from worldstate.adapters.camera.camera_channel import ImageHealth
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog, Detector
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.video import opencv
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.source import Source
from worldstate.ground import InputFileError, InvalidArgumentError, NotUsable
from worldstate.ground.typing import ImageArray
from worldstate.measurement.measurement import Bearing, Look, Side, Sighting

from .bounded_channel import BoundedChannel

# Looks that are remembered: whether a box stands still is asked over the last second, and a camera of more
# than 60 images a second brings nothing to a decision every 0.1 s.
REMEMBERED = 64

StampedFrames = Iterable[tuple[int, DetectionFrame]]
# Images that wait at most: a detector that is slower than the camera looks at the newest ones.
WAITING_IMAGES = 4

StampedImages = BoundedChannel[tuple[float, ImageArray]]


class LiveCamera:
    """Answers as `VisionQuery` does over a recording, from the last looks of a running detector.

    Parameters
    ----------
    source : Source
        Lens, miss rates, context and boxes that count.
    new_looks : callable
        Returns the looks since it was asked last: time of capture on the stream's clock, nanoseconds, and
        what was detected. A look that is no later than the one before is left out.
    degradation : callable
        Returns d of the camera at a stamp.
    """

    def __init__(
        self,
        source: Source,
        new_looks: Callable[[], StampedFrames],
        degradation: Callable[[int], float] = lambda stamp_ns: 0.0,
    ) -> None:
        self._source = replace(source, degradation=degradation)
        self._new_looks = new_looks
        self._looks: deque[tuple[int, DetectionFrame]] = deque(maxlen=REMEMBERED)
        self._channel = self._over_looks()

    def ask(
        self,
        stamp_ns: int,
        bearing: Bearing | NotUsable,
        expected_labels: Collection[str] | None = None,
        side: Side | None = None,
    ) -> CoEvidence:
        """Search a sector of the last image at or before the stamp."""
        return self._current().ask(stamp_ns, bearing, expected_labels, side)

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return the boxes that count in that image."""
        return self._current().sightings(stamp_ns)

    def last_look(self, stamp_ns: int) -> Look | None:
        """Return what the whole image says, None without one."""
        return self._current().last_look(stamp_ns)

    def _current(self) -> VisionQuery:
        news = False
        for stamp_ns, frame in self._new_looks():
            if not self._looks or stamp_ns > self._looks[-1][0]:
                self._looks.append((stamp_ns, frame))
                news = True
        if news:
            self._channel = self._over_looks()
        return self._channel

    def _over_looks(self) -> VisionQuery:
        stamps_ns = np.array([stamp_ns for stamp_ns, _ in self._looks], dtype=np.int64)
        log = DetectionLog(tuple(frame for _, frame in self._looks), stamps_ns, "the camera")
        on_sound_clock = log.shifted(self._source.camera.stamp_offset_s)
        return replace(self._source, detections=on_sound_clock).camera_channel()


def image_channel() -> StampedImages:
    """Return a channel of images, each with its time of capture on the clock of `time.monotonic`."""
    return BoundedChannel(WAITING_IMAGES)


class ImageLooks:
    """What a detector finds in the images of a channel.

    Parameters
    ----------
    images : StampedImages
        Filled by a `CameraFeed`, or by a callback of one's own.
    detector : Detector
        Looks at them in the order of time.
    stamp_ns : callable
        From the time of capture to the stream's clock: `LiveSound.stamp_ns`.
    size_px : (int, int)
        Width and height that the lens was given for.
    rates : MissRates, optional
        Where they hold the camera's scale of health, its degradation is read from the images.
    """

    def __init__(
        self,
        images: StampedImages,
        detector: Detector,
        stamp_ns: Callable[[float], int],
        size_px: tuple[int, int],
        rates: MissRates | None = None,
    ) -> None:
        self._images, self._detector, self._stamp_ns, self._size_px = images, detector, stamp_ns, size_px
        self._health = ImageHealth(rates)

    def __call__(self) -> Iterator[tuple[int, DetectionFrame]]:
        """Yield the looks at the images that wait."""
        for captured_s, image in self._images.take_all():
            self._check_size(image)
            stamp_ns = self._stamp_ns(captured_s)
            self._health.read(stamp_ns, image)
            yield stamp_ns, self._detector.detect(image)

    def degradation(self, stamp_ns: int) -> float:
        """Return d as last read, 0 where no scale of health is known."""
        return self._health.level

    def _check_size(self, image: ImageArray) -> None:
        got = image.shape[1], image.shape[0]
        if got != self._size_px:
            width, height = self._size_px
            problem = f"expected images of {width} x {height} px as its lens, got {got[0]} x {got[1]}"
            raise InvalidArgumentError(f"--camera: {problem}: give the lens of this camera")


class CameraFeed:
    """Read a camera of this machine into a channel until it is stopped.

    Parameters
    ----------
    device : int
        Number of the camera as OpenCV counts them.
    images : StampedImages
        Where the images go.

    Raises
    ------
    MissingExtraError
        If OpenCV is not installed.
    InputFileError
        If there is no such camera.
    """

    def __init__(self, device: int, images: StampedImages) -> None:
        self._capture: Any = opencv().VideoCapture(device)
        self._name, self._images = f"camera {device}", images
        if not self._capture.isOpened():
            self._capture.release()
            raise InputFileError(self._name, "expected a camera of this machine, it cannot be opened")
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> "CameraFeed":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()
        self._capture.release()

    def _read(self) -> None:
        while not self._stopped.is_set():
            found, image = self._capture.read()
            if not found:
                self._images.close(InputFileError(self._name, "expected images, the camera gives no more"))
                return
            self._images.put((time.monotonic(), image))
