"""Files within their size limit that would expand in memory: at most 1 GB is used."""

import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from worldstate.ground.errors import InputFileError
from worldstate.operations.recordings.hop_table import HopTable, load_streams, save_tables

MIB = 1 << 20
MOST_KIB = 1_000_000_000 // 1024
# A limit of 4 GB protects the machine if a bound fails.
MEASURE = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
from worldstate.adapters.camera.detections import read_any_detections, read_mot_text
from worldstate.adapters.datasets.feature_extraction import read_labels
from worldstate.adapters.datasets.feature_table import read_features, read_ids
from worldstate.adapters.files.checkpoint_file import read_checkpoint
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import WorldstateError

def peak_kib():
    # Of this process alone: ru_maxrss begins with what the process that started it had.
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))

for name, reader, path in zip(*[iter(sys.argv[1:])] * 3):
    try:
        globals()[reader](path, *(["."] if reader == "read_labels" else []))
    except WorldstateError as error:
        assert len(str(error)) < 1000, len(str(error))
    print(name, peak_kib(), sep=";")
"""


def repeated(piece: str, size: int, head: str = "", tail: str = "") -> bytes:
    return (head + piece * ((size - len(head) - len(tail)) // len(piece)) + tail).encode()


def json_list(piece: str, size: int, values: int | None = None) -> bytes:
    """Return a JSON list of `size` bytes or of `values` values."""
    wanted = size if values is None else min(size, values // sum(map(piece.count, "[{:,")) * len(piece) - 8)
    return repeated(piece, wanted, "[", "0]")


def mot_rows() -> bytes:
    return "".join(f"{i // 10 + 1},-1,{i}.5,2.5,{i}.25,4.5,.5,-1,-1\n" for i in range(999_990)).encode()


def keys(count: int) -> bytes:
    return json.dumps({f"{i:x}": i + 300 for i in range(count)}).encode()


RESULT = '{"image_id":107999,"category_id":3,"bbox":[1234.5,678,90,123],"score":0.9},'


def drive(note: str, images: int = 1) -> bytes:
    """Return images in OVAD's form, eight boxes each."""
    image = {
        "boxes": [[1234.56, 789.01, 1500.23, 999.9]] * 8,
        "scores": [0.9123] * 8,
        "classes_str": ["car"] * 8,
    }
    frames = ",".join([json.dumps(image)] * images)
    return f'{{"detections_per_frame": [{frames}], "note": "{note}"}}'.encode()


COLUMNS = [*(f"feat{i}" for i in range(60)), "Class", "ID", "Environment", "T0", "Recording ID"]
HEADER, ROW = ",".join(COLUMNS) + "\n", "0," * 60 + "none,a,S,,b\n"
LONG_NAME = HEADER + ROW.replace("a", "a" * 100_000)
LABELS = "ID,Class,Environment,Recording ID\n"
FILES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "empty lists": ("read_any_detections", lambda: json_list("[],", 64 * MIB)),
    "as many lists as may be": ("read_any_detections", lambda: json_list("[],", 64 * MIB, 4_000_000)),
    "as many keys as may be": ("read_any_detections", lambda: keys(1_900_000)),
    "wide text": ("read_any_detections", lambda: ('["\N{GRINNING FACE}' + "a" * (60 * MIB) + '"]').encode()),
    "a wide drive": ("read_any_detections", lambda: drive("\N{GRINNING FACE}" + "a" * (62 * MIB))),
    "an hour of results": ("read_any_detections", lambda: json_list(RESULT, 24 * MIB)),
    "an hour of images": ("read_any_detections", lambda: drive("", 54_000)),
    "as many rows as may be": ("read_mot_text", mot_rows),
    "wide rows": ("read_mot_text", lambda: ("\N{GRINNING FACE}" + "1," * (31 * MIB)).encode()),
    "empty objects": ("read_model", lambda: json_list("{},", 16 * MIB, 4_000_000)),
    "numbers": ("read_checkpoint", lambda: json_list("1.5,", 16 * MIB)),
    "short ids": ("read_ids", lambda: repeated("a\n", 16 * MIB, "ID\n")),
    "as many ids as may be": ("read_ids", lambda: "\n".join(["ID", *map(str, range(199_000))]).encode()),
    "a wide line": ("read_ids", lambda: repeated("ab,", 16 * MIB, "ID,", "\n")),
    "a wide header": ("read_features", lambda: repeated("a\n", 16 * MIB, HEADER[:-1] + ",b" * MIB + "\n")),
    "one long name": ("read_features", lambda: repeated(ROW, 8 * MIB, LONG_NAME)),
    "windows": ("read_features", lambda: repeated(ROW, 8 * MIB, HEADER)),
    "labels": ("read_labels", lambda: repeated("a,none,S,b\n", 16 * MIB, LABELS)),
}


@pytest.mark.slow
def test_no_file_within_its_limit_takes_a_gigabyte(tmp_path: Path) -> None:
    words: list[str] = []
    for number, (name, (reader, content)) in enumerate(FILES.items()):
        path = tmp_path / str(number)
        path.write_bytes(content())
        words += [name, reader, str(path)]
    command = [sys.executable, "-c", MEASURE, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120.0)
    for path in tmp_path.iterdir():
        path.unlink()
    assert done.returncode == 0, done.stderr
    peaks = {name: int(peak) for name, peak in (line.split(";") for line in done.stdout.splitlines())}
    assert list(peaks) == list(FILES)
    assert max(peaks.values()) < MOST_KIB, peaks


def test_arrays_are_measured_before_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "streams.npz"
    save_tables(path, [HopTable({"time_s": np.zeros(3)}, name="a")])
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("more.npy", "w") as member:
        header = {"descr": "|i1", "fortran_order": False, "shape": (70_000_000,)}
        np.lib.format.write_array_header_1_0(member, header)
        member.write(bytes(1000))
    with pytest.raises(InputFileError, match="at most 512 MiB"):
        load_streams(path)


def test_many_members_and_many_empty_streams_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "streams.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(2000):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(InputFileError, match="short list of members"):
        load_streams(path)
    save_tables(path, [HopTable({"time_s": np.zeros(0)}, name="a")] * 100_001)
    with pytest.raises(InputFileError, match="at most 100000 tables"):
        load_streams(path)
