"""Risk maps and calibration measures against SciPy, scikit-learn and plain loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from sklearn.calibration import calibration_curve
from sklearn.isotonic import IsotonicRegression
from sklearn.metrics import brier_score_loss, r2_score, roc_auc_score
from worldstate_lab.metrics.intervals import calibration_error_sampling

from worldstate.abduction.cueing.risk_map import (
    brier_score,
    brier_skill,
    expected_calibration_error,
    fit_isotonic,
    fit_platt,
    fit_sigmoid,
    reliability_curve,
)
from worldstate.operations.metrics.approach_table import auroc

samples = st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=2, max_size=80).filter(
    lambda sample: len({label for _, label in sample}) == 2
)


@given(samples, st.lists(st.floats(0, 1), min_size=2, max_size=20))
def test_isotonic_map_is_the_isotonic_regression_and_monotone(sample, queries):
    scores, labels = map(np.array, zip(*sample, strict=True))
    fitted = fit_isotonic(scores, labels)
    oracle = IsotonicRegression(y_min=0, y_max=1, out_of_bounds="clip").fit(scores, labels)
    np.testing.assert_allclose(fitted(np.array(queries)), oracle.predict(queries), atol=1e-9)
    assert (np.diff(fitted(np.sort(queries))) >= 0).all()
    assert fitted(queries[0]) == fitted(np.array(queries))[0]


@given(samples, st.lists(st.floats(0, 1), min_size=2, max_size=20))
def test_platt_map_is_monotone_and_a_probability(sample, queries):
    fitted = fit_platt(*map(np.array, zip(*sample, strict=True)))
    risks = fitted(np.sort(queries))
    assert (np.diff(risks) >= -1e-15).all()
    assert (risks >= 0).all()
    assert (risks <= 1).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_sigmoid_maximises_the_likelihood(seed):
    rng = np.random.default_rng(seed)
    labels = rng.random(60) < 0.4
    values = rng.normal(size=60) + 1.5 * labels
    counts = labels.sum(), (~labels).sum()
    target = np.where(labels, (counts[0] + 1) / (counts[0] + 2), 1 / (counts[1] + 2))

    def loss(point):
        exponent = point[0] * values + point[1]
        return np.sum(target * np.logaddexp(0, exponent) + (1 - target) * np.logaddexp(0, -exponent))

    oracle = minimize(loss, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    np.testing.assert_allclose(fit_sigmoid(values, labels), oracle.x, atol=1e-5)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_sigmoid_survives_separable_and_badly_scaled_values(scale):
    slope, offset = fit_sigmoid(scale * np.array([-2.0, -1.0, 1.0, 2.0]), [False, False, True, True])
    assert slope < 0
    assert np.isfinite([slope, offset]).all()


@given(samples)
def test_calibration_error_and_brier_score_agree_with_scikit_learn(sample):
    risk, labels = map(np.array, zip(*sample, strict=True))
    edges = np.minimum((risk * 10).astype(int), 9)
    by_hand = sum(abs(risk[edges == b].sum() - labels[edges == b].sum()) for b in range(10)) / risk.size
    assert expected_calibration_error(risk, labels) == pytest.approx(by_hand, abs=1e-12)
    assert brier_score(risk, labels) == pytest.approx(brier_score_loss(labels, risk), abs=1e-12)
    # Skill is the coefficient of determination of the labels.
    assert brier_skill(risk, labels) == pytest.approx(r2_score(labels, risk), abs=1e-12)
    assert brier_skill(np.full(labels.size, labels.mean()), labels) == pytest.approx(0.0, abs=1e-12)
    assert brier_skill(risk, labels * 0) is None


def test_reliability_curve_agrees_with_scikit_learn():
    rng = np.random.default_rng(3)
    risk = rng.random(500)
    labels = rng.random(500) < risk**2
    observed, predicted = calibration_curve(labels, risk, n_bins=10)
    curve = reliability_curve(risk, labels)
    np.testing.assert_allclose(curve.observed, observed)
    np.testing.assert_allclose(curve.predicted, predicted)
    assert curve.counts.sum() == 500


def test_the_floor_is_the_mean_error_of_perfect_labels():
    rng = np.random.default_rng(5)
    risk = rng.random(411)
    scored = [expected_calibration_error(risk, rng.random(411) < risk) for _ in range(400)]
    assert calibration_error_sampling(risk, rng)[0] == pytest.approx(np.mean(scored), rel=0.05)
    assert calibration_error_sampling(np.tile(risk, 100), rng)[0] < 0.15 * np.mean(scored)


@given(st.lists(st.tuples(st.sampled_from([0.0, 0.2, 0.5, 0.9]), st.booleans()), min_size=2, max_size=60))
def test_auroc_agrees_with_scikit_learn(sample):
    scores, labels = map(np.array, zip(*sample, strict=True))
    if labels.all() or not labels.any():
        assert auroc(scores, labels) is None
    else:
        assert auroc(scores, labels) == pytest.approx(roc_auc_score(labels, scores), abs=1e-12)
