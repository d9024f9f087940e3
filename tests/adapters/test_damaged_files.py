"""Damaged and expanding files are read or raise a typed error, within limits of memory and time."""

import io
import json
import os
import resource
import shutil
import signal
import struct
import traceback
import zipfile
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import onnx
import pytest
import zstandard
from camera_boxes import write_onnx
from damaged_files import RATE_HZ, spoilt, write_inputs

from worldstate.adapters import load_miss_rates, open_onnx, read_camera, read_checkpoint, read_model
from worldstate.adapters.audio.sound_file import open_audio, open_sound
from worldstate.adapters.camera.detections import read_any_detections, read_mot_text
from worldstate.adapters.datasets.feature_extraction import read_labels
from worldstate.adapters.datasets.feature_table import read_features, read_ids
from worldstate.adapters.datasets.ovad import OvadDataset, read_true_tracks
from worldstate.adapters.export.log_messages import SNAPSHOT_TOPIC, read_messages
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.context_file import read_context
from worldstate.adapters.files.file_io import atomic_path, write_text
from worldstate.adapters.files.odometry_file import read_odometry
from worldstate.adapters.ros.bag_input import read_sound
from worldstate.adapters.state_log import read_log, read_state_near
from worldstate.adapters.vehicle.car_file import read_camera_setup, read_car
from worldstate.ground.errors import InputFileError, WorldstateError
from worldstate.operations.labelling.street_passes import read_street
from worldstate.operations.recordings.hop_table import HopTable, load_streams, save_tables

# Seconds of processor time; without computation the limit is six times as long.
MOST_BYTES, MOST_S = 1 << 30, 10
FEW, MANY = 5, 300
BOMB_MIB, MCAP = 1500, b"\x89MCAP0\r\n"


def sound(path: Path) -> None:
    with open_audio(path) as audio:
        assert sum(map(len, audio.blocks())) > 0


def bag(path: Path) -> None:
    with open_sound(read_sound(path)[0]) as audio:
        assert sum(map(len, audio.blocks())) >= RATE_HZ


def log(path: Path) -> None:
    assert list(read_log(path))


def detector(path: Path) -> None:
    open_onnx(path, ("car",)).detect(np.zeros((24, 32, 3), np.uint8))


