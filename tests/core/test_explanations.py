"""The explanation filter: laws over random inputs, and two oracles that are not our code."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.belief.window_belief import ExplanationBelief, equilibrium, generator, transition
from worldstate.core.side_update import log_co_evidence

DIRECTIONS = ("left", "right")
rates = st.tuples(*[st.floats(0.0, 3.0)] * 6)
positive_rates = st.tuples(*[st.floats(0.01, 3.0)] * 6)
logs = st.floats(-30.0, 30.0)
steps_ns = st.integers(1_000_000, 5_000_000_000)
answers = st.one_of(
    st.builds(Absent, st.floats(0.0, 1.0), st.floats(0.0, 0.5)),
    st.builds(Present, st.floats(0.0, 1.0), st.floats(0.001, 0.5)),
    st.just(Unqueried("none")),
)


def co_terms(answer):
    return log_co_evidence(answer, 2)


def evidence(left, right, visible, none):
    return SignatureEvidence(DIRECTIONS, (left, right), visible, none)


@given(rates, st.integers(1, 4), steps_ns, steps_ns)
def test_transitions_are_stochastic_and_compose(rate, k, first, second):
    one, two = transition(rate, k, first), transition(rate, k, second)
    assert (one >= 0).all()
    assert one.sum(axis=1) == pytest.approx(1.0)
    assert one @ two == pytest.approx(transition(rate, k, first + second), abs=1e-9)


@settings(max_examples=20)
@given(positive_rates, st.floats(0.05, 3.0))
def test_transition_solves_the_forward_equation(rate, time_s):
    start = np.full(6, 1 / 6)
    flow = generator(rate, 2)
    solved = solve_ivp(lambda t, p: p @ flow, (0, time_s), start, rtol=1e-9, atol=1e-12).y[:, -1]
    assert start @ transition(rate, 2, round(time_s * 1e9)) == pytest.approx(solved, abs=1e-7)


@given(positive_rates)
def test_equilibrium_is_left_alone(rate):
    settled = equilibrium(rate, 2)
    assert settled @ generator(rate, 2) == pytest.approx(0.0, abs=1e-6)


looks_of_any_kind = st.lists(st.tuples(logs, logs, logs, logs, answers), min_size=1, max_size=8)


@given(rates, looks_of_any_kind)
def test_it_sums_to_one_and_stays_finite(rate, looks):
    belief = ExplanationBelief.settled(len(DIRECTIONS), rate)
    for left, right, visible, none, answer in looks:
        belief = belief.predict(rate, 100_000_000)
        belief = belief.update(evidence(left, right, visible, none), co_terms(answer))
        assert np.isfinite(belief.log_probabilities).all()
        assert belief.probabilities.sum() == pytest.approx(1.0, abs=1e-9)


@given(positive_rates, st.lists(st.tuples(logs, logs, logs, answers), min_size=1, max_size=20))
def test_it_lumps_onto_the_three_explanations(rate, looks):
    """With both directions alike, P(hidden) is that of a three-state filter written down on its own."""
    arrival, emergence, departure, reocclusion, visible_arrival, visible_departure = rate
    flow = np.array(
        [
            [-(emergence + departure), emergence, departure],
            [reocclusion, -(reocclusion + visible_departure), visible_departure],
            [2 * arrival, visible_arrival, -(2 * arrival + visible_arrival)],
        ]
    )
    step = expm(flow * 0.1)
    belief = ExplanationBelief.from_priors(len(DIRECTIONS), 0.2, 0.3, 0.5)
    three = np.array([0.2, 0.3, 0.5])
    for hidden, visible, none, answer in looks:
        belief = belief.predict(rate, 100_000_000)
        belief = belief.update(evidence(hidden, hidden, visible, none), co_terms(answer))
        log_three = np.log(np.maximum(three @ step, 1e-300))
        log_three = log_three + np.array([hidden, visible, none]) + answer.log_likelihoods()
        three = np.exp(log_three - np.logaddexp.reduce(log_three))
        assert belief.sides.hypotheses == pytest.approx(tuple(three), abs=1e-9)


def test_it_agrees_with_a_factor_graph():
    """gtsam's discrete factor graph over 30 steps of the lumped chain."""
    rng, rate, steps = np.random.default_rng(5), (0.05, 0.3, 0.1, 0.05, 0.05, 0.3), 30
    lump = np.zeros((6, 4))
    lump[[0, 1, 2, 3, 4, 5], [0, 1, 2, 2, 2, 3]] = 1.0
    step = (transition(rate, 2, 100_000_000) @ lump)[[0, 1, 4, 5]]
    prior, belief = [0.1, 0.1, 0.3, 0.5], ExplanationBelief.from_priors(len(DIRECTIONS), 0.2, 0.3, 0.5)
    graph = gtsam.DiscreteFactorGraph()
    graph.add([(0, 4)], " ".join(map(str, prior)))
    for i in range(1, steps + 1):
        heard, answer = rng.normal(0, 2, 4), Absent(0.2) if i % 3 else Present(0.1, 0.05)
        likelihood = np.exp(heard + co_terms(answer))
        graph.add([(i - 1, 4), (i, 4)], " ".join(f"{p:.17g}" for p in step.ravel()))
        graph.add([(i, 4)], " ".join(f"{p:.17g}" for p in likelihood))
        belief = belief.predict(rate, 100_000_000).update(evidence(*heard), co_terms(answer))
    expected = gtsam.DiscreteMarginals(graph).marginalProbabilities((steps, 4))
    got = [*belief.sides.hidden, *belief.sides.hypotheses[1:]]
    assert got == pytest.approx(np.asarray(expected).ravel(), abs=1e-8)


