"""Sensors in addition to the microphones, each read in its own thread.

These are UDP datagrams of other programs (detections per image, odometry), each with its age, and a camera of
this computer with a detector.
"""

import hmac
import json
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from worldstate.adapters.camera.detections import DetectionFrame, Detector, frame_of
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.video import ImageHealth
from worldstate.adapters.files.odometry_file import OdometryRecord
from worldstate.adapters.own_parts import checked_frame
from worldstate.core.fixed_lag import LAG_NS
from worldstate.ground import InputFileError, InvalidArgumentError, WorldstateError, in_range
from worldstate.ground.checks import host_and_port
from worldstate.ground.errors import OwnPartError
from worldstate.ground.extras import optional
from worldstate.ground.serialisation import decode, decode_json
from worldstate.ground.threads import BoundedChannel, WorkThread
from worldstate.ground.typing import ImageArray

T = TypeVar("T")
Sender: TypeAlias = tuple[str, int]
# One second of images of a fast camera; if the process stalls, older ones are useless.
WAITING_DATAGRAMS = 64
# The largest UDP datagram over IP.
_LARGEST_BYTES = 1 << 16
# Longest delay before a reading thread notices that it was stopped.
_POLL_S = 0.2
# The filter uses no data older than its lag.
_OLDEST_S = 1e-9 * LAG_NS
# Allowed difference between the clocks of a sensor and of its sender; a capture slightly in the future is
# taken as now.
_AHEAD_S = 0.05
# A sender that is silent for this long is taken as stopped, and another one may replace it.
PINNED_S = 10.0


# Largest difference between the sending time in a datagram and this computer's clock. Clocks with NTP differ
# by milliseconds; a datagram that an attacker delays for longer is refused.
CLOCKS_APART_S = 0.5
# Receive buffer for datagrams that arrive while another thread computes; the kernel may grant less.
_KERNEL_BYTES = 1 << 22


@dataclass(frozen=True, slots=True)
class Trust:
    """The senders whose datagrams a port accepts; without addresses and key, only the first sender."""

    allow: tuple[str, ...] = ()
    key: bytes | None = field(default=None, repr=False)
    numbers: Mapping[str, int] = field(default_factory=dict)  # Last accepted number per port before this run


def signed(record: Mapping[str, object], key: bytes, port: str) -> bytes:
    r"""Return a signed datagram that a port with this key accepts once, if it is sent now.

    Parameters
    ----------
    record : mapping of str to object
        Values for JSON; ``"age_s"`` is the time from capture to this call.
    key : bytes
        The secret of ``--key``.
    port : str
        Its port: ``odometry``, ``detections``, or ``detections/NAME`` for cameras with names.

    Examples
    --------
    >>> text, code = signed({"speed_mps": 5.0}, b"sixteen bytes or more", "odometry").split(b"\n")
    >>> len(code), text[:18]
    (64, b'{"speed_mps": 5.0,')
    """
    now = {"port": port, "sent_s": time.time(), "number": time.time_ns()}
    text = json.dumps({**record, **now}).encode()
    return text + b"\n" + _code(key, text)


def _code(key: bytes, text: bytes) -> bytes:
    return hmac.new(key, text, "sha256").hexdigest().encode()