READERS: dict[str, Callable[[Path], object]] = {
    **dict.fromkeys(("array.xml", "array.csv", "array.json"), read_array),
    "camera.json": lambda path: (read_camera(path), read_camera_setup(path)),
    "car.json": read_car,
    **dict.fromkeys(("boxes.json", "coco.json", "mot.txt"), read_any_detections),
    "yolo/000000.txt": lambda path: read_any_detections(path.parent, size_px=(640, 480)),
    "model.json": read_model,
    "belief.json": read_checkpoint,
    "street.json": read_street,
    "beta.json": load_miss_rates,
    "context.json": read_context,
    "odometry.csv": read_odometry,
    "truth.json": lambda path: read_true_tracks(path.parent),
    "table.csv": read_features,
    "ids.csv": read_ids,
    "labels.csv": lambda path: read_labels(path, path.parent),
    "DataLog.csv": lambda path: OvadDataset(path.parent),
    "streams.npz": load_streams,
    "sound.wav": sound,
    "states.jsonl": lambda path: (log(path), read_state_near(path, 10**8)),
    "states.mcap": log,
    **dict.fromkeys(("log_mcap/log_mcap.mcap", "log_db3/log_db3.db3"), log),
    "bag_mcap/bag_mcap.mcap": bag,
    "bag_db3/bag_db3.db3": lambda path: bag(path.parent),
    "bag_db3/metadata.yaml": lambda path: bag(path.parent),
    "detector.onnx": detector,
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    write_inputs(folder)
    # A model that finds one car in every image.
    write_onnx(folder / "detector.onnx", np.array([[[16.0], [16.0], [20.0], [10.0], [0.9]]]))
    return folder


def read_each(name: str, folder: Path, seeds: range) -> int:
    """Read a differently damaged file for each seed; return the number of errors."""
    data, refused = (folder / name).read_bytes(), 0
    READERS[name](folder / name)
    for seed in seeds:
        (folder / name).write_bytes(spoilt(name, data, np.random.default_rng(seed)))
        try:
            limited()
            READERS[name](folder / name)
        except WorldstateError as error:
            refused += 1
            assert str(folder) in str(error) and "\n" not in str(error), (seed, str(error))
        except BaseException as error:
            raise AssertionError(f"seed {seed}") from error
    return refused


def limited() -> None:
    """Make the system end this process after the time limit of one file."""
    signal.setitimer(signal.ITIMER_PROF, MOST_S)
    signal.alarm(6 * MOST_S)


def peak_bytes() -> int:
    """Return the most memory of this process alone; ru_maxrss begins with that of the parent."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) << 10


def in_child(work: Callable[[], int], report: Path, most_bytes: int = MOST_BYTES) -> None:
    """Run work in a child process with measured memory and a time limit."""
    child = os.fork()
    if not child:
        try:
            for ended in (signal.SIGALRM, signal.SIGPROF):
                signal.signal(ended, signal.SIG_DFL)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            before = peak_bytes()
            resource.setrlimit(resource.RLIMIT_AS, (16 * MOST_BYTES, 16 * MOST_BYTES))
            refused = work()
            taken = peak_bytes() - before
            assert taken < most_bytes, f"{taken >> 20} MiB"
            report.write_text(f"{refused}")
            os._exit(0)
        except BaseException:
            report.write_text(traceback.format_exc())
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert status == 0, report.read_text() if report.exists() else f"ended by signal {os.WTERMSIG(status)}"


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("times", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_a_damaged_file_is_read_or_refused(name, times, whole, tmp_path):
    shutil.copytree(whole, folder := tmp_path / "files")
    in_child(lambda: read_each(name, folder, range(times)), report := tmp_path / "report")
    assert int(report.read_text()) >= times // 5


def zeros_zip(path: Path) -> None:
    """Write npz with an array that claims to be short and has 1.5 GB of zeros."""
    head = io.BytesIO()
    np.lib.format.write_array(head, np.zeros(3), version=(1, 0))
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("a.npy", "w", force_zip64=True) as member,
    ):
        member.write(head.getvalue())
        for _ in range(BOMB_MIB):
            member.write(bytes(1 << 20))


def long_zip(path: Path) -> None:
    """Write npz with an array that claims 10^12 numbers."""
    head = io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    np.lib.format.write_array_header_1_0(head, shape)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", head.getvalue())


def zstd_frame(mib: int, *, stated: bool = True) -> bytes:
    """Return a record of zeros as a zstd frame, with or without its size in the header."""
    told = {"size": mib << 20} if stated else {}
    writing = zstandard.ZstdCompressor().compressobj(**told)
    head = struct.pack("<BQ", 0x80, (mib << 20) - 9)
    parts = [head.ljust(1 << 20, b"\0"), *[bytes(1 << 20)] * (mib - 1)]
    return b"".join([*map(writing.compress, parts), writing.flush()])


def lz4_frame(mib: int) -> bytes:
    """Return zeros as an lz4 frame without its size in the header."""
    writing = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB)
    parts = [writing.begin(), *(writing.compress(bytes(1 << 20)) for _ in range(mib)), writing.flush()]
    return b"".join(parts)


def mcap_chunk(codec: str, data: bytes, claimed: int) -> bytes:
    """Return a chunk record that claims a size."""
    named = codec.encode()
    head = struct.pack("<QQQII", 0, 0, claimed, 0, len(named)) + named + struct.pack("<Q", len(data))
    return struct.pack("<BQ", 6, len(head) + len(data)) + head + data


def chunk_bomb(path: Path, codec: str, data: bytes, claimed: int) -> None:
    """Write MCAP of ROS 2 with one chunk and no index, so that every reader decodes the chunk."""
    head = struct.pack("<BQI", 1, 12, 4) + b"ros2" + bytes(4)
    end = struct.pack("<BQI", 15, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + MCAP
    path.write_bytes(MCAP + head + mcap_chunk(codec, data, claimed) + end)


# Codec, content and claimed size of each chunk. Readers also decode a second zstd frame.
CHUNK_BOMBS: dict[str, tuple[str, Callable[[], bytes], int]] = {
    "chunk": ("zstd", lambda: zstd_frame(BOMB_MIB), BOMB_MIB << 20),
    "secret": ("zstd", lambda: zstd_frame(BOMB_MIB), 1000),
    "unstated": ("zstd", lambda: zstd_frame(BOMB_MIB, stated=False), 1000),
    "second": ("zstd", lambda: zstd_frame(1) + zstd_frame(BOMB_MIB), 1 << 20),
    "unstated_lz4": ("lz4", lambda: lz4_frame(BOMB_MIB), 1000),
}


def indexed_bag(path: Path, chunks: bytes, indices: list[tuple[int, int, int]]) -> None:
    """Write MCAP of ROS 2 with an index of the position and both sizes of each chunk."""
    head = MCAP + struct.pack("<BQI", 1, 12, 4) + b"ros2" + bytes(4)
    end = struct.pack("<BQI", 15, 4, 0)
    summary = len(head) + len(chunks) + len(end)
    for place, packed, size in indices:
        index = struct.pack("<QQQQIQI", 0, 0, len(head) + place, 0, 0, 0, 4) + b"zstd"
        end += struct.pack("<BQ", 8, len(index) + 16) + index + struct.pack("<QQ", packed, size)
    path.write_bytes(head + chunks + end + struct.pack("<BQQQI", 2, 20, summary, 0, 0) + MCAP)


def test_an_index_outside_of_the_chunks_is_refused(tmp_path):
    """The bomb is in an attachment, which only a reader that trusts the index would decode."""
    bomb, chunk = zstd_frame(BOMB_MIB), mcap_chunk("zstd", zstd_frame(1), 1 << 20)
    hidden = struct.pack("<BQ", 9, 44 + len(bomb)) + bytes(44) + bomb
    for index in ((len(chunk), len(bomb), BOMB_MIB << 20), (0, len(bomb), BOMB_MIB << 20)):
        indexed_bag(tmp_path / "bomb.mcap", chunk + hidden, [index])
        refused_by("bomb.mcap: expected an index of its chunks", bag, tmp_path)


def test_chunks_that_exceed_the_memory_together_are_refused(tmp_path):
    chunk = mcap_chunk("zstd", frame := zstd_frame(200), 200 << 20)
    places = [(i * len(chunk), len(frame), 200 << 20) for i in range(6)]
    indexed_bag(tmp_path / "many.mcap", chunk * 6, places)
    refused_by("many.mcap: expected at most 512 MiB", bag, tmp_path)


def constant_bomb(path: Path) -> None:
    """Write a model with a node of 4 x 10^10 numbers, which would need 40 GB."""
    make, kind = onnx.helper, onnx.TensorProto
    image = make.make_tensor_value_info("images", kind.FLOAT, [1, 3, 32, 32])
    shape = onnx.numpy_helper.from_array(np.array([1, 100_000, 100_000], np.int64), "shape")
    result = make.make_tensor_value_info("output0", kind.FLOAT, None)
    nodes = [make.make_node("ConstantOfShape", ["shape"], ["output0"])]
    graph = make.make_graph(nodes, "large", [image], [result], [shape])
    onnx.save(make.make_model(graph, opset_imports=[make.make_opsetid("", 13)], ir_version=8), path)


BOMBS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "zeros.npz": (zeros_zip, load_streams),
    "long.npz": (long_zip, load_streams),
    "lists.json": (lambda path: path.write_text("[" + "[]," * 20_000_000 + "[]]"), read_any_detections),
    "line.jsonl": (lambda path: path.write_bytes(b"[" * (1 << 28)), log),
    "deep.xml": (lambda path: path.write_text("<a>" * 300_000), read_array),
    "constant.onnx": (constant_bomb, detector),
}


def refused_by(said: str, read: Callable[[Path], object], folder: Path) -> None:
    """Check that reading a file raises an error with its name, within memory and time limits."""
    name = said.partition(":")[0]

    def refused() -> int:
        limited()
        with pytest.raises(WorldstateError, match=said):
            read(folder / name)
        return 1

    in_child(refused, folder / "report")


@pytest.mark.long
@pytest.mark.parametrize("name", BOMBS)
def test_an_expanding_file_is_refused(name, tmp_path):
    write, read = BOMBS[name]
    write(tmp_path / name)
    refused_by(name, read, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("kind", CHUNK_BOMBS)
def test_an_expanding_chunk_is_refused(kind, tmp_path):
    codec, frame, claimed = CHUNK_BOMBS[kind]
    chunk_bomb(tmp_path / "bomb.mcap", codec, frame(), claimed)
    for read in (lambda path: list(read_messages(path, SNAPSHOT_TOPIC)), bag):
        refused_by("bomb.mcap", read, tmp_path)
    # The metadata of a folder may list files with other names.
    (folder := tmp_path / "folder").mkdir()
    (tmp_path / "bomb.mcap").rename(folder / "bomb.dat")
    with pytest.raises(WorldstateError, match=r"bomb\.dat: expected"):
        bag(folder)


# Files within their size limit that would expand in memory.

MIB = 1 << 20


RESULT = '{"image_id":107999,"category_id":3,"bbox":[1234.5,678,90,123],"score":0.9},'
COLUMNS = [*(f"feat{i}" for i in range(60)), "Class", "ID", "Environment", "T0", "Recording ID"]
HEADER, ROW = ",".join(COLUMNS) + "\n", "0," * 60 + "none,a,S,,b\n"
LABELS = "ID,Class,Environment,Recording ID\n"


def repeated(piece: str, size: int, head: str = "[", tail: str = "0]") -> str:
    """Return a text of at most this size, by default a list in JSON."""
    return head + piece * ((size - len(head) - len(tail)) // len(piece)) + tail


def drive() -> str:
    """Return an hour of images in OVAD's form, eight boxes each."""
    box = {"boxes": [1234.56, 789.01, 1500.23, 999.9], "scores": 0.9123, "classes_str": "car"}
    frame = json.dumps({name: [value] * 8 for name, value in box.items()})
    return f'{{"detections_per_frame": [{",".join([frame] * 54_000)}]}}'


# Files with a limit of 4,000,000 values have almost as many.
FILES: dict[str, tuple[Callable[[Path], object], Callable[[], str]]] = {
    "lists": (read_any_detections, lambda: repeated("[],", 5_999_992)),
    "keys": (read_any_detections, lambda: json.dumps({f"{i:x}": i + 300 for i in range(1_900_000)})),
    "wide text": (read_any_detections, lambda: '["\N{GRINNING FACE}' + "a" * (60 * MIB) + '"]'),
    "an hour of results": (read_any_detections, lambda: repeated(RESULT, 24 * MIB)),
    "an hour of images": (read_any_detections, drive),
    "rows": (
        read_mot_text,
        lambda: "".join(f"{i // 10 + 1},-1,{i}.5,2.5,{i}.25,4.5,.5,-1,-1\n" for i in range(999_990)),
    ),
    "empty objects": (read_model, lambda: repeated("{},", 5_999_992)),
    "numbers": (read_checkpoint, lambda: repeated("1.5,", 16 * MIB)),
    "ids": (read_ids, lambda: "\n".join(["ID", *map(str, range(199_000))])),
    "a wide header": (read_features, lambda: repeated("a\n", 16 * MIB, HEADER[:-1] + ",b" * MIB + "\n", "")),
    "windows": (read_features, lambda: repeated(ROW, 8 * MIB, HEADER, "")),
    "labels": (lambda path: read_labels(path, "."), lambda: repeated("a,none,S,b\n", 16 * MIB, LABELS, "")),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_no_file_within_its_limit_takes_a_gigabyte(name, tmp_path):
    read, content = FILES[name]
    (tmp_path / "file").write_text(content(), "utf-8")

    def work() -> int:
        try:
            read(tmp_path / "file")
        except WorldstateError as error:
            assert len(str(error)) < 1000, len(str(error))
        return 0

    in_child(work, tmp_path / "report", 850 * MIB)  # 150 MiB are those of the library


def test_many_empty_streams_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "streams.npz"
    save_tables(path, [HopTable({"time_s": np.zeros(0)}, name="a")] * 100_001)
    with pytest.raises(InputFileError, match="at most 100000 tables"):
        load_streams(path)


# Files and folders are written whole or not at all.


def test_a_failed_write_leaves_the_old_file_and_a_finished_one_replaces_it(tmp_path: Path) -> None:
    name = tmp_path / "states.npz"
    write_text(name, "old")
    with pytest.raises(RuntimeError), atomic_path(name) as temporary:
        temporary.write_text("half a line")
        assert name.read_text() == "old"
        raise RuntimeError
    assert [path.name for path in tmp_path.iterdir()] == ["states.npz"]
    assert name.read_text() == "old"
    with atomic_path(name) as temporary:
        np.savez(temporary, value=2)
    assert [path.name for path in tmp_path.iterdir()] == ["states.npz"]
    assert np.load(name)["value"] == 2
