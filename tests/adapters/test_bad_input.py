"""Bad input raises a typed error with the file and the expectation, and leaves no partial file."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.adapters.audio.sound_file import open_audio
from worldstate.adapters.camera.detections import read_any_detections, read_detections
from worldstate.adapters.files.array_file import read_array, write_array_xml
from worldstate.adapters.files.file_io import atomic_path, write_text
from worldstate.adapters.files.model_file import read_model, save_model
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError

RATE_HZ = 8000


def noise(frames: int = 12_000, channels: int = 4) -> np.ndarray:
    return np.random.default_rng(1).uniform(-0.5, 0.5, (frames, channels))


def write(path: Path, samples: np.ndarray, **how: Any) -> Path:
    soundfile.write(path, samples, RATE_HZ, **how)
    return path


def spoilt(column: int, value: float, rows: slice = slice(None)) -> np.ndarray:
    samples = noise()
    samples[rows, column] = value
    return samples


def expect(problem: str, path: Path, action: Callable[[], object]) -> None:
    with pytest.raises(InputFileError, match=problem) as raised:
        action()
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


def read_all(path: Path) -> None:
    with open_audio(path) as source:
        for _ in source.blocks():
            pass


# --- sound -----------------------------------------------------------------------------------------------


def test_missing_sound(tmp_path: Path) -> None:
    expect("no such file", tmp_path / "no.wav", lambda: open_audio(tmp_path / "no.wav"))
    expect("found a folder", tmp_path, lambda: open_audio(tmp_path))


@pytest.mark.parametrize("data", [b"", b"RIFF", b"hello, world" * 100, b"RIFF\0\0\0\0WAVE", bytes(5000)])
def test_other_bytes_are_no_sound(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.wav").write_bytes(data)
    expect("expected", tmp_path / "a.wav", lambda: open_audio(tmp_path / "a.wav"))


def test_lossy_sound(tmp_path: Path) -> None:
    name = write(tmp_path / "a.ogg", noise(channels=2), format="OGG", subtype="VORBIS")
    expect("plain samples, got OGG VORBIS", name, lambda: open_audio(name))
    name = write(tmp_path / "a.wav", noise(channels=2), subtype="IMA_ADPCM")
    expect("got WAV IMA_ADPCM", name, lambda: open_audio(name))


@pytest.mark.parametrize("container", ["WAV", "WAVEX", "RF64", "W64", "FLAC"])
@pytest.mark.parametrize("kept", [0.999, 0.9, 0.5])
def test_truncated_sound(tmp_path: Path, container: str, kept: float) -> None:
    name = write(tmp_path / "cut", noise(), format=container, subtype="PCM_24")
    name.write_bytes(name.read_bytes()[: int(kept * name.stat().st_size)])
    expect("cut short", name, lambda: open_audio(name))


@pytest.mark.parametrize("container", ["WAV", "RF64", "W64", "FLAC"])
@given(cut=st.integers(0, 400))
@settings(max_examples=25, deadline=None)
def test_a_cut_anywhere_in_the_header_is_typed(
    tmp_path_factory: pytest.TempPathFactory, container: str, cut: int
) -> None:
    name = write(tmp_path_factory.mktemp("cut") / "cut", noise(), format=container, subtype="PCM_24")
    name.write_bytes(name.read_bytes()[:cut])
    expect("expected", name, lambda: open_audio(name))


@pytest.mark.parametrize("container", ["WAV", "RF64", "W64", "FLAC"])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_a_damaged_header_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, container: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("bad")
    name = write(folder / "bad", noise(frames=9000), format=container, subtype="PCM_16")
    data = bytearray(name.read_bytes())
    for position in rng.integers(0, 120, 4):
        data[position] = rng.integers(0, 256)
    name.write_bytes(data)
    try:
        read_all(name)
    except InputFileError as error:
        assert str(name) in str(error)


def test_wrong_channel_count(tmp_path: Path) -> None:
    name = write(tmp_path / "a.wav", noise())
    problem = "expected 56 channels, one per microphone, got 4"
    expect(problem, name, lambda: open_audio(name, expect_channels=56))


def test_too_short(tmp_path: Path) -> None:
    name = write(tmp_path / "a.wav", noise(frames=RATE_HZ - 1))
    expect("at least 1 s", name, lambda: open_audio(name))
    name = write(tmp_path / "b.wav", noise(frames=0))
    expect("empty", name, lambda: open_audio(name))


def test_silent_channels(tmp_path: Path) -> None:
    samples = noise()
    samples[:RATE_HZ, [0, 2]] = [0.0, 0.25]
    name = write(tmp_path / "a.wav", samples)
    expect("on channel 1, 3$", name, lambda: open_audio(name))
    samples[RATE_HZ - 1, [0, 2]] = 0.1
    with open_audio(write(tmp_path / "b.wav", samples)) as source:
        assert source.channels == 4


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_samples_that_are_no_numbers(tmp_path: Path, value: float) -> None:
    name = write(tmp_path / "a.wav", spoilt(1, value, slice(50, 51)), subtype="FLOAT")
    expect(r"expected finite samples, got \S+ in channel 2, sample 50$", name, lambda: open_audio(name))
    name = write(tmp_path / "b.wav", spoilt(3, value, slice(9000, 9001)), subtype="DOUBLE")
    expect("in channel 4, sample 9000$", name, lambda: read_all(name))


def test_a_refused_file_is_closed_again(tmp_path: Path) -> None:
    name = write(tmp_path / "a.wav", noise())
    opened = len(list(Path("/proc/self/fd").iterdir())) if Path("/proc/self/fd").is_dir() else 0
    for _ in range(20):
        with pytest.raises(InputFileError):
            open_audio(name, expect_channels=3)
    if opened:
        assert len(list(Path("/proc/self/fd").iterdir())) <= opened


# --- arrays ----------------------------------------------------------------------------------------------

POS = '<pos Name="Point {0}" x="0.{0}" y="0" z="0"/>'
TWO = POS.format(1) + POS.format(2)
BOMB = '<!DOCTYPE m [<!ENTITY a "1"><!ENTITY b "&a;&a;">]><MicArray>{}<pos x="&b;" y="0" z="0"/></MicArray>'
EXTERNAL = '<!DOCTYPE m [<!ENTITY a SYSTEM "file:///etc/hostname">]><MicArray>&a;{}</MicArray>'


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (BOMB.format(TWO), "entities, which are refused"),
        (EXTERNAL.format(TWO), "entities, which are refused"),
        ('<!DOCTYPE MicArray SYSTEM "a.dtd"><MicArray/>', "refused"),
        ("", "as XML, JSON or CSV"),
        ("x;y;z\n0,1;0;0\n0,2;0;0", "expected decimal points, got decimal commas"),
        ("name,left,right\na,0,0", "columns x, y, z"),
        ("0,0.1,0\n0,0.2\n", "microphone 2: .* finite number as z, got None"),
        ("0,0,0\n0,0,0.5\n", "vertical line"),
        ("0,-10,0\n0,0,0\n0,10,0\n", "centimetres"),
        ("0,1e-5,0\n0,0,0\n", "expected positions in metres"),
        ("0,0.1,0\n0,0.2,0\n0,0.200000001,0\n", "microphones 2 and 3 1e-09 m apart"),
        ("0,0.1,0\n0,0.1,0\n", "microphones 1 and 2 0 m apart"),
        ("[[0, 0.1, 0], [0, -0.1]]", "positions"),
        ("[[0, 0.1, 0], [0, -0.1, true]]", "microphone 2: .* finite number as z, got True"),
        ("[[0, 0.1, 0], [0, -0.1, NaN]]", "microphone 2"),
        (
            '{"positions_m": [[0, 0.1, 0], [0, -0.1, 0]], "axes": "ned"}',
            "axes: expected acoular or base_link",
        ),
        ('{"positions": []}', "positions_m"),
        ("[" * 100_000, "does not parse"),
        ("<MicArray>" + TWO, "does not parse"),
        ("<MicArray/>", "expected 2 to 1024"),
        (f"<MicArray>{POS.format(1)}</MicArray>", "got 1"),
        (f"<MicArray>{TWO}<pos x='1' y='0'/></MicArray>", "microphone 3: .* finite number as z, got None"),
        (f"<MicArray>{TWO}<pos x='1,5' y='0' z='0'/></MicArray>", "microphone 3: .* finite number as x"),
        (f"<MicArray>{TWO}<pos x='nan' y='0' z='0'/></MicArray>", "microphone 3"),
        (f"<MicArray>{TWO}<pos x='1' y='inf' z='0'/></MicArray>", "microphone 3"),
        (f"<MicArray>{TWO}<pos x='390' y='0' z='0'/></MicArray>", "millimetres"),
        (f"<MicArray>{POS.format(1) * 2}</MicArray>", "microphones 1 and 2 0 m apart"),
        ("<MicArray>" + TWO * 513 + "</MicArray>", "got 1026"),
        ("<?xml version='1.0' encoding='klingon'?><MicArray/>", "does not parse"),
    ],
)
def test_bad_arrays(tmp_path: Path, text: str, problem: str) -> None:
    name = tmp_path / "mics.xml"
    name.write_text(text)
    expect(problem, name, lambda: read_array(name))


def test_missing_and_huge_arrays(tmp_path: Path) -> None:
    expect("No such file", tmp_path / "no.xml", lambda: read_array(tmp_path / "no.xml"))
    expect("array file", tmp_path, lambda: read_array(tmp_path))
    (tmp_path / "big.xml").write_bytes(b"<MicArray>" + b" " * (1 << 20) + b"</MicArray>")
    expect("at most", tmp_path / "big.xml", lambda: read_array(tmp_path / "big.xml"))


@given(data=st.binary(max_size=300))
@settings(max_examples=60, deadline=None)
def test_any_bytes_as_an_array(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    name = tmp_path_factory.mktemp("xml") / "mics.xml"
    name.write_bytes(data)
    with pytest.raises(InputFileError):
        read_array(name)


# --- detections ------------------------------------------------------------------------------------------

GOOD: dict[str, list[Any]] = {"boxes": [[0, 0, 10, 20]], "scores": [0.9], "classes_str": ["car"]}


def at(stamp_ns: float) -> dict[str, object]:
    return {**GOOD, "stamp_ns": stamp_ns}


def frames(*rows: object) -> str:
    return json.dumps({"detections_per_frame": list(rows)})


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "expected JSON"),
        ("{", "expected JSON"),
        ('{"detections_per_frame": [', "expected JSON"),
        ("[" * 100_000, "expected JSON"),
        ("[]", "detections_per_frame"),
        ("{}", "detections_per_frame"),
        ('{"detections_per_frame": {}}', "detections_per_frame"),
        (frames(GOOD, 3), "frame 1: expected an object, got 3"),
        (frames({"boxes": [], "scores": []}), r"frame 0\.classes_str: expected a list .*, got None"),
        (frames({**GOOD, "scores": []}), "frame 0: expected as many of each, .*1 boxes, 0 scores"),
        (frames({**GOOD, "boxes": [[0, 0, 10]]}), r"boxes_px: expected shape \(1, 4\), got \(1, 3\)"),
        (frames({**GOOD, "boxes": [["0", "0", "1", "2"]]}), "expected a finite number, got '0'"),
        (
            frames({**GOOD, "boxes": [[0, 0, True, 2]]}),
            r"boxes\[0\]\[2\]: expected a finite number, got True",
        ),
        (frames({**GOOD, "boxes": [[0, 0, None, 2]]}), "expected a finite number, got None"),
        (frames({**GOOD, "boxes": [[10, 0, 0, 20]]}), "x1 <= x2"),
        (frames({**GOOD, "scores": [1.5]}), r"boxes\[0\]: .* scores in \[0, 1\], got .* with 1\.5"),
        (frames({**GOOD, "classes_str": [3]}), r"classes_str\[0\]: expected text, got 3"),
        (frames(GOOD, {**GOOD, "scores": [float("nan")]}), "NaN is not a JSON"),
        (frames({**GOOD, "boxes": [[0, 0, float("inf"), 2]]}), "Infinity is not a JSON"),
        (frames(GOOD).replace("20", "1e999"), r"boxes\[0\]\[3\]: expected a finite number"),
        (frames(GOOD).replace("20", "2" * 4000), r"boxes\[0\]\[3\]: expected a finite number"),
        (frames(GOOD).replace("20", "2" * 5000), "expected JSON"),
        (frames({key: value * 1001 for key, value in GOOD.items()}), "at most 1000"),
        (frames(at(5), GOOD), "frame 1: expected stamp_ns, as in other frames"),
        (frames(at(0.5)), r"frame 0\.stamp_ns: expected a whole number .*, got 0\.5"),
    ],
)
def test_bad_detections(tmp_path: Path, text: str, problem: str) -> None:
    name = tmp_path / "d.json"
    name.write_text(text)
    expect(problem, name, lambda: read_detections(name))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"detections_per_frame": [%s %s]}', "frame 1: expected JSON"),
        ('{"detections_per_frame": [%s, %s,]}', "frame 2: expected JSON"),
        ('{"detections_per_frame": [%s, %s]', "expected JSON"),
        ('{"detections_per_frame": [%s, %s]} {}', "expected JSON"),
        ('{"note": {"detections_per_frame": [%s, %s]}}', "expected an object with a list"),
        ('[%s, %s]', r"COCO.annotations\[0\].image_id"),
        ('{"detections_per_frame": [%s, %s, [[[]]]]}', "frame 2: expected an object"),
        ('{"detections_per_frame": [%s, %s], "a": NaN}', "NaN is not a JSON"),
        ('{"detections_per_frame": [%s, %s], "a": "\\ud800"}', "half a surrogate pair"),
    ],
)  # fmt: skip
def test_detections_that_are_read_one_by_one_are_as_strict(tmp_path: Path, text: str, problem: str) -> None:
    name, good = tmp_path / "d.json", json.dumps(GOOD)
    name.write_text(text % (good, good))
    expect(problem, name, lambda: read_any_detections(name))
    for blanks in (
        '{ "detections_per_frame" :\n[ %s\n,\t%s ]\n, "model": 1}',
        '{"a": {}, "detections_per_frame": [%s,%s]}',
    ):
        name.write_text(blanks % (good, good))
        assert len(read_any_detections(name)) == 2


def test_missing_detections_and_rates(tmp_path: Path) -> None:
    expect("No such file", tmp_path / "no.json", lambda: read_detections(tmp_path / "no.json"))
    for rate_hz in (0.0, float("nan"), 1e6):
        with pytest.raises(InvalidArgumentError, match="frame_rate_hz"):
            read_detections(tmp_path / "no.json", rate_hz)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from([*GOOD, "stamp_ns"]), inner),
    max_leaves=25,
)


@pytest.mark.long
@given(rows=st.lists(JSON, max_size=3))
@settings(max_examples=150, deadline=None)
def test_any_json_as_detections(tmp_path_factory: pytest.TempPathFactory, rows: list[Any]) -> None:
    name = tmp_path_factory.mktemp("json") / "d.json"
    name.write_text(frames(*rows))
    try:
        assert len(read_detections(name)) <= len(rows)  # of equal stamps one counts
    except InputFileError as error:
        assert str(error).startswith(f"{name}: ")


# --- models ----------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("version", ["2.0.0", "0.9.0"])
def test_a_model_of_another_major_version(tmp_path: Path, version: str) -> None:
    save_model(tmp_path / "model.json", read_model())
    document = json.loads((tmp_path / "model.json").read_text())
    assert document["schema"]["version"].startswith("1.")
    document["schema"]["version"] = version
    name = tmp_path / "other.json"
    name.write_text(json.dumps(document))
    with pytest.raises(SchemaVersionError, match=version) as raised:
        read_model(name)
    assert str(raised.value).startswith(f"{name}: ")


# --- nothing half-written --------------------------------------------------------------------------------


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    name = tmp_path / "states.jsonl"
    write_text(name, "old")
    with pytest.raises(RuntimeError), atomic_path(name) as temporary:
        temporary.write_text("half a line")
        assert name.read_text() == "old"
        raise RuntimeError
    assert [path.name for path in tmp_path.iterdir()] == ["states.jsonl"]
    assert name.read_text() == "old"


def test_a_finished_write_replaces_the_old_file(tmp_path: Path) -> None:
    name = tmp_path / "a.npz"
    for value in (1, 2):
        with atomic_path(name) as temporary:
            np.savez(temporary, value=value)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]
    assert np.load(name)["value"] == 2


def test_folders_are_written_whole_too(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "set") as temporary:
        temporary.mkdir()
        (temporary / "one").write_text("1")
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "other") as temporary:
        temporary.mkdir()
        (temporary / "one").write_text("1")
        raise RuntimeError
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")) == ["set", "set/one"]


def test_writers_refuse_a_missing_folder(tmp_path: Path) -> None:
    array = MicrophoneArray(np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]))
    name = tmp_path / "nowhere" / "mics.xml"
    expect("expected an existing folder", name, lambda: write_array_xml(name, array))
    (tmp_path / "taken").mkdir()
    expect("found a folder", tmp_path / "taken", lambda: write_text(tmp_path / "taken", "x"))
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
