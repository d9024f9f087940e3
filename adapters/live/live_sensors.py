"""Sensors that run beside the microphones, each read in a thread of its own.

UDP datagrams of other programs, detections image by image and odometry, each with its age; a camera of this
machine, and what a detector finds in its images.
"""

import hmac
import json
import math
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, Self, TypeAlias, TypeVar

import numpy as np

from worldstate.adapters.camera.camera_channel import ImageHealth
from worldstate.adapters.camera.detections import DetectionFrame, Detector, frame_of
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.files.odometry_file import OdometryRecord
from worldstate.adapters.own_parts import checked_frame
from worldstate.core.fixed_lag import LAG_NS
from worldstate.ground import InputFileError, InvalidArgumentError, WorldstateError, in_range
from worldstate.ground.checks import host_and_port
from worldstate.ground.errors import OwnPartError
from worldstate.ground.extras import optional
from worldstate.ground.serialisation import decode, decode_json
from worldstate.ground.typing import ImageArray

from .live_sound import BoundedChannel

T = TypeVar("T")
Sender: TypeAlias = tuple[str, int]
# A second of images of a fast camera; what a stalled machine finds there beyond is too old to be of use.
WAITING_DATAGRAMS = 64
# The largest datagram that IP carries.
_LARGEST_BYTES = 1 << 16
# How soon a socket that is no longer listened to is noticed.
_POLL_S = 0.2
# Nothing older than the lag of the filter is used.
_OLDEST_S = 1e-9 * LAG_NS
# By so much the clocks of a sensor and of its sender may differ: what comes from the future is of now.
_AHEAD_S = 0.05
# A sender that has been silent for so long has ended: the next one takes its place.
PINNED_S = 10.0


# Between the time of sending that a datagram states and this machine's clock: clocks that NTP keeps differ by
# milliseconds, and what was held back for longer would pass for fresh.
CLOCKS_APART_S = 0.5
# Asked of the kernel, which grants less where its limit is lower: what came while another thread computes.
_KERNEL_BYTES = 1 << 22


@dataclass(frozen=True, slots=True)
class Trust:
    """Whose datagrams a port takes: those of its first sender where neither addresses nor a key are given."""

    allow: tuple[str, ...] = ()
    key: bytes | None = field(default=None, repr=False)
    numbers: Mapping[str, int] = field(default_factory=dict)  # Taken last by each port, before this run


def signed(record: Mapping[str, object], key: bytes, port: str) -> bytes:
    r"""Return a datagram of an object that a port with this key takes, once and now.

    Parameters
    ----------
    record : mapping of str to object
        JSON-able; with ``"age_s"`` from capture to this call.
    key : bytes
        The secret of ``--key``.
    port : str
        Which takes it: ``odometry``, ``detections``, or ``detections/NAME`` where cameras have names.

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


class ReaderThread(ABC):
    """A thread that reads while the context lasts, and `close` at its end."""

    def __init__(self, close: Callable[[], object]) -> None:
        self._close, self._stopped = close, threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()
        self._close()

    @abstractmethod
    def _read(self) -> None:
        """Read until `_stopped` is set."""


class DatagramSocket(ReaderThread, Generic[T]):
    """Records that arrive as UDP datagrams of one JSON object, with ``"age_s"`` from capture to sending.

    Where it has a ``"number"``, numbers must rise. With a key a line follows: the HMAC-SHA256 of the object
    in hexadecimal digits. Then the number is due, which keeps a datagram from being sent again, and so are
    ``"port"``, which keeps it from another one, and ``"sent_s"``, the Unix time, from being held back.
    All of it is checked by the thread that reads: what is refused displaces nothing that waits.

    Parameters
    ----------
    address : str
        HOST:PORT to listen at.
    stamp_ns : callable
        From the time of capture to the stream's clock: `LiveSound.stamp_ns`.
    decode : callable
        From the object without its age to what it stands for.
    name : str
        ``"port"`` of its datagrams: the option that named the address, and after a slash the camera.
    trust : Trust, optional
        Whose datagrams are taken.

    Attributes
    ----------
    refused : int
        Datagrams that could not be read, came late, again, or from a stranger.
    problem : str
        What was wrong with the last of them.
    port : int
        That is listened at, where 0 was given the one that was free.

    Raises
    ------
    InvalidArgumentError
        If the address is none, or taken.
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
        # The number taken last, by host; by a key there is one
        before = self._trust.numbers.get(name)
        self._last = {} if before is None else {"": before}
        super().__init__(self._socket.close)
        self.port, self.refused, self.problem = int(self._socket.getsockname()[1]), 0, ""
        self._counting, self._delivered = threading.Lock(), 0

    @property
    def dropped(self) -> int:
        """Datagrams that were not taken in time."""
        return self._records.dropped

    @property
    def numbers(self) -> dict[str, int]:
        """The number that was taken last by a key, under the name of the port; empty before the first."""
        return {self.name: self._last[""]} if "" in self._last else {}

    def deliver(self, take: Callable[[int, T], None]) -> int:
        """Pass on what waits, each with the time of its capture on the stream's clock, nanoseconds.

        What cannot be read, or is refused there, is counted; return how many were since the call before.
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
        """Return when a datagram's object was captured, and what it stands for."""
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
                raise InvalidArgumentError(f"number: expected one above {last}, taken already, got {number}")
        read = arrived_s - max(age_s, 0.0), self._decode(record)
        if number is not None:
            self._last[source] = number
        self._pinned = pinned
        return read

    def _check_sender(self, arrived_s: float, sender: Sender) -> tuple[float, Sender] | None:
        """Return which sender is pinned from now on; refuse a stranger."""
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
        """Return the object of a datagram, whose code is right where there is a key."""
        if self._trust.key is None:
            return datagram
        text, _, code = datagram.rpartition(b"\n")
        if not hmac.compare_digest(_code(self._trust.key, text), code):
            raise InvalidArgumentError("datagram: expected a line with the HMAC-SHA256 of the key")
        return text

    def _check_sent(self, port: object, sent_s: object) -> None:
        """Refuse what was signed for another port, or was sent at another time."""
        if port != self.name:
            raise InvalidArgumentError(f"port: expected {self.name!r}, got {port!r:.60}")
        late_s = time.time() - decode(float, sent_s, "sent_s")
        if abs(late_s) > CLOCKS_APART_S:
            problem = f"expected the time within {CLOCKS_APART_S:g} s, got one {late_s:.3f} s ago"
            raise InvalidArgumentError(f"sent_s: {problem}")

    def _read(self) -> None:
        self._socket.settimeout(_POLL_S)
        while not self._stopped.is_set():
            try:
                datagram, sender = self._socket.recvfrom(_LARGEST_BYTES)
            except OSError:  # nothing came, or what the system says of a datagram sent before
                continue
            try:
                self._records.put(self._read_one(time.monotonic(), datagram, sender))
            except WorldstateError as error:
                self._refuse(error)


