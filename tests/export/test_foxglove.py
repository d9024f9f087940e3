"""Foxglove and Rerun: schemas of the messages, the same states back, scenes, and a client of the server."""

import base64
import json
import math
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from importlib.resources import files

import cv2
import jsonschema
import numpy as np
import pytest
import soundfile
from camera_boxes import write_video
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from scripted_states import EGO, scripted_states, write_states
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.sync.client import connect

from worldstate.adapters.export import foxglove_server, log_messages
from worldstate.adapters.export.foxglove_server import OriginGate, live_server
from worldstate.adapters.export.log_messages import state_messages
from worldstate.adapters.export.scene import scene_update
from worldstate.adapters.state_log import read_log
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.state import SearchedView, WorldState

STATES = scripted_states()
AZIMUTHS = np.radians(np.arange(-90.0, 91.0))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A second and a half of noise with a video of two colours beside it."""
    folder = tmp_path_factory.mktemp("log")
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, (72_000, 56))
    soundfile.write(folder / "out_multi.wav", noise, 48_000)
    greys = (np.full((48, 64, 3), 40 + 10 * number, np.uint8) for number in range(15))
    write_video(folder / "ueye_stereo_vid.mp4", greys)
    return folder


@pytest.fixture(scope="module")
def logged(recording):
    log, states = recording / "out.mcap", recording / "states.jsonl"
    sound = str(recording / "out_multi.wav")
    assert main(["run", sound, "--export", f"mcap={log}", "--out", str(states)]) == 0
    return log, states


def messages(path, *topics):
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(topics or None)
        return [(channel.topic, schema, message) for schema, channel, message in found]


def test_replay_gives_the_same_bytes_back(logged, tmp_path, capsys):
    log, states = logged
    assert main(["log", "replay", str(log), "--out", str(tmp_path / "again.jsonl")]) == 0
    assert (tmp_path / "again.jsonl").read_bytes() == states.read_bytes()
    assert main(["log", "replay", str(states), "--export", f"mcap={tmp_path / 'again.mcap'}"]) == 0
    assert main(["log", "replay", str(tmp_path / "again.mcap"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["states"] == 6


def test_every_message_holds_to_the_schema_of_its_channel(logged):
    found = messages(logged[0])
    own = {f"/worldstate/{name}" for name in ("snapshot", "scene", "srp")}
    assert {topic for topic, _, _ in found} == own | {"/camera/image", "/microphones/sound"}
    # One of each topic: all are made by the same types.
    for schema, message in {topic: one for topic, *one in found}.values():
        described = json.loads(schema.data)
        jsonschema.Draft202012Validator.check_schema(described)
        jsonschema.Draft202012Validator(described).validate(json.loads(message.data))
    shipped = json.loads(files("worldstate").joinpath("data/snapshot.schema.json").read_text("utf-8"))
    assert shipped in [json.loads(schema.data) for topic, schema, _ in found if topic.endswith("snapshot")]


def test_an_image_is_the_frame_of_its_time(logged):
    images = messages(logged[0], "/camera/image")
    assert len(images) == 5, "the video ends after 1.4 s, so the sixth hop has no new frame"
    for _, _, message in images:
        jpeg = base64.b64decode(json.loads(message.data)["data"])
        grey = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).mean()
        assert grey == pytest.approx(40 + message.log_time / 1e7, abs=4.0)


def test_the_sound_of_a_log_is_that_of_a_microphone_at_its_time(recording, logged):
    blocks = messages(logged[0], "/microphones/sound")
    assert [message.log_time for _, _, message in blocks] == [k * 10**8 for k in range(15)]
    said = [json.loads(message.data) for _, _, message in blocks]
    forms = {(one["format"], one["sample_rate"], one["number_of_channels"]) for one in said}
    assert forms == {("pcm-s16", 48_000, 1)}
    heard = np.frombuffer(b"".join(base64.b64decode(one["data"]) for one in said), "<i2")
    written, _ = soundfile.read(recording / "out_multi.wav")
    assert heard / 32768.0 == pytest.approx(written[:, 0], abs=0.51 / 32768.0)


def test_the_frame_of_a_scene_stands_in_the_map_by_odometry():
    frame = list(state_messages(STATES[0]))[2].value
    assert (frame.parent_frame_id, frame.child_frame_id) == ("map", "base_link")
    assert (frame.translation.x, frame.translation.y) == EGO.position_m
    assert 2.0 * math.atan2(frame.rotation.z, frame.rotation.w) == pytest.approx(EGO.yaw_rad)
    without = [message.topic for message in state_messages(replace(STATES[0], ego=None))]
    assert without == ["/worldstate/snapshot", "/worldstate/scene"]


def of_foxglove(name):
    """Return the message class that Foxglove itself publishes."""
    import foxglove.messages

    schema = getattr(foxglove.messages, name).get_schema()
    described = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    pool = descriptor_pool.DescriptorPool()
    for file in described.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))


def as_protobuf_json(value, key=""):
    """Convert time stamps and durations to protobuf's JSON; everything else is equal."""
    if isinstance(value, list):
        return [as_protobuf_json(one) for one in value]
    if not isinstance(value, dict):
        return value
    if set(value) == {"sec", "nsec"}:
        if key == "lifetime":
            return f"{value['sec']}.{value['nsec']:09d}s"
        return f"1970-01-01T00:{value['sec'] // 60:02d}:{value['sec'] % 60:02d}.{value['nsec']:09d}Z"
    return {name: as_protobuf_json(one, name) for name, one in value.items()}


