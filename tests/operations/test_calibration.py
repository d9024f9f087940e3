"""Risk maps and measures of calibration against peers, and thresholds set on recorded streams."""

import json
import math

import numpy as np
import pytest
import soundfile
from hop_tables import blank_stream
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.signal import lfilter
from sklearn.calibration import calibration_curve
from sklearn.isotonic import IsotonicRegression
from sklearn.metrics import brier_score_loss, r2_score, roc_auc_score
from worldstate_lab.metrics.intervals import calibration_error_sampling

from worldstate.abduction.co_evidence import Absent, Unqueried
from worldstate.abduction.cueing.cueing_policy import sustained_statistic
from worldstate.abduction.cueing.risk_map import (
    IsotonicMap,
    PlattMap,
    brier_score,
    brier_skill,
    expected_calibration_error,
    fit_isotonic,
    fit_platt,
    fit_risk_map,
    fit_sigmoid,
    reliability_curve,
)
from worldstate.abduction.evidence import SignatureEvidence, statistic
from worldstate.adapters.files.model_file import read_model
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError
from worldstate.ground.serialisation import encode
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement
from worldstate.operations.calibration.cueing_calibration import (
    CueingSettings,
    calibrate_cueing,
    correlation_time_hops,
    statistic_at,
)
from worldstate.operations.metrics.approach_table import auroc
from worldstate.operations.recordings.hop_table import hop_stream, load_streams, save_tables

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


PRIOR = (0.3, 0.3, 0.2, 0.2)
nats = st.floats(-8.0, 8.0)


def street(rng, label="none", hops=291, level=-1.5, phi=0.9):
    """Return a stream whose log-odds are an AR(1) about `level`; an approach rises to T0 at 20 s."""
    log_odds = lfilter([math.sqrt(1 - phi**2)], [1.0, -phi], rng.normal(size=hops)) + level
    stream = blank_stream(f"{label}/{rng.integers(1 << 30)}", hops)
    if label != "none":
        log_odds = log_odds + np.clip((stream.time_s - 15.0) * 1.0, 0.0, 6.0)
    heard = np.stack([log_odds, log_odds - 2.0, log_odds - 3.0, np.zeros(hops)], axis=1)
    t0_s = math.nan if label == "none" else 20.0
    return stream.replace(label=label, t0_s=t0_s, log_likelihoods=heard)


@given(st.lists(st.tuples(nats, nats, nats, nats), min_size=1, max_size=8), st.floats(0.0, 1.0))
def test_the_statistic_of_a_stream_equals_that_of_each_hop(rows, beta):
    heard = [SignatureEvidence(("left", "right"), row[:2], row[2], row[3]) for row in rows]
    silent = NotUsable("-")
    measured = [
        Measurement((i + 10) * 10**8, one, Unqueried("-"), silent, silent) for i, one in enumerate(heard)
    ]
    expected = [statistic(one, Absent(beta), PRIOR) for one in heard]
    assert statistic_at(hop_stream(measured, name="x"), PRIOR, beta) == pytest.approx(expected, rel=1e-9)


def test_few_samples_give_a_platt_map_and_many_an_isotonic_map():
    rng = np.random.default_rng(0)
    labels = rng.random(600) < 0.5
    scores = 1 / (1 + np.exp(-rng.normal(size=600) - labels))
    assert isinstance(fit_risk_map(scores[:150], labels[:150]), PlattMap)
    assert isinstance(fit_risk_map(scores, labels), IsotonicMap)
    assert isinstance(fit_risk_map(scores, labels, independent=60.0), PlattMap)


def test_calibrated_thresholds_keep_the_budget_on_new_recordings():
    kept = read_model().policies
    settings_, rates = CueingSettings(alphas=(0.05,)), []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        done = calibrate_cueing([street(rng) for _ in range(40)], PRIOR, kept, settings_)
        gamma = done.policies.for_alpha(0.05, 0.0).gamma
        fresh = [statistic_at(street(rng), PRIOR, 0.0) for _ in range(40)]
        rates.append(np.mean([np.mean(sustained_statistic(one, 3) >= gamma) for one in fresh]))
        assert done.risk == "kept"
        assert done.policies.for_alpha(0.05, 0.0).risk_map == kept.for_alpha(0.02, 0.0).risk_map
        assert [b.held_out_rate for b in done.budgets] == pytest.approx([0.04, 0.04], abs=0.03)
    assert 0.5 * 0.05 < np.mean(rates) <= 0.05


