"""What a detector of one's own reports, image by image, as datagrams on a socket."""

import socket
import threading
import time
from collections.abc import Callable, Iterator

from worldstate.adapters.camera.detections import DetectionFrame, frame_of
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import decode_json

from .bounded_channel import BoundedChannel

# A second of images of a fast camera; what a stalled machine finds there beyond is too old to be a look.
WAITING_DATAGRAMS = 64
# The largest datagram that IP carries.
_LARGEST_BYTES = 1 << 16
# How soon a socket that is no longer listened to is noticed.
_POLL_S = 0.2
# No look older than this is used anyway: see VisionSettings.max_frame_age_s.
_OLDEST_S = 10.0


class DetectionSocket:
    """Looks that arrive as UDP datagrams: OVAD's record of one image, and the age of the image when sent.

    ``{"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...], "age_s": 0.04}``; an image in
    which nothing was found is sent, too: it was searched. A datagram that is lost is an image not asked.

    Parameters
    ----------
    address : str
        HOST:PORT to listen at.
    stamp_ns : callable
        From the time of capture to the stream's clock: `LiveSound.stamp_ns`.

    Attributes
    ----------
    refused : int
        Datagrams that could not be read.
    problem : str
        What was wrong with the last of them.

    Raises
    ------
    InvalidArgumentError
        If the address is none, or taken.
    """

    def __init__(self, address: str, stamp_ns: Callable[[float], int]) -> None:
        self._socket, self._stamp_ns = bound_socket(address), stamp_ns
        self._datagrams: BoundedChannel[tuple[float, bytes]] = BoundedChannel(WAITING_DATAGRAMS)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self.refused, self.problem = 0, ""

    @property
    def dropped(self) -> int:
        """Datagrams that nobody took in time."""
        return self._datagrams.dropped

    @property
    def port(self) -> int:
        """The port that is listened at, where 0 was given the one that was free."""
        return int(self._socket.getsockname()[1])

    def __enter__(self) -> "DetectionSocket":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()
        self._socket.close()

    def __call__(self) -> Iterator[tuple[int, DetectionFrame]]:
        """Yield the looks that wait."""
        for arrived_s, datagram in self._datagrams.take_all():
            try:
                age_s, frame = _decoded(datagram)
            except InvalidArgumentError as error:
                self.refused, self.problem = self.refused + 1, str(error)
                continue
            yield self._stamp_ns(arrived_s - age_s), frame

    def _read(self) -> None:
        self._socket.settimeout(_POLL_S)
        while not self._stopped.is_set():
            try:
                datagram = self._socket.recv(_LARGEST_BYTES)
            except TimeoutError:
                continue
            self._datagrams.put((time.monotonic(), datagram))


def bound_socket(address: str) -> socket.socket:
    """Return a socket for datagrams at HOST:PORT."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) >= 1 << 16:
        raise InvalidArgumentError(f"--detections: expected HOST:PORT to listen at, got {address}")
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listening.bind((host, int(port)))
    except OSError as error:
        listening.close()
        problem = f"expected a free address, got {address} ({error})"
        raise InvalidArgumentError(f"--detections: {problem}") from error
    return listening


def _decoded(datagram: bytes) -> tuple[float, DetectionFrame]:
    try:
        record = decode_json(datagram.decode(), "datagram")
    except UnicodeDecodeError as error:
        raise InvalidArgumentError("datagram: expected UTF-8") from error
    age_s = record.pop("age_s", 0.0) if isinstance(record, dict) else 0.0
    return in_range("age_s", age_s, 0.0, _OLDEST_S), frame_of(record, "datagram")
