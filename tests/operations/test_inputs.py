"""Recordings and arrays of users in `array bearings`, `array bounds` and `array check`."""

import io
import json
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
from plane_waves import noise_from

from worldstate.adapters.audio.sound_file import RawPcm, open_sound
from worldstate.adapters.files.array_file import read_array, write_array_xml
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.errors import InputFileError, InvalidArgumentError

RATE = 8_000


def ring(n: int, radius_m: float) -> list[list[float]]:
    return [[radius_m * math.cos(a), radius_m * math.sin(a), 1.5] for a in 2 * np.pi * np.arange(n) / n]


def line(n: int, spacing_m: float, axis: int = 1) -> list[list[float]]:
    return [[spacing_m * i if k == axis else 0.0 for k in range(3)] for i in range(n)]


def plate(rows: int, columns: int, pitch_m: float, u: int, v: int) -> list[list[float]]:
    return [
        [pitch_m * i if k == u else pitch_m * j if k == v else 0.0 for k in range(3)]
        for i in range(rows)
        for j in range(columns)
    ]


OWN = {
    "pair across": line(2, 0.15),
    "four in a row": line(4, 0.05),
    "sixteen along": line(16, 0.04, 0),
    "six on a puck": ring(6, 0.046),
    "twelve round the roof": ring(12, 0.8),
    "sixteen on a board": plate(4, 4, 0.042, 1, 2),
    "board on the roof": plate(4, 4, 0.042, 0, 1),
    "four corners of a van": [[4.0, 0.9, 2], [4.0, -0.9, 2], [0, 0.9, 2], [0, -0.9, 2]],
    "tetrahedron": [[0, 0, 0], [0.1, 0, 0], [0.05, 0.09, 0], [0.05, 0.03, 0.08]],
    "32 at random": np.random.default_rng(3).uniform(-0.4, 0.4, (32, 3)).tolist(),
    "tilted plate": [[0.3 * y, y, z] for _, y, z in plate(3, 5, 0.07, 2, 1)],
}
FORMS = ("xml", "csv", "json", "txt")


def write_array(path: Path, positions: list[list[float]]) -> Path:
    if path.suffix == ".xml":
        write_array_xml(path, MicrophoneArray(positions))
    elif path.suffix == ".json":
        path.write_text(json.dumps({"positions_m": positions}))
    else:
        mark, head = (",", "name,x,y,z\n") if path.suffix == ".csv" else (" ", "")
        rows = (mark.join([f"m{i}", *map(str, one)]) + "\n" for i, one in enumerate(positions))
        path.write_text(head + "".join(rows))
    return path


def wave(array: MicrophoneArray, azimuth_deg: float) -> np.ndarray:
    return 0.1 * noise_from(array, math.radians(azimuth_deg), RATE, 1.3)


def rows_of(path: Path) -> np.ndarray:
    assert path.read_text().startswith("time_s,azimuth_deg,std_deg,prominence,at_edge")
    return np.loadtxt(path, delimiter=",", skiprows=1)


@pytest.mark.long
@pytest.mark.parametrize(("number", "name"), list(enumerate(OWN)))
def test_all_commands_accept_all_arrays(number: int, name: str, tmp_path: Path) -> None:
    file = write_array(tmp_path / f"mics.{FORMS[number % 4]}", OWN[name])
    array = read_array(file)
    np.testing.assert_allclose(array.positions_m, OWN[name])
    broadside = 90.0 if array.aperture_m[1] < 1e-3 else 0.0
    soundfile.write(tmp_path / "a.wav", wave(array, broadside), RATE)
    given = ["--array", str(file)]
    out = tmp_path / "b.csv"
    assert main(["array", "bearings", str(tmp_path / "a.wav"), *given, "--out", str(out)]) == 0
    rows = rows_of(out)
    assert len(rows) == 4
    assert np.abs(np.abs(rows[:, 1]) - broadside).max() < 8.0
    assert main(["array", "bounds", *given, "--json"]) == 0
    assert main(["array", "check", str(tmp_path / "a.wav"), *given]) in (0, 1)


