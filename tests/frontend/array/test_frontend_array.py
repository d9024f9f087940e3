"""Arrays: textbook geometry, the numbers of the paper, files, and power at few directions for all."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from released_data import FOLDER

from worldstate.adapters.files.array_file import read_array, write_array_xml
from worldstate.frontend.array.microphone_array import LEAST_SPACING_M, MicrophoneArray, roof_array_56
from worldstate.frontend.array.steering import Steering, interpolation_nodes
from worldstate.frontend.spectra.stft import bin_frequencies_hz
from worldstate.ground.errors import InvalidArgumentError


def test_roof_array_has_the_dimensions_of_the_paper_and_is_read_only() -> None:
    array = roof_array_56()
    assert array.n_microphones == 56
    np.testing.assert_allclose(array.aperture_m, [0.0, 0.78, 0.65], atol=1e-12)
    assert array.horizontal_moment_m2 == pytest.approx(3.03, abs=0.005)
    assert array.mean_spacing_m == pytest.approx(0.088, abs=0.0005)
    assert array.alias_hz() == pytest.approx(1.9e3, rel=0.03)
    assert array.ambiguity == "front-back"
    np.testing.assert_array_equal(roof_array_56().positions_m, array.positions_m)
    with pytest.raises(ValueError, match="read-only"):
        array.positions_m[0, 0] = 1.0


@given(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.integers(0, 2**32 - 1))
def test_far_field_delay_is_the_limit_of_distance(azimuth: float, elevation: float, seed: int) -> None:
    positions = np.random.default_rng(seed).normal(size=(5, 3))
    source = 1e7 * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    travel = (np.linalg.norm(source - positions, axis=1) - 1e7) / 343.0
    np.testing.assert_allclose(MicrophoneArray(positions).delays_s(azimuth, elevation), travel, atol=1e-8)


@pytest.mark.parametrize(
    ("positions", "expected"),
    [
        ([[0, -1, 0], [0, 0, 0], [0, 1, 0]], "cone"),
        ([[0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]], "front-back"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "up-down"),
        ([[0, 0, 0], [1, 0, 0], [0, 0, 1]], "mirror"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "none"),
    ],
)
def test_an_array_has_the_ambiguity_of_its_geometry(positions: list[list[float]], expected: str) -> None:
    assert MicrophoneArray(positions).ambiguity == expected


@given(st.integers(2, 9), st.integers(0, 2**32 - 1), st.floats(0.0, 3.0), st.data())
def test_microphones_at_one_place_raise_an_error_with_their_numbers(n, seed, in_least, data) -> None:
    """All other microphones are 1 m apart."""
    places = np.random.default_rng(seed).permutation(n)[:, None] * [0.0, 1.0, 0.0]
    first, second = sorted(data.draw(st.lists(st.integers(0, n - 1), min_size=2, max_size=2, unique=True)))
    places[second] = places[first] + [in_least * LEAST_SPACING_M, 0.0, 0.0]
    if in_least > 1.001:
        assert MicrophoneArray(places).n_microphones == n
    elif in_least < 0.999:
        said = rf"got microphones {first + 1} and {second + 1} .* m apart"
        with pytest.raises(InvalidArgumentError, match=said):
            MicrophoneArray(places)


COORDINATES = st.integers(-90, 90).map(lambda k: k / 113)


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


def test_the_released_array_has_the_papers_moment() -> None:
    released = (FOLDER or Path()) / "ourmicarray_56.xml"
    if not released.is_file():
        pytest.skip("the released array file is not here")
    array = read_array(released)
    assert len(array.positions_m) == 56
    assert np.var(array.positions_m[:, 1]) * 56 == pytest.approx(3.03, abs=0.005)
    np.testing.assert_array_equal(array.positions_m[0], [0.0, 0.392, 0.288])


ROOF, GRID = roof_array_56(), np.radians(np.arange(-90.0, 91.0))


def test_too_coarse_a_grid_has_no_nodes() -> None:
    assert interpolation_nodes(ROOF.steering([1500.0], np.radians(np.linspace(-90, 90, 15)))) is None


def test_the_roof_array_needs_few_nodes_for_the_power_within_all_beams() -> None:
    frequencies = bin_frequencies_hz(range(3, 19), 47_998, 512)
    beams, response = Steering.towards(ROOF, frequencies, GRID), ROOF.steering(frequencies, GRID)
    assert beams.nodes is not None
    assert beams.nodes[0].weights.shape[2] <= 32
    parts = np.random.default_rng(1).standard_normal((2, 16, 56, 2))
    E = np.linalg.qr((parts[0] + 1j * parts[1]).astype(np.complex64))[0]
    within = np.square(np.abs(E.conj().transpose(0, 2, 1) @ response)).sum(axis=1)
    np.testing.assert_allclose(beams.power_within(E), within, atol=1e-4)
