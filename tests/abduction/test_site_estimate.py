"""Learning a site while running: the weighted mean, its limits and checkpoints."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.abduction.signature.ensemble import mirror_features, site_reference
from worldstate.abduction.signature.ensemble_training import SiteEnsembleClassifier
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings, SiteSignature
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import decode, encode

SETTINGS = SiteEstimateSettings()


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(0)
    labels = rng.permutation(np.repeat(("front", "left", "none", "right"), 40))
    azimuth = np.tile(np.linspace(-1, 1, 30), 2)
    shape = {"front": 1 + azimuth**2, "none": 0 * azimuth, "left": 0.7 - azimuth, "right": 0.7 + azimuth}
    levels = np.stack([shape[label] for label in labels]) + 0.5 * rng.normal(size=(160, 60))
    X = np.hstack([np.exp(levels), np.tile(site_reference(levels), (160, 1))])
    return SiteEnsembleClassifier().fit(X, labels).model_


def listened(windows, dt_s=0.1, settings=SETTINGS):
    estimate = SiteEstimate.start(windows.shape[1])
    for window in windows:
        estimate = estimate.updated(window, dt_s, settings)
    return estimate


@given(st.integers(1, 60), st.floats(0.01, 2.0), st.floats(0.5, 100.0))
def test_an_estimate_is_the_exponentially_weighted_mean(n, dt_s, forgetting_s):
    windows = np.random.default_rng(n).uniform(0.1, 1.0, (n, 4))
    estimate = listened(windows, dt_s, SiteEstimateSettings(forgetting_s=forgetting_s))
    weights = np.exp(-dt_s * np.arange(n)[::-1] / forgetting_s)
    np.testing.assert_allclose(estimate.level, weights @ np.log(windows) / weights.sum(), rtol=1e-9)
    assert estimate.heard_s == pytest.approx(dt_s * weights.sum(), rel=1e-9)
    assert estimate.heard_s <= forgetting_s + dt_s


def test_an_empty_estimate_gives_the_default_reference(model):
    assert SiteEstimate.start(60).reference(model) is model.home
    at_home = listened(np.tile(np.exp(model.empty), (50, 1)))
    np.testing.assert_allclose(at_home.reference(model), model.home, atol=1e-9)


@given(st.floats(-1.0, 1.0), st.integers(0, 100))
def test_a_quarter_of_the_level_and_the_whole_pattern_move_the_reference(model, level, seed):
    pattern = np.random.default_rng(seed).normal(size=60)
    pattern -= pattern.mean()
    estimate = SiteEstimate(model.empty + level + pattern, heard_s=10.0)
    shift = estimate.reference(replace(model, prior_s=0.0)) - model.home
    np.testing.assert_allclose(shift, np.tile(0.25 * level + pattern, 3), atol=1e-9)


def test_the_mirrored_street_mirrors_the_reference(model):
    windows = np.random.default_rng(1).uniform(0.1, 1.0, (20, 60))
    there, back = (listened(w).reference(model) for w in (windows, mirror_features(windows)))
    np.testing.assert_allclose(mirror_features(there[None], 6)[0], back, atol=1e-9)


def test_a_checkpoint_continues_exactly(model):
    windows = np.random.default_rng(2).uniform(0.1, 1.0, (20, 60))
    first, whole = SiteSignature(model), SiteSignature(model)
    for window in windows[:10]:
        first.evidence(window)
    saved = json.loads(json.dumps(encode(first.estimate), allow_nan=False))
    second = SiteSignature(model, estimate=decode(SiteEstimate, saved, "file"))
    answers = [whole.evidence(window) for window in windows]
    assert [second.evidence(window) for window in windows[10:]] == answers[10:]


def test_a_window_is_compared_with_earlier_ones_only(model):
    window = np.random.default_rng(3).uniform(0.1, 1.0, 60)
    assert SiteSignature(model).evidence(window) == model.evidence(window)


@pytest.mark.parametrize("bad", [np.full(60, np.nan), np.ones(59)])
def test_a_refused_window_leaves_the_estimate_unchanged(model, bad):
    signature = SiteSignature(model)
    with pytest.raises(InvalidArgumentError):
        signature.evidence(bad)
    assert signature.estimate.heard_s == 0.0
