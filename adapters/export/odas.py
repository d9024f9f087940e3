"""Tracks on a socket as ODAS sends them, which ODAS Studio shows."""

import json
import math
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from worldstate.ground.errors import InvalidArgumentError
from worldstate.state import Entity, WorldState

# ODAS sends as many tracks each time, empty ones with id 0.
_TRACKS = 4


class OdasTracks:
    """Snapshots as ODAS's JSON of tracked sources; entities are numbered as they come up.

    Examples
    --------
    >>> OdasTracks().line(WorldState(0, 12))[:60]
    '{"timeStamp": 12, "src": [{"id": 0, "tag": "", "x": 0.0, "y"'
    """

    def __init__(self) -> None:
        # Of who is there now: a long run has more entities than memory should hold.
        self._numbers: dict[str, int] = {}
        self._count = 0

    def line(self, state: WorldState) -> str:
        """Return one line: the likeliest moving entities as directions, existence as activity."""
        there = {one.id for one in state.entities}
        self._numbers = {name: number for name, number in self._numbers.items() if name in there}
        moving = [one for one in state.entities if one.moving]
        likeliest = sorted(moving, key=lambda one: -one.existence_probability)[:_TRACKS]
        tracks = [self._track(one) for one in likeliest]
        empty = {"id": 0, "tag": "", "x": 0.0, "y": 0.0, "z": 0.0, "activity": 0.0}
        return json.dumps({"timeStamp": state.seq, "src": tracks + [empty] * (_TRACKS - len(tracks))})

    def _track(self, entity: Entity) -> dict[str, object]:
        if entity.id not in self._numbers:
            self._count += 1
            self._numbers[entity.id] = self._count
        number = self._numbers[entity.id]
        x, y = math.cos(entity.azimuth_rad), math.sin(entity.azimuth_rad)
        activity = round(entity.existence_probability, 3)
        return {
            "id": number,
            "tag": "dynamic",
            "x": round(x, 3),
            "y": round(y, 3),
            "z": 0.0,
            "activity": activity,
        }


@contextmanager
def odas_socket(address: str) -> Iterator[Callable[[WorldState], None]]:
    """Connect to HOST:PORT, as ODAS does, and lend a function that sends a state's line."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise InvalidArgumentError(f"--export odas: expected HOST:PORT, got {address}")
    tracks = OdasTracks()
    try:
        connection = socket.create_connection((host, int(port)), timeout=10.0)
    except OSError as error:
        # It has no file name, by which the command would name it.
        raise InvalidArgumentError(f"--export odas: expected a listener at {address} ({error})") from error
    with connection:
        yield lambda state: connection.sendall((tracks.line(state) + "\n").encode())
