"""Balanced chains keep their stationary distribution; a change of prior is reversible."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from worldstate.abduction.sequence.markov_chain import at_prior, balanced, transitions

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.integers(1, 10**9), st.integers(1, 10**9))
def test_a_balanced_chain_keeps_its_distribution_and_two_steps_are_one(seed: int, one: int, two: int) -> None:
    rng = np.random.default_rng(seed)
    chain, share = rng.dirichlet(np.ones(5), 5), 0.9 * rng.dirichlet(np.ones(5)) + 0.02
    rates_hz = balanced(0.9 * chain + 0.02, share) - np.eye(5)
    first, second, both = (transitions(rates_hz, step_ns) for step_ns in (one, two, one + two))
    np.testing.assert_allclose(first @ second, both, atol=1e-9)
    np.testing.assert_allclose(share @ both, share, atol=1e-7)
    np.testing.assert_allclose(np.eye(5)[0] @ transitions(rates_hz, 10**12), share, atol=1e-4)


@given(SEEDS, st.integers(1, 22), st.floats(-4.0, 2.0), st.integers(1, 10**10))
def test_a_step_is_the_matrix_exponential_of_its_rates(
    seed: int, states: int, scale: float, step_ns: int
) -> None:
    rates_hz = np.random.default_rng(seed).exponential(10.0**scale, (states, states))
    np.fill_diagonal(rates_hz, 0.0)
    np.fill_diagonal(rates_hz, -rates_hz.sum(axis=1))
    np.testing.assert_allclose(transitions(rates_hz, step_ns), expm(rates_hz * (step_ns / 1e9)), atol=1e-11)


@given(SEEDS)
def test_a_change_of_prior_is_reversible(seed: int) -> None:
    share, prior, said = 0.9 * np.random.default_rng(seed).dirichlet(np.ones(5), 3) + 0.02
    there = at_prior(said, share, prior)
    np.testing.assert_allclose(at_prior(there, prior, share), said / said.sum(), atol=1e-12)