class DetectionSocket(DatagramSocket[DetectionFrame]):
    """Looks of another program's detector: OVAD's record of one image, and the age of the image when sent.

    ``{"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...], "age_s": 0.04}``; an image
    without detections is sent, too: it was searched. A datagram that is lost is an image not asked.
    """

    def __init__(
        self, address: str, stamp_ns: Callable[[float], int], trust: Trust | None = None, camera: str = ""
    ) -> None:
        name = f"detections/{camera}" if camera else "detections"
        super().__init__(address, stamp_ns, partial(frame_of, where="datagram"), name, trust)


class OdometrySocket(DatagramSocket[OdometryRecord]):
    """Odometry of a running vehicle, for `Listener.add`.

    ``{"speed_mps": 5.0, "yaw_rate_rad_s": 0.1, "age_s": 0.01}``, with a localiser "x_m", "y_m" and "yaw_rad"
    in the map, too. The last one holds until the next. The filter puts what is up to two seconds late where
    it belongs.
    """

    def __init__(self, address: str, stamp_ns: Callable[[float], int], trust: Trust | None = None) -> None:
        read = partial(decode, OdometryRecord, where="datagram")
        super().__init__(address, stamp_ns, read, "odometry", trust)


def _bound_socket(address: str, option: str) -> socket.socket:
    """Return a socket for datagrams at HOST:PORT."""
    target = host_and_port(option, address)
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with suppress(OSError):
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BYTES)
    try:
        listening.bind(target)
    except (OSError, TypeError, UnicodeError) as error:  # of a host, too, that is no name
        listening.close()
        problem = f"expected a free address, got {address} ({error})"
        raise InvalidArgumentError(f"{option}: {problem}") from error
    return listening


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

    Attributes
    ----------
    refused : int
        Images of another size or none, those at which the detector failed or gave no `DetectionFrame`, and
        those whose boxes were refused. Only a part that an installed package brings ends the run.
    problem : str
        What was wrong with the last of them.
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
        """Pass on, such as to `Listener.look`, what is found in the images that wait, each with its stamp.

        Return how many were refused.
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
        """Return the images that wait; what ended the camera counts once."""
        try:
            return self._images.take_all()
        except Exception as error:  # whatever the callback that fills the channel ended it with
            if (problem := f"camera: expected images, got {error!r}") != self.problem:
                self.refused, self.problem = self.refused + 1, problem
            return []

    def _found(self, stamp_ns: int, image: ImageArray) -> DetectionFrame:
        """Return what the detector finds in an image that has the size of the lens."""
        try:
            self._check_size(image)
            self._health.read(stamp_ns, image)
            found: object = self._detector.detect(image)
        except WorldstateError:
            raise
        except Exception as error:  # of the caller's own detector, which may raise anything
            raise InvalidArgumentError(f"camera: expected a detector that works, got {error!r}") from error
        return checked_frame("camera", found)

    def degradation(self, stamp_ns: int) -> float:
        """Return d as last read, 0 where no scale of health is known."""
        return self._health.level

    def _check_size(self, image: ImageArray) -> None:
        if not (isinstance(image, np.ndarray) and image.ndim == 3 and image.dtype == np.uint8):
            raise InvalidArgumentError(f"--camera: expected images, got {type(image).__name__}")
        got = image.shape[1], image.shape[0]
        if got != self._size_px:
            width, height = self._size_px
            problem = f"expected images of {width} x {height} px as its lens, got {got[0]} x {got[1]}"
            raise InvalidArgumentError(f"--camera: {problem}: give the lens of this camera")


class CameraFeed(ReaderThread):
    """Read a camera of this machine into a channel until it is stopped.

    Parameters
    ----------
    device : int
        Number of the camera as OpenCV counts them.
    images : StampedImages
        Where the images go. While the camera gives none, it is asked again, until the end.

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
            raise InputFileError(f"camera {device}", "expected a camera of this machine, it cannot be opened")
        super().__init__(self._capture.release)

    def _read(self) -> None:
        while not self._stopped.is_set():
            found, image = self._capture.read()
            if not found:
                self._stopped.wait(_POLL_S)
                continue
            self._images.put((time.monotonic(), image))
