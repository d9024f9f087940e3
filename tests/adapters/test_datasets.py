"""Data sets in the layout of OVAD, tables of feature windows, and their extraction from recordings."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
from camera_boxes import EMPTY, write_boxes
from made_up_sound import THREE
from scipy.signal import resample_poly

from worldstate.adapters import OvadDataset, write_array_xml
from worldstate.adapters.datasets.feature_table import FEATURE_COLUMNS, LABEL_COLUMNS, read_features, read_ids
from worldstate.adapters.datasets.ovad import DETECTION_NAMES, Recording, choose_array, read_true_tracks
from worldstate.cli.main import main
from worldstate.frontend import published_feature
from worldstate.ground.errors import InputFileError, InvalidArgumentError

RATE = 16_000
ROWS = ("1_00_0002,SA1,left,70", "2_00_0007,SA1,none,70", "3_08_0119,DB2,right,58")


def write_log(root: Path, *rows: str, header: str = "ID,Environment,Class,T0") -> Path:
    (root / "DataLog.csv").write_text("\n".join([header, *rows]) + "\n")
    return root


def write_sound(path: Path, seconds: float = 1.2) -> np.ndarray:
    """Write noise of three microphones; return it as it is read."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(sum("".join(path.parts[-3:]).encode()))
    soundfile.write(path, 0.1 * rng.standard_normal((round(seconds * RATE), 3)), RATE, subtype="PCM_16")
    return soundfile.read(path, dtype="float32")[0]


def recorded(folder: Path) -> Path:
    write_sound(folder / "out_multi.wav")
    return folder


def write_csv(path, rows, header):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


# Recordings.


def test_recordings_are_those_of_the_log(tmp_path: Path) -> None:
    left, none, right = OvadDataset(write_log(tmp_path, *ROWS)).recordings
    assert (left.recording_id, left.label, left.moving_ego) == ("1_00_0002", "left", False)
    assert (left.t0_frame, left.t0_s) == (70, 7.0)
    assert left.audio_path == tmp_path / "SA1" / "left" / "1_00_0002" / "out_multi.wav"
    assert (none.label, none.t0_frame, none.t0_s) == ("none", None, None)
    assert (right.moving_ego, right.t0_s) == (True, 5.8)
    text = "\ufeffT0,Note,Class,ID,Environment\n70,wet road,left,1_00_0002,SA1\n"
    (tmp_path / "DataLog.csv").write_text(text, encoding="utf-8")
    assert OvadDataset(tmp_path).recordings[0] == left


@pytest.mark.parametrize("name", DETECTION_NAMES)
def test_a_recording_opens_its_sound_and_detections(tmp_path: Path, name: str) -> None:
    folder = recorded(tmp_path / "SA1" / "left" / "1_00_0002")
    recording = Recording.open(folder)
    with recording.open_audio(expect_channels=3) as source:
        assert source.frames == round(1.2 * RATE)
    assert recording.detections_path is None and recording.read_detections() is None
    write_boxes(folder / name, [EMPTY])
    assert recording.detections_path == folder / name
    log = recording.read_detections()
    assert log is not None and len(log) == 1


def test_a_bare_folder_finds_its_log_or_uses_its_path(tmp_path: Path) -> None:
    write_log(tmp_path, *ROWS)
    folder = recorded(tmp_path / "DB2" / "right" / "3_08_0119")
    assert Recording.open(folder) == Recording(folder, "3_08_0119", "DB2", "right", 58)
    assert Recording.open(folder / ".." / "3_08_0119").t0_s == 5.8
    folder = recorded(tmp_path / "SA2" / "right" / "mine")
    assert Recording.open(folder) == Recording(folder, "mine", "SA2", "right", None)
    alone = Recording.open(recorded(tmp_path / "street" / "today" / "run"))
    assert (alone.environment, alone.label, alone.moving_ego, alone.t0_s) == (None,) * 4


def test_a_folder_that_contradicts_its_log_or_has_no_sound_is_refused(tmp_path: Path) -> None:
    write_log(tmp_path, *ROWS)
    with pytest.raises(InputFileError, match=r"DataLog\.csv: expected 1_00_0002 in SA1/left"):
        Recording.open(recorded(tmp_path / "SA1" / "right" / "1_00_0002"))
    with pytest.raises(InputFileError, match=r"out_multi\.wav"):
        Recording.open(tmp_path)


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("1_00_0002,SA1,left,7.5", "line 2: expected T0 as a frame number"),
        ("1_00_0002,SA1,left,99999999999999999999", "T0"),
        ("1_00_0002,SA1,front,70", "line 2: expected Class left, none or right, got 'front'"),
        ("1_00_0002,../..,left,70", "expected an Environment"),
        ("../../etc,SA1,left,70", "line 2: expected an ID"),
        (",SA1,left,70", "expected an ID"),
        ("\n".join([ROWS[0], *ROWS]), "expected every ID once, got 1_00_0002 twice"),
    ],
)
def test_a_damaged_log_is_refused(tmp_path: Path, row: str, problem: str) -> None:
    with pytest.raises(InputFileError, match=problem) as raised:
        OvadDataset(write_log(tmp_path, row))
    assert str(raised.value).startswith(str(tmp_path / "DataLog.csv"))