class DatagramSocket(WorkThread, Generic[T]):
    """Records that arrive as UDP datagrams of one JSON object, with ``"age_s"`` from capture to sending.

    If the object has a ``"number"``, numbers must increase. With a key, the HMAC-SHA256 of the object follows
    as a line of hexadecimal digits, and three values are required: the number against replay, ``"port"``
    against redirection to another port, and ``"sent_s"`` (Unix time) against delay. The reading thread checks
    all of this, so that refused datagrams displace no waiting ones.

    Parameters
    ----------
    address : str
        HOST:PORT on which datagrams are received.
    stamp_ns : callable
        Converts the time of capture to the stream's clock: `LiveSound.stamp_ns`.
    decode : callable
        Converts the object without its age to a record.
    name : str
        ``"port"`` of its datagrams: the option of the address, followed by a slash and the camera's name.
    trust : Trust, optional
        Whose datagrams are accepted.

    Attributes
    ----------
    refused : int
        Number of datagrams that were unreadable, late, repeated, or of an unknown sender.
    problem : str
        Cause of the last refusal.
    port : int
        Number of the port; if 0 was given, the free port that was chosen.

    Raises
    ------
    InvalidArgumentError
        If the address is invalid or in use.
    """

    def __init__(
        self,
        address: str,
        stamp_ns: Callable[[float], int],
        decode: Callable[[object], T],
        name: str,
        trust: Trust | None = None,
    ) -> None:
        self._socket, self._stamp_ns = _bound_socket(address, f"--{name.partition('/')[0]}"), stamp_ns
        self._decode, self._trust, self.name = decode, trust or Trust(), name
        self._records: BoundedChannel[tuple[float, T]] = BoundedChannel(WAITING_DATAGRAMS)
        self._pinned: tuple[float, Sender] | None = None
        # Number accepted last, by host; with a key there is only one.
        before = self._trust.numbers.get(name)
        self._last = {} if before is None else {"": before}
        super().__init__(self._socket.close)
        self.port, self.refused, self.problem = int(self._socket.getsockname()[1]), 0, ""
        self._counting, self._delivered = threading.Lock(), 0

    @property
    def dropped(self) -> int:
        """Number of datagrams that were not processed in time."""
        return self._records.dropped

    @property
    def numbers(self) -> dict[str, int]:
        """Last number accepted with a key, by the name of the port; empty before the first."""
        return {self.name: self._last[""]} if "" in self._last else {}

    def deliver(self, take: Callable[[int, T], None]) -> int:
        """Pass each waiting record to `take` with its time of capture on the stream's clock, nanoseconds.

        Return the number of records that were unreadable, or refused by `take`, since the last call.
        """
        for captured_s, told in self._records.take_all():
            try:
                take(self._stamp_ns(captured_s), told)
            except WorldstateError as error:
                self._refuse(error)
        before, self._delivered = self._delivered, self.refused
        return self._delivered - before

    def _refuse(self, error: WorldstateError) -> None:
        with self._counting:
            self.refused, self.problem = self.refused + 1, str(error)

    def _read_one(self, arrived_s: float, datagram: bytes, sender: Sender) -> tuple[float, T]:
        """Return the capture time and the record of a datagram."""
        pinned = self._check_sender(arrived_s, sender)
        try:
            record = decode_json(self._checked_text(datagram).decode(), "datagram")
        except UnicodeDecodeError as error:
            raise InvalidArgumentError("datagram: expected UTF-8") from error
        about = record if isinstance(record, dict) else {}
        age_s = in_range("age_s", decode(float, about.pop("age_s", 0.0), "age_s"), -_AHEAD_S, _OLDEST_S)
        source, number = sender[0], about.pop("number", None)
        if self._trust.key is not None:
            source = ""
            self._check_sent(about.pop("port", None), about.pop("sent_s", None))
        if number is not None or self._trust.key is not None:
            last = self._last.get(source, -1)
            number = decode(int, number, "number")
            if number <= last:
                raise InvalidArgumentError(f"number: expected more than the last one, {last}, got {number}")
        read = arrived_s - max(age_s, 0.0), self._decode(record)
        if number is not None:
            self._last[source] = number
        self._pinned = pinned
        return read

    def _check_sender(self, arrived_s: float, sender: Sender) -> tuple[float, Sender] | None:
        """Return the sender accepted from now on; refuse any other."""
        if self._trust.allow:
            if sender[0] not in self._trust.allow:
                allowed = ", ".join(self._trust.allow)
                raise InvalidArgumentError(f"sender: expected one of {allowed}, got {sender[0]}")
            return None
        if self._trust.key is not None:
            return None
        if self._pinned is not None and self._pinned[1] != sender:
            heard_s, (host, port) = self._pinned
            if arrived_s - heard_s <= PINNED_S:
                problem = f"expected {host}:{port}, the first one, got {sender[0]}:{sender[1]}"
                raise InvalidArgumentError(f"sender: {problem}")
            self._last.clear()
        return arrived_s, sender

    def _checked_text(self, datagram: bytes) -> bytes:
        """Return the object of a datagram; with a key, its code is verified."""
        if self._trust.key is None:
            return datagram
        text, _, code = datagram.rpartition(b"\n")
        if not hmac.compare_digest(_code(self._trust.key, text), code):
            raise InvalidArgumentError("datagram: expected a line with the HMAC-SHA256 of the key")
        return text

    def _check_sent(self, port: object, sent_s: object) -> None:
        """Refuse a datagram that was signed for another port or not sent just now."""
        if port != self.name:
            raise InvalidArgumentError(f"port: expected {self.name!r}, got {port!r:.60}")
        late_s = time.time() - decode(float, sent_s, "sent_s")
        if abs(late_s) > CLOCKS_APART_S:
            problem = f"expected a time within {CLOCKS_APART_S:g} s of now, got one {late_s:.3f} s ago"
            raise InvalidArgumentError(f"sent_s: {problem}")

    def _work(self) -> None:
        self._socket.settimeout(_POLL_S)
        while not self._stopped.is_set():
            try:
                datagram, sender = self._socket.recvfrom(_LARGEST_BYTES)
            except OSError:  # a time-out, or an error report for an earlier datagram
                continue
            try:
                self._records.put(self._read_one(time.monotonic(), datagram, sender))
            except WorldstateError as error:
                self._refuse(error)


