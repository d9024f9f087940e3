"""Feature windows of labelled recordings: the command, the search for sound, errors with the line."""

import csv
import json
import re

import numpy as np
import pytest
import soundfile
from scipy.signal import resample_poly

from worldstate.adapters.datasets.feature_table import read_features
from worldstate.adapters.files.array_file import write_array_xml
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import published_feature

RATE = 16_000
ARRAY = MicrophoneArray([[0.0, 0.3, 0.0], [0.0, 0.0, 0.0], [0.0, -0.3, 0.0]])
HEADER = ["ID", "Class", "Environment", "Recording ID", "File", "End", "T0"]
ROWS = [
    ["1_00_0001", "left", "SA1", "34", "street/a.wav", "1.5", "70"],
    ["0_00_0001", "front", "SA1", "34", "street/a.wav", "", "70"],
    ["2_00_0007", "none", "SA1", "7", "", "", ""],
    ["3_00_0009", "right", "SB1", "9", "", "1.0", ""],
]


@pytest.fixture
def dataset(tmp_path):
    rng = np.random.default_rng(0)
    root = tmp_path / "data"
    for name, seconds in (
        ("street/a.wav", 2.0),
        ("SA1/none/2_00_0007/out_multi.wav", 1.0),
        ("3_00_0009.wav", 1.2),
    ):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        sound = 0.1 * rng.standard_normal((round(seconds * RATE), 3))
        soundfile.write(path, sound, RATE, subtype="PCM_16")
    write_array_xml(tmp_path / "mics.xml", ARRAY)
    return root


def write_labels(path, rows, header=HEADER):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def refusal(capsys, *words) -> str:
    assert command(*words) == 2
    return capsys.readouterr().err


def command(dataset, labels, out):
    listed = [] if labels is None else ["--labels", labels]
    words = [dataset, *listed, "--array", dataset.parent / "mics.xml", "--out", out, "--json"]
    return main(["model", "features", *map(str, words)])


def at_24_khz(sound: np.ndarray) -> np.ndarray:
    """Return the feature at the next rate that has the bins of the published one."""
    return published_feature(resample_poly(sound, 3, 2, window=("kaiser", 8.0)), ARRAY, 24_000)


def test_each_window_is_the_second_before_its_end(dataset, tmp_path, capsys):
    out = tmp_path / "features.csv"
    assert command(dataset, write_labels(tmp_path / "l.csv", ROWS), out) == 0
    assert json.loads(capsys.readouterr().out)["n_windows"] == 4
    table = read_features(out)
    assert table.labels.tolist() == ["left", "front", "none", "right"]
    assert table.t0_frames == (70, 70, None, None)
    assert table.recordings.tolist() == ["34", "34", "7", "9"]
    street, _ = soundfile.read(dataset / "street" / "a.wav", dtype="float32")
    other, _ = soundfile.read(dataset / "3_00_0009.wav", dtype="float32")
    for row, sound in ((0, street[8000:24_000]), (1, street[16_000:]), (3, other[:RATE])):
        np.testing.assert_allclose(table.features[row], at_24_khz(sound), atol=1e-4)


def test_only_the_labels_are_needed(dataset, tmp_path):
    labels = write_labels(tmp_path / "l.csv", [row[:4] for row in ROWS[2:]], HEADER[:4])
    command(dataset, labels, tmp_path / "f.csv")
    assert len(read_features(tmp_path / "f.csv")) == 2


@pytest.mark.parametrize(
    ("column", "value", "problem"),
    [
        ("Class", "up", "line 3: expected a class"),
        ("Environment", "", "line 3: expected a value of Environment"),
        ("End", "soon", "line 3"),
        ("End", "nan", "line 3: expected a finite number as End"),
        ("End", "0.5", "expected 1 s of sound before 0.5 s"),
        ("End", "9", "expected 1 s of sound before 9 s"),
        ("T0", "x", "line 3"),
        ("File", "../secret.wav", "line 3: expected a file inside"),
        ("File", "/etc/hosts", "line 3: expected a file inside"),
        ("File", "nowhere.wav", "line 3: expected a file nowhere.wav"),
    ],
)
def test_a_wrong_label_is_refused_with_its_line(dataset, tmp_path, column, value, problem, capsys):
    rows = [list(row) for row in ROWS]
    rows[1][HEADER.index(column)] = value
    assert problem in refusal(capsys, dataset, write_labels(tmp_path / "l.csv", rows), tmp_path / "f.csv")
    assert not (tmp_path / "f.csv").exists()


def test_another_array_is_refused(dataset, tmp_path, capsys):
    write_array_xml(tmp_path / "mics.xml", MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]))
    assert "channels" in refusal(capsys, dataset, write_labels(tmp_path / "l.csv", ROWS), tmp_path / "f.csv")


LOG = """ID,Environment,Class,T0
1_00_0001,SA1,left,12
2_00_0002,SA1,none,20
3_06_0003,DA2,right,13
1_02_0004,SB1,left,21
"""


def test_without_labels_windows_equal_those_of_the_released_program(tmp_path, capsys):
    root, rng = tmp_path / "ovad", np.random.default_rng(1)
    sounds = {}
    for row in csv.DictReader(LOG.splitlines()):
        path = root / row["Environment"] / row["Class"] / row["ID"] / "out_multi.wav"
        path.parent.mkdir(parents=True)
        soundfile.write(path, 0.1 * rng.standard_normal((round(3.5 * RATE), 3)), RATE, subtype="PCM_16")
        sounds[row["ID"]] = soundfile.read(path, dtype="float32")[0]
    (root / "DataLog.csv").write_text(LOG)
    write_array_xml(tmp_path / "mics.xml", ARRAY)
    assert command(root, None, tmp_path / "f.csv") == 0
    assert json.loads(capsys.readouterr().out)["n_left_out"] == 1  # the last one's front, which ends at 3.6 s
    table = read_features(tmp_path / "f.csv")
    found = dict(zip(table.ids, zip(table.labels, table.features, strict=True), strict=True))
    expected = {
        "1_00_0001": ("left", "1_00_0001", 1.2), "0_00_0000": ("front", "1_00_0001", 2.7),
        "2_00_0002": ("none", "2_00_0002", 2.0), "3_06_0003": ("right", "3_06_0003", 1.8),
        "0_06_0001": ("front", "3_06_0003", 3.3), "1_02_0004": ("left", "1_02_0004", 2.1),
    }  # fmt: skip
    assert found.keys() == expected.keys()
    for name, (label, recording, end_s) in expected.items():
        cut = sounds[recording][round((end_s - 1.0) * RATE) : round(end_s * RATE)]
        assert found[name][0] == label
        np.testing.assert_allclose(found[name][1], at_24_khz(cut), atol=1e-4)
    assert table.recordings.tolist() == ["0", "0", "1", "2", "2", "3"]


def test_a_data_set_of_recordings_too_short_is_refused(tmp_path, capsys):
    path = tmp_path / "SA1" / "left" / "1_00_0001" / "out_multi.wav"
    path.parent.mkdir(parents=True)
    soundfile.write(path, 0.1 * np.random.default_rng(0).standard_normal((round(1.2 * RATE), 3)), RATE)
    (tmp_path / "DataLog.csv").write_text("ID,Environment,Class,T0\n1_00_0001,SA1,left,4\n")
    write_array_xml(tmp_path.parent / "mics.xml", ARRAY)
    assert re.search(r"DataLog\.csv.*2 are cut off", refusal(capsys, tmp_path, None, tmp_path / "f.csv"))
