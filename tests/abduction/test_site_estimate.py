"""Learning a site while running: the weighted mean, its limits and its effect on real windows."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from released_data import FOLDER
from released_data import TABLE as NAME

from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.abduction.signature.ensemble import mirror_features, site_reference
from worldstate.abduction.signature.ensemble_training import SiteEnsembleClassifier
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings, SiteSignature
from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.adapters.datasets.feature_table import read_features
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import decode, encode
from worldstate.operations.training.site_references import with_site_references
from worldstate.operations.training.training import fit_ensemble, folds_by_recording, out_of_fold

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


TABLE = FOLDER and FOLDER / NAME
real = pytest.mark.skipif(
    TABLE is None, reason="extracted_features.csv neither where OVAD_FEATURES points nor in ../shared/ovad"
)


def stream_of(table, here, rng, hops=600):
    """Rows of a stream at a junction, 19 of 20 of them hazard-free."""
    none, hazard = (np.flatnonzero(here & flags) for flags in (table.hazard_free, table.hazards))
    return np.where(rng.random(hops) < 0.95, rng.choice(none, hops), rng.choice(hazard, hops))


def rates(table, prepared, train, here, rng):
    """Return decisions with and without the learned site, at an out-of-fold threshold, and labels."""
    known = prepared.select(train)
    model, folds = fit_ensemble(known), folds_by_recording(known, rng)
    (inner,) = out_of_fold(known, folds, fit_ensemble, [lambda one, rows: one.explain(known.features[rows])])
    gamma = neyman_pearson_threshold(list(hazard_statistic(inner, 0.0)[known.hazard_free][:, None]), 0.02)
    estimate, decisions = SiteEstimate.start(60), []
    rows = stream_of(table, here, rng)
    for row in rows:
        reference = estimate.reference(model)
        window = table.features[row]
        both = np.stack([np.concatenate([window, r]) for r in (reference, model.home)])
        decisions.append(hazard_statistic(model.predict_proba(both), 0.0) >= gamma)
        # Independent one-second windows, one per second.
        estimate = estimate.updated(window, 1.0, SETTINGS)
    return np.array(decisions), table.hazards[rows]


def pooled_rates(group, seen, seed=0):
    table = read_features(TABLE).group(group)
    prepared, rng = with_site_references(table), np.random.default_rng(seed)
    parts = []
    for junction in np.unique(table.environments):
        here = table.environments == junction
        if seen:
            keys = np.unique(table.recording_keys[here])
            here &= np.isin(table.recording_keys, rng.permutation(keys)[: len(keys) // 2])
        parts.append(rates(table, prepared, ~here, here, rng))
    decisions, hazards = (np.concatenate(part) for part in zip(*parts, strict=True))
    on, off = decisions.T
    return on[hazards].mean(), on[~hazards].mean(), off[hazards].mean(), off[~hazards].mean()


@pytest.mark.long
@pytest.mark.slow
@real
@pytest.mark.parametrize("seen", [False, True])
def test_learning_an_empty_street_costs_a_standing_ego_no_detections(seen):
    hits, false, hits_off, false_off = pooled_rates("static", seen)
    assert hits >= hits_off - 0.05
    assert false <= false_off + 0.02


@pytest.mark.long
@pytest.mark.slow
@real
def test_learning_a_new_junction_halves_false_alarms_of_a_moving_ego():
    hits, false, hits_off, false_off = pooled_rates("dynamic", seen=False)
    assert hits >= hits_off - 0.05
    assert false <= false_off / 2
