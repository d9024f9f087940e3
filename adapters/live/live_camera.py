"""A camera that runs: its images, and what a detector finds in them."""

import threading
import time
from collections.abc import Callable
from typing import Any

from worldstate.adapters.camera.camera_channel import ImageHealth
from worldstate.adapters.camera.detections import DetectionFrame, Detector
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.video import opencv
from worldstate.ground import InputFileError, InvalidArgumentError
from worldstate.ground.typing import ImageArray

from .live_sound import BoundedChannel

# Images that wait at most: a detector that is slower than the camera looks at the newest ones.
WAITING_IMAGES = 4

StampedImages = BoundedChannel[tuple[float, ImageArray]]


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

    def deliver(self, take: Callable[[int, DetectionFrame], None]) -> None:
        """Pass on, such as to `Listener.look`, what is found in the images that wait, each with its stamp."""
        for captured_s, image in self._images.take_all():
            self._check_size(image)
            stamp_ns = self._stamp_ns(captured_s)
            self._health.read(stamp_ns, image)
            take(stamp_ns, self._detector.detect(image))

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
