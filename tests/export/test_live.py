"""A Foxglove client, written from its protocol, sees what a run serves."""

import base64
import json
import os
import socket
import struct
import threading
import time

import pytest
from scripted_states import scripted_states

from worldstate.adapters.export import foxglove_server
from worldstate.adapters.export.foxglove_server import OriginGate, live_server
from worldstate.adapters.export.log_messages import state_messages
from worldstate.ground.errors import InvalidArgumentError

pytest.importorskip("foxglove")


class Client:
    """As much of RFC 6455 and of the protocol foxglove.sdk.v1 as takes to subscribe and listen."""

    def __init__(self, port, *fields):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=20.0)
        key = base64.b64encode(os.urandom(16)).decode()
        self.socket.sendall(
            f"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n".encode()
            + "".join(f"{one}\r\n" for one in [*fields, ""]).encode()
        )
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += self.socket.recv(1)
        if b"101" not in head.split(b"\r\n")[0]:
            raise ConnectionRefusedError(head)

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


@pytest.mark.parametrize(
    ("fields", "taken"),
    [
        ([], True),
        (["Origin: http://localhost:8080"], True),
        (["Origin: https://app.foxglove.dev"], True),
        (["origin: https://evil.example"], False),
        (["Origin: null"], False),
        (["Origin: http://localhost", "Origin: https://evil.example"], False),
        (["Origin: https://app.foxglove.dev.evil.example"], False),
    ],
)
def test_a_page_of_the_web_sees_nothing_unless_its_origin_is_named(fields, taken):
    with live_server(0, origins=["https://app.foxglove.dev"]) as (_, port):
        if taken:
            assert Client(port, *fields).receive()["op"] == "serverInfo"
        else:
            with pytest.raises(ConnectionRefusedError, match="403"):
                Client(port, *fields)


def test_what_is_no_websocket_is_refused_and_places_are_few():
    with live_server(0) as (_, port):
        with socket.create_connection(("127.0.0.1", port), 20.0) as page:
            page.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert b"403" in page.recv(100)
        viewers = [Client(port) for _ in range(foxglove_server.MOST_VIEWERS)]
        with pytest.raises(ConnectionRefusedError):
            Client(port)
        viewers.pop().socket.close()
        until_s = time.monotonic() + 10.0
        while not viewers[foxglove_server.MOST_VIEWERS - 1 :] and time.monotonic() < until_s:
            try:
                viewers.append(Client(port))
            except ConnectionRefusedError:
                time.sleep(0.05)
        assert len(viewers) == foxglove_server.MOST_VIEWERS


def dripping(port, number):
    """Open connections that never ask, from as many addresses as there are numbers."""
    asked = []
    for one in number:
        asked.append(socket.socket())
        asked[-1].bind((f"127.0.0.{one}", 0))
        asked[-1].connect(("127.0.0.1", port))
        asked[-1].sendall(b"GET / HTTP/1.1\r\n")
    return asked


@pytest.mark.parametrize("number", [[1] * 40, range(2, 130)])
def test_connections_that_drip_keep_no_viewer_out(number):
    with live_server(0) as (_, port):
        asked = dripping(port, number)
        try:
            viewers = [Client(port) for _ in range(foxglove_server.MOST_VIEWERS)]
            assert all(viewer.receive()["op"] == "serverInfo" for viewer in viewers)
            waiting = [one for one in threading.enumerate() if "_serve" in one.name]
            most = foxglove_server.MOST_ASKING if number == [1] * 40 else foxglove_server.MOST_ASKING_OF_ALL
            assert len(waiting) <= most + len(viewers)
        finally:
            for one in asked:
                one.close()


def test_one_deadline_holds_for_a_whole_head(monkeypatch):
    monkeypatch.setattr(foxglove_server, "_HEAD_S", 0.6)
    with live_server(0) as (_, port):
        (one,) = dripping(port, [1])
        one.settimeout(0.1)
        begun_s, ended = time.monotonic(), False
        while not ended and time.monotonic() < begun_s + 5.0:
            try:
                one.sendall(b"X")
                ended = one.recv(1) == b""
            except TimeoutError:
                continue
            except ConnectionError:
                ended = True
        assert 0.4 < time.monotonic() - begun_s < 2.0
        one.close()


def test_a_viewer_that_takes_nothing_holds_nobody_up_and_is_let_go(monkeypatch):
    monkeypatch.setattr(foxglove_server, "STALLED_S", 0.5)
    gates = []
    monkeypatch.setattr(
        foxglove_server, "OriginGate", lambda *given: gates.append(OriginGate(*given)) or gates[0]
    )
    state = scripted_states()[0]
    with live_server(0, paced=False) as (send, port):
        client = Client(port)
        client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for message in state_messages(state):
            send(message)
        ids = [one["id"] for said in (client.receive(), client.receive()) for one in said.get("channels", ())]
        subscriptions = [{"id": 7 + one, "channelId": one} for one in ids]
        client.send({"op": "subscribe", "subscriptions": subscriptions})
        begun_s, slowest_s = time.monotonic(), 0.0
        while not gates[0].stalled and time.monotonic() < begun_s + 20.0:
            sent_s = time.monotonic()
            for message in state_messages(state):
                send(message)
            slowest_s = max(slowest_s, time.monotonic() - sent_s)
        assert gates[0].stalled == 1
        assert slowest_s < 0.4
