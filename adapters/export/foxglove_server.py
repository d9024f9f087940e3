"""Foxglove's server on a websocket, with a check of the viewers' origins and a limit for slow viewers."""

import io
import logging
import secrets
import socket
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from http.client import parse_headers
from typing import Any
from urllib.parse import urlsplit

from worldstate.ground import InvalidArgumentError, seconds
from worldstate.ground.extras import optional
from worldstate.ground.threads import WorkThread

from .log_messages import LogMessage, LogSink

_LOG = logging.getLogger(__name__)
HOST = "127.0.0.1"
MOST_VIEWERS = 8
# Largest number of connections without a request so far, per address and in total; the newest replaces the
# oldest. A viewer sends its request at once, so connections that send a byte now and then cannot block
# viewers.
MOST_ASKING, MOST_ASKING_OF_ALL = 8, 64
# Largest number of messages that wait for a viewer, 3 s of hops; the newest replaces the oldest.
MOST_WAITING = 100
# A viewer that reads nothing for this time is disconnected.
STALLED_S = 10.0
# Longest time (s) and size (bytes) of the head of a request, size of a read (bytes), polling period (s).
_HEAD_S, _HEAD_BYTES, _BLOCK_BYTES, _POLL_S = 5.0, 1 << 13, 1 << 16, 0.2
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


def is_trusted(origin: str | None, named: Collection[str] = ()) -> bool:
    """Return whether a request comes from a program or a page of this machine, or from an allowed origin.

    The origin of a web page contains its host; the origin of a page in a sandbox is ``null``. Programs have
    no origin, or one with a scheme of their own.

    Examples
    --------
    >>> is_trusted(None), is_trusted("http://localhost:8080"), is_trusted("file://")
    (True, True, True)
    >>> is_trusted("https://app.foxglove.dev"), is_trusted("null")
    (False, False)
    >>> is_trusted("http://localhost.evil.example")
    False
    >>> is_trusted("https://app.foxglove.dev", ["https://app.foxglove.dev"])
    True
    """
    if origin is None or origin in named:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    if parts.scheme in ("http", "https"):
        return parts.hostname in ("localhost", "127.0.0.1", "::1")
    return bool(parts.scheme)


class OriginGate(WorkThread):
    """Accept viewers at a port, and connect those that are allowed to a server behind it.

    Foxglove's server accepts every origin, and browsers let any page connect to a port of the same machine.

    Parameters
    ----------
    port : int
        Port for viewers; 0 selects a free one.
    server : (str, int)
        Host and port of the server.
    origins : collection of str
        Origins of web pages that may connect, such as ``https://app.foxglove.dev``.

    Attributes
    ----------
    refused : int
        Number of refused connections: of another origin, not a websocket, or beyond the limit.
    stalled : int
        Number of viewers that were disconnected because they read nothing.

    Raises
    ------
    InvalidArgumentError
        If the port is invalid or in use.
    """

    def __init__(self, port: int, server: tuple[str, int], origins: Collection[str] = ()) -> None:
        try:
            self._listening = socket.create_server((HOST, port))
        except (OSError, OverflowError) as error:
            problem = f"expected a free port, got {port} ({error})"
            raise InvalidArgumentError(f"--export foxglove: {problem}") from error
        self.port = int(self._listening.getsockname()[1])
        self.refused = self.stalled = 0
        self._server, self._origins = server, frozenset(origins)
        self._places = threading.Semaphore(MOST_VIEWERS)
        self._asking: list[tuple[str, socket.socket]] = []
        super().__init__(self._end)

    def _end(self) -> None:
        self._listening.close()
        if self.refused or self.stalled:
            told = "websocket: %d connections were refused, %d viewers took nothing"
            _LOG.warning(told, self.refused, self.stalled)

    def _work(self) -> None:
        self._listening.settimeout(_POLL_S)
        while not self._stopped.is_set():
            try:
                viewer, (address, _) = self._listening.accept()
            except OSError:  # no viewer, or it has disconnected
                continue
            self._make_room(address)
            self._asking.append((address, viewer))
            threading.Thread(target=self._serve, args=(address, viewer), daemon=True).start()

    def _make_room(self, address: str) -> None:
        """Close the oldest waiting connections if too many wait."""
        every = list(self._asking)
        same = [one for one in every if one[0] == address]
        if len(same) >= MOST_ASKING or len(every) >= MOST_ASKING_OF_ALL:
            oldest = (same if len(same) >= MOST_ASKING else every)[0]
            with suppress(ValueError):  # its request has arrived meanwhile
                self._asking.remove(oldest)
                self.refused += 1
                _hang_up(oldest[1])

    def _serve(self, address: str, viewer: socket.socket) -> None:
        with viewer, suppress(OSError):
            try:
                head = _head(viewer)
            finally:
                with suppress(ValueError):  # closed for a newer one
                    self._asking.remove((address, viewer))
            if not (_may_connect(head, self._origins) and self._places.acquire(blocking=False)):
                self.refused += 1
                viewer.sendall(_REFUSED)
                return
            try:
                with socket.create_connection(self._server, _HEAD_S) as server:
                    server.sendall(head)
                    self._join(viewer, server)
            finally:
                self._places.release()

    def _join(self, viewer: socket.socket, server: socket.socket) -> None:
        """Forward the data of both until one of them ends."""
        viewer.settimeout(STALLED_S)
        server.settimeout(STALLED_S)
        asks = threading.Thread(target=_pass_on, args=(viewer, server, self._stopped), daemon=True)
        asks.start()
        try:
            _pass_on(server, viewer, self._stopped)
        except TimeoutError:
            self.stalled += 1
        _hang_up(viewer)
        asks.join()