class DetectionSocket(DatagramSocket[DetectionFrame]):
    """Detections of another program: OVAD's record of one image, with the age of the image when sent.

    ``{"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...], "age_s": 0.04}``. An image
    without detections must be sent too, because it was searched. The image of a lost datagram is unqueried.
    """

    def __init__(
        self, address: str, stamp_ns: Callable[[float], int], trust: Trust | None = None, camera: str = ""
    ) -> None:
        name = f"detections/{camera}" if camera else "detections"
        super().__init__(address, stamp_ns, partial(frame_of, where="datagram"), name, trust)


class OdometrySocket(DatagramSocket[OdometryRecord]):
    """Odometry of a driving vehicle, for `Listener.add`.

    ``{"speed_mps": 5.0, "yaw_rate_rad_s": 0.1, "age_s": 0.01}``; a localiser adds "x_m", "y_m" and "yaw_rad"
    in the map. The last record is valid until the next. The filter inserts a record that is up to 2 s late at
    its time.
    """

    def __init__(self, address: str, stamp_ns: Callable[[float], int], trust: Trust | None = None) -> None:
        read = partial(decode, OdometryRecord, where="datagram")
        super().__init__(address, stamp_ns, read, "odometry", trust)


def _bound_socket(address: str, option: str) -> socket.socket:
    target = host_and_port(option, address)
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with suppress(OSError):
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BYTES)
    try:
        listening.bind(target)
    except (OSError, TypeError, UnicodeError) as error:  # also for an invalid host name
        listening.close()
        problem = f"expected a free address, got {address} ({error})"
        raise InvalidArgumentError(f"{option}: {problem}") from error
    return listening


# Largest number of waiting images; a detector slower than the camera processes the newest ones.
WAITING_IMAGES = 4

StampedImages = BoundedChannel[tuple[float, ImageArray]]


def image_channel() -> StampedImages:
    """Return a channel of images, each with its capture time on the clock of `time.monotonic`."""
    return BoundedChannel(WAITING_IMAGES)


