"""Bounds in closed form, estimates against exact values, laws of information."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats
from sklearn.feature_selection import mutual_info_classif
from sklearn.linear_model import LogisticRegression
from test_feature_evaluation import made_up_table, written
from worldstate_lab.cli.main import main
from worldstate_lab.paper.identifiability import (
    entropy_bits,
    fano_bound,
    information_from_posteriors,
    nearest_neighbour_information_bits,
    reach_of_array,
    reach_on_data,
    sharp_fano_bound,
)

from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.ground.errors import InvalidArgumentError


def mutual_information_bits(joint):
    """Return the exact I(z; x) of a joint table by its definition."""
    independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    there = joint > 0.0
    return float((joint[there] * np.log2(joint[there] / independent[there])).sum())


joints = st.tuples(st.integers(2, 5), st.integers(2, 5)).flatmap(
    lambda shape: arrays(float, shape, elements=st.floats(0.001, 1.0)).map(lambda p: p / p.sum())
)


@given(st.integers(2, 12), st.floats(0.01, 0.99))
def test_fano_is_attained_by_the_symmetric_channel_of_any_size(k, share):
    error = share * (k - 1) / k
    joint = np.full((k, k), error / (k - 1)) / k
    np.fill_diagonal(joint, (1 - error) / k)
    information = mutual_information_bits(joint)
    assert sharp_fano_bound(math.log2(k), information, k) == pytest.approx(error, abs=1e-6)
    assert fano_bound(math.log2(k), information, k) <= error + 1e-9


@given(joints)
def test_no_detector_errs_less_than_the_fano_bound(joint):
    entropy, information = entropy_bits(joint.sum(axis=1)), mutual_information_bits(joint)
    best = 1.0 - joint.max(axis=0).sum()
    sharp = sharp_fano_bound(entropy, information, len(joint))
    assert fano_bound(entropy, information, len(joint)) <= sharp + 1e-9
    assert sharp <= best + 1e-6


def gaussian_sample(n, distance, seed=0):
    rng = np.random.default_rng(seed)
    z = rng.integers(0, 2, n)
    return rng.normal(size=n) + distance * z, z


def gaussian_information_bits(distance):
    """Return the exact I of two equally likely unit Gaussians at a distance, by quadrature."""
    x = np.linspace(-8.0, 8.0 + distance, 20_001)
    p0, p1 = stats.norm.pdf(x), stats.norm.pdf(x - distance)
    mixed = (p0 + p1) / 2
    entropy_of_mixture = -np.trapezoid(mixed * np.log2(np.maximum(mixed, 1e-300)), x)
    return entropy_of_mixture - 0.5 * math.log2(2 * math.pi * math.e)


def exact_posteriors(x, distance):
    odds = 1 / (1 + np.exp(-(distance * x - distance**2 / 2)))
    return np.stack([1 - odds, odds], axis=1)


@pytest.mark.parametrize("distance", [0.0, 0.5, 1.5, 3.0])
def test_estimates_agree_with_the_exact_value_of_two_gaussians(distance):
    x, z = gaussian_sample(20_000, distance)
    exact = gaussian_information_bits(distance)
    found = information_from_posteriors(exact_posteriors(x, distance), z)
    assert found.lower == pytest.approx(exact, abs=0.02)
    assert found.plug_in == pytest.approx(exact, abs=0.02)
    near = nearest_neighbour_information_bits(x[:, None], z)
    assert near == pytest.approx(exact, abs=0.03)
    assert near == pytest.approx(mutual_info_classif(x[:, None], z)[0] / math.log(2), abs=0.02)


@pytest.mark.parametrize("sharpness", [0.3, 3.0])
def test_an_uncalibrated_classifier_lowers_the_bound_and_biases_the_plug_in(sharpness):
    x, z = gaussian_sample(20_000, 1.5)
    q = exact_posteriors(x, 1.5) ** sharpness
    found = information_from_posteriors(q / q.sum(axis=1, keepdims=True), z)
    exact = gaussian_information_bits(1.5)
    assert found.lower < exact - 0.03
    assert (found.plug_in > exact) == (sharpness > 1)


def test_the_endfire_corollary_on_a_line_across_the_vehicle():
    line = MicrophoneArray(np.stack([np.zeros(8), np.linspace(-0.5, 0.5, 8), np.zeros(8)], axis=1))
    azimuths = np.radians([0.0, 30.0, 60.0, 80.0])
    found = reach_of_array(line, azimuths, [500.0, 1000.0], [0.1, 0.1], 40)
    assert found.endfire == pytest.approx(np.cos(azimuths) ** 2, abs=1e-9)
    assert (found.std_rad / found.std_rad[0]) == pytest.approx(1 / np.cos(azimuths), rel=1e-6)
    endfire = reach_of_array(line, [math.pi / 2], [500.0], [0.1], 40, vision_std_rad=0.05)
    assert endfire.std_rad[0] > 1e3 or math.isinf(endfire.std_rad[0])
    assert endfire.with_vision_rad[0] == pytest.approx(0.05, rel=1e-6)


def test_with_a_camera_the_bound_is_the_sum_and_never_worse():
    azimuths = np.radians(np.arange(-80.0, 81.0, 20.0))
    found = reach_of_array(roof_array_56(), azimuths, [500.0], [0.01], 10, vision_std_rad=0.02)
    assert found.with_vision_rad**-2 == pytest.approx(found.std_rad**-2 + 0.02**-2)
    assert (found.with_vision_rad <= np.minimum(found.std_rad, 0.02)).all()


def test_bounds_of_any_detector_on_data():
    x, z = gaussian_sample(3000, 1.0, seed=4)
    q = LogisticRegression().fit(x[:1000, None], z[:1000]).predict_proba(x[1000:, None])
    found = reach_on_data(q, z[1000:], x[1000:, None], np.arange(2000), np.random.default_rng(0))
    exact = gaussian_information_bits(1.0)
    bayes = stats.norm.cdf(-0.5)
    assert found.information_lower <= exact + 0.02
    assert exact <= found.information_high
    assert found.fano <= found.sharp_fano <= bayes <= found.error + 0.02
    assert found.sharp_fano > 0.5 * bayes
    assert found.windows == 2000


def test_a_state_with_few_windows_has_no_neighbours():
    with pytest.raises(InvalidArgumentError, match="more than 3 windows"):
        nearest_neighbour_information_bits([[0.0], [1.0]], [0, 1])


def test_the_command_prints_the_bounds_of_a_table_and_of_the_array(tmp_path, capsys):
    made_up = made_up_table(recordings=60)
    table = written(tmp_path / "t.csv", replace(made_up, features=np.exp(0.3 * made_up.features)))
    assert main(["reach", "--features", str(table), "--method", "baseline", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    data, array = found["features"], found["array"]
    assert data["fano"] <= data["sharp_fano"] <= data["error"]
    assert 0.0 < data["information_lower"] <= data["information_high"] <= data["entropy_bits"]
    assert array["std_rad"][0] is None
    assert array["with_vision_rad"][0] == pytest.approx(np.radians(1.0))
    assert min(x for x in array["std_rad"] if x is not None) == array["std_rad"][6]
