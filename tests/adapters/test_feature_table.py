"""The table of feature windows: exact reading, errors with file and line."""

import csv

import numpy as np
import pytest

from worldstate.adapters.datasets.feature_table import FEATURE_COLUMNS, LABEL_COLUMNS, read_features, read_ids
from worldstate.ground.errors import InputFileError, InvalidArgumentError

HEADER = [*FEATURE_COLUMNS, *LABEL_COLUMNS]
LABELS = [
    ["none", "2_00_0000", "SA1", "", "0"],
    ["left", "1_00_0001", "SA1", "70", "34"],
    ["front", "0_00_0017", "SA1", "70", "34"],
    ["right", "3_06_0003", "DB2", "55", "34"],
]


def write(path, rows, header=HEADER):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def good_rows():
    return [[*(f"{0.01 * i + line:.3f}" for i in range(60)), *labels] for line, labels in enumerate(LABELS)]


@pytest.fixture
def table(tmp_path):
    return read_features(write(tmp_path / "f.csv", good_rows()))


def test_a_feature_table_is_read(table):
    assert len(table) == 4
    assert table.features[1, 2] == pytest.approx(1.02)
    assert table.t0_frames == (None, 70, 70, 55)
    assert table.hazards.tolist() == [False, True, False, True]
    assert table.hazard_free.tolist() == [True, False, False, False]


def test_columns_may_stand_in_any_order(tmp_path, table):
    shuffled = [list(reversed(row)) for row in good_rows()]
    other = read_features(write(tmp_path / "r.csv", shuffled, HEADER[::-1]))
    np.testing.assert_array_equal(other.features, table.features)


def test_groups_follow_the_environment(table):
    assert table.group("static").environments.tolist() == ["SA1"] * 3
    assert table.group("dynamic").ids.tolist() == ["3_06_0003"]
    assert len(table.group("all")) == 4
    with pytest.raises(InvalidArgumentError, match="dynamic"):
        table.group("static").group("dynamic")


def test_a_list_selects_whole_recordings(table):
    # The front window of recording 34 at SA1 belongs to its hazard window; 34 at DB2 is another recording.
    assert table.only(["1_00_0001"]).ids.tolist() == ["1_00_0001", "0_00_0017"]
    assert table.without(["1_00_0001"]).ids.tolist() == ["2_00_0000", "3_06_0003"]
    with pytest.raises(InvalidArgumentError, match="ids"):
        table.only(["9_99_9999"])
    assert len(table.without([])) == 4


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("feat7", "nan"),
        ("feat0", "inf"),
        ("feat59", "loud"),
        ("Class", "up"),
        ("T0", "soon"),
        ("Environment", "X1"),
    ],
)
def test_a_bad_cell_is_refused_with_file_and_line(tmp_path, column, value):
    rows = good_rows()
    rows[2][HEADER.index(column)] = value
    with pytest.raises(InputFileError, match=r"f\.csv: line 4"):
        read_features(write(tmp_path / "f.csv", rows))


def test_short_rows_missing_columns_and_empty_files_are_refused(tmp_path):
    rows = good_rows()
    rows[1] = rows[1][:40]
    with pytest.raises(InputFileError, match="line 3"):
        read_features(write(tmp_path / "short.csv", rows))
    with pytest.raises(InputFileError, match="feat59"):
        read_features(write(tmp_path / "narrow.csv", [], [name for name in HEADER if name != "feat59"]))
    with pytest.raises(InputFileError, match="at least one window"):
        read_features(write(tmp_path / "empty.csv", []))
    with pytest.raises(InputFileError, match="missing"):
        read_features(tmp_path / "missing.csv")


def test_lists_of_ids(tmp_path):
    listed = write(tmp_path / "ids.csv", [["1_00_0002"], [" 1_00_0003 "]], ["ID"])
    assert read_ids(listed) == {"1_00_0002", "1_00_0003"}
    with pytest.raises(InputFileError, match="at least one ID"):
        read_ids(write(tmp_path / "none.csv", [], ["ID"]))
    with pytest.raises(InputFileError, match="ID"):
        read_ids(write(tmp_path / "other.csv", [["1"]], ["Name"]))