def test_missing_columns_and_a_missing_log_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="missing Class, T0"):
        OvadDataset(write_log(tmp_path, "1_00_0002,SA1", header="ID,Environment"))
    with pytest.raises(InputFileError, match="DataLog"):
        OvadDataset(tmp_path / "nowhere")


@pytest.mark.parametrize("target", ["{name}", "/dev/zero", "/", "missing", "/proc/self/mem", "DataLog.csv"])
def test_links_in_a_data_set_are_read_or_refused(target: str, tmp_path: Path) -> None:
    """Links to themselves, devices, folders, missing files, process memory and other files."""
    (recording,) = OvadDataset(write_log(tmp_path, ROWS[0])).recordings
    recording.path.mkdir(parents=True)
    for name in ("out_multi.wav", "camera_baseline_results.json", "truth.json", "array.xml"):
        where = tmp_path if target == "DataLog.csv" else Path()
        (recording.path / name).symlink_to(where / target.format(name=name))
    of_folder = (lambda: read_true_tracks(recording.path)), (lambda: choose_array(recording.path))
    for read in (recording.open_audio, recording.read_detections, *of_folder):
        try:
            read()
        except InputFileError as error:
            assert str(recording.path) in str(error)


# Tables of feature windows.

HEADER = [*FEATURE_COLUMNS, *LABEL_COLUMNS]
LABELS = [
    ["none", "2_00_0000", "SA1", "", "0"],
    ["left", "1_00_0001", "SA1", "70", "34"],
    ["front", "0_00_0017", "SA1", "70", "34"],
    ["right", "3_06_0003", "DB2", "55", "34"],
]


def good_rows():
    return [[*(f"{0.01 * i + line:.3f}" for i in range(60)), *labels] for line, labels in enumerate(LABELS)]


@pytest.fixture
def table(tmp_path):
    return read_features(write_csv(tmp_path / "f.csv", good_rows(), HEADER))


def test_a_feature_table_is_read_with_its_columns_in_any_order(tmp_path, table):
    assert len(table) == 4 and table.features[1, 2] == pytest.approx(1.02)
    assert table.t0_frames == (None, 70, 70, 55)
    assert table.hazards.tolist() == [False, True, False, True]
    assert table.hazard_free.tolist() == [True, False, False, False]
    shuffled = write_csv(tmp_path / "r.csv", [row[::-1] for row in good_rows()], HEADER[::-1])
    np.testing.assert_array_equal(read_features(shuffled).features, table.features)


def test_groups_follow_the_environment_and_lists_select_whole_recordings(table):
    assert table.group("static").environments.tolist() == ["SA1"] * 3
    assert table.group("dynamic").ids.tolist() == ["3_06_0003"]
    assert len(table.group("all")) == len(table.without([])) == 4
    # The front window of recording 34 at SA1 belongs to its hazard window; 34 at DB2 is another recording.
    assert table.only(["1_00_0001"]).ids.tolist() == ["1_00_0001", "0_00_0017"]
    assert table.without(["1_00_0001"]).ids.tolist() == ["2_00_0000", "3_06_0003"]
    for choose, said in (
        (lambda: table.group("static").group("dynamic"), "dynamic"),
        (lambda: table.only(["9_99_9999"]), "ids"),
    ):
        with pytest.raises(InvalidArgumentError, match=said):
            choose()


NUMBERS = [("feat7", "nan"), ("feat0", "inf"), ("feat59", "loud")]


@pytest.mark.parametrize(
    ("column", "value"), [*NUMBERS, ("Class", "up"), ("T0", "soon"), ("Environment", "X1")]
)
def test_a_bad_cell_is_refused_with_file_and_line(tmp_path, column, value):
    rows = good_rows()
    rows[2][HEADER.index(column)] = value
    with pytest.raises(InputFileError, match=r"f\.csv: line 4"):
        read_features(write_csv(tmp_path / "f.csv", rows, HEADER))


def test_short_rows_missing_columns_and_empty_files_are_refused(tmp_path):
    rows = good_rows()
    rows[1] = rows[1][:40]
    write_csv(tmp_path / "short.csv", rows, HEADER)
    write_csv(tmp_path / "narrow.csv", [], [name for name in HEADER if name != "feat59"])
    write_csv(tmp_path / "empty.csv", [], HEADER)
    for name, said in (("short", "line 3"), ("narrow", "feat59"), ("empty", "one window"), ("no", "no.csv")):
        with pytest.raises(InputFileError, match=said):
            read_features(tmp_path / f"{name}.csv")