def bearings(sound: np.ndarray, positions: list[list[float]], folder: Path, *options: str) -> Path:
    """Return the table of the command for this sound."""
    soundfile.write(folder / "a.wav", sound, RATE)
    given = ["--array", str(write_array(folder / "m.csv", positions)), "--out", str(folder / "b.csv")]
    assert main(["array", "bearings", str(folder / "a.wav"), *given, *options]) == 0
    return folder / "b.csv"


def test_a_ring_gives_bearings_all_round(tmp_path: Path) -> None:
    around, figure = ("--azimuth-span", "360"), tmp_path / "b.png"
    sound = wave(MicrophoneArray(ring(8, 0.2)), 150.0)
    found = rows_of(bearings(sound, ring(8, 0.2), tmp_path, *around, "--figure", str(figure)))
    np.testing.assert_allclose(found[:, 1], 150.0, atol=1.0)
    assert figure.is_file()


def test_integer_samples_are_scaled_to_full_scale() -> None:
    array = MicrophoneArray(ring(4, 0.2))
    sound = wave(array, 20.0)
    exact = np.round(sound * 2**15)
    (frame, *_) = FrontEnd(array, RATE).process(exact / 2**15)
    for whole in (exact.astype(np.int16), exact.astype(np.int32) * 2**16):
        (other, *_) = FrontEnd(array, RATE).process(whole)
        np.testing.assert_array_equal(other.band_log_energy, frame.band_log_energy)
    with pytest.raises(InvalidArgumentError, match="int16 or int32, got int64"):
        FrontEnd(array, RATE).process(exact.astype(np.int64))


@pytest.mark.parametrize("encoding", ["s16", "s24", "s32", "f32"])
def test_raw_samples_on_standard_input_equal_those_of_a_file(encoding, tmp_path, monkeypatch, capsys):
    sound, raw, out = wave(MicrophoneArray(ring(4, 0.2)), 20.0), io.BytesIO(), tmp_path / "b.csv"
    file = write_array(tmp_path / "m.csv", ring(4, 0.2))
    subtype = {"s16": "PCM_16", "s24": "PCM_24", "s32": "PCM_32", "f32": "FLOAT"}[encoding]
    soundfile.write(raw, sound, RATE, format="RAW", subtype=subtype)
    soundfile.write(tmp_path / "a.wav", sound, RATE, subtype=subtype)
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(raw.getvalue())))
    said = f"pcm:{RATE}:4:{encoding}"
    assert main(["array", "bearings", said, "--array", str(file), "--out", str(out)]) == 0
    by_pipe = out.read_text()
    assert main(["array", "bearings", str(tmp_path / "a.wav"), "--array", str(file), "--out", str(out)]) == 0
    assert by_pipe == out.read_text()
    capsys.readouterr()
    assert main(["array", "bearings", "-", "--array", str(file), "--out", str(out)]) == 2
    assert "pcm:RATE:CHANNELS:FORMAT" in capsys.readouterr().err


BAD_BYTES = [(3, "whole samples of 2"), (16_000, "at least 1 s"), (0, "at least 1 s"), (32_000, "constant")]


@pytest.mark.parametrize(("n_bytes", "problem"), BAD_BYTES)
def test_bad_samples_on_a_pipe_raise_an_error(n_bytes: int, problem: str) -> None:
    with pytest.raises(InputFileError, match=problem):
        open_sound(RawPcm(io.BytesIO(bytes(n_bytes)), RATE, 2))
    with pytest.raises(InputFileError, match="expected 3 channels"):
        open_sound(RawPcm(io.BytesIO(bytes(n_bytes - n_bytes % 4)), RATE, 2), 3)


