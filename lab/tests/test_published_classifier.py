"""The signature model against libsvm's own probabilities, and the coupling against its definition."""

import warnings

import numpy as np
import pytest
from scipy.optimize import minimize
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC
from worldstate_lab.features.published_classifier import PublishedClassifier, mirror_hazards

from worldstate.abduction.co_evidence import Absent, Unqueried
from worldstate.abduction.evidence import abduce, statistic
from worldstate.abduction.signature.ensemble import mirror_features
from worldstate.abduction.signature.published_signature import PAIRS, SignatureModel, couple
from worldstate.abduction.signature.window_classes import CLASSES, hazard_statistic
from worldstate.ground.serialisation import decode, encode


def windows(rng, n=240, spread=1.3):
    """Return four overlapping classes with the mirror symmetry of the real ones."""
    labels = rng.permutation(np.repeat(CLASSES, n // 4))
    azimuth = np.tile(np.linspace(-1, 1, 30), 2)
    shape = {"front": azimuth**2, "none": 0 * azimuth, "left": -azimuth, "right": azimuth}
    return np.stack([shape[label] for label in labels]) + spread * rng.normal(size=(n, 60)), labels


@pytest.fixture(scope="module")
def trained():
    X, y = windows(np.random.default_rng(1))
    return X, y, PublishedClassifier(np.random.default_rng(2)).fit(X, y).model_


@pytest.fixture(scope="module")
def libsvm(trained):
    if "probability" not in SVC().get_params():
        pytest.skip("this scikit-learn has no probabilities of libsvm's own any more")
    X, y, _ = trained
    augmented, labels = mirror_hazards(X, y)
    scaler = StandardScaler().fit(augmented)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        machine = SVC(kernel="linear", C=1.0, probability=True, random_state=0)
        machine.fit(scaler.transform(augmented), labels)
    return scaler, machine


def test_agrees_with_libsvm_on_windows_not_trained_on(trained, libsvm):
    scaler, machine = libsvm
    X, _ = windows(np.random.default_rng(7), n=1000)
    oracle, ours = machine.predict_proba(scaler.transform(X)), trained[2].predict_proba(X)
    assert machine.classes_.tolist() == list(CLASSES)
    # Both draw the folds of their sigmoids at random.
    assert np.abs(oracle - ours).mean() < 0.02
    assert (oracle.argmax(axis=1) == ours.argmax(axis=1)).mean() > 0.97


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_with_libsvm_s_sigmoids_only_its_tolerance_is_left(trained, libsvm):
    scaler, machine = libsvm
    numbers = encode(trained[2]) | {"slopes": machine.probA_.tolist(), "offsets": machine.probB_.tolist()}
    same = decode(SignatureModel, numbers, "file")
    X, _ = windows(np.random.default_rng(8), n=1000)
    # libsvm's iteration stops at an error of 0.005 / 4.
    np.testing.assert_allclose(same.predict_proba(X), machine.predict_proba(scaler.transform(X)), atol=5e-3)


@pytest.mark.parametrize("seed", range(4))
def test_coupling_minimises_its_criterion(seed):
    pairs = np.random.default_rng(seed).uniform(0.02, 0.98, 6)

    def disagreement(p):
        return sum((p[i] * (1 - r) - p[j] * r) ** 2 for r, (i, j) in zip(pairs, PAIRS, strict=True))

    whole = {"type": "eq", "fun": lambda p: p.sum() - 1}
    bounds, close = [(0, 1)] * 4, {"ftol": 1e-14}
    oracle = minimize(
        disagreement, np.full(4, 0.25), method="SLSQP", bounds=bounds, constraints=whole, options=close
    )
    found = couple(pairs[None], 4)[0]
    np.testing.assert_allclose(found, oracle.x, atol=1e-5)
    assert found.sum() == pytest.approx(1.0, abs=1e-12) and (found > 0).all()


def test_the_posterior_at_the_training_prior_is_the_classifier_s(trained):
    X, _, model = trained
    left, right, visible, none = 1, 3, 0, 2
    for x, p in zip(X[:20], model.predict_proba(X[:20]), strict=True):
        posterior = abduce(np.log(model.reference_prior), model.evidence(x), Unqueried("no camera"))
        np.testing.assert_allclose(posterior.probabilities, p[[left, right, visible, none]], atol=1e-9)


@pytest.mark.parametrize("beta", [0.0, 0.04, 0.5, 1.0])
def test_the_statistic_of_many_windows_is_that_of_each(trained, beta):
    X, _, model = trained
    at_once = hazard_statistic(model.predict_proba(X[:20]), beta)
    one_by_one = [statistic(model.evidence(x), Absent(beta), model.reference_prior) for x in X[:20]]
    np.testing.assert_allclose(at_once, one_by_one, atol=1e-9)


def test_the_mirror_swaps_sides_and_is_its_own_inverse():
    X, y = windows(np.random.default_rng(3))
    np.testing.assert_array_equal(mirror_features(mirror_features(X)), X)
    features, labels = mirror_hazards(X, y)
    hazards = np.isin(y, ("left", "right"))
    assert len(labels) == len(y) + hazards.sum()
    assert (labels == "left").sum() == (labels == "right").sum() == hazards.sum()
    first = features[len(y)].reshape(2, 30)
    np.testing.assert_array_equal(first, X[hazards][0].reshape(2, 30)[:, ::-1])
