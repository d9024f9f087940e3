"""Files and folders are written whole or not at all."""

from pathlib import Path

import numpy as np
import pytest

from worldstate.adapters.files.array_file import write_array_xml
from worldstate.adapters.files.file_io import atomic_path, write_text
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError


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


def test_folders_are_written_whole_too(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "set") as temporary:
        temporary.mkdir()
        (temporary / "one").write_text("1")
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "other") as temporary:
        temporary.mkdir()
        (temporary / "one").write_text("1")
        raise RuntimeError
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")) == ["set", "set/one"]


def test_writers_refuse_a_missing_folder_and_a_folder(tmp_path: Path) -> None:
    (taken := tmp_path / "taken").mkdir()
    with pytest.raises(InputFileError, match=r"nowhere/mics.xml: expected an existing folder"):
        write_array_xml(tmp_path / "nowhere" / "mics.xml", MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]))
    with pytest.raises(InputFileError, match=r"taken: .*found a folder"):
        write_text(taken, "x")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
