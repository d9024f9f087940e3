"""A Foxglove client, written from its protocol, sees what a run serves."""

import base64
import json
import os
import socket
import struct
import time

import pytest
from scripted_states import scripted_states

from worldstate.adapters.export.log_messages import live_server, state_messages
from worldstate.ground.errors import InvalidArgumentError

pytest.importorskip("foxglove")


class Client:
    """As much of RFC 6455 and of the protocol foxglove.sdk.v1 as takes to subscribe and listen."""

    def __init__(self, port):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=20.0)
        key = base64.b64encode(os.urandom(16)).decode()
        self.socket.sendall(
            f"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += self.socket.recv(1)
        assert b"101" in head.split(b"\r\n")[0]

    def send(self, value):
        data, mask = json.dumps(value).encode(), b"\0\0\0\0"
        self.socket.sendall(struct.pack("!BBH", 0x81, 0x80 | 126, len(data)) + mask + data)

    def receive(self):
        kind, size = struct.unpack("!BB", self._take(2))
        if size == 126:
            (size,) = struct.unpack("!H", self._take(2))
        elif size == 127:
            (size,) = struct.unpack("!Q", self._take(8))
        data = self._take(size)
        return json.loads(data) if kind & 15 == 1 else data

    def next_message(self, patience_s):
        """Return the subscription, the time stamp and the content of the next message; zeros without one."""
        self.socket.settimeout(patience_s)
        try:
            while not isinstance(data := self.receive(), bytes) or data[0] != 1:
                pass
        except TimeoutError:
            return 0, 0, b""
        subscription, stamp_ns = struct.unpack_from("<IQ", data, 1)
        return subscription, stamp_ns, data[13:]

    def _take(self, size):
        data = b""
        while len(data) < size:
            data += self.socket.recv(size - len(data))
        return data


def test_a_viewer_receives_the_snapshots_in_the_time_that_they_tell():
    first, second, third = scripted_states()[:3]
    with live_server(0) as (send, port):
        client = Client(port)
        for message in state_messages(first):
            send(message)
        channels = {}
        while len(channels) < 2:
            said = client.receive()
            channels |= (
                {one["topic"]: one for one in said.get("channels", ())} if isinstance(said, dict) else {}
            )
        snapshot = channels["/worldstate/snapshot"]
        assert (snapshot["encoding"], snapshot["schemaName"]) == ("json", "worldstate.Snapshot")
        assert json.loads(snapshot["schema"])["properties"]["stamp_ns"]["type"] == "integer"
        client.send({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": snapshot["id"]}]})
        for state in (second, third):
            # A subscription is not answered, so that the first messages may come before it counts.
            while True:
                for message in state_messages(state):
                    send(message)
                subscription, stamp_ns, data = client.next_message(patience_s=0.5)
                if stamp_ns == state.stamp_ns:
                    break
            assert (subscription, data) == (7, state.to_json().encode())


def test_a_recording_plays_no_faster_than_its_sound():
    states = scripted_states()
    with live_server(0) as (send, _):
        begun_s = time.monotonic()
        for state in states[:4]:
            for message in state_messages(state):
                send(message)
        lasted_s = (states[3].stamp_ns - states[0].stamp_ns) / 1e9
        assert time.monotonic() - begun_s >= lasted_s


def test_a_port_that_is_taken_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InvalidArgumentError, match=f"free port, got {port}"), live_server(port):
            pass
