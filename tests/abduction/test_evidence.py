"""Laws 1 to 4 of the posterior, its statistic and threshold, with gtsam as an oracle; votes, policies."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.special import logsumexp

from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.cueing.cueing_policy import (
    CueingPolicies,
    CueingPolicy,
    neyman_pearson_threshold,
    sustained_alarm,
    sustained_statistic,
)
from worldstate.abduction.cueing.risk_map import PlattMap
from worldstate.abduction.evidence import SignatureEvidence, abduce, log_lambda, statistic, with_bearing_vote
from worldstate.abduction.signature.window_classes import (
    CLASSES,
    WINDOW_CLASSES,
    explained,
    side_ratios,
    window_evidence,
)
from worldstate.ground.errors import InvalidArgumentError

nats = st.floats(-300, 300)
open_unit = st.floats(1e-6, 1 - 1e-6)
answers = st.one_of(
    st.builds(Absent, open_unit),
    st.builds(Absent, open_unit, st.floats(0, 0.5)),
    st.builds(Present, open_unit, open_unit),
    st.just(Unqueried("no camera")),
)


@st.composite
def scenes(draw, scale=300.0, directions=None):
    k = directions or draw(st.integers(1, 4))
    levels = st.floats(-scale, scale)
    hidden = draw(st.lists(levels, min_size=k, max_size=k))
    evidence = SignatureEvidence(tuple("abcd"[:k]), tuple(hidden), draw(levels), draw(levels))
    weights = np.array(draw(st.lists(st.floats(1e-3, 1), min_size=k + 2, max_size=k + 2)))
    return weights / weights.sum(), evidence


@given(scenes(), answers)
def test_law_1_sums_to_one_and_stays_finite(scene, answer):
    prior, evidence = scene
    posterior = abduce(np.log(prior), evidence, answer)
    assert np.isfinite(posterior.log_probabilities).all()
    assert np.isfinite([posterior.log_lambda, posterior.log_evidence]).all()
    assert posterior.probabilities.sum() == pytest.approx(1.0, abs=1e-12)
    assert posterior.hidden_total + posterior.visible + posterior.none == pytest.approx(1.0, abs=1e-12)


@given(scenes())
def test_law_2_beta_one_is_neutral_and_beta_zero_removes_the_visible(scene):
    prior, evidence = scene
    unasked = abduce(np.log(prior), evidence, Unqueried("no camera"))
    blind = abduce(np.log(prior), evidence, Absent(1.0))
    assert blind == unasked
    sharp = abduce(np.log(prior), evidence, Absent(0.0))
    assert sharp.visible == 0.0
    rest = np.delete(prior, -2), np.delete(evidence.log_likelihoods, -2)
    joint = np.log(rest[0]) + rest[1]
    expected = np.exp(joint - joint.max()) / np.exp(joint - joint.max()).sum()
    np.testing.assert_allclose(np.delete(sharp.probabilities, -2), expected, atol=1e-12)


@given(st.floats(0, 1), st.floats(0, 1), nats)
def test_law_3_without_a_hidden_prior_absence_is_the_bernoulli_update(r, pd, level):
    if r * pd > 1 - 1e-9:
        return
    evidence = SignatureEvidence(("left", "right"), (0.0, 0.0), level, level)
    with np.errstate(divide="ignore"):
        log_prior = np.log([0.0, 0.0, r, 1 - r])
    posterior = abduce(log_prior, evidence, Absent(miss_rate=1 - pd))
    assert posterior.visible == pytest.approx(r * (1 - pd) / (1 - r * pd), abs=1e-9)


@given(scenes(scale=8, directions=2), scenes(scale=8, directions=2), open_unit)
def test_law_4_the_statistic_is_a_monotone_map_of_lambda(scene, other, beta):
    prior, evidence = scene
    rival, answer = other[1], Absent(beta)
    ratios = [log_lambda(np.log(prior), e, answer) for e in (evidence, rival)]
    scores = [statistic(e, answer, prior) for e in (evidence, rival)]
    assert (ratios[1] - ratios[0]) * (scores[1] - scores[0]) >= -1e-12
    odds = np.log(prior[:2].sum() / prior[2:].sum())
    assert scores[0] == pytest.approx(1 / (1 + np.exp(-(ratios[0] + odds))), abs=1e-9)


@given(scenes(scale=20), answers, open_unit)
def test_lambda_does_not_depend_on_how_probable_a_hidden_source_is(scene, answer, pi_hidden):
    prior, evidence = scene
    moved = prior.copy()
    moved[:-2] *= pi_hidden / prior[:-2].sum()
    moved[-2:] *= (1 - pi_hidden) / prior[-2:].sum()
    expected = log_lambda(np.log(prior), evidence, answer)
    assert log_lambda(np.log(moved), evidence, answer) == pytest.approx(expected, abs=1e-9)


@given(scenes(scale=12), answers)
def test_gtsam_agrees_on_one_step(scene, answer):
    prior, evidence = scene
    hidden, visible, none = np.exp(answer.log_likelihoods())
    factors = [
        prior,
        np.exp(evidence.log_likelihoods - evidence.log_likelihoods.max()),
        np.array([hidden] * len(evidence.directions) + [visible, none]),
    ]
    key = (0, prior.size)
    graph = gtsam.DiscreteFactorGraph()
    for factor in factors:
        graph.add(key, " ".join(f"{value:.17g}" for value in factor))
    oracle = gtsam.DiscreteMarginals(graph).marginalProbabilities(key)
    ours = abduce(np.log(prior), evidence, answer).probabilities
    np.testing.assert_allclose(ours, oracle, atol=1e-9)


four_weights = st.lists(st.floats(0.01, 1), min_size=4, max_size=4)


@given(four_weights, four_weights)
def test_a_classifier_gives_the_published_statistic_and_ours(posteriors, frequencies):
    p, pi = (np.array(v) / np.sum(v) for v in (posteriors, frequencies))
    ratio = np.log(p / pi)
    evidence = SignatureEvidence(("left", "right"), tuple(ratio[:2]), ratio[2], ratio[3])
    assert statistic(evidence, Unqueried("unused"), pi) == pytest.approx(p[0] + p[1])
    for beta in (0.0, 0.04, 0.5):
        expected = (p[0] + p[1]) / (p[0] + p[1] + beta * p[2] + p[3])
        assert statistic(evidence, Absent(beta), pi) == pytest.approx(expected)


likelihoods = st.floats(-8.0, 8.0)
bearings = st.tuples(st.floats(-1.5, 1.5), st.floats(0.03, 0.9))
chances = st.floats(0.0, 1.0)


def of(values: tuple[float, ...]) -> SignatureEvidence:
    return SignatureEvidence(("left", "right"), values[:2], values[2], values[3])


@given(st.tuples(*[likelihoods] * 4), bearings, chances)
def test_a_vote_raises_no_likelihood_and_is_symmetric(values, bearing, d):
    before, voted = of(values), with_bearing_vote(of(values), *bearing, d)
    assert (voted.visible, voted.none) == (before.visible, before.none)
    assert logsumexp(voted.hidden) <= logsumexp(before.hidden) + 1e-9
    mirrored = with_bearing_vote(of((values[1], values[0], *values[2:])), -bearing[0], bearing[1], d)
    np.testing.assert_allclose(mirrored.hidden, voted.hidden[::-1], atol=1e-6)


@given(st.tuples(*[likelihoods] * 4), st.floats(0.2, 1.5))
def test_certain_direct_sound_takes_the_side_of_its_bearing(values, azimuth):
    voted = with_bearing_vote(of(values), azimuth, 0.1, 1.0)
    assert voted.hidden[0] - voted.hidden[1] > 3.0
    assert logsumexp(voted.hidden) <= logsumexp([voted.visible, voted.none]) + 1e-9


@given(st.tuples(*[likelihoods] * 4), bearings)
def test_reflected_sound_changes_nothing(values: tuple[float, ...], bearing: tuple[float, float]) -> None:
    assert with_bearing_vote(of(values), *bearing, 0.0) == of(values)


FIVE = (*CLASSES, "both")


@st.composite
def shares(draw, n=6):
    weights = draw(hnp.arrays(float, n, elements=st.floats(1e-4, 1.0)))
    return weights / weights.sum()


@given(shares(), shares())
def test_hypotheses_are_a_distribution_that_agrees_with_the_likelihoods(posterior, prior):
    four = explained(posterior[None], WINDOW_CLASSES, prior)[0]
    assert four.sum() == pytest.approx(1.0) and (four > 0).all()
    # Bayes' rule back: likelihoods and the prior of the explanations give the posterior again.
    evidence = window_evidence(posterior[None], WINDOW_CLASSES, prior)
    left, right, visible, none = np.exp(evidence.log_likelihoods)
    known = explained(prior[None], WINDOW_CLASSES, prior)[0]
    np.testing.assert_allclose(np.array([visible, left, none, right]) * known, four, rtol=1e-9)


@given(shares(5), shares(4))
def test_certain_direct_sound_leaves_the_hypotheses_unchanged(prior, rest):
    prior = np.concatenate([0.9 * prior, [0.1]])
    window = np.concatenate([1e-9 * rest, [0.0], [1.0 - 1e-9]])[None]
    evidence = window_evidence(window, WINDOW_CLASSES, prior)
    np.testing.assert_allclose(evidence.log_likelihoods, evidence.none, atol=1e-3)
    np.testing.assert_allclose(evidence.sides.log_ratios, -np.log(2.0), atol=1e-3)


def test_evidence_of_both_sides_raises_each_side():
    prior = np.array([0.2, 0.25, 0.2, 0.25, 0.1])
    one, two = np.array([[0.02, 0.9, 0.02, 0.02, 0.04], [0.02, 0.04, 0.02, 0.02, 0.9]])
    single, double = (side_ratios(window[None], FIVE, prior)[0] for window in (one, two))
    assert single[0] > 1.0 > 0.0 > single[1]
    assert (double > 1.0).all()
    hidden = window_evidence(two[None], FIVE, prior).hidden
    assert hidden[0] == pytest.approx(hidden[1], abs=0.1)


# Few distinct values, so that ties are common.
scores = st.sampled_from(np.linspace(0, 1, 9).tolist())
streams = st.lists(st.lists(scores, min_size=1, max_size=30), min_size=1, max_size=6)
hops = st.integers(1, 5)
PRIOR = (0.25, 0.25, 0.25, 0.25)


@given(st.lists(st.booleans(), max_size=40), hops)
def test_an_alarm_needs_consecutive_hops_above_the_threshold(held, k):
    by_hand = [t + 1 >= k and all(held[t + 1 - k : t + 1]) for t in range(len(held))]
    assert sustained_alarm(held, k).tolist() == by_hand


def alarm_rate(recordings, gamma, k):
    return np.concatenate([sustained_alarm(np.array(r) >= gamma, k) for r in recordings]).mean()


@given(streams, st.floats(0, 0.99), hops)
def test_law_4_the_threshold_is_the_smallest_within_the_budget(recordings, alpha, k):
    gamma = neyman_pearson_threshold(recordings, alpha, k)
    assert alarm_rate(recordings, gamma, k) <= alpha + 1e-12
    # The smallest: the next lower score that occurs would break the budget.
    lower = [s for r in recordings for s in sustained_statistic(r, k) if s < gamma and np.isfinite(s)]
    if lower:
        assert alarm_rate(recordings, max(lower), k) > alpha


def test_policies_are_found_by_budget():
    made = [CueingPolicy(a, 1, a, PRIOR, PlattMap(-1.0, 0.0), b) for a in (0.01, 0.02) for b in (0.0, 1.0)]
    policies = CueingPolicies(tuple(made))
    assert policies.for_alpha(0.02, 1.0) is made[3]
    with pytest.raises(InvalidArgumentError, match=r"0\.01, 0\.02"):
        policies.for_alpha(0.03)
    with pytest.raises(InvalidArgumentError, match=r"miss_rate: expected .* \(0, 1\), got 0\.5"):
        policies.for_alpha(0.02, 0.5)
