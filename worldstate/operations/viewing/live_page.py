"""A page on the loopback interface that shows a live run; a websocket delivers the hops."""

import asyncio
import json
import logging
import socket
import threading
from collections import deque
from http import HTTPStatus
from importlib.resources import files
from typing import TYPE_CHECKING, Self

from worldstate.adapters.live.live_listening import LiveStep
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import check_extra, optional
from worldstate.measurement.measurement import Sighting

from .log_page import PageData, Row, degrees, ends_deg, page_html, page_row

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

HOST, STATES = "127.0.0.1", "/states"
# One minute of hops: a page that is opened later shows them at once, and a slow page may lag by up to a
# minute.
MOST_ROWS = 600
MOST_VIEWERS = 8
# Longest time that a viewer may take for its request, for the reply to a ping, and for closing.
_PATIENCE_S = 3.0
# Viewers send pings only: a longer message ends the connection.
_MOST_BYTES = 1024


class LivePage:
    """Serve the page of a live run, and send each open page the hops as they arrive.

    Only the pages that it serves, and programs on this machine, receive states. A browser lets any web page
    connect to a port of the same machine, but the request contains the origin of that page, which is checked.

    Parameters
    ----------
    port : int
        Port on the loopback interface; 0 selects a free one.

    Attributes
    ----------
    url : str
        Address of the page.

    Raises
    ------
    InvalidArgumentError
        If the port is invalid or in use.
    MissingExtraError
        If the package websockets is not installed.

    Examples
    --------
    >>> from urllib.request import urlopen
    >>> with LivePage(0) as page:
    ...     urlopen(page.url).headers["Content-Type"]
    'text/html; charset=utf-8'
    """

    def __init__(self, port: int) -> None:
        check_extra("websockets")
        try:
            self._listening = socket.create_server((HOST, port))
        except (OSError, OverflowError) as error:
            raise InvalidArgumentError(f"--web: expected a free port, got {port} ({error})") from error
        self._port = self._listening.getsockname()[1]
        self.url = f"http://{HOST}:{self._port}/"
        self._rows, self._count, self._ended = deque[str](maxlen=MOST_ROWS), 0, False
        self._changed, self._feeds = asyncio.Condition(), set[asyncio.Task[None]]()
        script = (files("worldstate") / "data" / "live_view.js").read_text("utf-8")
        empty = PageData(title="worldstate live", remarks=[], t0_s=None, truth=[], states=[])
        self._page = page_html(empty, script.replace("@states@", STATES))
        self._loop = asyncio.new_event_loop()
        serve = self._loop.run_until_complete
        self._thread = threading.Thread(target=serve, args=(self._serve(),), daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        asyncio.run_coroutine_threadsafe(self._take(None), self._loop)
        self._thread.join()
        self._loop.close()

    def show(self, live: LiveStep) -> None:
        """Send a hop to every open page; a slow page does not delay it."""
        text = json.dumps(_live_row(live), allow_nan=False, separators=(",", ":"))
        asyncio.run_coroutine_threadsafe(self._take(text), self._loop)

    async def _take(self, row: str | None) -> None:
        """Store a row, or the end of the run (None), and wake all feeds."""
        async with self._changed:
            if row is None:
                self._ended = True
            else:
                self._rows.append(row)
                self._count += 1
            self._changed.notify_all()

    async def _serve(self) -> None:
        origins = [None, *(f"http://{name}:{self._port}" for name in (HOST, "localhost"))]
        times = dict.fromkeys(("open_timeout", "ping_interval", "ping_timeout", "close_timeout"), _PATIENCE_S)
        async with optional("websockets.asyncio.server").serve(
            self._feed,
            sock=self._listening,
            origins=origins,
            process_request=self._answer,
            compression=None,
            server_header=None,
            max_size=_MOST_BYTES,
            # A refused connection is not reported as an event of the run.
            logger=logging.Logger("viewers", logging.CRITICAL),
            **times,
        ):
            async with self._changed:
                await self._changed.wait_for(lambda: self._ended)
            if self._feeds:
                await asyncio.wait(self._feeds, timeout=_PATIENCE_S)

    def _answer(self, viewer: "ServerConnection", request: "Request") -> "Response | None":
        """Answer a request for the page; the server answers a request for the websocket."""
        if request.path == STATES:
            return None
        if request.path != "/":
            return viewer.respond(HTTPStatus.NOT_FOUND, "expected /\n")
        response = viewer.respond(HTTPStatus.OK, self._page)
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
        return response

    async def _feed(self, viewer: "ServerConnection") -> None:
        """Send a viewer all new rows, several as one message, until the viewer or the run ends."""
        task = asyncio.current_task()
        if task is None or len(self._feeds) >= MOST_VIEWERS:
            return
        self._feeds.add(task)
        try:
            sent = 0
            while True:
                async with self._changed:
                    while self._count == sent and not self._ended:
                        await self._changed.wait()
                if self._count == sent:
                    return
                rows, sent = list(self._rows)[sent - self._count :], self._count
                async with asyncio.timeout(_PATIENCE_S):
                    await viewer.send(f"[{','.join(rows)}]")
        except TimeoutError:
            viewer.transport.abort()  # the closing handshake would wait for it as well
        finally:
            self._feeds.discard(task)


def _live_row(live: LiveStep) -> Row:
    """Return the data of a hop for the page: snapshot, boxes of each camera, health and delay."""
    state = live.step.state
    late = {"latency_s": round(live.latency_s, 3), "overruns": live.overruns, "lost_s": round(live.lost_s, 2)}
    sensors = [[one.sensor, one.condition, one.reason] for one in state.sensors]
    views = {one.sensor: ends_deg(one.sector_rad) for one in state.searched}
    cameras = {
        seen.look.sensor: views[seen.look.sensor] | {"boxes": [_box(one) for one in seen.sightings]}
        for seen in live.step.measurement.looks
        if seen.look.sensor in views
    }
    return page_row(state) | {"live": late, "sensors": sensors, "cameras": cameras}


def _box(one: Sighting) -> Row:
    parts = {"label": one.label, "score": round(one.score, 2), "moving": one.moving}
    return parts | {"azimuth": degrees(one.azimuth_rad), "width": degrees(one.width_rad)}
