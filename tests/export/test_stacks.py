"""Exports to OSI, Autoware and ODAS, read by their own packages or by parsers after their definitions."""

import argparse
import io
import json
import math
import re
import socket
import time
import uuid
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader
from osi3.osi_sensordata_pb2 import SensorData
from scripted_states import EGO, scripted_states, write_states

from worldstate.adapters.export import other_stacks
from worldstate.adapters.export.other_stacks import autoware_objects, lane_objects, osi_sensor_data
from worldstate.adapters.ros import message_types as types
from worldstate.cli.common.exports import open_exports
from worldstate.cli.main import main
from worldstate.ground.errors import InvalidArgumentError

STATES = scripted_states()
HIDDEN, PLACED = STATES[0], STATES[-1]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_states(tmp_path_factory.mktemp("stacks") / "states.jsonl", STATES)


def replayed(log, export, *options):
    assert main(["log", "replay", str(log), "--export", export, *options]) == 0


def test_osi_reads_the_trace_and_finds_every_entity(log, tmp_path):
    from osi3trace.osi_trace import OSITrace

    replayed(log, f"osi={tmp_path / 'out.osi'}", "--crossing", "7")
    found = list(OSITrace(str(tmp_path / "out.osi"), type_name="SensorData"))
    assert [stamp_of(one.timestamp) for one in found] == [state.stamp_ns for state in STATES]
    for message, state in zip(found, STATES, strict=True):
        moving = [one for one in state.entities if one.moving]
        for told, entity in zip(message.moving_object, moving, strict=True):
            assert told.header.existence_probability == entity.existence_probability
            azimuth = math.atan2(told.base.position.y, told.base.position.x)
            assert azimuth == pytest.approx(entity.azimuth_rad, abs=0.05)
    first = found[0].moving_object[0]
    assert first.header.measurement_state == first.header.MEASUREMENT_STATE_PREDICTED
    assert first.base.position.x == pytest.approx(7.0)
    assert first.base.velocity.y < 0.0, "it is hidden on the left and comes towards the axis"
    last = found[-1].moving_object[0]
    assert last.header.measurement_state == last.header.MEASUREMENT_STATE_MEASURED
    assert (last.base.position.x, last.base.position.y) == PLACED.entities[0].position_m[:2]
    assert last.base.position.z == 0.5 * last.base.dimension.height, "it is the middle of the box"
    car, unknown = last.candidate
    assert (car.probability, unknown.probability) == (0.7, 0.3)
    assert car.vehicle_classification.type == car.vehicle_classification.TYPE_CAR
    assert found[-2].moving_object[0].header.tracking_id == last.header.tracking_id


def test_osi_reads_its_mcap_under_its_own_name(log, tmp_path):
    from google.protobuf import __version__ as protobuf
    from osi3trace.osi_trace import OSITrace

    replayed(log, f"osi={tmp_path / 'street.mcap'}")
    (path,) = tmp_path.iterdir()
    pattern = r"\d{8}T\d{6}Z_sd_3\d\d_" + protobuf.replace(".", "") + rf"_{len(STATES)}_street\.mcap"
    assert re.fullmatch(pattern, path.name)
    trace = OSITrace(str(path), type_name="SensorData")
    assert list(trace) == [osi_sensor_data(state) for state in STATES]
    (about,) = trace.get_file_metadata()
    versions = {"version"} | {f"{end}_{of}_version" for end in ("min", "max") for of in ("osi", "protobuf")}
    assert (about.name, set(about.metadata)) == ("net.asam.osi.trace", versions)
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", version) for version in about.metadata.values())
    channel = "net.asam.osi.trace.channel"
    assert set(trace.get_channel_metadata()) == {f"{channel}.osi_version", f"{channel}.protobuf_version"}
    trace.close()


# Ranges in OSI's definitions, by field.
OSI_RANGES = {
    "nanos": (0, 999_999_999), "seconds": (0, math.inf), "probability": (0.0, 1.0), "age": (0.0, math.inf),
    "existence_probability": (0.0, 1.0), "length": (0.0, math.inf), "width": (0.0, math.inf),
    "height": (0.0, math.inf), "yaw": (-math.pi, math.pi), "pitch": (-math.pi, math.pi),
    "roll": (-math.pi, math.pi), "value": (0, 2**64 - 2),
}  # fmt: skip
OSI_WHOLE = {"Vector3d", "Orientation3d", "Dimension3d", "Timestamp", "InterfaceVersion", "MountingPosition"}
OSI_NEEDED = {
    "SensorData": "version timestamp sensor_id mounting_position last_measurement_time moving_object_header",
    "DetectedEntityHeader": "measurement_time cycle_counter data_qualifier",
    "DetectedMovingObject": "header base base_rmse movement_state candidate",
    "DetectedItemHeader": "tracking_id existence_probability age measurement_state",
    "BaseMoving": "position",
    "CandidateMovingObject": "probability type",
}


