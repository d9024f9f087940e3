"""Model files with an ensemble: a written file reads back bit for bit, a damaged one raises an error."""

import copy
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worldstate_lab.features.feature_evaluation import predict_held_out

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.adapters.files.file_io import refused_as_file
from worldstate.adapters.files.model_file import Model, read_model, save_model
from worldstate.ground.errors import WorldstateError
from worldstate.ground.serialisation import decode, encode
from worldstate.operations.training.training import TrainingSettings, train_model

WRONG = [None, True, "text", [], {}, [None], -1.5, 10**400, float("nan"), float("inf"), "1.0", ["1.0"]]


def read(data: object) -> Model:
    with refused_as_file("bad.json"):
        return decode(Model, data, "model")


def made_up_table(seed=0, recordings=60):
    rng = np.random.default_rng(seed)
    azimuth = np.tile(np.linspace(-1, 1, 30), 2)
    shape = {"front": azimuth**2, "none": 0 * azimuth, "left": -azimuth, "right": azimuth}
    rows = []
    for number in range(recordings):
        side = ("left", "right")[number // 6 % 2]
        for label in ("none",) if number % 2 else (side, "front"):
            levels = shape[label] + 0.7 * rng.normal(size=60) + 0.3 * (number % 3)
            rows.append((np.exp(levels), label, f"{label}_{number}", f"SA{number % 3}", str(number)))
    features, *labels = zip(*rows, strict=True)
    return FeatureTable(np.array(features), *map(np.array, labels), (None,) * len(rows))


@pytest.fixture(scope="module")
def model():
    chosen = TrainingSettings(repeats=1)
    return train_model(made_up_table(), chosen, dataset="made up", group="static")


@pytest.fixture(scope="module")
def default(model):
    return encode(model)


def test_written_and_read_back_to_the_bit(model, default, tmp_path):
    save_model(tmp_path / "m", model)
    again = read_model(tmp_path / "m")
    assert encode(again) == default
    read = read_model(tmp_path / "m")
    signature, policies = read.signature, read.policies
    assert isinstance(signature, EnsembleModel)
    assert policies.for_alpha(0.02).reference_prior == signature.reference_prior
    X = made_up_table(1).features
    np.testing.assert_array_equal(signature.predict_proba(X), model.signature.predict_proba(X))


def test_no_row_of_the_data_is_written(default):
    rows = {np.float64(value).tobytes() for value in np.log(made_up_table().features).ravel()}
    written = np.array(json.loads(json.dumps(default["signature"]["home"])))
    assert not rows & {value.tobytes() for value in written}
    for expert in default["signature"]["experts"]:
        assert not rows & {np.float64(value).tobytes() for value in np.ravel(expert["weights"])}


def test_an_ensemble_predicts_other_recordings_of_its_sites(model):
    table = made_up_table(seed=2)
    other = FeatureTable(
        table.features, table.labels, table.ids, table.environments,
        np.char.add("x", table.recordings), table.t0_frames,
    )  # fmt: skip
    predictions = predict_held_out(model, other, 0.05, "run", np.random.default_rng(0))[0.0]
    assert (predictions.classes == other.labels).mean() > 0.8


def places(value, here=()):
    yield here
    if isinstance(value, list):
        value = dict(enumerate(value[:1]))
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from places(inner, (*here, key))


def replaced(data, path, value):
    data = copy.deepcopy(data)
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return data


@settings(max_examples=200, deadline=None)
@given(data=st.data(), value=st.sampled_from(WRONG))
def test_wrong_values_are_refused_or_harmless(default, data, value):
    path = data.draw(st.sampled_from([place for place in places(default) if place[:1] == ("signature",)]))
    try:
        changed = read(replaced(default, path, value))
    except WorldstateError as error:
        assert str(error).startswith("bad.json")
    else:
        json.dumps(encode(changed), allow_nan=False)
        inputs = np.zeros((1, changed.signature.n_features))
        assert np.isfinite(changed.signature.predict_proba(inputs)).all()
