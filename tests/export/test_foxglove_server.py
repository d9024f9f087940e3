"""A Foxglove client, written from its protocol, sees what a run serves."""

import json
import socket
import struct
import threading
import time

import pytest
from scripted_states import scripted_states
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.sync.client import connect

from worldstate.adapters.export import foxglove_server
from worldstate.adapters.export.foxglove_server import OriginGate, live_server
from worldstate.adapters.export.log_messages import state_messages
from worldstate.ground.errors import InvalidArgumentError

pytest.importorskip("foxglove")


def client_of(port, *origins, **more):
    # Names of headers have no case.
    protocol, origins = ["foxglove.sdk.v1"], [*zip(("origin", "Origin"), origins, strict=False)]
    at = f"ws://127.0.0.1:{port}"
    return connect(
        at, subprotocols=protocol, additional_headers=origins, open_timeout=20.0, max_size=None, **more
    )


def received(client):
    """Return the next text of a server."""
    while isinstance(data := client.recv(20.0), bytes):
        pass
    return json.loads(data)


def subscribed(client, *topics):
    """Subscribe to topics, numbered from 7; return their channels."""
    channels = {}
    while not channels.keys() >= {*topics}:
        channels |= {one["topic"]: one for one in received(client).get("channels", ())}
    asked = [{"id": 7 + k, "channelId": channels[topic]["id"]} for k, topic in enumerate(topics)]
    client.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
    return channels


def test_a_viewer_receives_the_snapshots_in_the_time_that_they_tell():
    first, second, third = scripted_states()[:3]
    with live_server(0) as (send, port), client_of(port) as client:
        for message in state_messages(first):
            send(message)
        snapshot = subscribed(client, "/worldstate/snapshot")["/worldstate/snapshot"]
        assert (snapshot["encoding"], snapshot["schemaName"]) == ("json", "worldstate.Snapshot")
        assert json.loads(snapshot["schema"])["properties"]["stamp_ns"]["type"] == "integer"
        for state in (second, third):
            data = b""
            # A subscription is not answered, so that the first messages may come before it counts.
            while struct.unpack_from("<Q", data + bytes(13), 5)[0] != state.stamp_ns:
                for message in state_messages(state):
                    send(message)
                try:
                    data = client.recv(0.5)
                except TimeoutError:
                    continue
                data = data if isinstance(data, bytes) and data[0] == 1 else b""
            assert struct.unpack_from("<I", data, 1) == (7,)
            assert data[13:] == state.to_json().encode()


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
    ("origins", "taken"),
    [
        ([], True),
        (["http://localhost:8080"], True),
        (["https://app.foxglove.dev"], True),
        (["https://evil.example"], False),
        (["null"], False),
        (["http://localhost", "https://evil.example"], False),
        (["https://app.foxglove.dev.evil.example"], False),
    ],
)
def test_a_page_of_the_web_sees_nothing_unless_its_origin_is_named(origins, taken):
    with live_server(0, origins=["https://app.foxglove.dev"]) as (_, port):
        if taken:
            with client_of(port, *origins) as client:
                assert received(client)["op"] == "serverInfo"
        else:
            with pytest.raises(InvalidStatus, match="403"):
                client_of(port, *origins)


def test_what_is_no_websocket_is_refused_and_places_are_few():
    with live_server(0) as (_, port):
        with socket.create_connection(("127.0.0.1", port), 20.0) as page:
            page.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert b"403" in page.recv(100)
        viewers = [client_of(port) for _ in range(foxglove_server.MOST_VIEWERS)]
        with pytest.raises(InvalidStatus):
            client_of(port)
        viewers.pop().close()
        until_s = time.monotonic() + 10.0
        while len(viewers) < foxglove_server.MOST_VIEWERS and time.monotonic() < until_s:
            try:
                viewers.append(client_of(port))
            except WebSocketException:
                time.sleep(0.05)
        assert len(viewers) == foxglove_server.MOST_VIEWERS
        for one in viewers:
            one.close()


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
            viewers = [client_of(port) for _ in range(foxglove_server.MOST_VIEWERS)]
            assert all(received(viewer)["op"] == "serverInfo" for viewer in viewers)
            waiting = [one for one in threading.enumerate() if "_serve" in one.name]
            most = foxglove_server.MOST_ASKING if number == [1] * 40 else foxglove_server.MOST_ASKING_OF_ALL
            assert len(waiting) <= most + len(viewers)
        finally:
            for one in (*asked, *viewers):
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
        client = client_of(port, max_queue=1)
        for message in state_messages(state):
            send(message)
        subscribed(client, *(message.topic for message in state_messages(state)))
        begun_s, slowest_s = time.monotonic(), 0.0
        while not gates[0].stalled and time.monotonic() < begun_s + 20.0:
            sent_s = time.monotonic()
            for message in state_messages(state):
                send(message)
            slowest_s = max(slowest_s, time.monotonic() - sent_s)
        assert gates[0].stalled == 1
        assert slowest_s < 0.4
        client.close()