def test_one_file_per_microphone_equals_one_file_of_all(tmp_path, capsys):
    sound = wave(MicrophoneArray(ring(4, 0.2)), 20.0)
    names = [tmp_path / f"mic{i}.wav" for i in range(4)]
    for name, channel in zip(names, sound.T, strict=True):
        soundfile.write(name, channel, RATE)
    out = bearings(sound, ring(4, 0.2), tmp_path)
    together = out.read_text()
    words = ["array", "bearings", *map(str, names), "--array", str(tmp_path / "m.csv"), "--out", str(out)]
    assert main(words) == 0
    assert together == out.read_text()
    for wrong, problem in (
        (sound[:-1, 2], "mic2.wav: expected 10400 samples at 8000 Hz as in mic0.wav"),
        (sound[:, :2], "expected 1 channels"),
    ):
        soundfile.write(names[2], wrong, RATE)
        assert main(words) == 2
        assert problem in capsys.readouterr().err


def recorded_by_card(path: Path, sound: np.ndarray, silent: int) -> Path:
    """Write a beam, the microphones and silent channels as a sound card does."""
    beam = np.random.default_rng(4).normal(0, 0.3, (len(sound), 1))
    soundfile.write(path, np.hstack([beam, sound, np.zeros((len(sound), silent))]), RATE)
    return path


@pytest.mark.parametrize("silent", [1, 12])
def test_channels_of_a_sound_card_are_selected(silent, tmp_path, monkeypatch):
    array, out = read_array("respeaker-usb"), tmp_path / "b.csv"
    sound = wave(array, 20.0)
    soundfile.write(tmp_path / "chosen.wav", sound, RATE)
    card = recorded_by_card(tmp_path / "card.wav", sound, silent)
    raw = io.BytesIO()
    soundfile.write(raw, soundfile.read(card)[0], RATE, format="RAW", subtype="PCM_16")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(raw.getvalue())))
    file = write_array(tmp_path / "m.csv", array.positions_m.tolist())
    (tmp_path / "car.json").write_text('{"array": {"file": "respeaker-usb"}}')

    def with_channels(*channels: int) -> str:
        told = {"positions_m": array.positions_m.tolist(), "channels": channels}
        (tmp_path / "chosen.json").write_text(json.dumps(told))
        return str(tmp_path / "chosen.json")

    def written(sound: Path | str, *options: str) -> str:
        assert main([*command, str(sound), *options, "--out", str(out)]) == 0
        return out.read_text()

    command = ["array", "bearings"]
    expected = written(tmp_path / "chosen.wav", "--array", str(file))
    assert written(card, "--array", "respeaker-usb") == expected
    assert written(card, "--array", with_channels(2, 3, 4, 5)) == expected
    assert written(f"pcm:{RATE}:{5 + silent}", "--array", "respeaker-usb") == expected
    assert written(tmp_path / "chosen.wav", "--array", "respeaker-usb") == expected
    turned = written(tmp_path / "chosen.wav", "--array", with_channels(2, 3, 4, 1))
    assert turned != expected
    assert written(card, "--array", with_channels(3, 4, 5, 2)) == turned
    command = ["run", "--uncalibrated"]
    expected = written(tmp_path / "chosen.wav", "--array", str(file))
    assert written(card, "--array", "respeaker-usb") == expected
    assert written(card, "--car", str(tmp_path / "car.json")) == expected
    assert written(card, "--array", with_channels(2, 3, 4, 5)) == expected


@pytest.mark.parametrize(
    ("channels", "problem"),
    [
        ([4, 5, 6, 7], "card.wav: expected at least 7 channels, the largest.*number.*, got 6"),
        ([2, 2, 3, 4], "channels: expected 4 different numbers from 1 on.*got 2, 2, 3, 4"),
        ([2, 3, 4], "channels: expected 4 different.* one for each microphone, got 2, 3, 4"),
        ([], "card.wav: expected 4 channels, one per microphone, got 6; .channels. in the JSON file"),
    ],
)
def test_wrong_channels_raise_an_error(channels, problem, tmp_path, capsys):
    file = tmp_path / "m.json"
    file.write_text(json.dumps({"positions_m": ring(4, 0.2)} | ({"channels": channels} if channels else {})))
    card = recorded_by_card(tmp_path / "card.wav", wave(MicrophoneArray(ring(4, 0.2)), 20.0), 1)
    assert main(["run", str(card), "--array", str(file), "--uncalibrated"]) == 2
    assert re.search(problem, capsys.readouterr().err)
