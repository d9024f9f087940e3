"""Bags of ROS 2: written ones in other readers, and read ones as recordings."""

import json
import logging
import math
import re
import shutil
import sqlite3
import struct
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scripted_states import scripted_states

from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.export.other_stacks import autoware_objects
from worldstate.adapters.export.scene import scene_update
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.odometry_file import OdometryLog
from worldstate.adapters.ros.bag_input import needed_array, read_bag
from worldstate.adapters.ros.bag_writer import bag_writer, state_bag
from worldstate.adapters.ros.message_types import AUDIO, DETECTIONS, ODOMETRY, header
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError
from worldstate.measurement.odometry import Odometry

RATE_HZ, CHANNELS = 8000, 4
STATES = [replace(state, stamp_ns=state.stamp_ns + 1_700_000_000 * 10**9) for state in scripted_states()]


def sound_of(n_samples: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.5, 0.5, (n_samples, CHANNELS)).astype(np.float32)


def block(samples: np.ndarray, stamp_ns: int, **changed: object) -> dict[str, object]:
    layout = {"sample_rate": RATE_HZ, "channels": samples.shape[1], "layout": "interleaved"}
    return {"header": header(stamp_ns), "data": samples.ravel()} | layout | changed


def write_blocks(path: Path, samples: np.ndarray, *, lost: tuple[int, ...] = (), **changed: object) -> Path:
    """Write sound in blocks of 0.1 s from 5 s on."""
    with bag_writer(path) as write:
        for k, start in enumerate(range(0, len(samples), RATE_HZ // 10)):
            if k not in lost:
                stamp_ns = 5_000_000_000 + k * 100_000_000
                part = samples[start : start + RATE_HZ // 10]
                write("/mics", AUDIO, stamp_ns, block(part, stamp_ns, **changed))
    return path


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def written(request, tmp_path_factory):
    """Write states as a bag in each storage."""
    path = tmp_path_factory.mktemp("bag") / "states"
    with state_bag(path, 7.0, request.param) as write:
        for state in STATES:
            write(state)
    return path


def read_by_others(path: Path) -> list[tuple[str, int, object]]:
    """Return topic, time and message of a bag by Foxglove's MCAP reader or the SQLite reader of rosbags."""
    (storage,) = (file for file in path.iterdir() if file.suffix != ".yaml")
    if storage.suffix == ".mcap":
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory

        with storage.open("rb") as file:
            found = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
            return [(channel.topic, said.log_time, message) for _, channel, said, message in found]
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as bag:
        return [(one.topic, time, bag.deserialize(data, one.msgtype)) for one, time, data in bag.messages()]


def test_other_readers_find_the_values_of_the_states(written):
    read = read_by_others(written)
    planners = "/perception/object_recognition/objects"
    for topic in ("/worldstate/advisories", planners, "/worldstate/markers"):
        times = [time for name, time, _ in read if name == topic]
        assert times == [state.stamp_ns for state in STATES]
    advisories = [message for name, _, message in read if name.endswith("advisories")]
    for message, state in zip(advisories, STATES, strict=True):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == state.stamp_ns
        assert message.header.frame_id == "base_link"
        assert [one.direction for one in message.advisories] == [cue.direction for cue in state.cues]
        for told, cue in zip(message.advisories, state.cues, strict=True):
            assert (told.risk, told.azimuth, told.raised) == (
                cue.risk,
                cue.azimuth_rad,
                cue.advisory is not None,
            )
            assert dict(zip(told.horizon, told.within, strict=True)) == {
                float(after): share for after, share in (cue.within or {}).items()
            }
            assert list(told.alpha) == ([] if cue.alpha is None else [cue.alpha]), "unknown is empty, not 0"
    assert any(one.raised for message in advisories for one in message.advisories)


def test_objects_in_the_bag_are_those_of_autoware(written):
    found = [message for name, _, message in read_by_others(written) if name.endswith("objects")]
    for message, state in zip(found, STATES, strict=True):
        wanted = autoware_objects(state, 7.0)["objects"]
        assert [bytes(one.object_id.uuid) for one in message.objects] == [
            bytes(one["object_id"]["uuid"]) for one in wanted
        ]
        for one, said in zip(message.objects, wanted, strict=True):
            assert one.existence_probability == pytest.approx(said["existence_probability"], rel=1e-6)
            at = said["kinematics"]["initial_pose_with_covariance"]
            pose = one.kinematics.initial_pose_with_covariance
            assert pose.pose.position.y == at["pose"]["position"]["y"]
            assert list(pose.covariance) == at["covariance"]
            assert len(one.kinematics.predicted_paths[0].path) == 7


def test_markers_replace_those_of_the_last_scene(written):
    for _, _, message in (one for one in read_by_others(written) if one[0].endswith("markers")):
        first, *drawn = message.markers
        assert first.action == 3, "all that was there goes"
        assert len({(one.ns, one.id) for one in drawn}) == len(drawn), "RViz would draw one of two"
        assert all(max(one.scale.x, one.scale.y, one.scale.z) > 0.0 and one.color.a > 0.0 for one in drawn)
    scene = scene_update(STATES[-1])
    assert {one.ns for one in drawn} == {item.id for item in scene.entities}
    areas = [one for one in drawn if one.type == 11]
    assert sum(len(one.points) for one in areas) == sum(
        len(area.points) for item in scene.entities for area in item.triangles
    )


def test_replay_of_folder_and_file_gives_the_written_states(written, tmp_path, capsys):
    (storage,) = (file for file in written.iterdir() if file.suffix != ".yaml")
    for log in (written, storage):
        assert main(["log", "replay", str(log), "--out", str(tmp_path / "states.jsonl")]) == 0
        assert (tmp_path / "states.jsonl").read_text().splitlines() == [state.to_json() for state in STATES]
    write_blocks(tmp_path / "sound", sound_of(RATE_HZ))
    capsys.readouterr()
    assert main(["log", "replay", str(tmp_path / "sound")]) == 2
    assert "expected snapshots, got none" in capsys.readouterr().err


def test_messages_have_the_layout_of_cdr(tmp_path):
    """Parsed by hand: header of 4 bytes, little endian, values at multiples of their size."""
    samples = sound_of(3)
    with bag_writer(tmp_path / "one", "sqlite3") as write:
        write("/mics", AUDIO, 1_500_000_000, block(samples, 1_500_000_000))
    with sqlite3.connect(tmp_path / "one" / "one.db3") as database:
        ((data,),) = database.execute("select data from messages").fetchall()
    assert data[:4] == b"\x00\x01\x00\x00"
    body = data[4:]
    sec, nanosec, size = struct.unpack_from("<iII", body, 0)
    assert (sec, nanosec, body[12 : 12 + size]) == (1, 500_000_000, b"base_link\x00")
    at = (12 + size + 3) // 4 * 4
    rate, channels = struct.unpack_from("<IH", body, at)
    assert (rate, channels) == (RATE_HZ, CHANNELS)
    at = (at + 6 + 3) // 4 * 4
    (size,) = struct.unpack_from("<I", body, at)
    assert body[at + 4 : at + 4 + size] == b"interleaved\x00"
    at = (at + 4 + size + 3) // 4 * 4
    (count,) = struct.unpack_from("<I", body, at)
    assert body[at + 4 :] == samples.tobytes()
    assert count == samples.size


@pytest.fixture(scope="module")
def bag_of_approach(approach, tmp_path_factory):
    path = tmp_path_factory.mktemp("approach") / "street"
    assert main(["sim", "to-bag", str(approach.folder), str(path), "--start", "1700000000"]) == 0
    return path


def test_the_bag_of_a_recording_has_the_frames_of_array_and_camera(bag_of_approach):
    """The chain of frames ends at `base_link`; rotations of SciPy are the oracle."""
    read = read_by_others(bag_of_approach)
    ((_, stamp_ns, told),) = (one for one in read if one[0] == "/tf_static")
    assert stamp_ns == min(time for _, time, _ in read), "before all that stands in these frames"
    found = {one.child_frame_id: one for one in told.transforms}
    assert {one.header.frame_id for one in told.transforms} == {"base_link"}
    frames = {message.header.frame_id for name, _, message in read if name.endswith(("audio", "detections"))}
    assert frames == set(found)
    (places,) = (message.positions for name, _, message in read if name.endswith("array"))
    middle = np.mean([[one.x, one.y, one.z] for one in places], axis=0)
    at = found["microphones"].transform
    assert [at.translation.x, at.translation.y, at.translation.z] == pytest.approx(middle)
    assert at.rotation.w == 1.0
    seen, camera = found["camera"].transform, PinholeCamera.ovad()
    assert (seen.translation.x, seen.translation.y, seen.translation.z) == camera.position_m
    turn = Rotation.from_quat([seen.rotation.x, seen.rotation.y, seen.rotation.z, seen.rotation.w])
    up = camera.pitch_rad
    assert turn.apply([1.0, 0.0, 0.0]) == pytest.approx([math.cos(up), 0.0, math.sin(up)])
    assert turn.apply([0.0, 1.0, 0.0]) == pytest.approx([0.0, 1.0, 0.0])
    # 1 is TRANSIENT_LOCAL, without which a player sends the one message only to existing subscribers.
    assert (bag_of_approach / "metadata.yaml").read_text().count("durability: 1") == 1


@pytest.mark.long
def test_a_recording_and_its_bag_give_the_same_states(approach, bag_of_approach, tmp_path):
    out, again = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    assert main(["run", str(approach.folder), "--out", str(out)]) == 0
    assert (
        main(["run", str(bag_of_approach), "--out", str(again), "--export", f"rosbag={tmp_path / 'c'}"]) == 0
    )
    of_folder, of_bag = ([json.loads(line) for line in path.open()] for path in (out, again))
    assert len(of_folder) == len(of_bag) > 50
    for one, other in zip(of_folder, of_bag, strict=True):
        assert other["stamp_ns"] - one["stamp_ns"] == 1_700_000_000 * 10**9
        assert other["context"]["ego_speed_mps"] == 0.0, "the odometry of a standing ego"
        assert [cue["advisory"] is None for cue in one["cues"]] == [
            cue["advisory"] is None for cue in other["cues"]
        ]
        for cue, as_before in zip(one["cues"], other["cues"], strict=True):
            # Seconds since 1970 have a resolution of 240 ns, in which a belief changes by at most 1 per s,
            # and the learned traffic, which is published in steps, may take its next step.
            assert cue["risk"] == pytest.approx(as_before["risk"], abs=1e-4)
        assert [one["status"] for one in one["entities"]] == [one["status"] for one in other["entities"]]
    # The bag has no pose in the map, without which there are no objects for a planner.
    assert len(read_by_others(tmp_path / "c")) == 3 * len(of_bag)
    replayed = tmp_path / "d.jsonl"
    assert main(["log", "replay", str(tmp_path / "c"), "--out", str(replayed)]) == 0
    assert replayed.read_bytes() == again.read_bytes()


def test_other_commands_use_the_array_of_a_bag(bag_of_approach, tmp_path, capsys):
    assert main(["array", "bearings", str(bag_of_approach), "--out", str(tmp_path / "b.csv"), "--json"]) == 0
    assert "56 microphones" in capsys.readouterr().out
    assert len((tmp_path / "b.csv").read_text().splitlines()) > 50


def test_the_camera_of_a_bag_labels_its_street(approach, bag_of_approach, tmp_path, capsys):
    for name, path in (("folder", approach.folder), ("bag", bag_of_approach)):
        assert main(["street", "label", str(path), "--out", str(tmp_path / name), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["n_passes"] == 1
    of_folder, of_bag = (json.loads((tmp_path / name).read_text())["openlabel"] for name in ("folder", "bag"))
    (one,), (other,) = (label["objects"].values() for label in (of_folder, of_bag))
    assert (one["name"], one["type"]) == (other["name"], other["type"])
    t0_s, t0_of_bag_s = (label["object_data"]["num"][0]["val"] for label in (one, other))
    assert t0_of_bag_s - t0_s == pytest.approx(1_700_000_000, abs=1e-3)
    windows = ["--out", str(tmp_path / "c"), "--windows", str(tmp_path / "labels.csv")]
    assert main(["street", "label", str(bag_of_approach), *windows]) == 2
    assert "--windows: expected none for a bag" in capsys.readouterr().err


def test_sound_of_both_layouts_reads_back_exactly(tmp_path):
    samples = sound_of(9600)
    write_blocks(tmp_path / "interleaved", samples)
    with bag_writer(tmp_path / "planar", "sqlite3") as write:
        for k in range(3):
            part = samples[3200 * k : 3200 * (k + 1)].T
            write("/mics", AUDIO, k, block(part, 1 + k * 400_000_000, layout="planar", channels=CHANNELS))
    for name, start_ns in (("interleaved", 5_000_000_000), ("planar", 1)):
        sound = read_bag(tmp_path / name).sound
        assert sound.start_ns == start_ns
        with open_sound(sound, CHANNELS) as audio:
            blocks = list(audio.blocks(700))
            assert audio.duration_s == pytest.approx(1.2)
        assert {len(one) for one in blocks[:-1]} == {700}
        np.testing.assert_array_equal(np.concatenate(blocks), samples)


def test_bytes_of_audio_common_are_read_by_their_info(tmp_path):
    whole = np.random.default_rng(1).integers(-(2**15), 2**15, (RATE_HZ * 2, 2), dtype=np.int16)
    info = {"channels": 2, "sample_rate": RATE_HZ, "sample_format": "S16LE", "coding_format": "wave"}
    for name, kind in (("stamped", "AudioDataStamped"), ("plain", "AudioData")):
        with bag_writer(tmp_path / name) as write:
            write("/audio_info", "audio_common_msgs/msg/AudioInfo", 0, info)
            for k in range(4):
                data = np.frombuffer(whole[4000 * k : 4000 * (k + 1)].tobytes(), np.uint8)
                said = {"header": header(10**9 * 7 + k * 500_000_000), "audio": {"data": data}}
                values = said if name == "stamped" else {"data": data}
                write("/audio", f"audio_common_msgs/msg/{kind}", 10**9 * 7 + (k + 1) * 500_000_000, values)
        sound = read_bag(tmp_path / name).sound
        assert sound.start_ns == 7 * 10**9, "a block without a stamp ends when it is recorded"
        with open_sound(sound, 2) as audio:
            heard = np.concatenate(list(audio.blocks()))
        np.testing.assert_array_equal(heard, whole.astype(np.float32) / 2**15)


# As their packages define them, written by rosbags only.
FOREIGN = {
    "audio_utils_msgs/msg/AudioFrame": """std_msgs/Header header
        string format
        uint32 channel_count
        uint32 sampling_frequency
        uint32 frame_sample_count
        uint8[] data""",
    "foxglove_msgs/msg/RawAudio": """builtin_interfaces/Time timestamp
        uint8[] data
        string format
        uint32 sample_rate
        uint32 number_of_channels""",
}
FRAME, RAW = FOREIGN
KINDS = {"signed_16": "<i2", "signed_24": "<i4", "signed_32": "<i4", "float": "<f4", "pcm-s16": "<i2"}


def foreign_bag(path: Path, samples: np.ndarray, said: str, *, lost: tuple[int, ...] = (), **changed) -> Path:
    """Write samples of full scale 1 from 5 s on in messages of 0.1 s as other recorders do."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    kind, step = RAW if said.startswith("pcm") else FRAME, RATE_HZ // 10
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(FOREIGN[kind], kind))
    time, head = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    full = 1.0 if said == "float" else 2.0 ** (int(said.rpartition("_")[2].removeprefix("pcm-s")) - 1)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        to = bag.add_connection("/mics", kind, typestore=store)
        for k, part in enumerate(np.split(samples, range(step, len(samples), step))):
            data = (part * full).astype(KINDS[said]).tobytes()
            if said == "signed_24":
                data = np.frombuffer(data, np.uint8).reshape(-1, 4)[:, :3].tobytes()
            values = {"format": said, "data": np.frombuffer(data, np.uint8)}
            tenths = 50 + k + (kind == FRAME)  # the stamp of an AudioFrame is that of its last sample
            stamp = time(sec=tenths // 10, nanosec=tenths % 10 * 100_000_000)
            if kind == FRAME:
                values |= {"header": head(stamp=stamp, frame_id="mics"), "channel_count": part.shape[1]}
                values |= {"sampling_frequency": RATE_HZ, "frame_sample_count": len(part)}
            else:
                values |= {"timestamp": stamp, "sample_rate": RATE_HZ, "number_of_channels": part.shape[1]}
            if k not in lost:
                # Changes begin with the third message.
                message = store.types[kind](**(values | (changed if k > 2 else {})))
                bag.write(to, tenths * 100_000_000, store.serialize_cdr(message, kind))
    return path


@pytest.mark.parametrize("said", KINDS)
def test_self_describing_messages_are_read_exactly(tmp_path, said):
    samples = np.random.default_rng(2).integers(-(2**15), 2**15, (RATE_HZ * 2, CHANNELS)) / np.float32(2**15)
    sound = read_bag(foreign_bag(tmp_path / "bag", samples, said)).sound
    assert sound.start_ns == 5 * 10**9
    with open_sound(sound, CHANNELS) as audio:
        assert audio.sample_rate_hz == RATE_HZ
        np.testing.assert_array_equal(np.concatenate(list(audio.blocks())), samples)


def test_sixteen_channels_of_another_recorder_give_the_same_states(tmp_path, caplog):
    noise = np.random.default_rng(5).integers(-9000, 9000, (3 * RATE_HZ, 16)) / np.float32(2**15)
    foreign_bag(tmp_path / "theirs", noise, "signed_16", lost=(12,))
    write_blocks(tmp_path / "ours", noise, lost=(12,))
    array = tmp_path / "ring.csv"
    turns = 2 * np.pi * np.arange(16) / 16
    array.write_text("".join(f"{0.2 * np.cos(t)},{0.2 * np.sin(t)},1.5\n" for t in turns))
    for name in ("theirs", "ours"):
        words = ["run", str(tmp_path / name), "--array", str(array), "--uncalibrated"]
        assert main([*words, "--out", str(tmp_path / f"{name}.jsonl")]) == 0
        assert f"{name}: 0.100 s of /mics are missing at 1.200 s" in caplog.text
    states = (tmp_path / "theirs.jsonl").read_text()
    assert len(states.splitlines()) == 21
    assert states == (tmp_path / "ours.jsonl").read_text()


def board_bag(path: Path, transforms: list[tuple[str, str, tuple, tuple]], topic: str = "/tf_static") -> Path:
    """Write sound of the frame `mics` and transforms: parent, child, translation, quaternion x, y, z, w."""
    with bag_writer(path) as write:
        for k, (parent, child, at, turn) in enumerate(transforms):
            moved = {"translation": dict(zip("xyz", at, strict=True))}
            moved |= {"rotation": dict(zip("xyzw", turn, strict=True))}
            one = {"header": header(k, parent), "child_frame_id": child, "transform": moved}
            write(topic, "tf2_msgs/msg/TFMessage", k, {"transforms": [one]})
        samples = (sound_of(RATE_HZ) * 2**15).astype("<i2")
        said = {"format": "signed_16", "sampling_frequency": RATE_HZ, "channel_count": CHANNELS}
        said |= {"frame_sample_count": RATE_HZ, "data": np.frombuffer(samples.tobytes(), np.uint8)}
        write("/mics", FRAME, 6 * 10**9, {"header": header(6 * 10**9, "mics")} | said)
    return path


BOARD = read_array("respeaker-4")
STILL, QUARTER = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
angles, metres = st.floats(-math.pi, math.pi), st.floats(-5.0, 5.0)
poses = st.tuples(st.tuples(metres, metres, metres), st.tuples(angles, angles, angles))


@pytest.mark.long
@settings(max_examples=20)
@given(st.lists(poses, min_size=1, max_size=4))
def test_static_transforms_place_a_board(chain):
    """Rotations of SciPy are the oracle; transforms are written from last to first."""
    frames, told = [*("base_link", "roof", "pole", "head")[: len(chain)], "mics"], []
    wanted = BOARD.positions_m.copy()
    for (parent, child), (at, turn) in reversed(list(zip(pairwise(frames), chain, strict=True))):
        rotation = Rotation.from_euler("ZYX", turn)
        wanted = rotation.apply(wanted) + at
        told.append((parent, child, at, tuple(rotation.as_quat())))
    with TemporaryDirectory() as folder:
        sound = read_bag(board_bag(Path(folder, "bag"), told)).sound
        placed = needed_array(sound, BOARD)
    np.testing.assert_allclose(placed.positions_m, wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("transforms", "topic"),
    [
        ([], "/tf_static"),
        ([("base_link", "camera", (1.0, 0.0, 0.0), QUARTER)], "/tf_static"),
        ([("pole", "mics", (1.0, 0.0, 0.0), QUARTER)], "/tf_static"),
        ([("base_link", "mics", (1.0, 0.0, 0.0), QUARTER)], "/tf"),
    ],
)
def test_a_board_without_static_transforms_is_not_moved(transforms, topic, tmp_path, caplog):
    sound = read_bag(board_bag(tmp_path / "bag", transforms, topic)).sound
    assert needed_array(sound, BOARD) is BOARD and not caplog.text


def test_turned_boards_are_reported_and_array_files_kept(tmp_path, caplog, capsys):
    bag = board_bag(tmp_path / "bag", [("base_link", "/mics", (1.0, 0.0, 1.5), QUARTER)])
    words = ["array", "bearings", str(bag), "--azimuth-span", "360", "--out", str(tmp_path / "b.csv")]
    assert main([*words, "--array", "respeaker-4"]) == 0
    assert caplog.messages == [
        f"{bag}: respeaker-4 is turned and moved by /tf_static, its middle at (1, 0, 1.5) m"
    ]
    caplog.clear()
    # A ring of four turned by a quarter equals itself with other channels; by an eighth it does not.
    assert main(["run", str(bag), "--array", "respeaker-4"]) == 0
    assert "respeaker-4: its microphones are in another order" in caplog.text
    caplog.clear()
    eighth = (0.0, 0.0, float(np.sin(np.pi / 8.0)), float(np.cos(np.pi / 8.0)))
    skew = board_bag(tmp_path / "skew", [("base_link", "/mics", (1.0, 0.0, 1.5), eighth)])
    assert main(["run", str(skew), "--array", "respeaker-4"]) == 0
    assert "respeaker-4 is turned" in caplog.text, "what is compared with the model is the board as it stands"
    assert "not the array of the model" in caplog.text and "no model" in capsys.readouterr().out
    own = tmp_path / "respeaker.json"
    own.write_text(json.dumps(BOARD.positions_m.tolist()))
    caplog.clear()
    assert main([*words, "--array", str(own)]) == 0
    assert not caplog.text


@pytest.mark.parametrize(
    ("transforms", "problem"),
    [
        (
            [("base_link", "mics", (0.0,) * 3, (0.0, 0.0, 0.0, 0.0))],
            "expected a quaternion of length 1, got 0",
        ),
        (
            [("base_link", "mics", (0.0,) * 3, (0.0, 0.0, 1.0, 1.0))],
            "expected a quaternion of length 1, got 1.41",
        ),
        ([("base_link", "mics", (math.nan, 0.0, 0.0), STILL)], "expected finite"),
        ([("pole", "mics", (0.0,) * 3, STILL), ("mics", "pole", (0.0,) * 3, STILL)], "expected no loop"),
        ([("mics", "mics", (0.0,) * 3, STILL)], "expected no loop"),
        (
            [("base_link", "mics", (0.0,) * 3, STILL), ("pole", "mics", (0.0,) * 3, STILL)],
            "expected one parent of mics, got base_link and pole",
        ),
    ],
)
def test_wrong_transforms_raise_an_error(transforms, problem, tmp_path):
    sound = read_bag(board_bag(tmp_path / "bag", transforms)).sound
    with pytest.raises(InputFileError, match=re.escape(problem)):
        needed_array(sound, BOARD)


@pytest.mark.parametrize(
    ("said", "changed", "problem"),
    [
        ("signed_16", {"channel_count": 3}, "800 as frame_sample_count says, got 6400 bytes"),
        ("signed_16", {"channel_count": 2, "frame_sample_count": 1600}, "and 4 channels as in the first"),
        ("signed_16", {"channel_count": 0}, "channels: expected a number in [1, 1024], got 0"),
        ("signed_16", {"sampling_frequency": 2**31}, "sample_rate_hz: expected a number in [1, 10000000]"),
        ("signed_16", {"frame_sample_count": 2**32 - 1}, "4294967295 as frame_sample_count says"),
        ("float", {"format": "double"}, "signed_padded_24, signed_32, float, got 'double'"),
        ("float", {"data": np.full(12_800, 255, np.uint8)}, "expected finite samples, got nan in channel 1"),
        ("pcm-s16", {"format": "opus"}, "/mics: expected one of pcm-s16, got 'opus'"),
        ("pcm-s16", {"data": np.zeros(0, np.uint8)}, "expected at least 1 s of audio, got 0.300 s"),
        ("pcm-s16", {"data": np.zeros(9, np.uint8)}, "expected at least 1 s of audio, got 0.301 s"),
        ("pcm-s16", {"sample_rate": 16_000}, "expected 8000 Hz and 4 channels as in the first"),
    ],
)
def test_contradictory_messages_raise_an_error(tmp_path, said, changed, problem):
    path = foreign_bag(tmp_path / "bag", sound_of(RATE_HZ), said, **changed)
    with (
        pytest.raises(InputFileError, match=re.escape(problem)) as refused,
        open_sound(read_bag(path).sound) as audio,
    ):
        list(audio.blocks())
    assert str(refused.value).startswith(str(path))


def test_a_lost_message_becomes_silence_and_a_long_gap_an_error(tmp_path, caplog):
    samples = sound_of(4 * RATE_HZ)
    gone = write_blocks(tmp_path / "one_lost", samples, lost=(20,))
    with caplog.at_level(logging.WARNING), open_sound(read_bag(gone).sound) as audio:
        heard = np.concatenate(list(audio.blocks()))
    assert not heard[16_000:16_800].any()
    np.testing.assert_array_equal(heard[16_800:], samples[16_800:])
    assert "0.100 s of /mics are missing at 2.000 s" in caplog.text
    long = write_blocks(tmp_path / "many_lost", samples, lost=tuple(range(12, 34)))
    with (
        open_sound(read_bag(long).sound) as audio,
        pytest.raises(InputFileError, match=r"at 1.200 s the next is 2.200 s off"),
    ):
        list(audio.blocks())


def box(left: float, top: float, width: float, height: float, label: str, score: float) -> dict[str, object]:
    centre = {"position": {"x": left + width / 2, "y": top + height / 2}}
    return {
        "bbox": {"center": centre, "size_x": width, "size_y": height},
        "results": [
            {"hypothesis": {"class_id": "person", "score": score / 2}},
            {"hypothesis": {"class_id": label, "score": score}},
        ],
    }


def test_detections_and_odometry_have_their_stamps(tmp_path):
    with bag_writer(tmp_path / "bag") as write:
        for k in range(3):
            stamp_ns = 3_000_000_000 + k * 500_000_000
            write("/mics", AUDIO, stamp_ns, block(sound_of(4000), stamp_ns))
            found = [box(10, 20, 30, 40, "car", 0.8)] if k else []
            write("/boxes", DETECTIONS, stamp_ns + 7, {"header": header(stamp_ns), "detections": found})
            twist = {"twist": {"linear": {"x": 2.0 * k}}}
            write("/odom", ODOMETRY, stamp_ns + 9, {"header": header(stamp_ns), "twist": twist})
    held = read_bag(tmp_path / "bag")
    assert held.detections.stamps_ns.tolist() == [3_000_000_000, 3_500_000_000, 4_000_000_000]
    assert [len(frame) for frame in held.detections.frames] == [0, 1, 1], (
        "an image without boxes was searched"
    )
    frame = held.detections.frames[1]
    assert (frame.labels, frame.scores.tolist(), frame.boxes_px.tolist()) == (
        ("car",),
        [0.8],
        [[10.0, 20.0, 40.0, 60.0]],
    )
    assert [(one.stamp_ns, one.speed_mps) for one in held.ego.told][:1] == [(3_000_000_000, 0.0)]
    assert held.ego.moves
    assert held.array is None


def test_states_have_the_speed_of_the_ego(tmp_path):
    from worldstate.adapters.listener import listen_steps
    from worldstate.adapters.source import ListenSettings, open_source
    from worldstate.frontend import MicrophoneArray

    path = write_blocks(tmp_path / "bag", sound_of(2 * RATE_HZ))
    told = [Odometry("wheels", 5_000_000_000 + k * 250_000_000, 2.0 * k) for k in range(9)]
    source = open_source(
        read_bag(path).sound,
        array=MicrophoneArray([[0, y, 0] for y in (0.1, 0.05, -0.05, -0.1)]),
        odometry=OdometryLog(tuple(told)),
        settings=ListenSettings(uncalibrated=True),
    )
    said = {step.state.stamp_ns: step.state.context.ego_speed_mps for step in listen_steps(source)}
    assert list(said) == [6_000_000_000 + k * 100_000_000 for k in range(11)]
    assert list(said.values()) == [2.0 * int(4 + 0.4 * k) for k in range(11)]


def test_wrong_topics_raise_an_error_with_the_topics(tmp_path, capsys):
    samples = sound_of(2 * RATE_HZ)
    with bag_writer(tmp_path / "two") as write:
        for topic in ("/front", "/rear"):
            write(topic, AUDIO, 0, block(samples, 0))
    with bag_writer(tmp_path / "blind") as write:
        write("/odom", ODOMETRY, 0, {"header": header(0)})
    write_blocks(tmp_path / "planes", samples, layout="spiral")
    write_blocks(tmp_path / "three", samples, channels=3)
    bad = samples.copy()
    bad[900, 2] = math.nan
    write_blocks(tmp_path / "nan", bad)
    with bag_writer(tmp_path / "changing") as write:
        write("/mics", AUDIO, 0, block(samples, 1))
        write("/mics", AUDIO, 1, block(samples, 2 * 10**9 + 1, sample_rate=16_000))
    array = tmp_path / "mics.csv"
    array.write_text("".join(f"0,{y},0\n" for y in (0.1, 0.0, -0.1)))
    four = tmp_path / "four.csv"
    four.write_text("".join(f"0,{y},0\n" for y in (0.1, 0.05, -0.05, -0.1)))
    write_blocks(tmp_path / "four", samples)
    for name, options, said in (
        ("two", [], "expected --topic audio= with one of /front, /rear"),
        ("two", ["--topic", "audio=/left"], "on /left (--topic audio=), got /front (worldstate_msgs"),
        ("two", ["--topic", "audio=/front"], "expected --array, or a message of worldstate_msgs"),
        ("blind", [], "MultiChannelAudio or audio_common_msgs/msg/AudioDataStamped or"),
        ("planes", [], "expected interleaved or planar, got 'spiral'"),
        ("three", [], "expected samples of 3 channels, got 3200 numbers"),
        ("nan", ["--array", str(array)], "expected finite samples, got nan in channel 3, sample 900"),
        ("changing", ["--array", str(four)], "expected 8000 Hz and 4 channels as in the first message"),
        ("four", ["--array", str(array), "--uncalibrated"], "expected 3 channels, one per microphone, got 4"),
        ("four", ["--array", str(array), "--start", "3"], "start_s: expected none with a bag"),
        ("four", ["--array", str(array), "--topic", "detections=/x"], "on /x (--topic detections=), got"),
        (
            "four",
            ["--array", str(array), "--export", f"rosbag={tmp_path / 'two'}"],
            "expected a new name",
        ),
    ):
        options = [*options, *(["--uncalibrated"] if "--array" in options else [])]
        assert main(["run", str(tmp_path / name), *options]) == 2, (name, options)
        assert said in " ".join(capsys.readouterr().err.split()), (name, options)


# Tenths of a second of the stamps of detections and odometry, or None; all are recorded.
STAMPED = {
    "as they were": lambda k: k,
    "not at all": lambda k: None,
    "some not": lambda k: None if k % 3 == 1 else k,
    "out of order": lambda k: k ^ 1,
    "all alike": lambda k: 0,
    "ten alike": lambda k: k // 10 * 10,
    "delivered twice": lambda k: k // 2 * 2,
}


@pytest.mark.parametrize("name", STAMPED)
def test_bad_stamps_lose_no_boxes_or_odometry(name, tmp_path, caplog):
    begun_ns, tenth_ns = 3_000_000_000, 100_000_000
    with bag_writer(tmp_path / "bag") as write:
        for k in range(40):
            recorded_ns, tenth = begun_ns + k * tenth_ns, STAMPED[name](k)
            stamp_ns = 0 if tenth is None else begun_ns + tenth * tenth_ns
            write("/mics", AUDIO, recorded_ns, block(sound_of(800), recorded_ns))
            found = [box(10.0 + k, 20, 30, 40, "car", 0.8)]
            write("/boxes", DETECTIONS, recorded_ns, {"header": header(stamp_ns), "detections": found})
            twist = {"twist": {"linear": {"x": 0.1 * k}}}
            write("/odom", ODOMETRY, recorded_ns, {"header": header(stamp_ns), "twist": twist})
    held = read_bag(tmp_path / "bag")
    kept = range(1, 40, 2) if name == "delivered twice" else range(40)
    order = [k ^ 1 for k in kept] if name == "out of order" else [*kept]
    assert [round(frame.boxes_px[0, 0]) - 10 for frame in held.detections.frames] == order
    assert [round(10 * one.speed_mps) for one in held.ego.told] == order
    times = [round((ns - begun_ns) / tenth_ns) for ns in held.detections.stamps_ns.tolist()]
    assert times == [one.stamp_ns // tenth_ns - 30 for one in held.ego.told]
    assert times == [k - (name == "delivered twice") for k in kept]
    assert ("do not advance" in caplog.text) is (name in ("all alike", "ten alike"))


def test_the_bag_of_a_drive_has_its_speed(tmp_path, capsys):
    folder = tmp_path / "DA1" / "left" / "1_00_0001"
    folder.mkdir(parents=True)
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, (RATE_HZ, 56))
    soundfile.write(folder / "out_multi.wav", noise, RATE_HZ)
    bag = [str(folder), str(tmp_path / "unknown")]
    assert main(["sim", "to-bag", *bag, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["odometry"] is False, "OVAD says that it moves, not how fast"
    assert read_bag(tmp_path / "unknown").ego is None
    (folder / "truth.json").write_text(json.dumps({"ego": {"speed_mps": [4.0] * 5 + [2.0] * 6}}))
    assert main(["sim", "to-bag", str(folder), str(tmp_path / "driven"), "--start", "3"]) == 0
    ego = read_bag(tmp_path / "driven").ego
    assert [(one.stamp_ns, one.speed_mps) for one in ego.told] == [
        (3_000_000_000 + k * 100_000_000, 4.0 if k < 5 else 2.0) for k in range(11)
    ]


def test_a_log_of_snapshots_is_no_bag(tmp_path, capsys):
    states, log = tmp_path / "states.jsonl", tmp_path / "out.mcap"
    states.write_text("".join(state.to_json() + "\n" for state in STATES))
    assert main(["log", "replay", str(states), "--export", f"mcap={log}"]) == 0
    capsys.readouterr()
    assert main(["run", str(log)]) == 2
    assert "`worldstate log replay` reads" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("storage", ["mcap", "sqlite3", "signed_16", "pcm-s16"])
def test_a_damaged_bag_raises_an_error_with_its_name(tmp_path, storage):
    samples = sound_of(RATE_HZ)
    if storage in KINDS:
        foreign_bag(tmp_path / "whole", samples, storage)
    else:
        with bag_writer(tmp_path / "whole", storage) as write:
            for k in range(10):
                write("/mics", AUDIO, k, block(samples[800 * k : 800 * (k + 1)], 1 + k * 100_000_000))
    (good,) = (file for file in (tmp_path / "whole").iterdir() if file.suffix != ".yaml")
    content, rng, refused = good.read_bytes(), np.random.default_rng(3), 0
    damaged = tmp_path / f"damaged{good.suffix}"
    for trial in range(40):
        spoiled = bytearray(content)
        if trial % 2:
            spoiled = spoiled[: rng.integers(len(spoiled))]
        else:
            for place in rng.integers(0, len(spoiled), 8 if trial % 4 else 2000):
                spoiled[place] = rng.integers(256)
        damaged.write_bytes(spoiled)
        try:
            with open_sound(read_bag(damaged).sound, strict=False) as audio:
                list(audio.blocks())
        except InputFileError as error:
            refused += 1
            assert str(error).startswith(str(damaged))
    assert refused >= 20


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_compressed_bags_raise_an_error(tmp_path, mode):
    samples = sound_of(RATE_HZ)
    with bag_writer(tmp_path / "bag", "sqlite3") as write:
        for k in range(10):
            write("/mics", AUDIO, k, block(samples[800 * k : 800 * (k + 1)], 1 + k * 100_000_000))
    said = tmp_path / "bag" / "metadata.yaml"
    text, none = said.read_text(), "compression_mode: ''"
    assert none in text
    said.write_text(text.replace(none, f"compression_mode: {mode}"))
    with pytest.raises(InputFileError, match="`ros2 bag convert`"):
        read_bag(tmp_path / "bag")


def indices_of(mcap: bytes) -> list[int]:
    """Return the position of each chunk index, with its first and last time."""
    at, found = 8, []
    while at + 9 <= len(mcap):
        kind, length = struct.unpack_from("<BQ", mcap, at)
        found += [at + 9] * (kind == 8)
        at += 9 + length
    return found


@pytest.mark.parametrize(("first_ns", "last_ns"), [(1, 0), (0, -1), (-(10**18), -(10**18)), (2 * 10**9, 0)])
def test_a_wrong_index_of_an_mcap_raises_an_error(tmp_path, first_ns, last_ns):
    """Readers omit and hold messages by these times."""
    with bag_writer(tmp_path / "bag") as write:
        for k in range(20):
            samples = np.random.default_rng(k).uniform(-0.5, 0.5, (40_000, CHANNELS)).astype(np.float32)
            write("/mics", AUDIO, 10**18 + k * 10**8, block(samples, 10**18 + k * 10**8, sample_rate=400_000))
    (file,) = (tmp_path / "bag").glob("*.mcap")
    data = bytearray(file.read_bytes())
    indices = indices_of(data)
    assert len(indices) > 1
    assert len(read_bag(file).sound.open().silent_channels) == 0
    first, last = struct.unpack_from("<QQ", data, indices[-1])
    struct.pack_into("<QQ", data, indices[-1], first + first_ns, last + last_ns)
    file.write_bytes(data)
    with pytest.raises(InputFileError, match="expected an index with the times of its messages"):
        read_bag(file)


def test_bag_metadata_is_parsed_once_more_than_by_rosbags(tmp_path, monkeypatch):
    from ruamel.yaml import YAML

    path, parsed, load = write_blocks(tmp_path / "bag", sound_of(RATE_HZ)), [], YAML.load
    monkeypatch.setattr(YAML, "load", lambda yaml, text: parsed.append(text) or load(yaml, text))
    with open_sound(read_bag(path).sound) as audio:
        assert sum(map(len, audio.blocks())) == RATE_HZ
    opened = 4  # for the stamps of its sound, for the other topics, for its first second, and for its blocks
    assert len(parsed) == opened + 1


def test_a_run_that_fails_leaves_no_bag(tmp_path):
    with pytest.raises(RuntimeError), state_bag(tmp_path / "out") as write:
        write(STATES[0])
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_without_rosbags_the_extra_is_named(tmp_path, monkeypatch, capsys):
    from worldstate.adapters.ros import message_types

    message_types.typestore.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "rosbags", None)
    states = tmp_path / "states.jsonl"
    states.write_text("".join(state.to_json() + "\n" for state in STATES))
    assert main(["log", "replay", str(states), "--export", f"rosbag={tmp_path / 'out'}"]) == 2
    assert "worldstate[ros]" in capsys.readouterr().err
    shutil.copy(states, tmp_path / "a.mcap")
    assert main(["run", str(tmp_path / "a.mcap")]) == 2
    assert "worldstate[ros]" in capsys.readouterr().err


@pytest.mark.long
def test_the_program_of_the_page_runs(bag_of_approach, tmp_path, monkeypatch):
    page = Path(__file__).resolve().parents[2] / "docs" / "reference" / "ros.md"
    (program,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    (tmp_path / "street_bag").symlink_to(bag_of_approach)
    monkeypatch.chdir(tmp_path)
    exec(compile(program, str(page), "exec"), {})
    assert len(read_by_others(tmp_path / "states_bag")) > 150
