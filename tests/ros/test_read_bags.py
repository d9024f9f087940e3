"""Bags of ROS 2 of several recorders: formats, topics, places of boards, and damage."""

import json
import logging
import math
import re
import struct
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from bag_messages import CHANNELS, RATE_HZ, bag_of, block, blocks, heard, info, moved, read_bag, sound_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.ros.bag_input import needed_array
from worldstate.adapters.ros.message_types import header
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError


def test_sound_of_both_layouts_reads_back_exactly(tmp_path):
    samples = sound_of(9600)
    parts = enumerate(np.split(samples, 3))
    planar = [block(part.T, 1 + k * 400_000_000, layout="planar", channels=CHANNELS) for k, part in parts]
    mcap, sqlite = bag_of(tmp_path / "a", blocks(samples)), bag_of(tmp_path / "b", planar, "sqlite3")
    for path, start_ns in ((mcap, 5_000_000_000), (sqlite, 1)):
        sound = read_bag(path).sound
        assert sound.start_ns == start_ns
        with open_sound(sound, CHANNELS) as audio:
            read = list(audio.blocks(700))
            assert audio.duration_s == pytest.approx(1.2)
        assert {len(one) for one in read[:-1]} == {700}
        np.testing.assert_array_equal(np.concatenate(read), samples)


def test_bytes_without_a_stamp_end_when_they_are_recorded(tmp_path):
    whole = np.random.default_rng(1).integers(-(2**15), 2**15, (RATE_HZ * 2, 2), dtype=np.int16)
    parts = [np.frombuffer(part.tobytes(), np.uint8) for part in np.split(whole, 4)]
    plain = [
        ("/audio", "audio_common_msgs/msg/AudioData", 7 * 10**9 + (k + 1) * 500_000_000, {"data": part})
        for k, part in enumerate(parts)
    ]
    path = bag_of(tmp_path / "plain", [info(channels=2), *plain])
    assert read_bag(path).sound.start_ns == 7 * 10**9
    np.testing.assert_array_equal(heard(path, 2), whole.astype(np.float32) / 2**15)


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


def foreign_bag(path: Path, samples: np.ndarray, said: str, **changed) -> Path:
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
            # Changes begin with the third message.
            message = store.types[kind](**(values | (changed if k > 2 else {})))
            bag.write(to, tenths * 100_000_000, store.serialize_cdr(message, kind))
    return path


@pytest.mark.parametrize("said", KINDS)
def test_self_describing_messages_are_read_exactly(tmp_path, said):
    samples = np.random.default_rng(2).integers(-(2**15), 2**15, (RATE_HZ * 2, CHANNELS)) / np.float32(2**15)
    path = foreign_bag(tmp_path / "bag", samples, said)
    sound = read_bag(path).sound
    assert (sound.start_ns, sound.sample_rate_hz) == (5 * 10**9, RATE_HZ)
    np.testing.assert_array_equal(heard(path), samples)


def board_bag(path: Path, transforms: list[tuple[str, str, tuple, tuple]], topic: str = "/tf_static") -> Path:
    """Write sound of the frame `mics` and transforms: parent, child, translation, quaternion x, y, z, w."""
    messages = []
    for k, (parent, child, at, turn) in enumerate(transforms):
        poses = {
            "translation": dict(zip("xyz", at, strict=True)),
            "rotation": dict(zip("xyzw", turn, strict=True)),
        }
        one = {"header": header(k, parent), "child_frame_id": child, "transform": poses}
        messages.append((topic, "tf2_msgs/msg/TFMessage", k, {"transforms": [one]}))
    samples = (sound_of(RATE_HZ) * 2**15).astype("<i2")
    said = {"format": "signed_16", "sampling_frequency": RATE_HZ, "channel_count": CHANNELS}
    said |= {"frame_sample_count": RATE_HZ, "data": np.frombuffer(samples.tobytes(), np.uint8)}
    sound = "/mics", FRAME, 6 * 10**9, {"header": header(6 * 10**9, "mics")} | said
    return bag_of(path, [*messages, sound])


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
        placed = needed_array(read_bag(board_bag(Path(folder, "bag"), told)).sound, BOARD)
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
    assert "respeaker-4 is turned" in caplog.text, "the board is compared with the model after its rotation"
    assert "not the array of the model" in caplog.text and "no model" in capsys.readouterr().out
    own = tmp_path / "respeaker.json"
    own.write_text(json.dumps(BOARD.positions_m.tolist()))
    caplog.clear()
    assert main([*words, "--array", str(own)]) == 0
    assert not caplog.text


