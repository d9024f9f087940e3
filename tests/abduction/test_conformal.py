"""Thresholds with a finite-sample guarantee, and how many windows a stream is worth."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapie.risk_control.methods import find_best_predict_param, get_r_hat_plus
from scipy import stats
from scipy.signal import lfilter

from worldstate.abduction.cueing.cueing_policy import sustained_statistic
from worldstate.abduction.cueing.risk_map import correlation_time_hops
from worldstate.abduction.cueing.thresholds import (
    conformal_threshold,
    neyman_pearson_threshold,
    recordings_needed,
    risk_controlling,
)
from worldstate.ground.errors import InvalidArgumentError

WINDOWS, PHI = 91, 0.9


def autoregressive(rng, recordings, windows=WINDOWS, phi=PHI):
    """Recordings of a stationary Gaussian AR(1), unit variance; correlation time (1 + phi) / (1 - phi)."""
    shocks = rng.normal(size=(recordings, windows)) * math.sqrt(1.0 - phi**2)
    shocks[:, 0] = rng.normal(size=recordings)
    return lfilter([1.0], [1.0, -phi], shocks, axis=1)


def shares(streams, gamma, hops):
    return np.array([np.mean(sustained_statistic(s, hops) >= gamma) for s in streams])


@settings(deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(60, 150), st.floats(0.03, 0.5), st.integers(1, 4), st.booleans()
)
def test_it_is_the_smallest_threshold_that_satisfies_its_definition(seed, n, alpha, hops, ties):
    rng = np.random.default_rng(seed)
    streams = [rng.normal(size=rng.integers(3, 30)).round(1 if ties else 9) for _ in range(n)]
    gamma = conformal_threshold(streams, alpha, hops)
    assert (shares(streams, gamma, hops).sum() + 1) / (n + 1) <= alpha + 1e-9
    below = np.nextafter(gamma, -np.inf)
    held = np.concatenate([sustained_statistic(s, hops) for s in streams])
    if (held >= below).any() and gamma > np.finfo(float).min:
        assert (shares(streams, below, hops).sum() + 1) / (n + 1) > alpha - 1e-9


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.4))
def test_with_one_window_a_recording_it_is_the_split_conformal_quantile(seed, alpha):
    scores = np.sort(np.random.default_rng(seed).normal(size=80))
    rank = math.ceil((80 + 1) * (1.0 - alpha) - 1e-9)
    gamma = conformal_threshold(scores[:, None], alpha)
    if rank > 80:
        assert gamma == math.inf
    else:
        assert gamma == np.nextafter(scores[rank - 1], np.inf)


@given(st.floats(0.005, 0.5), st.sampled_from([None, 0.8, 0.95]))
def test_fewer_recordings_than_needed_give_no_finite_threshold(alpha, confidence):
    need = recordings_needed(alpha, confidence)
    scores = np.linspace(0.0, 1.0, need)
    assert math.isfinite(conformal_threshold(scores[:, None], alpha, 1, confidence))
    if need > 1:
        assert conformal_threshold(scores[1:, None], alpha, 1, confidence) == math.inf


@pytest.mark.long
@pytest.mark.slow
def test_the_achieved_rate_is_beta_binomial_as_theory_says():
    """n calibration and m test scores, exchangeable: exceedances of the k-th largest are beta-binomial."""
    rng, n, m, alpha, trials = np.random.default_rng(3), 99, 200, 0.05, 800
    counts = [
        int((rng.normal(size=m) >= conformal_threshold(rng.normal(size=(n, 1)), alpha)).sum())
        for _ in range(trials)
    ]
    k = math.floor(alpha * (n + 1) - 1 + 1e-9) + 1
    expected = stats.betabinom(m, k, n + 1 - k)
    assert np.mean(counts) / m <= alpha + 3 * expected.std() / m / math.sqrt(trials)
    edges = [0, 5, 10, 15, 20, m]
    observed = np.histogram(counts, [0, 6, 11, 16, 21, m + 1])[0]
    theory = trials * np.diff([0.0, *expected.cdf(edges[1:])])
    assert stats.chisquare(observed, theory * trials / theory.sum()).pvalue > 1e-3


@pytest.mark.long
@pytest.mark.parametrize(("alpha", "confidence"), [(0.02, None), (0.05, None), (0.05, 0.9)])
def test_the_achieved_rate_stays_within_the_budgets_binomial_interval(alpha, confidence):
    """Fresh recordings of a known autocorrelated law, 100 seeds.

    The windows of 200 recordings are worth N / tau independent ones, tau of the alarm itself and known from
    the law; the achieved rate is held against the one-sided 95 % limit of a binomial with that many trials.
    """
    hops, recordings, within, rates = 3, 200, 0, []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        gamma = conformal_threshold(autoregressive(rng, recordings), alpha, hops, confidence)
        fresh = autoregressive(rng, recordings)
        alarms = np.stack([sustained_statistic(s, hops) >= gamma for s in fresh])
        trials = round(alarms.size / ALARM_TIME_HOPS[alpha])
        limit = stats.binom.ppf(0.95, trials, alpha) / trials
        within += alarms.mean() <= limit
        rates.append(alarms.mean())
    assert within >= 95
    assert np.mean(rates) <= alpha * 1.05
    # Hoeffding-Bentkus does not know that losses averaged over a recording vary little, and stays far below.
    assert np.mean(rates) >= alpha * (0.7 if confidence is None else 0.1)


# Correlation time of "the last 3 hops of the AR(1) were at or above the (1 - alpha) level", in hops:
# measured once on 4e6 hops of the law, and held against a shorter run by the test below.
ALARM_TIME_HOPS = {0.02: 7.7, 0.05: 9.6}


@pytest.mark.parametrize("alpha", [0.02, 0.05])
def test_the_correlation_time_of_the_alarm_is_that_of_the_law(alpha):
    stream = autoregressive(np.random.default_rng(0), 40, 20_000)
    held = np.stack([sustained_statistic(s, 3) for s in stream])[:, 2:]
    alarm = (held >= np.quantile(held, 1.0 - alpha)).astype(float)
    assert correlation_time_hops(alarm) == pytest.approx(ALARM_TIME_HOPS[alpha], rel=0.1)


@pytest.mark.long
@pytest.mark.slow
def test_confidence_holds_over_calibrations_and_the_plain_rule_does_not():
    rng, alpha = np.random.default_rng(8), 0.05
    exact, plain = [], []
    for _ in range(200):
        scores = rng.normal(size=(150, 1))
        exact.append(stats.norm.sf(conformal_threshold(scores, alpha, confidence=0.9)))
        plain.append(stats.norm.sf(neyman_pearson_threshold(scores, alpha)))
    assert np.mean(np.array(exact) <= alpha) >= stats.binom.ppf(1e-3, 200, 0.9) / 200
    assert np.mean(np.array(plain) <= alpha) < 0.6


@given(st.floats(0.0, 0.9))
@settings(deadline=None, max_examples=15)
def test_correlation_time_of_an_autoregression(phi):
    streams = autoregressive(np.random.default_rng(1), 30, 4000, phi)
    assert correlation_time_hops(streams) == pytest.approx((1 + phi) / (1 - phi), rel=0.15)


def losses(rng, units, thresholds=30, largest=3.0):
    """Losses of units that rise towards lower thresholds, each at its own, now and then falling again."""
    at = rng.uniform(0.0, thresholds, (units, 1))
    rising = np.maximum(np.arange(thresholds) - at, 0.0) * rng.exponential(0.3, (units, 1))
    return np.minimum(rising * rng.choice([1.0, 0.0], rising.shape), largest)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.floats(0.05, 2.5))
def test_the_expected_loss_of_a_unit_left_out_is_within_the_budget_whatever_the_losses(seed, units, alpha):
    table = losses(np.random.default_rng(seed), units)
    kept = [risk_controlling(np.delete(table, unit, axis=0), alpha, 3.0) for unit in range(units)]
    lost = [row[k - 1] if k else 0.0 for row, k in zip(table, kept, strict=True)]
    assert np.mean(lost) <= alpha + 1e-9


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(5, 40), st.floats(0.1, 0.9))
def test_a_controlled_risk_is_that_of_another_implementation(seed, units, alpha):
    table = np.maximum.accumulate(losses(np.random.default_rng(seed), units), axis=1)
    table[:, 0], numbers = 0.0, np.arange(table.shape[1], dtype=float)
    _, bound = get_r_hat_plus(table / 3.0, numbers, "crc", None, None, None)
    if bound[0] < alpha < bound[-1]:
        theirs = find_best_predict_param(numbers, bound, np.array([alpha]))
        assert risk_controlling(table, 3.0 * alpha, 3.0) == theirs[0] + 1


@pytest.mark.parametrize(
    "bad", [{"alpha": 0.0}, {"alpha": 1.0}, {"alpha": 0.1, "confidence": 1.0}, {"alpha": math.nan}]
)
def test_numbers_out_of_range_are_refused(bad):
    with pytest.raises(InvalidArgumentError):
        conformal_threshold([[0.1, 0.2]], **bad)
    with pytest.raises(InvalidArgumentError, match="window"):
        conformal_threshold([], 0.1)
    with pytest.raises(InvalidArgumentError, match="window"):
        correlation_time_hops([])