@given(logs, logs, logs, logs)
def test_blind_vision_is_neutral_and_perfect_vision_removes_the_visible(left, right, visible, none):
    start = ExplanationBelief.from_priors(len(DIRECTIONS), 0.2, 0.3, 0.5)
    heard = evidence(left, right, visible, none)
    blind = start.update(heard, co_terms(Absent(1.0)))
    unasked = start.update(heard, co_terms(Unqueried("-")))
    assert blind.probabilities == pytest.approx(unasked.probabilities)
    assert start.update(heard, co_terms(Absent(0.0))).sides.hypotheses[1] < 1e-200


@given(st.floats(0.01, 0.99), st.floats(0.0, 0.2))
def test_hand_over_moves_mass_into_view_and_keeps_the_sum(hidden, residual):
    start = ExplanationBelief.from_priors(len(DIRECTIONS), hidden, (1 - hidden) / 2, (1 - hidden) / 2)
    start = start.predict((0.05, 0.3, 0.1, 0.05, 0.05, 0.3), 10**9)
    before, emerged = start.sides, start.emerge(0, residual)
    after = emerged.sides
    assert after.hidden == pytest.approx(tuple(residual * one for one in before.hidden), abs=1e-12)
    assert after.emerged[0] == pytest.approx(0.0, abs=1e-12)
    assert emerged.probabilities.sum() == pytest.approx(1.0)


def test_what_came_into_view_is_remembered_by_side():
    """A hidden source that merely stops being hidden is still the one that was heard before."""
    rate = (0.05, 0.3, 0.1, 0.05, 0.05, 0.3)
    belief = ExplanationBelief.from_priors(len(DIRECTIONS), 0.0, 0.0, 1.0)
    heard_hidden, heard_in_view = evidence(2.0, 0.0, 0.0, 0.0), evidence(0.0, 0.0, 2.0, 0.0)
    for heard in [heard_hidden] * 30 + [heard_in_view] * 30:
        belief = belief.predict(rate, 10**8).update(heard, co_terms(Unqueried("-")))
    assert belief.sides.hypotheses[1] > 0.8
    assert belief.sides.emerged[0] > 0.7 > 0.1 > belief.sides.emerged[1]