def test_foxglove_parses_every_field_by_its_own_definitions():
    names = "SceneUpdate", "CompressedImage", "FrameTransform"
    scene_class, image_class, frame_class = map(of_foxglove, names)
    srp = np.linspace(1.0, 2.0, AZIMUTHS.size)
    for state in STATES:
        for message in (*list(state_messages(state))[1:], log_messages.srp_message(state, AZIMUTHS, srp)):
            kind = {"foxglove.FrameTransform": frame_class}.get(message.schema_name, scene_class)
            json_format.Parse(json.dumps(as_protobuf_json(json.loads(message.data))), kind())
    sound = json.loads(log_messages.sound_message(10**9, np.array([0.5, -1.0, 2.0], np.float32), 8000).data)
    samples = json_format.Parse(json.dumps(as_protobuf_json(sound)), of_foxglove("RawAudio")()).data
    assert np.frombuffer(samples, "<i2").tolist() == [16384, -32768, 32767]
    image = json.loads(log_messages.image_message(1_500_000_000, b"\xff\xd8\xff").data)
    assert json_format.Parse(json.dumps(as_protobuf_json(image)), image_class()).data == b"\xff\xd8\xff"


def test_the_sound_of_a_log_is_that_of_the_first_microphone_that_hears(tmp_path):
    heard = np.stack([np.zeros(8000), np.full(8000, 0.5), np.zeros(8000)], axis=1)
    heard[::2, 1:] *= -1.0
    heard[:, 2] = 0.25 * heard[:, 1]
    soundfile.write(tmp_path / "a.wav", heard, 8000, subtype="FLOAT")
    with log_messages.recorded_sound(tmp_path / "a.wav") as sound_until:
        (first,) = sound_until(100_000_000)
    samples = np.frombuffer(base64.b64decode(json.loads(first.data)["data"]), "<i2")
    assert samples[:2].tolist() == [-16384, 16384]


def test_a_scene_shows_entities_searched_sectors_and_risks():
    drawn = [{item.id: item for item in scene_update(state).entities} for state in STATES]
    hidden = STATES[0]
    assert {"ego", "cue left", "cue right", "searched camera", "occluder corner_left"} <= set(drawn[0])
    assert f"entity {hidden.entities[0].id}" in drawn[0]
    assert "ADVISORY" in drawn[0]["cue left"].texts[0].text
    assert "ADVISORY" not in drawn[0]["cue right"].texts[0].text
    placed = STATES[-1].entities[0]
    box = drawn[-1][f"entity {placed.id}"].cubes[0].pose.position
    assert (box.x, box.y, box.z) == (*placed.position_m[:2], 0.75), "it stands on the road"
    assert len(drawn[-1][f"entity {placed.id}"].lines) == 1 + len(placed.forecast)


angles = st.floats(-math.pi, math.pi)


@settings(max_examples=15)
@given(angles, st.floats(0.01, 6.0))
def test_a_drawn_sector_goes_from_the_first_azimuth_to_the_left_until_the_second(first, width):
    last = math.remainder(first + width, math.tau)
    view = SearchedView("lidar", 0, False, 0.1, 0.1, (first, last))
    (item,) = [i for i in scene_update(WorldState(0, 0, searched=(view,))).entities if "lidar" in i.id]
    points = item.triangles[0].points
    turned = [(math.atan2(p.y, p.x) - first) % math.tau for p in points if math.hypot(p.x, p.y) > 1.0]
    turned = [0.0 if angle > math.tau - 1e-6 else angle for angle in turned]
    assert min(turned) == pytest.approx(0.0, abs=1e-6)
    assert max(turned) == pytest.approx(width, abs=1e-6)
    area = sum(
        0.5 * ((b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x))
        for a, b, c in zip(points[::3], points[1::3], points[2::3], strict=True)
    )
    assert area == pytest.approx(0.5 * width * 15.0**2, rel=0.01)


def test_the_layout_shows_topics_that_are_written(logged):
    layout = files("worldstate").joinpath("data/foxglove_layout.json").read_text("utf-8")
    panels = json.loads(layout)["configById"]
    written = {topic for topic, _, _ in messages(logged[0])}
    shown = {*panels["3D!worldstate"]["topics"], panels["Image!camera"]["imageMode"]["imageTopic"]}
    shown.add(panels["Audio!sound"]["topic"])
    plots = [path["value"] for name in panels for path in panels[name].get("paths", ())]
    assert shown | {plot.split(".")[0] for plot in plots} == written


