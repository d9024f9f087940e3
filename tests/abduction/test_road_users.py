"""Kinds of road users: softmax probabilities, model files and sets of likely classes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.special
from hypothesis import given
from hypothesis import strategies as st

from worldstate.abduction.road_users import RoadUserModel, likeliest, with_siren
from worldstate.adapters.files.model_file import read_model, save_model
from worldstate.ground.errors import InputFileError, InvalidArgumentError

CLASSES = ("van", "car", "unknown")


def model(seed: int = 0) -> RoadUserModel:
    rng = np.random.default_rng(seed)
    return RoadUserModel(("a", "b"), CLASSES, rng.standard_normal((3, 2)), rng.standard_normal(3))


@given(st.integers(0, 99), st.lists(st.floats(-50.0, 50.0), min_size=2, max_size=2))
def test_class_probabilities_are_a_softmax(seed: int, measured: list[float]) -> None:
    one, x = model(seed), np.array(measured)
    expected = dict(zip(CLASSES, scipy.special.softmax(one.weights @ x + one.biases), strict=True))
    said = one.classify(x)
    assert [name for name, _ in said] == sorted(CLASSES)
    assert dict(said) == pytest.approx(expected, abs=1e-12)


def test_a_class_recovers_from_a_share_of_zero() -> None:
    shares = np.array([0.5, 0.3, 0.2])
    one = replace(model(), shares=shares)
    again = one.with_shares(np.array([0.7, 0.0, 0.3])).with_shares(shares)
    np.testing.assert_allclose(again.biases, one.biases, atol=1e-9)


@given(st.lists(st.floats(0.01, 1.0), min_size=3, max_size=3), st.floats(-5.0, 5.0), st.floats(0.05, 0.999))
def test_the_likeliest_set_is_minimal_and_a_siren_keeps_its_odds(
    parts: list[float], log_odds: float, mass: float
) -> None:
    shares = tuple(zip(sorted(CLASSES), (np.array(parts) / sum(parts)).tolist(), strict=True))
    chosen, by_name = likeliest(shares, mass), dict(shares)
    assert sum(by_name[name] for name in chosen) >= mass - 1e-9
    assert sum(sorted(by_name.values())[-len(chosen) + 1 :] if len(chosen) > 1 else [0.0]) < mass
    heard = dict(with_siren(shares, log_odds))
    assert sum(heard.values()) == pytest.approx(1.0)
    assert np.log(heard["siren"] / (1.0 - heard["siren"])) == pytest.approx(log_odds)


def test_a_model_file_keeps_the_guard_and_wrong_ones_raise_an_error(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    save_model(path, replace(read_model(), road_users=model()))
    again = read_model(path).road_users
    assert again is not None
    np.testing.assert_array_equal(again.weights, model().weights)
    assert read_model().road_users is not None
    path.write_text(path.read_text().replace('"unknown"', '"ghost"'))
    with pytest.raises(InputFileError, match="unknown"):
        read_model(path)
    with pytest.raises(InvalidArgumentError, match="biases"):
        RoadUserModel(("a",), CLASSES, np.zeros((3, 1)), np.zeros(2))
