"""Figures of merit against scipy, brute force, Monte Carlo and laws over random inputs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest, bootstrap, poisson
from worldstate_lab.metrics.intervals import (
    deal_folds,
    middle,
    paired_gains,
    poisson_upper,
    random_detection,
    stratified_draws,
    worst_group,
)

from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.metrics.approach_table import poisson_interval, share_interval

few = settings(max_examples=40)


@given(st.integers(0, 400), st.floats(1e-3, 1e3), st.floats(0.5, 0.999))
@few
def test_the_interval_of_a_rate_contains_the_likely_counts(count, hours, confidence):
    low, high = poisson_interval(count, hours, confidence)
    tail = (1 - confidence) / 2
    assert poisson.cdf(count, high * hours) == pytest.approx(tail, rel=1e-6)
    assert low == 0 if count == 0 else poisson.sf(count - 1, low * hours) == pytest.approx(tail, rel=1e-6)
    # A rate at its upper bound gives so few counts once in ten.
    assert poisson.cdf(count, poisson_upper(count, hours) * hours) == pytest.approx(0.1, rel=1e-6)


@pytest.mark.parametrize("arguments", [(-1, 1.0), (1, 0.0), (1, 1.0, 1.0)])
def test_a_rate_without_time_or_with_a_negative_count_is_rejected(arguments):
    with pytest.raises(InvalidArgumentError):
        poisson_interval(*arguments)


@given(st.integers(1, 2000), st.floats(0.0, 1.0))
@settings(max_examples=20)
def test_the_interval_of_a_share_is_that_of_clopper_and_pearson(of, share):
    count = round(share * of)
    exact = binomtest(count, of).proportion_ci(0.95, "exact")
    assert share_interval(count, of) == pytest.approx((exact.low, exact.high), abs=1e-9)


@given(st.lists(st.floats(0, 20), min_size=1, max_size=5), st.integers(0, 30), st.integers(0, 2**32))
@settings(max_examples=10)
def test_the_random_detection_rate_equals_that_of_drawn_alarms(windows, alarms, seed):
    total, draws = sum(windows) + 10.0, 20_000
    ends = np.cumsum(windows)
    onsets = np.random.default_rng(seed).uniform(0, total, (draws, alarms, 1))
    hit = ((onsets < ends) & (onsets >= ends - windows)).any(axis=1)
    # Four standard errors of a mean of draws, each in [0, 1].
    assert random_detection(windows, alarms, total) == pytest.approx(hit.mean(), abs=4 * 0.5 / draws**0.5)
    assert np.isnan(random_detection([], 3, 10.0))


strata = st.lists(st.tuples(st.sampled_from("LRN"), st.sampled_from("AB")), min_size=1, max_size=30)


@given(strata, st.integers(0, 2**32))
@few
def test_draws_keep_the_size_of_every_stratum(strata, seed):
    drawn = stratified_draws(strata, np.random.default_rng(seed), draws=7)
    assert drawn.shape == (7, len(strata))
    assert all(strata[j] == strata[i] for row in drawn for i, j in enumerate(row))


def test_the_central_interval_of_the_draws_is_the_percentile_bootstrap():
    values = np.random.default_rng(1).gamma(2.0, size=60)
    drawn = values[stratified_draws(["one"] * 60, np.random.default_rng(2), draws=4000)].mean(axis=1)
    oracle = bootstrap((values,), np.mean, method="percentile", n_resamples=4000, rng=3).confidence_interval
    assert middle(drawn) == pytest.approx(tuple(oracle), abs=0.02)
    assert middle(np.append(drawn, np.nan)) == middle(drawn)
    assert np.isnan(middle(np.full(3, np.nan))).all()


def test_paired_draws_show_a_difference_smaller_than_the_spread_of_recordings():
    rng = np.random.default_rng(0)
    hard = rng.normal(size=40)
    draws = stratified_draws(["one"] * 40, rng)
    ours, theirs = (
        {"lead_s": (hard + shift + rng.normal(scale=0.1, size=40))[draws].mean(axis=1)}
        for shift in (0.2, 0.0)
    )
    assert middle(ours["lead_s"])[0] < middle(theirs["lead_s"])[1]
    assert paired_gains(ours, theirs)["lead_s"][0] > 0.1


def test_the_worst_group_is_one_that_has_a_figure():
    rates = {"SA1": np.nan, "SA2": 3.0, "SB1": 9.7, "SB2": 3.0}
    assert worst_group(rates, "high") == ("SB1", 9.7)
    assert worst_group(rates, "low") == ("SA2", 3.0)
    assert worst_group({"SA1": np.nan}, "low")[0] == ""


recordings = st.lists(
    st.tuples(st.sampled_from(["none", "left", "right"]), st.sampled_from(["SA1", "SB1", "SC1"])),
    min_size=4,
    max_size=80,
).filter(lambda made: 2 <= sum(label == "none" for label, _ in made) <= len(made) - 2)


@given(recordings, st.integers(2, 12), st.integers(0, 2**32))
@few
def test_folds_divide_every_kind_label_and_stratum(made, folds, seed):
    labels, groups = zip(*made, strict=True)
    dealt = deal_folds(labels, groups, np.random.default_rng(seed), folds)
    kinds = [label == "none" for label in labels]
    number = dealt.max() + 1
    assert number == min(folds, sum(kinds), len(kinds) - sum(kinds))
    for ways in (made, labels, kinds, [0] * len(made)):
        for value in set(ways):
            counts = np.bincount(dealt[[way == value for way in ways]], minlength=number)
            assert np.ptp(counts) <= 1


def test_folds_are_drawn_again_and_errors_state_what_is_missing():
    labels, groups = ["none", "left"] * 20, ["SA1"] * 40
    first, second = (deal_folds(labels, groups, np.random.default_rng(seed)) for seed in (0, 1))
    assert (first != second).any()
    with pytest.raises(InvalidArgumentError, match="got 1 approaches, 3 hazard-free"):
        deal_folds(["none", "none", "none", "left"], ["SA1"] * 4, np.random.default_rng(0))