def osi_faults(message, place="SensorData"):
    """Yield the faults of a message and of the messages in it by the rules of OSI."""
    kind, filled = message.DESCRIPTOR, {field.name: value for field, value in message.ListFields()}
    named = OSI_NEEDED.get(kind.name, "").split()
    needed = [field.name for field in kind.fields] if kind.name in OSI_WHOLE else named
    yield from (f"{place}: {name} is not set" for name in set(needed) - filled.keys())
    for field, value in message.ListFields():
        for number, part in enumerate(value if field.is_repeated else [value]):
            inner = f"{place}.{field.name}[{number}]"
            if field.message_type is not None:
                yield from osi_faults(part, inner)
            elif field.enum_type is not None:
                if part == 0 and field.name != "type":
                    yield f"{inner} is unknown"
            else:
                low, high = OSI_RANGES.get(field.name, (-math.inf, math.inf))
                if not low <= part <= high:
                    yield f"{inner} is {part}"


def stamp_of(time):
    return time.seconds * 10**9 + time.nanos


def test_osi_messages_keep_the_rules_of_its_definitions():
    both = HIDDEN.entities[0]
    several = tuple(replace(both, id=str(uuid.uuid5(uuid.NAMESPACE_OID, str(k)))) for k in range(5))
    no_class = replace(PLACED, entities=(replace(PLACED.entities[0], classification=()),))
    before = -1
    later = [replace(no_class, stamp_ns=10**10), replace(HIDDEN, stamp_ns=10**11, entities=several)]
    for state in [*STATES, *later]:
        message = osi_sensor_data(state)
        assert list(osi_faults(message)) == []
        assert (message.version.version_major, message.version.version_minor) >= (3, 8)
        measured = stamp_of(message.moving_object_header.measurement_time)
        assert before < measured <= stamp_of(message.last_measurement_time) <= stamp_of(message.timestamp)
        before = stamp_of(message.timestamp)
        numbers = [one.header.tracking_id.value for one in message.moving_object]
        assert len(numbers) == len(set(numbers)) == sum(one.moving for one in state.entities)
        for one in message.moving_object:
            assert sum(kind.probability for kind in one.candidate) == pytest.approx(1.0)
            assert one.base_rmse.position.z > 0.0


@settings(max_examples=30)
@given(st.floats(-1.3, 1.3), st.floats(-0.5, 0.5), st.floats(0.0, 15.0), st.floats(-0.3, 0.3))
def test_a_moving_ego_does_not_move_a_vehicle_out_of_its_lane(azimuth, rate, speed, turning):
    ego = replace(EGO, speed_mps=speed, yaw_rate_rad_s=turning)
    seen = replace(STATES[-2].entities[0], azimuth_rad=azimuth, azimuth_rate_rad_s=rate)
    state = replace(STATES[-2], entities=(seen,), ego=ego)
    base = osi_sensor_data(state).moving_object[0].base
    x, y, vx, vy = base.position.x, base.position.y, base.velocity.x, base.velocity.y
    # OSI's velocity is relative to the axes of the vehicle, so it gives the observed azimuth rate.
    assert (x * vy - y * vx) / (x * x + y * y) == pytest.approx(rate, abs=1e-9)
    (one,) = lane_objects(state)
    assert one.velocity_mps[0] == pytest.approx(0.0, abs=1e-9), "over ground it stays in its lane"


def without_type(fields):
    return {name: value for name, value in fields.items() if name != "__msgtype__"}