def _pass_on(source: socket.socket, target: socket.socket, stopped: threading.Event) -> None:
    """Forward the data of a socket until it or the run ends; raise TimeoutError for a slow receiver."""
    with suppress(ConnectionError):
        while not stopped.is_set():
            try:
                block = source.recv(_BLOCK_BYTES)
            except TimeoutError:  # the source sends nothing
                continue
            if not block:
                break
            target.sendall(block)
    _hang_up(target)


def _hang_up(one: socket.socket) -> None:
    with suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)


def _head(viewer: socket.socket) -> bytes:
    """Return the head of a viewer's request, up to the empty line; drop a viewer that sends none."""
    head, until_s = b"", time.monotonic() + _HEAD_S
    while not head.endswith(b"\r\n\r\n"):
        viewer.settimeout(max(until_s - time.monotonic(), 1e-3))
        block = viewer.recv(1)
        if not block or len(head) >= _HEAD_BYTES:
            raise ConnectionError
        head += block
    return head


def _may_connect(head: bytes, named: Collection[str]) -> bool:
    fields = parse_headers(io.BytesIO(head.partition(b"\r\n")[2]))
    trusted = all(is_trusted(origin, named) for origin in fields.get_all("Origin", [None]))
    return trusted and fields.get("Upgrade", "").lower() == "websocket"


@contextmanager
def live_server(
    port: int, *, paced: bool = True, origins: Collection[str] = ()
) -> Iterator[tuple[LogSink, int]]:
    """Yield a function that sends messages to connected viewers, and the port; 0 selects a free one.

    Each message is delayed until its time stamp, so that a recording plays at the speed of its sound. With
    `paced` False there is no delay, as for microphones, which set the pace themselves. A slow viewer delays
    no message: messages that it does not read are dropped. For `origins` see `OriginGate`.
    """
    # A separate context is used, because the global one keeps its channels for all servers of the process.
    context = optional("foxglove").Context()
    server, host = _hidden_server(context)
    channels: dict[str, Any] = {}
    begun_s: float | None = None

    def send(message: LogMessage) -> None:
        nonlocal begun_s
        stamp_s = seconds(message.stamp_ns)
        begun_s = time.monotonic() - stamp_s if begun_s is None else begun_s
        if paced:
            time.sleep(max(begun_s + stamp_s - time.monotonic(), 0.0))
        if message.topic not in channels:
            channels[message.topic] = _channel(message, context)
        channels[message.topic].log(message.data, log_time=message.stamp_ns)

    try:
        with OriginGate(port, (host, server.port), origins) as gate:
            yield send, gate.port
    finally:
        server.stop()


def _hidden_server(context: Any) -> tuple[Any, str]:
    """Start Foxglove's server at an address that only the gate has; return both.

    Linux has 2^24 loopback addresses; together with the port these are too many for a page to try. On a
    system with one such address only the port is unknown.
    """
    start = partial(optional("foxglove").start_server, name="worldstate", port=0, context=context)
    host = "127." + ".".join(str(secrets.randbelow(254) + 1) for _ in range(3))
    try:
        return start(host=host, message_backlog_size=MOST_WAITING), host
    except RuntimeError:
        return start(host=HOST, message_backlog_size=MOST_WAITING), HOST


def _channel(message: LogMessage, context: Any) -> Any:
    foxglove = optional("foxglove")
    schema = foxglove.Schema(name=message.schema_name, encoding="jsonschema", data=message.schema)
    return foxglove.Channel(message.topic, schema=schema, message_encoding="json", context=context)
