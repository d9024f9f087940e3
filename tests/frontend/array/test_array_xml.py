"""Array files: Acoular reads the same positions, and written files read back exactly."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from released_data import FOLDER

from worldstate.adapters.files.array_file import read_array, write_array_xml
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56

COORDINATES = st.integers(-90, 90).map(lambda k: k / 113)


def released_array() -> Path:
    return (FOLDER or Path()) / "ourmicarray_56.xml"


@given(arrays(np.float64, st.tuples(st.integers(2, 12), st.just(3)), elements=COORDINATES, unique=True))
@settings(max_examples=30, deadline=None)
def test_round_trip_is_exact(tmp_path_factory: pytest.TempPathFactory, positions_m: np.ndarray) -> None:
    name = tmp_path_factory.mktemp("array") / "mics.xml"
    write_array_xml(name, MicrophoneArray(positions_m), name='a "quoted" <array>')
    np.testing.assert_array_equal(read_array(name).positions_m, positions_m)


def test_acoular_reads_the_same_places(tmp_path: Path) -> None:
    acoular = pytest.importorskip("acoular")
    array = roof_array_56()
    write_array_xml(tmp_path / "roof.xml", array)
    x, y, z = acoular.MicGeom(file=tmp_path / "roof.xml").pos_total
    np.testing.assert_array_equal(np.column_stack([z, -x, y]) + 0.0, array.positions_m)


def test_right_in_the_file_is_right_of_the_vehicle(tmp_path: Path) -> None:
    name = tmp_path / "mics.xml"
    name.write_text('<MicArray><pos x="0.4" y="0" z="0"/><pos x="0" y="0.3" z="0.1"/></MicArray>')
    np.testing.assert_array_equal(read_array(name).positions_m, [[0, -0.4, 0], [0.1, 0, 0.3]])


def test_the_released_array_has_the_papers_moment() -> None:
    if not released_array().is_file():
        pytest.skip("the released array file is not here")
    array = read_array(released_array())
    assert len(array.positions_m) == 56
    assert np.var(array.positions_m[:, 1]) * 56 == pytest.approx(3.03, abs=0.005)
    np.testing.assert_array_equal(array.positions_m[0], [0.0, 0.392, 0.288])