def test_autoware_objects_have_the_fields_of_the_message_and_the_path_of_the_lane(log, tmp_path):
    replayed(log, f"autoware={tmp_path / 'objects.jsonl'}")
    lines = (tmp_path / "objects.jsonl").read_text().splitlines()
    assert len(lines) == len(STATES)
    for line, state in zip(lines, STATES, strict=True):
        told = json.loads(line)
        # The type of ROS is the oracle: no field is missing or unknown, and each value is of its type.
        typed = types.message(types.OBJECTS, told)
        assert len(types.typestore().serialize_cdr(typed, types.OBJECTS)) > 20
        again = json.dumps(asdict(typed), default=np.ndarray.tolist)
        assert json.loads(again, object_hook=without_type) == told
        ids = [str(uuid.UUID(bytes=bytes(one["object_id"]["uuid"]))) for one in told["objects"]]
        assert ids == [one.id for one in state.entities if one.moving]
        assert told["header"]["frame_id"] == "map"
    (path,) = json.loads(lines[0])["objects"][0]["kinematics"]["predicted_paths"]
    # The car stands at (100, 50) with its front along y: ahead of it is y, to its right x.
    ahead = [pose["position"]["y"] - 50.0 for pose in path["path"]]
    across = [100.0 - pose["position"]["x"] for pose in path["path"]]
    assert ahead == pytest.approx([9.0] * 7)
    assert np.diff(across) == pytest.approx(-0.5 * 0.5 * 9.0), "at the pace of the usual corner"
    assert across[0] > 0.0, "it is hidden on the left"
    for line in lines:
        for one in json.loads(line)["objects"]:
            poses = one["kinematics"]["predicted_paths"][0]["path"]
            at = one["kinematics"]["initial_pose_with_covariance"]["pose"]
            assert {pose["position"]["z"] for pose in (at, *poses)} == {0.5 * one["shape"]["dimensions"]["z"]}


