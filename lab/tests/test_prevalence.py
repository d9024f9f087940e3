"""Risks shifted without labels until hazards are as frequent as in training."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit
from worldstate_lab.features.feature_evaluation import matched_risk

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError


def table(recordings, sites):
    words = np.array(["none"] * len(recordings))
    columns = (np.array(sites), np.array(recordings))
    return FeatureTable(np.ones((len(recordings), 60)), words, words, *columns, (None,) * len(recordings))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.05, 0.95), st.floats(-6.0, 6.0))
def test_a_shift_common_to_a_site_is_undone(seed, mean, shift):
    rng = np.random.default_rng(seed)
    log_odds = rng.normal(0.0, 2.0, 30)
    here = table([str(i) for i in range(30)], ["DA1"] * 15 + ["DB1"] * 15)
    there = log_odds + shift * (np.arange(30) < 15)
    matched = matched_risk(expit(there), here, mean)
    np.testing.assert_allclose(matched, matched_risk(expit(log_odds), here, mean), atol=1e-4)


def test_the_mean_is_that_of_the_other_recordings():
    risk = np.array([0.1, 0.3, 0.6, 0.9])
    matched = matched_risk(risk, table(["a", "b", "c", "d"], ["DA1"] * 4), 0.5)
    for i in range(4):
        shift = logit(matched[i]) - logit(risk[i])
        assert expit(logit(np.delete(risk, i)) + shift).mean() == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize("risk", [[0.1, 1.1], [0.1, np.nan], [0.1], [-0.1, 0.5]])
def test_invalid_risks_are_rejected(risk):
    with pytest.raises(InvalidArgumentError, match="risk"):
        matched_risk(risk, table(["a", "b"], ["DA1"] * 2), 0.5)


def test_a_site_with_one_recording_and_an_impossible_mean_are_rejected():
    with pytest.raises(InvalidArgumentError, match="DA1/a"):
        matched_risk([0.5, 0.5], table(["a", "a"], ["DA1"] * 2), 0.5)
    with pytest.raises(InvalidArgumentError, match="mean_risk"):
        matched_risk([0.5, 0.5], table(["a", "b"], ["DA1"] * 2), 1.0)
