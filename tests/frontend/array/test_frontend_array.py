"""The array against textbook geometry, and the roof array against the paper's numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.frontend.array.microphone_array import LEAST_SPACING_M, MicrophoneArray, roof_array_56
from worldstate.ground.errors import InvalidArgumentError


def test_roof_array_has_the_dimensions_of_the_paper() -> None:
    array = roof_array_56()
    assert array.n_microphones == 56
    np.testing.assert_allclose(array.aperture_m, [0.0, 0.78, 0.65], atol=1e-12)
    assert array.horizontal_moment_m2 == pytest.approx(3.03, abs=0.005)
    assert array.mean_spacing_m == pytest.approx(0.088, abs=0.0005)
    assert array.alias_hz() == pytest.approx(1.9e3, rel=0.03)
    assert array.ambiguity == "front-back"


def test_roof_array_is_the_same_every_time_and_read_only() -> None:
    np.testing.assert_array_equal(roof_array_56().positions_m, roof_array_56().positions_m)
    with pytest.raises(ValueError, match="read-only"):
        roof_array_56().positions_m[0, 0] = 1.0


def test_left_source_reaches_the_left_microphone_first() -> None:
    array = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, -0.2, 0.0]])
    left, right = array.delays_s(np.pi / 2)
    assert left < right
    assert right - left == pytest.approx(0.4 / 343.0)


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


def test_a_planar_array_has_equal_steering_front_and_back() -> None:
    array = roof_array_56()
    front, back = array.steering(1000.0, [0.4, np.pi - 0.4])[0].T
    np.testing.assert_allclose(front, back, atol=1e-12)


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