ORIGIN = (0.0, 0.0, 0.0)
TRANSFORMS = {
    "expected a quaternion of length 1, got 0": [("base_link", "mics", ORIGIN, (0.0, 0.0, 0.0, 0.0))],
    "expected a quaternion of length 1, got 1.41": [("base_link", "mics", ORIGIN, (0.0, 0.0, 1.0, 1.0))],
    "expected finite": [("base_link", "mics", (math.nan, 0.0, 0.0), STILL)],
    "expected no loop, got one of 2": [("pole", "mics", ORIGIN, STILL), ("mics", "pole", ORIGIN, STILL)],
    "expected no loop, got one of 1": [("mics", "mics", ORIGIN, STILL)],
    "one parent of mics, got base_link and pole": [
        ("base_link", "mics", ORIGIN, STILL),
        ("pole", "mics", ORIGIN, STILL),
    ],
}


@pytest.mark.parametrize("problem", TRANSFORMS)
def test_wrong_transforms_raise_an_error(problem, tmp_path):
    sound = read_bag(board_bag(tmp_path / "bag", TRANSFORMS[problem])).sound
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
    with pytest.raises(InputFileError, match=f"^{path}.*{re.escape(problem)}"):
        heard(path, None)


def test_a_lost_message_becomes_silence_and_a_long_gap_an_error(tmp_path, caplog):
    samples = sound_of(4 * RATE_HZ)
    with caplog.at_level(logging.WARNING):
        found = heard(bag_of(tmp_path / "one_lost", blocks(samples, lost=(20,))))
    assert not found[16_000:16_800].any()
    np.testing.assert_array_equal(found[16_800:], samples[16_800:])
    assert "0.100 s of /mics are missing at 2.000 s" in caplog.text
    long = bag_of(tmp_path / "many_lost", blocks(samples, lost=tuple(range(12, 34))))
    with pytest.raises(InputFileError, match=r"at 1.200 s the next is 2.200 s off"):
        heard(long)


def test_wrong_topics_raise_an_error_with_the_topics(tmp_path, capsys):
    samples = sound_of(2 * RATE_HZ)
    bad = samples.copy()
    bad[900, 2] = math.nan
    for name, messages in {
        "two": [(topic, *block(samples, 0)[1:]) for topic in ("/front", "/rear")],
        "blind": [moved(0, 0, 0.0)],
        "planes": blocks(samples, layout="spiral"),
        "three": blocks(samples, channels=3),
        "nan": blocks(bad),
        "changing": [block(samples, 1), block(samples, 2 * 10**9 + 1, sample_rate=16_000)],
        "four": blocks(samples),
    }.items():
        bag_of(tmp_path / name, messages)
    array, four = tmp_path / "mics.csv", tmp_path / "four.csv"
    array.write_text("0,0.1,0\n0,0,0\n0,-0.1,0\n")
    four.write_text("0,0.1,0\n0,0.05,0\n0,-0.05,0\n0,-0.1,0\n")
    three = ["--array", str(array), "--uncalibrated"]
    for name, options, said in (
        ("two", [], "expected --topic audio= with one of /front, /rear"),
        ("two", ["--topic", "audio=/left"], "on /left (--topic audio=), got /front (worldstate_msgs"),
        ("two", ["--topic", "audio=/front"], "expected --array, or a message of worldstate_msgs"),
        ("blind", [], "MultiChannelAudio or audio_common_msgs/msg/AudioDataStamped or"),
        ("planes", [], "expected interleaved or planar, got 'spiral'"),
        ("three", [], "expected samples of 3 channels, got 3200 numbers"),
        ("nan", three, "expected finite samples, got nan in channel 3, sample 900"),
        ("changing", ["--array", str(four), "--uncalibrated"], "8000 Hz and 4 channels as in the first"),
        ("four", three, "expected 3 channels, one per microphone, got 4"),
        ("four", [*three, "--start", "3"], "start_s: expected none with a bag"),
        ("four", [*three, "--topic", "detections=/x"], "on /x (--topic detections=), got"),
        ("four", [*three, "--export", f"rosbag={tmp_path / 'two'}"], "expected a new name"),
    ):
        assert main(["run", str(tmp_path / name), *options]) == 2, (name, options)
        assert said in " ".join(capsys.readouterr().err.split()), (name, options)


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_compressed_bags_raise_an_error(tmp_path, mode):
    said = bag_of(tmp_path / "bag", blocks(sound_of(RATE_HZ)), "sqlite3") / "metadata.yaml"
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
    samples = sound_of(40_000)
    bag_of(tmp_path / "bag", [block(samples, 10**18 + k * 10**8, sample_rate=400_000) for k in range(20)])
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