def test_lists_of_ids_are_read_or_refused(tmp_path):
    listed = write_csv(tmp_path / "ids.csv", [["1_00_0002"], [" 1_00_0003 "]], ["ID"])
    assert read_ids(listed) == {"1_00_0002", "1_00_0003"}
    for rows, header, said in (([], "ID", "at least one ID"), ([["1"]], "Name", "ID")):
        with pytest.raises(InputFileError, match=said):
            read_ids(write_csv(tmp_path / "ids.csv", rows, [header]))


# The command that extracts features.

LISTED = ["ID", "Class", "Environment", "Recording ID", "File", "End", "T0"]
WINDOWS = [
    ["1_00_0001", "left", "SA1", "34", "street/a.wav", "1.5", "70"],
    ["0_00_0001", "front", "SA1", "34", "street/a.wav", "", "70"],
    ["2_00_0007", "none", "SA1", "7", "", "", ""],
    ["3_00_0009", "right", "SB1", "9", "", "1.0", ""],
]


@pytest.fixture
def extract(tmp_path, capsys):
    """Return a function that calls the command for a data set and labels, and returns its report or error."""

    def call(root, rows=None, header=LISTED):
        write_array_xml(tmp_path / "mics.xml", THREE)
        listed = ["--labels", write_csv(tmp_path / "l.csv", rows, header)] if rows else []
        out = tmp_path / "features.csv"
        words = [root, *listed, "--array", tmp_path / "mics.xml", "--out", out, "--json"]
        code, told = main(["model", "features", *map(str, words)]), capsys.readouterr()
        assert code in (0, 2) and out.exists() == (code == 0)
        return json.loads(told.out) if code == 0 else told.err

    return call


@pytest.fixture
def sounds(tmp_path):
    """Write a data set; return its folder and sounds."""
    names = {"street/a.wav": 2.0, "SA1/none/2_00_0007/out_multi.wav": 1.0, "3_00_0009.wav": 1.2}
    return tmp_path / "data", {name: write_sound(tmp_path / "data" / name, s) for name, s in names.items()}


def at_24_khz(sound: np.ndarray) -> np.ndarray:
    """Return the feature at the next rate that has the bins of the published one."""
    return published_feature(resample_poly(sound, 3, 2, window=("kaiser", 8.0)), THREE, 24_000)


def test_each_window_is_the_second_before_its_end(sounds, extract, tmp_path):
    root, sound = sounds
    assert extract(root, WINDOWS)["n_windows"] == 4
    table = read_features(tmp_path / "features.csv")
    assert table.labels.tolist() == ["left", "front", "none", "right"]
    assert table.t0_frames == (70, 70, None, None)
    assert table.recordings.tolist() == ["34", "34", "7", "9"]
    street, other = sound["street/a.wav"], sound["3_00_0009.wav"]
    for row, cut in ((0, street[8000:24_000]), (1, street[16_000:]), (3, other[:RATE])):
        np.testing.assert_allclose(table.features[row], at_24_khz(cut), atol=1e-4)
    # Only the labels are needed.
    assert extract(root, [row[:4] for row in WINDOWS[2:]], LISTED[:4])["n_windows"] == 2


@pytest.mark.parametrize(
    ("column", "value", "problem"),
    [
        ("Class", "up", "line 3: expected a class"),
        ("Environment", "", "line 3: expected a value of Environment"),
        ("End", "nan", "line 3: expected a finite number as End"),
        ("End", "0.5", "expected 1 s of sound before 0.5 s"),
        ("End", "9", "expected 1 s of sound before 9 s"),
        ("T0", "x", "line 3"),
        ("File", "../secret.wav", "line 3: expected a file inside"),
        ("File", "nowhere.wav", "line 3: expected a file nowhere.wav"),
    ],
)
def test_a_wrong_label_is_refused_with_its_line(sounds, extract, column, value, problem):
    rows = [list(row) for row in WINDOWS]
    rows[1][LISTED.index(column)] = value
    assert problem in extract(sounds[0], rows)


def test_without_labels_windows_equal_those_of_the_released_program(tmp_path, extract):
    rows = "1_00_0001,SA1,left,12", "2_00_0002,SA1,none,20", "3_06_0003,DA2,right,13", "1_02_0004,SB1,left,21"
    sounds = {}
    for one in OvadDataset(write_log(tmp_path, *rows)).recordings:
        sounds[one.recording_id] = write_sound(one.audio_path, 3.5)
    assert extract(tmp_path)["n_left_out"] == 1  # the last one's front, which ends at 3.6 s
    table = read_features(tmp_path / "features.csv")
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


def test_a_data_set_of_recordings_too_short_is_refused(tmp_path, extract):
    recorded(write_log(tmp_path, "1_00_0001,SA1,left,4") / "SA1" / "left" / "1_00_0001")
    told = extract(tmp_path)
    assert "DataLog.csv" in told and "2 are cut off" in told