def test_a_log_that_was_cut_anywhere_is_read_up_to_its_last_whole_chunk(logged, tmp_path, caplog):
    """The log is cut within a chunk, a head, the index and the footer."""
    path, whole = tmp_path / "cut.mcap", logged[0].read_bytes()
    written, before = logged[1].read_text().splitlines(), 0
    for end in [*range(0, len(whole), 1009), *range(len(whole) - 3000, len(whole), 7)]:
        path.write_bytes(whole[:end])
        try:
            lines = [line for line, _ in read_log(path)]
        except InputFileError as error:
            assert not before and ("its first whole chunk" in str(error) or "got none" in str(error))
            continue
        assert lines == written[: len(lines)] and len(lines) >= before
        before = len(lines)
        assert "it was cut" in caplog.text
        caplog.clear()
    assert before == len(written)


def printed_by_rerun(path):
    """Check a recording with Rerun's command line; return its output."""
    said = ""
    for word in ("verify", "print"):
        command = [sys.executable, "-m", "rerun", "rrd", word, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
        said += done.stdout + done.stderr
    assert "verified without error" in said
    return said


def test_a_rerun_recording_has_the_scene_the_power_and_the_images(tmp_path):
    pytest.importorskip("rerun")
    states, out = tmp_path / "states.jsonl", tmp_path / "out.rrd"
    write_states(states, STATES)
    assert main(["log", "replay", str(states), "--export", f"rerun={out}"]) == 0
    printed = printed_by_rerun(out)
    paths = set(re.findall(r" - (/worldstate/\S*) - ", printed))
    assert "/worldstate/snapshot" in paths
    for name in {item.id for state in STATES for item in scene_update(state).entities}:
        assert any(path.startswith(f"/worldstate/scene/{name.replace(' ', '/')}/") for path in paths), name
    for kind in ("Mesh3D:triangle_indices", "LineStrips3D:strips", "Points3D:labels", "Clear:is_recursive"):
        assert kind in printed
    with log_messages.rerun_file(out) as write:
        write(log_messages.srp_message(STATES[0], AZIMUTHS, np.ones(181)))
        write(log_messages.image_message(10**9, b"\xff\xd8\xff\xe0 a jpeg"))
    printed = printed_by_rerun(out)
    assert "/worldstate/srp/srp/lines" in printed
    assert re.search(r"/camera/image - .*EncodedImage:blob", printed)


def client_of(port, *origins, **more):
    # The case of a header's name does not matter.
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


def test_a_viewer_receives_snapshots_with_their_times():
    first, second, third = scripted_states()[:3]
    with live_server(0) as (send, port), client_of(port) as client:
        for message in state_messages(first):
            send(message)
        snapshot = subscribed(client, "/worldstate/snapshot")["/worldstate/snapshot"]
        assert (snapshot["encoding"], snapshot["schemaName"]) == ("json", "worldstate.Snapshot")
        assert json.loads(snapshot["schema"])["properties"]["stamp_ns"]["type"] == "integer"
        for state in (second, third):
            data = b""
            # A subscription has no answer, so the first messages may be sent before it is effective.
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
        assert time.monotonic() - begun_s >= (states[3].stamp_ns - states[0].stamp_ns) / 1e9


def test_a_taken_port_raises_an_error():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InvalidArgumentError, match=f"free port, got {port}"), live_server(port):
            pass


@pytest.mark.parametrize(
    ("origins", "taken"),
    [
        ([], True),
        (["https://app.foxglove.dev"], True),
        (["http://localhost", "https://evil.example"], False),
        (["https://app.foxglove.dev.evil.example"], False),
    ],
)
def test_web_pages_of_other_origins_are_refused(origins, taken):
    with live_server(0, origins=["https://app.foxglove.dev"]) as (_, port):
        if taken:
            with client_of(port, *origins) as client:
                assert received(client)["op"] == "serverInfo"
        else:
            with pytest.raises(InvalidStatus, match="403"):
                client_of(port, *origins)


def test_other_requests_and_viewers_beyond_the_limit_are_refused():
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
    """Open connections with incomplete requests, one from each numbered address."""
    asked = []
    for one in number:
        asked.append(socket.socket())
        asked[-1].bind((f"127.0.0.{one}", 0))
        asked[-1].connect(("127.0.0.1", port))
        asked[-1].sendall(b"GET / HTTP/1.1\r\n")
    return asked


@pytest.mark.parametrize("number", [[1] * 40, range(2, 130)])
def test_incomplete_requests_do_not_block_viewers(number):
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


def test_a_request_has_one_deadline(monkeypatch):
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


def test_a_viewer_that_reads_nothing_delays_no_message_and_is_disconnected(monkeypatch):
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