class ImageLooks:
    """Detections of a detector in the images of a channel.

    Parameters
    ----------
    images : StampedImages
        Filled by a `CameraFeed` or your own callback.
    detector : Detector
        Processes the images in the order of time.
    stamp_ns : callable
        Converts the time of capture to the stream's clock: `LiveSound.stamp_ns`.
    size_px : (int, int)
        Width and height of the images for which the lens was specified.
    rates : MissRates, optional
        If they contain the camera's health scale, its degradation is estimated from the images.

    Attributes
    ----------
    refused : int
        Number of images that had another size or were invalid, on which the detector failed or did not return
        a `DetectionFrame`, or whose boxes were refused. Only a detector from an installed plug-in ends the
        run.
    problem : str
        Cause of the last refusal.
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
        self.refused, self.problem = 0, ""

    def deliver(self, take: Callable[[int, DetectionFrame], None]) -> int:
        """Pass the detections of each waiting image with its stamp to `take`, such as `Listener.look`.

        Return the number of refused images.
        """
        before = self.refused
        for waiting in self._waiting():
            try:
                if not (isinstance(waiting, tuple) and len(waiting) == 2):
                    raise InvalidArgumentError(f"camera: expected a time and an image, got {waiting!r:.60}")
                stamp_ns = self._stamp_ns(in_range("camera: time", waiting[0], -math.inf, math.inf))
                take(stamp_ns, self._found(stamp_ns, waiting[1]))
            except OwnPartError:
                raise
            except WorldstateError as error:
                self.refused, self.problem = self.refused + 1, str(error)
        return self.refused - before

    def _waiting(self) -> list[tuple[float, ImageArray]]:
        """Return the waiting images; a failure of the camera counts as one refusal."""
        try:
            return self._images.take_all()
        except Exception as error:  # the callback that fills the channel may end it with any error
            if (problem := f"camera: expected images, got {error!r}") != self.problem:
                self.refused, self.problem = self.refused + 1, problem
            return []

    def _found(self, stamp_ns: int, image: ImageArray) -> DetectionFrame:
        """Return the detections in an image of the lens's size."""
        try:
            self._check_size(image)
            self._health.read(stamp_ns, image)
            found: object = self._detector.detect(image)
        except WorldstateError:
            raise
        except Exception as error:  # the caller's detector may raise anything
            raise InvalidArgumentError(f"camera: expected a detector that works, got {error!r}") from error
        return checked_frame("camera", found)

    def degradation(self, stamp_ns: int) -> float:
        """Return the latest d, 0 without a health scale."""
        return self._health.level

    def _check_size(self, image: ImageArray) -> None:
        if not (isinstance(image, np.ndarray) and image.ndim == 3 and image.dtype == np.uint8):
            raise InvalidArgumentError(f"--camera: expected images, got {type(image).__name__}")
        got = image.shape[1], image.shape[0]
        if got != self._size_px:
            width, height = self._size_px
            problem = f"expected images of the lens's {width} x {height} px, got {got[0]} x {got[1]}"
            raise InvalidArgumentError(f"--camera: {problem}: give the lens of this camera")


class CameraFeed(WorkThread):
    """Read a camera of this computer into a channel until it is stopped.

    Parameters
    ----------
    device : int
        Number of the camera in OpenCV.
    images : StampedImages
        Channel for the images. If the camera gives no image, reading is tried again until the end.

    Raises
    ------
    MissingExtraError
        If OpenCV is not installed.
    InputFileError
        If there is no such camera.
    """

    def __init__(self, device: int, images: StampedImages) -> None:
        self._capture: Any = optional("cv2").VideoCapture(device)
        self._images = images
        if not self._capture.isOpened():
            self._capture.release()
            raise InputFileError(f"camera {device}", "expected a camera, but it cannot be opened")
        super().__init__(self._capture.release)

    def _work(self) -> None:
        while not self._stopped.is_set():
            found, image = self._capture.read()
            if not found:
                self._stopped.wait(_POLL_S)
                continue
            self._images.put((time.monotonic(), image))
