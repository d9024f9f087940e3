"""The ensemble for unseen junctions: mirror law, optimal coefficients, references learned while running."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import log_softmax
from worldstate_lab.features.feature_evaluation import predict_held_out

from worldstate.abduction.signature.ensemble import (
    expert_views,
    log_levels,
    mirror_features,
    site_reference,
)
from worldstate.abduction.signature.ensemble_training import (
    HEARD_PART,
    OTHER_SIDE,
    RECIPES,
    Recipe,
    SimulatedWindows,
    SiteEnsembleClassifier,
)
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings, SiteSignature
from worldstate.abduction.signature.window_classes import CLASSES, WINDOW_CLASSES, mirrored_classes
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import decode, encode
from worldstate.operations.training.site_references import learned_while_listening, with_site_references
from worldstate.operations.training.training import TrainingSettings, train_model

AZIMUTH = np.tile(np.linspace(-1, 1, 30), 2)
SHAPE = {"front": AZIMUTH**2, "none": 0 * AZIMUTH, "left": -AZIMUTH, "right": AZIMUTH}


def windows(rng, n=200, spread=0.8):
    """Return features of four overlapping classes at two sites of different level, with site references."""
    labels = rng.permutation(np.repeat(CLASSES, n // 4))
    levels = np.stack([SHAPE[label] for label in labels]) + spread * rng.normal(size=(n, 60))
    site = rng.integers(2, size=n)
    levels += 0.7 * site[:, None]
    references = np.stack([site_reference(levels[site == s]) for s in (0, 1)])[site]
    return np.hstack([np.exp(levels), references]), labels


@pytest.fixture(scope="module")
def trained():
    X, y = windows(np.random.default_rng(1))
    return X, y, SiteEnsembleClassifier().fit(X, y).model_


def mirrored(X):
    return mirror_features(X, X.shape[1] // 30)


@pytest.mark.parametrize("classes", [CLASSES, (*CLASSES, "both"), WINDOW_CLASSES])
def test_mirroring_the_world_exchanges_the_sides(trained, classes):
    model = trained[2]
    if classes != CLASSES:
        more = simulated(np.random.default_rng(10), ["SA1"], classes[len(CLASSES) :])
        model = SiteEnsembleClassifier(simulated=more).fit(*trained[:2], ["SA1"] * len(trained[1])).model_
    assert model.classes == classes
    X, _ = windows(np.random.default_rng(2))
    image = mirrored_classes(len(classes))
    np.testing.assert_array_equal(model.predict_proba(mirrored(X))[:, image], model.predict_proba(X))
    np.testing.assert_array_equal(model.explain(mirrored(X))[:, image[:4]], model.explain(X))
    there, back = model.evidence(X[0]), model.evidence(mirrored(X)[0])
    assert there.hidden == back.hidden[::-1]
    assert there.sides.log_ratios == back.sides.log_ratios[::-1]
    # Also without a reference: the mean of the training sites is symmetric.
    plain = X[:, :60]
    np.testing.assert_allclose(
        model.predict_proba(mirrored(plain))[:, image], model.predict_proba(plain), atol=1e-9
    )


@given(st.integers(0, 1000), st.floats(-2.0, 2.0))
def test_a_louder_site_with_its_own_reference_changes_nothing(seed, offset):
    X, y = windows(np.random.default_rng(3))
    model = SiteEnsembleClassifier((Recipe("mean", 0.1), Recipe("median", 0.1))).fit(X, y).model_
    x = X[seed % len(X)].copy()
    louder = np.concatenate([x[:60] * np.exp(offset), x[60:] + offset])
    np.testing.assert_allclose(model.predict_proba([louder]), model.predict_proba([x]), rtol=1e-9)


@pytest.mark.parametrize(("between", "expected_s"), [(0.2, 25.0), (0.5, 4.0), (1.0, 1.0), (0.0, 60.0)])
def test_the_more_sites_differ_the_faster_a_new_one_is_learned(between, expected_s):
    # Scatter of 1 within a site: the pattern of n windows has 1 / n, that of the site `between` squared.
    rng, sites = np.random.default_rng(7), np.repeat(np.arange(40), 24)
    patterns = between * rng.normal(size=(40, 60))[sites] + rng.normal(size=(960, 60))
    louder = 3.0 * rng.normal(size=(960, 1))
    X = np.hstack([np.exp(patterns + louder), np.zeros((960, 180))])
    y = np.tile(CLASSES, 240)
    model = SiteEnsembleClassifier((Recipe("mean", 1.0),)).fit(X, y, sites.astype(str)).model_
    assert model.prior_s == pytest.approx(expected_s, rel=0.3)


def simulated(rng, sites, more=()):
    X, y = windows(rng)
    y = y.astype("<U6")
    for position, name in enumerate(more):
        y[np.flatnonzero(y == CLASSES[position])[:20]] = name
    return SimulatedWindows(X, y, rng.choice(sites, len(y)), np.ones(len(y)), np.full(len(y), OTHER_SIDE))


def test_an_excluded_site_has_no_simulated_windows():
    rng = np.random.default_rng(8)
    X, y = windows(rng)
    groups, everywhere = np.tile(["SA1", "SA2"], 100), simulated(rng, ["SA1", "SA2", "SB1"])
    chosen = np.isin(everywhere.sites, ["SA1", "SA2"])
    here = SimulatedWindows(*(getattr(everywhere, column.name)[chosen] for column in fields(everywhere)))
    with_all, with_some, without = (
        SiteEnsembleClassifier(simulated=some).fit(X, y, groups).model_ for some in (everywhere, here, None)
    )
    assert encode(with_all) == encode(with_some)
    assert np.abs(with_all.predict_proba(X) - without.predict_proba(X)).max() > 0.01
    # The default reference and the learning rate of a site depend on real windows only.
    np.testing.assert_array_equal(with_all.home, without.home)
    assert with_all.prior_s == without.prior_s


def test_training_adds_windows_with_the_estimated_reference():
    """With no history the reference is the mean of the training sites, as for windows without a site."""
    X, y = windows(np.random.default_rng(12))
    groups, nothing = np.tile(["SA1", "SA2"], 100), SiteEstimate.start(60)
    nowhere = np.hstack([X[:, :60], np.full((len(X), 180), np.nan)])
    part = np.full(len(y), HEARD_PART / (1.0 - HEARD_PART))
    beside = SimulatedWindows(nowhere, y, groups, part, np.zeros(len(y)))
    twice = SiteEnsembleClassifier(simulated=beside).fit(X, y, groups).model_
    heard = SiteEnsembleClassifier().fit(X, y, groups, [nothing] * len(X)).model_
    np.testing.assert_allclose(heard.predict_proba(X), twice.predict_proba(X), atol=1e-4)
    np.testing.assert_allclose(heard.class_prior, twice.class_prior, rtol=1e-12)
    # The default reference depends only on the site references, and each window has weight one.
    plain = SiteEnsembleClassifier().fit(X, y, groups).model_
    np.testing.assert_array_equal(heard.home, plain.home)
    assert np.abs(heard.predict_proba(X) - plain.predict_proba(X)).max() > 0.01


def test_simulated_junctions_stay_whichever_site_is_held_out():
    """Simulated junctions have their own names; windows of them were once dropped beside real ones."""
    rng = np.random.default_rng(9)
    X, y = windows(rng)
    groups = np.tile(["SA1", "SA2"], 100)
    drawn = simulated(rng, ["SA1", "SA101", "SB101"], ("both", "direct")).beside(["SA1", "SA2", "SB1"])
    known = SiteEnsembleClassifier(simulated=drawn).fit(X, y, groups).model_
    assert {"both", "direct"} <= set(known.classes)
    kept = drawn.at(["SA2"])
    assert len(kept.y) == np.sum(drawn.sites != "SA1") > 0


@pytest.mark.parametrize("other_side", [0.0, OTHER_SIDE])
def test_a_share_of_a_simulated_hazard_is_labelled_with_the_other_side(other_side):
    # One pattern that no real window has: the posterior is the share of each label by weight. A symmetric one
    # would be equally likely on both sides.
    rng, n = np.random.default_rng(9), 300
    X, y = windows(rng, n)
    X, sites = X[y != "left"], np.repeat("SA1", n - n // 4)
    left = np.tile(np.hstack([np.full(60, 50.0), np.zeros(180)]), (n, 1))
    left[:, :20] = 400.0
    rest = np.tile(np.hstack([np.full(60, 1.0), np.zeros(180)]), (2, 1))
    labels = np.concatenate([np.repeat("left", n), ["front", "none"]])
    at, shares = np.repeat("SA1", n + 2), (np.full(n + 2, 1.0), np.full(n + 2, other_side))
    more = SimulatedWindows(np.concatenate([left, rest]), labels, at, *shares)
    model = SiteEnsembleClassifier((Recipe("mean", 1e-5),), more).fit(X, y[y != "left"], sites).model_
    assert model.predict_proba(left[:1])[0, [1, 3]] == pytest.approx([1.0 - other_side, other_side], abs=0.05)


def test_another_site_reference_changes_the_prediction(trained):
    X, _, model = trained
    moved = replace(model, home=model.home + 0.5)
    assert np.abs(moved.predict_proba(X[:, :60]) - model.predict_proba(X[:, :60])).max() > 0.05
    behind = np.hstack([X[:, :60], np.tile(moved.home, (len(X), 1))])
    np.testing.assert_allclose(model.predict_proba(behind), moved.predict_proba(X[:, :60]), rtol=1e-12)


def test_the_coefficients_are_the_optimum_of_the_penalised_likelihood(trained):
    X, y, model = trained
    codes = np.searchsorted(CLASSES, y)
    both = np.vstack([X, mirrored(X)])
    codes = np.concatenate([codes, np.array([0, 3, 2, 1])[codes]])
    for recipe, expert in zip(RECIPES, model.experts, strict=True):
        seen = expert_views(log_levels(both[:, :60]), both[:, 60:])[expert.view]
        standard = (seen - expert.mean) / expert.scale

        def loss(weights, standard=standard, expert=expert, ridge=recipe.ridge):
            log_p = log_softmax(standard @ weights.T + expert.intercepts, axis=1)
            return -log_p[np.arange(len(codes)), codes].mean() + ridge / 2 * (weights**2).sum()

        rng, best = np.random.default_rng(0), loss(expert.weights)
        for _ in range(20):
            step = rng.normal(size=expert.weights.shape) * 0.01
            assert loss(expert.weights + step) > best


def table(labels, environments, recordings, features):
    n = len(labels)
    return FeatureTable(
        features, *(np.array(column) for column in (labels, labels, environments, recordings)), (None,) * n
    )


def test_a_reference_excludes_its_recording_other_sites_and_labels():
    rng = np.random.default_rng(5)
    n = 40
    labels = rng.choice(CLASSES, n).tolist()
    sites = rng.choice(["SA1", "SB1"], n).tolist()
    recordings = rng.integers(8, size=n).astype(str).tolist()
    features = rng.uniform(0.1, 1.0, (n, 60))
    before = with_site_references(table(labels, sites, recordings, features)).features[:, 60:]
    relabelled = with_site_references(table(labels[::-1], sites, recordings, features))
    np.testing.assert_array_equal(relabelled.features[:, 60:], before)
    for i in range(0, n, 5):
        louder = features.copy()
        louder[i] *= 3.0
        after = with_site_references(table(labels, sites, recordings, louder)).features[:, 60:]
        same_recording = np.array([(sites[j], recordings[j]) == (sites[i], recordings[i]) for j in range(n)])
        other_site = np.array([sites[j] != sites[i] for j in range(n)])
        np.testing.assert_array_equal(after[same_recording | other_site], before[same_recording | other_site])
        assert (np.abs(after - before).max(axis=1) > 0)[~(same_recording | other_site)].all()


def made_up_junctions():
    rng, n = np.random.default_rng(6), 90
    labels = np.repeat(["none", "left", "front"], n // 3).tolist()
    return labels, ["SA1"] * n, (np.arange(n) // 2).astype(str).tolist(), rng.uniform(0.1, 1.0, (n, 60))


@settings(max_examples=8)
@given(st.integers(0, 44), st.sampled_from(["none", "left", "right"]))
def test_a_learned_reference_excludes_the_scored_recording(recording, label):
    labels, _, recordings, features = made = made_up_junctions()
    before = learned_while_listening(table(*made), np.random.default_rng(recording))
    mine = [row for row, name in enumerate(recordings) if name == str(recording)]
    for row in mine:
        labels[row], features[row] = label, 3.0
    after = learned_while_listening(table(*made), np.random.default_rng(recording))
    for row in mine:
        np.testing.assert_array_equal(before[row].level, after[row].level)


def test_learning_needs_hazard_free_windows_of_two_recordings_or_starts_empty():
    labels, sites, recordings, features = made_up_junctions()
    labels = ["left" if name == "none" else name for name in labels]
    streets = table(labels, sites, recordings, features)
    with pytest.raises(InvalidArgumentError, match="SA1/0"):
        with_site_references(table(["none"] * 2, ["SA1"] * 2, ["0", "0"], np.ones((2, 60))))
    with pytest.raises(InvalidArgumentError, match="hazard-free"):
        learned_while_listening(streets, np.random.default_rng(0))
    learned = learned_while_listening(streets, np.random.default_rng(0), or_nothing=True)
    assert {one.heard_s for one in learned} == {0.0}


def test_likelihoods_are_finite_far_from_the_training_data(trained):
    for level in (0.0, 1e-30, 1.0, 1e30):
        assert np.isfinite(trained[2].evidence(np.full(60, level)).log_likelihoods).all()


def made_up_table(seed):
    """Return features of 60 recordings at three sites; a step of three is a louder site."""
    rng = np.random.default_rng(seed)
    labels = [
        (n, one)
        for n in range(60)
        for one in (("none",) if n % 2 else (("left", "right")[n // 6 % 2], "front"))
    ]
    levels = [SHAPE[one] + 0.7 * rng.normal(size=60) + 0.3 * (n % 3) for n, one in labels]
    sites, recordings = ([f"SA{n % 3}" for n, _ in labels], [f"{seed} {n}" for n, _ in labels])
    return table([one for _, one in labels], sites, recordings, np.exp(levels))


def test_a_trained_model_predicts_other_recordings_and_holds_no_row_of_its_data():
    known, other = made_up_table(0), made_up_table(2)
    model = train_model(known, TrainingSettings(repeats=1), dataset="made up", group="static")
    assert model.policies.for_alpha(0.02).reference_prior == model.signature.reference_prior
    predictions = predict_held_out(model, other, 0.05, "run", np.random.default_rng(0))
    assert (predictions.classes == other.labels).mean() > 0.8
    rows = {value.tobytes() for value in np.log(known.features).ravel()}
    written = [model.signature.home, *(expert.weights for expert in model.signature.experts)]
    assert not rows & {value.tobytes() for one in written for value in one.ravel()}


SETTINGS = SiteEstimateSettings()


@pytest.fixture(scope="module")
def model(trained):
    return trained[2]


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


def test_a_first_window_has_the_default_reference(model):
    assert SiteEstimate.start(60).reference(model) is model.home
    window = np.random.default_rng(3).uniform(0.1, 1.0, 60)
    assert SiteSignature(model).evidence(window) == model.evidence(window)
    at_home = listened(np.tile(np.exp(model.empty), (50, 1)))
    np.testing.assert_allclose(at_home.reference(model), model.home, atol=1e-9)


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


@pytest.mark.parametrize("bad", [np.full(60, np.nan), np.ones(59)])
def test_a_refused_window_leaves_the_estimate_unchanged(model, bad):
    signature = SiteSignature(model)
    with pytest.raises(InvalidArgumentError):
        signature.evidence(bad)
    assert signature.estimate.heard_s == 0.0