@settings(max_examples=20)
@given(st.floats(-3.1, 3.1), st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
def test_objects_in_the_map_have_the_uncertainty_of_object_and_ego(yaw, x, y):
    ego = replace(EGO, position_m=(x, y), yaw_rad=yaw, covariance=((0.09, 0, 0), (0, 0.09, 0), (0, 0, 0.01)))
    known = tuple(map(tuple, np.diag([0.25, 1.0, 1.0, 1.0]).tolist()))
    certain = replace(PLACED.entities[0], covariance=known)
    (one,) = autoware_objects(replace(PLACED, entities=(certain,), ego=ego))["objects"]
    pose = one["kinematics"]["initial_pose_with_covariance"]
    at = complex(pose["pose"]["position"]["x"], pose["pose"]["position"]["y"])
    seen_m = (at - complex(x, y)) * np.exp(-1j * yaw)
    assert (seen_m.real, seen_m.imag) == pytest.approx(certain.position_m[:2])
    turned = 2.0 * math.atan2(pose["pose"]["orientation"]["z"], pose["pose"]["orientation"]["w"])
    assert np.exp(1j * turned) == pytest.approx(np.exp(1j * (yaw - 0.5 * np.pi))), "it drives to the right"
    # An error of the car's yaw moves the object by its range.
    trace = sum(np.reshape(pose["covariance"], (6, 6)).diagonal()[:2])
    range_m = math.hypot(*certain.position_m[:2])
    assert trace == pytest.approx(0.25 + 1.0 + 2 * 0.09 + 0.01 * range_m**2)


def exporting(export, live=True, odometry=None):
    asked = {"export": [export], "origin": [], "rotate_mib": None, "odometry": odometry}
    return open_exports(argparse.Namespace(**asked), live=live)


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("ego", [None, replace(EGO, localised=False)])
def test_objects_without_a_pose_in_the_map_are_refused(ego, live, tmp_path):
    nowhere, out = replace(HIDDEN, ego=ego), tmp_path / "objects.jsonl"
    words = "expected odometry with x_m, y_m and yaw_rad"
    with pytest.raises(InvalidArgumentError, match=words), exporting(f"autoware={out}", live) as exports:
        exports.state(nowhere)
    assert live or not out.exists()
    # A pose that is lost during the run, or not known yet, does not end the run.
    for first, odometry in [(HIDDEN, None)] + [(nowhere, "127.0.0.1:9000")] * live:
        with exporting(f"autoware={out}", live, odometry) as exports:
            for state in (first, replace(nowhere, seq=90), PLACED):
                exports.state(state)
        assert len(out.read_text().splitlines()) == 1 + (first is HIDDEN)


@pytest.mark.parametrize("target", ["autoware=out.jsonl", "mot=out.txt", "osi=out.osi", "osi=out.mcap"])
def test_files_of_a_live_run_can_be_read_during_the_run(target, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with exporting(target) as exports:
        for seq in range(40):
            exports.state(replace(PLACED, seq=seq, stamp_ns=seq * 10**8))
        kept = (tmp_path / target.partition("=")[2]).read_bytes()
    assert kept.count(b"\n") == 40 or len(osi_messages(kept, target)) >= 30


def osi_messages(kept, target):
    """Return the messages of an unfinished trace."""
    found = []
    if target.endswith("mcap"):
        reader = NonSeekingReader(io.BytesIO(kept))
        with suppress(EndOfFile):
            found.extend(message.data for *_, message in reader.iter_messages(log_time_order=False))
    while target.endswith("osi") and kept:
        end = 4 + int.from_bytes(kept[:4], "little")
        found, kept = [*found, kept[4:end]], kept[end:]
    return [SensorData.FromString(one) for one in found]


def stops_for(message, least_confidence=0.05, kinds=(0, 1, 2, 3, 4, 5, 6)):
    """Return the objects for which Autoware's intersection module stops, including unknown ones."""
    return [
        one
        for one in message["objects"]
        if one["classification"][0]["label"] in kinds
        and any(path["confidence"] >= least_confidence for path in one["kinematics"]["predicted_paths"])
    ]


def test_an_existence_of_five_per_cent_stops_no_planner():
    faint = replace(HIDDEN.entities[0], existence_probability=0.05, hidden_probability=0.05, sides=())
    likely = replace(faint, existence_probability=0.9, hidden_probability=0.9)
    cue = next(one for one in HIDDEN.cues if one.direction == faint.direction)
    for entity, within, minded in ((faint, 0.04, 0), (likely, 0.04, 0), (likely, 0.6, 1)):
        state = replace(HIDDEN, entities=(entity,), cues=(replace(cue, within={"3": within}),))
        message = autoware_objects(state)
        assert len(stops_for(message)) == minded
        (path,) = message["objects"][0]["kinematics"]["predicted_paths"]
        assert path["confidence"] == pytest.approx(within)
    in_view = replace(PLACED, entities=(replace(PLACED.entities[0], existence_probability=0.04),))
    assert not stops_for(autoware_objects(in_view)), "only the existence of a visible vehicle matters"


@settings(max_examples=30)
@given(st.floats(-3.1, 3.1), st.floats(0.001, 0.05), st.floats(3.0, 30.0))
def test_a_vehicle_without_a_range_keeps_its_azimuth_and_deviation_in_the_lane(azimuth, std, crossing):
    entity = replace(HIDDEN.entities[0], azimuth_rad=azimuth, azimuth_std_rad=std)
    (one,) = lane_objects(replace(HIDDEN, entities=(entity,)), crossing)
    x, y = one.position_m
    assert math.atan2(y, x) == pytest.approx(azimuth, abs=1e-9)
    if abs(azimuth) < math.radians(79.0):
        assert x == pytest.approx(crossing)
    # By linear propagation, the gradient of atan2 gives the deviation of the azimuth again.
    gradient = np.array([-y, x]) / (x * x + y * y)
    assert math.sqrt(gradient @ one.covariance @ gradient) == pytest.approx(std, rel=1e-6)
    assert np.linalg.eigvalsh(one.covariance).min() >= -1e-9


def test_sizes_and_the_order_of_labels_are_those_of_the_likeliest_class():
    seen = PLACED.entities[0]
    for classes, shares in (
        (seen.classification, [(1, 0.7), (0, 0.3)]),
        (seen.classification[::-1], [(1, 0.7), (0, 0.3)]),
        ((), [(0, 1.0)]),
    ):
        state = replace(PLACED, entities=(replace(seen, classification=classes),))
        (told,) = autoware_objects(state)["objects"]
        assert [(one["label"], one["probability"]) for one in told["classification"]] == shares
        assert told["shape"]["dimensions"]["x"] == 4.5


class OdasStudio:
    """The rule by which ODAS Studio's socket handler splits the received text into messages."""

    def __init__(self):
        self.rest, self.messages = "", []

    def take(self, text):
        *whole, self.rest = (self.rest + text).split("}\n{")
        for part in whole:
            opened = part if part.startswith("{") else "{" + part
            self.messages.append(opened if "}" in opened[-3:-1] else opened + "}")


def test_a_receiver_that_disconnects_does_not_end_a_live_run(monkeypatch):
    monkeypatch.setattr(other_stacks, "AGAIN_S", 0.05)
    server = socket.create_server(("127.0.0.1", 0))
    address = f"127.0.0.1:{server.getsockname()[1]}"
    with server, other_stacks.odas_socket(address, live=True) as send:
        first, _ = server.accept()
        send(HIDDEN)
        assert first.recv(10)
        first.close()
        server.settimeout(0.1)
        until_s, again = time.monotonic() + 20.0, None
        while again is None and time.monotonic() < until_s:
            send(HIDDEN)
            with suppress(TimeoutError):
                again, _ = server.accept()
        send(HIDDEN)
        again.settimeout(20.0)
        assert again.recv(10)
        again.close()


def test_a_receiver_that_reads_nothing_delays_no_state():
    server = socket.create_server(("127.0.0.1", 0))
    target = server.getsockname()
    with server, other_stacks.LiveSender(target, socket.create_connection(target, 10.0)) as sender:
        begun_s = time.monotonic()
        for _ in range(100):
            sender.put(bytes(1 << 20))
        assert time.monotonic() - begun_s < 5.0
        assert sender.dropped >= 50


def test_odas_studio_gets_tracks_that_keep_their_numbers(log):
    studio = OdasStudio()
    with socket.create_server(("127.0.0.1", 0)) as server:
        # The system accepts the connection and holds the few messages.
        replayed(log, f"odas=127.0.0.1:{server.getsockname()[1]}")
        connection, _ = server.accept()
        with connection, connection.makefile() as sent:
            studio.take(sent.read() + "{")
    tracks = [json.loads(one) for one in studio.messages]
    assert [one["timeStamp"] for one in tracks] == [state.seq for state in STATES]
    for one, state in zip(tracks, STATES, strict=True):
        assert len(one["src"]) == 4
        assert set(one["src"][0]) == {"id", "tag", "x", "y", "z", "activity"}
        assert math.hypot(one["src"][0]["x"], one["src"][0]["y"]) == pytest.approx(1.0, abs=1e-3)
        assert [track["id"] > 0 for track in one["src"]] == [k < len(state.entities) for k in range(4)]
    assert tracks[0]["src"][0]["id"] == tracks[-1]["src"][0]["id"]


@given(st.lists(st.integers(0, 5), min_size=1, max_size=6), st.sets(st.integers(0, 3000), max_size=8))
def test_odas_messages_are_whole_however_the_stream_is_cut(vehicles, cuts):
    one, tracks = HIDDEN.entities[0], other_stacks.OdasTracks()
    ticks = [
        replace(HIDDEN, seq=tick, entities=tuple(replace(one, id=f"entity-{k}") for k in range(many)))
        for tick, many in enumerate(vehicles)
    ]
    stream, studio, ends = "".join(map(tracks.message, ticks)) + "{", OdasStudio(), [0, *sorted(cuts), None]
    for first, end in pairwise(ends):
        studio.take(stream[first:end])
    found = [json.loads(message) for message in studio.messages]
    assert [message["timeStamp"] for message in found] == list(range(len(vehicles)))
    sources = [sum(source["id"] > 0 for source in message["src"]) for message in found]
    assert sources == [min(many, 4) for many in vehicles]


def test_numbers_of_tracks_are_used_once_and_forgotten():
    tracks, numbers = other_stacks.OdasTracks(), []
    with_entity = next(state for state in STATES if state.entities)
    for hop in range(200):
        one = replace(with_entity.entities[0], id=f"entity-{hop}", moving=True)
        message = json.loads(tracks.message(replace(with_entity, entities=(one,))))
        numbers.append(message["src"][0]["id"])
    assert numbers == list(range(1, 201)) and not tracks._numbers.of(replace(with_entity, entities=()))


def test_mot_text_has_a_row_for_each_position(tmp_path):
    """A row has ten numbers; the second of three states has no distance, and one track keeps its number."""
    only_heard = replace(HIDDEN.entities[0], id="heard")
    lost = replace(only_heard, id="a")
    first, last, other = (
        replace(PLACED.entities[0], id=name, position_m=(x, y, 0.0), existence_probability=exists)
        for name, x, y, exists in (("a", 8.0, 4.4, 0.9), ("a", 7.0, 4.0, 0.9), ("b", 9.0, -3.0, 0.25))
    )
    entities = [(first, only_heard), (lost,), (last, other)]
    states = [replace(PLACED, seq=k, entities=each) for k, each in enumerate(entities)]
    replayed(write_states(tmp_path / "states.jsonl", states), f"mot={tmp_path / 'tracks.txt'}")
    table = np.loadtxt(tmp_path / "tracks.txt", delimiter=",", ndmin=2)
    assert table.shape == (3, 10)
    assert table[:, 0].tolist() == [1, 3, 3] and (table[:, 2:6] == -1).all()
    assert table[:, 1].tolist() == [1, 1, 3], "a number stays with its entity"
    assert table[:, 6:].tolist() == [[0.9, 8.0, 4.4, 0.0], [0.9, 7.0, 4.0, 0.0], [0.25, 9.0, -3.0, 0.0]]


def test_a_missing_listener_and_a_crossing_at_the_ego_raise_an_error(log, tmp_path, refused):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    for options, said in (
        (["--export", f"odas=127.0.0.1:{port}"], "expected a listener at"),
        (["--export", f"osi={tmp_path / 'out.osi'}", "--crossing", "0"], "--crossing"),
    ):
        assert said in refused(["log", "replay", str(log), *options])
