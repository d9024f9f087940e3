"""UDP datagrams of other programs: detections image by image, and odometry, each with its age."""

import socket
import threading
import time
from collections.abc import Callable
from typing import Generic, Self, TypeVar

from worldstate.adapters.camera.detections import DetectionFrame, frame_of
from worldstate.adapters.files.odometry_file import OdometryRecord
from worldstate.ground import InvalidArgumentError, WorldstateError, in_range
from worldstate.ground.serialisation import decode, decode_json

from .live_sound import BoundedChannel

T = TypeVar("T")
# A second of images of a fast camera; what a stalled machine finds there beyond is too old to be of use.
WAITING_DATAGRAMS = 64
# The largest datagram that IP carries.
_LARGEST_BYTES = 1 << 16
# How soon a socket that is no longer listened to is noticed.
_POLL_S = 0.2
# Nothing older than this is used: see MAX_IMAGE_AGE_S of the vision query and the lag of the filter.
_OLDEST_S = 10.0


class DatagramSocket(Generic[T]):
    """Records that arrive as UDP datagrams of one JSON object, with ``"age_s"`` from capture to sending.

    Parameters
    ----------
    address : str
        HOST:PORT to listen at.
    stamp_ns : callable
        From the time of capture to the stream's clock: `LiveSound.stamp_ns`.
    decode : callable
        From the object without its age to what it stands for.
    option : str
        That named the address, for messages.

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

    def __init__(
        self, address: str, stamp_ns: Callable[[float], int], decode: Callable[[object], T], option: str
    ) -> None:
        self._socket, self._stamp_ns = _bound_socket(address, option), stamp_ns
        self._decode = decode
        self._datagrams: BoundedChannel[tuple[float, bytes]] = BoundedChannel(WAITING_DATAGRAMS)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self.refused, self.problem = 0, ""

    @property
    def dropped(self) -> int:
        """Datagrams that were not taken in time."""
        return self._datagrams.dropped

    @property
    def port(self) -> int:
        """The port that is listened at, where 0 was given the one that was free."""
        return int(self._socket.getsockname()[1])

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()
        self._socket.close()

    def deliver(self, take: Callable[[int, T], None]) -> None:
        """Pass on what waits, each with the time of its capture on the stream's clock, nanoseconds.

        What cannot be read, or is refused there, is counted.
        """
        for arrived_s, datagram in self._datagrams.take_all():
            try:
                age_s, told = self._read_one(datagram)
                take(self._stamp_ns(arrived_s - age_s), told)
            except WorldstateError as error:
                self.refused, self.problem = self.refused + 1, str(error)

    def _read_one(self, datagram: bytes) -> tuple[float, T]:
        try:
            record = decode_json(datagram.decode(), "datagram")
        except UnicodeDecodeError as error:
            raise InvalidArgumentError("datagram: expected UTF-8") from error
        age_s = record.pop("age_s", 0.0) if isinstance(record, dict) else 0.0
        return in_range("age_s", age_s, 0.0, _OLDEST_S), self._decode(record)

    def _read(self) -> None:
        self._socket.settimeout(_POLL_S)
        while not self._stopped.is_set():
            try:
                datagram = self._socket.recv(_LARGEST_BYTES)
            except TimeoutError:
                continue
            self._datagrams.put((time.monotonic(), datagram))


class DetectionSocket(DatagramSocket[DetectionFrame]):
    """Looks of another program's detector: OVAD's record of one image, and the age of the image when sent.

    ``{"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...], "age_s": 0.04}``; an image
    without detections is sent, too: it was searched. A datagram that is lost is an image not asked.
    """

    def __init__(self, address: str, stamp_ns: Callable[[float], int]) -> None:
        super().__init__(address, stamp_ns, lambda record: frame_of(record, "datagram"), "--detections")


class OdometrySocket(DatagramSocket[OdometryRecord]):
    """Odometry of a running vehicle, for `Listener.tell`.

    ``{"speed_mps": 5.0, "yaw_rate_rad_s": 0.1, "age_s": 0.01}``, with a localiser "x_m", "y_m" and "yaw_rad"
    in the map, too. The last one holds until the next. The filter puts what is up to two seconds late where
    it belongs.
    """

    def __init__(self, address: str, stamp_ns: Callable[[float], int]) -> None:
        super().__init__(
            address, stamp_ns, lambda record: decode(OdometryRecord, record, "datagram"), "--odometry"
        )


def _bound_socket(address: str, option: str) -> socket.socket:
    """Return a socket for datagrams at HOST:PORT."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) >= 1 << 16:
        raise InvalidArgumentError(f"{option}: expected HOST:PORT to listen at, got {address}")
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listening.bind((host, int(port)))
    except OSError as error:
        listening.close()
        problem = f"expected a free address, got {address} ({error})"
        raise InvalidArgumentError(f"{option}: {problem}") from error
    return listening
