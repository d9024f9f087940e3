"""The layout of OVAD: labels, junctions, T0 and missing files."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
from released_data import FOLDER

from worldstate.adapters.datasets.feature_table import read_ids
from worldstate.adapters.datasets.ovad import (
    DETECTION_NAMES,
    OvadDataset,
    Recording,
    choose_array,
    read_true_tracks,
)
from worldstate.ground.errors import InputFileError

HEADER = "ID,Environment,Class,T0"
ROWS = ("1_00_0002,SA1,left,70", "2_00_0007,SA1,none,70", "3_08_0119,DB2,right,58")


def write_log(root: Path, *rows: str, header: str = HEADER) -> Path:
    (root / "DataLog.csv").write_text("\n".join([header, *rows]) + "\n")
    return root


def write_sound(folder: Path) -> Path:
    folder.mkdir(parents=True)
    samples = np.random.default_rng(0).uniform(-0.1, 0.1, (9600, 2))
    soundfile.write(folder / "out_multi.wav", samples, 8000, subtype="PCM_24")
    return folder


def write_detections(folder: Path, name: str) -> None:
    row: dict[str, list[object]] = {"boxes": [], "scores": [], "classes_str": []}
    (folder / name).write_text(json.dumps({"detections_per_frame": [row]}))


def test_recordings_are_those_of_the_log(tmp_path: Path) -> None:
    left, none, right = OvadDataset(write_log(tmp_path, *ROWS)).recordings
    assert (left.recording_id, left.label) == ("1_00_0002", "left")
    assert left.moving_ego is False
    assert (left.t0_frame, left.t0_s) == (70, 7.0)
    assert left.audio_path == tmp_path / "SA1" / "left" / "1_00_0002" / "out_multi.wav"
    assert (none.label, none.t0_frame, none.t0_s) == ("none", None, None)
    assert (right.moving_ego, right.t0_s) == (True, 5.8)


def test_opens_sound_and_detections(tmp_path: Path) -> None:
    write_log(tmp_path, *ROWS)
    write_detections(write_sound(tmp_path / "SA1" / "left" / "1_00_0002"), DETECTION_NAMES[0])
    recording = OvadDataset(tmp_path).recordings[0]
    with recording.open_audio(expect_channels=2) as source:
        assert source.frames == 9600
    log = recording.read_detections()
    assert log is not None
    assert len(log) == 1


@pytest.mark.parametrize("name", DETECTION_NAMES)
def test_accepts_both_names_of_the_detections(tmp_path: Path, name: str) -> None:
    folder = write_sound(tmp_path / "SA1" / "left" / "1_00_0002")
    assert Recording.open(folder).detections_path is None
    write_detections(folder, name)
    assert Recording.open(folder).detections_path == folder / name


def test_no_detections_is_no_error(tmp_path: Path) -> None:
    recording = Recording.open(write_sound(tmp_path / "DB2" / "right" / "3_08_0119"))
    assert recording.detections_path is None
    assert recording.read_detections() is None


def test_a_bare_folder_finds_its_log(tmp_path: Path) -> None:
    write_log(tmp_path, *ROWS)
    folder = write_sound(tmp_path / "DB2" / "right" / "3_08_0119")
    assert Recording.open(folder) == Recording(folder, "3_08_0119", "DB2", "right", 58)
    assert Recording.open(folder / ".." / "3_08_0119").t0_s == 5.8


def test_a_bare_folder_uses_its_path(tmp_path: Path) -> None:
    folder = write_sound(tmp_path / "SA2" / "right" / "mine")
    assert Recording.open(folder) == Recording(folder, "mine", "SA2", "right", None)
    alone = Recording.open(write_sound(tmp_path / "street" / "today" / "run"))
    assert (alone.environment, alone.label, alone.moving_ego, alone.t0_s) == (None,) * 4


def test_a_folder_that_contradicts_its_log(tmp_path: Path) -> None:
    write_log(tmp_path, *ROWS)
    folder = write_sound(tmp_path / "SA1" / "right" / "1_00_0002")
    with pytest.raises(InputFileError, match=r"DataLog\.csv: expected 1_00_0002 in SA1/left"):
        Recording.open(folder)


def test_a_folder_without_sound(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=r"out_multi\.wav"):
        Recording.open(tmp_path)


def test_the_official_lists() -> None:
    folder = FOLDER or Path()
    if not (folder / "timeHorizonStaticTestset.csv").is_file():
        pytest.skip("the official lists are not here")
    assert len(read_ids(folder / "timeHorizonStaticTestset.csv")) == 83
    assert len(read_ids(folder / "timeHorizonDynamicTestset.csv")) == 59


def test_other_columns_order_and_a_byte_order_mark_do_not_matter(tmp_path: Path) -> None:
    text = "\ufeffT0,Note,Class,ID,Environment\n70,wet road,left,1_00_0002,SA1\n"
    (tmp_path / "DataLog.csv").write_text(text, encoding="utf-8")
    assert OvadDataset(tmp_path).recordings[0].t0_frame == 70


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("1_00_0002,SA1,left,7.5", "line 2: expected T0 as a frame number"),
        ("1_00_0002,SA1,left,-3", "T0"),
        ("1_00_0002,SA1,left,", "T0"),
        ("1_00_0002,SA1,left", "T0"),
        ("1_00_0002,SA1,left,99999999999999999999", "T0"),
        ("1_00_0002,SA1,none,soon", "T0"),
        ("1_00_0002,SA1,front,70", "line 2: expected Class left, none or right, got 'front'"),
        ("1_00_0002,XA1,left,70", "expected an Environment"),
        ("1_00_0002,../..,left,70", "expected an Environment"),
        ("../../etc,SA1,left,70", "line 2: expected an ID"),
        (",SA1,left,70", "expected an ID"),
    ],
)
def test_refuses_a_damaged_row(tmp_path: Path, row: str, problem: str) -> None:
    with pytest.raises(InputFileError, match=problem) as raised:
        OvadDataset(write_log(tmp_path, row))
    assert str(raised.value).startswith(str(tmp_path / "DataLog.csv"))


def test_refuses_missing_columns_and_duplicates(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="missing Class, T0"):
        OvadDataset(write_log(tmp_path, "1_00_0002,SA1", header="ID,Environment"))
    with pytest.raises(InputFileError, match="expected every ID once, got 1_00_0002 twice"):
        OvadDataset(write_log(tmp_path, ROWS[0], ROWS[1], ROWS[0]))


def test_refuses_a_missing_log(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="DataLog"):
        OvadDataset(tmp_path / "nowhere")


@pytest.mark.parametrize("target", ["{name}", "/dev/zero", "/", "missing", "/proc/self/mem", "DataLog.csv"])
def test_links_in_a_data_set_are_read_or_refused(target, tmp_path):
    """Links to themselves, devices, folders, missing files, process memory and other files."""
    folder = tmp_path / "SA1" / "left" / "1_00_0002"
    folder.mkdir(parents=True)
    (tmp_path / "DataLog.csv").write_text("ID,Environment,Class,T0\n1_00_0002,SA1,left,70\n")
    for name in ("out_multi.wav", "camera_baseline_results.json", "truth.json", "array.xml"):
        where = tmp_path if target == "DataLog.csv" else Path()
        (folder / name).symlink_to(where / target.format(name=name))
    (recording,) = OvadDataset(tmp_path).recordings
    for read in (
        recording.open_audio,
        recording.read_detections,
        lambda: read_true_tracks(folder),
        lambda: choose_array(folder),
    ):
        try:
            read()
        except InputFileError as error:
            assert str(folder) in str(error)