def test_approaches_with_a_t0_give_the_risk_map():
    rng = np.random.default_rng(1)
    streams = [street(rng, label) for label in ("none", "left") * 20]
    done = calibrate_cueing(streams, PRIOR, read_model().policies, CueingSettings(alphas=(0.05,)))
    assert done.risk in ("platt", "isotonic")
    risk = done.policies.for_alpha(0.05, 0.0).risk_map
    assert risk(0.1) < risk(0.9)
    assert (done.recordings, done.windows) == (20, 20 * 291)


def test_too_few_hours_give_a_warning_with_the_hours_needed():
    few = [street(np.random.default_rng(2)) for _ in range(5)]
    done = calibrate_cueing(few, PRIOR, read_model().policies, CueingSettings(alphas=(0.01,)))
    assert any("h would determine it to a factor of two" in warning for warning in done.warnings)
    assert any(warning.startswith("5 recordings") for warning in done.warnings)


@pytest.fixture
def streams_file(tmp_path):
    rng = np.random.default_rng(3)
    path = tmp_path / "streams.npz"
    save_tables(path, [street(rng, label) for label in ("none", "none", "right") * 6])
    return path


def test_streams_read_back_as_written(streams_file):
    streams = load_streams(streams_file)
    again = streams_file.with_name("again.npz")
    save_tables(again, streams)
    for before, after in zip(streams, load_streams(again), strict=True):
        assert (before.name, before.label, len(before)) == (after.name, after.label, 291)
        assert np.array_equal(before.log_likelihoods, after.log_likelihoods)
        assert np.array_equal(before.t0_s, after.t0_s, equal_nan=True)


def test_wrong_arrays_of_a_stream_file_raise_an_error(streams_file, tmp_path):
    with np.load(streams_file) as file:
        arrays = dict(file)
    for key, value in {
        "version": np.array({"a": 1}, dtype=object),
        "answer": arrays["answer"] + 7,
        "time_s": arrays["time_s"][1:],
        "log_likelihoods": np.full((5, 4), np.nan),
    }.items():
        wrong = tmp_path / f"{key}.npz"
        np.savez(wrong, **(arrays | {key: value}))
        with pytest.raises(InputFileError, match=wrong.name):
            load_streams(wrong)


def test_the_command_replaces_the_policies_and_keeps_the_signature(streams_file, tmp_path, capsys):
    out = tmp_path / "model.json"
    options = ["--alpha", "0.01", "0.1", "--out", str(out), "--json"]
    assert main(["model", "threshold", str(streams_file), *options]) == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert "12 recordings" in captured.err
    assert summary["warnings"]
    assert summary["hazard_free_hours"] == pytest.approx(12 * 291 / 36000)
    before, after = read_model(), read_model(out)
    assert encode(after.signature) == encode(before.signature)
    assert {(p.alpha, p.miss_rate) for p in after.policies.policies} == {
        (a, b) for a in (0.01, 0.1) for b in (0.0, 1.0)
    }
    assert after.policies.for_alpha(0.1, 0.0).gamma == summary["budgets"][1]["gamma"]


def test_the_threshold_command_reads_a_sound_file(tmp_path, capsys):
    sound = tmp_path / "quiet.wav"
    soundfile.write(sound, np.random.default_rng(0).normal(0, 0.01, (120_000, 56)), 48_000)
    out, streams = tmp_path / "model.json", tmp_path / "s.npz"
    extra = ["--alpha", "0.2", "--save-streams", str(streams), "--json"]
    assert main(["model", "threshold", str(sound), "--out", str(out), *extra]) == 0
    assert json.loads(capsys.readouterr().out)["windows"] == 16
    (heard,) = load_streams(streams)
    assert heard.hazard_free
    assert not heard.answer.any()


@given(st.floats(0.0, 0.9))
@settings(deadline=None, max_examples=15)
def test_the_correlation_time_of_an_autoregression_is_found(phi):
    """Stationary Gaussian AR(1) rows of unit variance."""
    rng = np.random.default_rng(1)
    shocks = rng.normal(size=(30, 4000)) * math.sqrt(1.0 - phi**2)
    shocks[:, 0] = rng.normal(size=30)
    streams = lfilter([1.0], [1.0, -phi], shocks, axis=1)
    assert correlation_time_hops(streams) == pytest.approx((1 + phi) / (1 - phi), rel=0.15)
