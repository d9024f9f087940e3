"""The ratio recursion against exact hidden Markov filters, and what a message is worth over time."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.abduction.sequence.ratio_recursion import SequenceBelief, at_prior, balanced, next_belief

SEEDS = st.integers(0, 2**32 - 1)


def _drawn(seed: int, groups: int = 5) -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng, rng.dirichlet(np.ones(groups), groups), rng.dirichlet(np.ones(groups))


@given(SEEDS)
def test_with_a_posterior_of_the_same_chain_it_is_the_exact_filter_of_everything(seed: int) -> None:
    rng, chain, prior = _drawn(seed)
    sound, message = rng.normal(size=(2, 20, 5))
    exact = heard = prior
    belief = None
    for emission, extra in zip(sound, message, strict=True):
        heard = heard @ chain * np.exp(emission) if belief else heard * np.exp(emission)
        heard = heard / heard.sum()
        if belief is None:
            belief, exact = SequenceBelief(*[heard[None]] * 2), heard
            continue
        exact = exact @ chain * np.exp(emission + extra)
        exact = exact / exact.sum()
        belief = next_belief(belief, heard[None], chain, extra[None])
        np.testing.assert_allclose(belief.belief[0], exact, atol=1e-9)


@given(SEEDS)
def test_alone_it_is_what_the_sequence_says_whatever_the_chain(seed: int) -> None:
    rng, chain, _ = _drawn(seed)
    said = rng.dirichlet(np.full(5, 0.3), (30, 2))
    belief = SequenceBelief(said[0], said[0])
    for one in said[1:]:
        belief = next_belief(belief, one, chain)
        np.testing.assert_allclose(belief.belief, one, rtol=1e-6, atol=1e-12)


@given(SEEDS, st.floats(0.5, 4.0))
def test_a_message_is_worth_its_nats_at_once_and_less_later(seed: int, nats: float) -> None:
    rng, chain, _ = _drawn(seed, groups=2)
    # Slow, as streets are: a message spoken now holds for seconds.
    slow = 0.95 * np.eye(2) + 0.05 * chain
    said = rng.dirichlet(np.ones(2) * 3.0, 25)[:, None]
    belief, worth = SequenceBelief(said[0], said[0]), []
    for number, one in enumerate(said[1:]):
        belief = next_belief(belief, one, slow, np.array([[nats, 0.0]]) if number == 0 else 0.0)
        (p, _), (q, _) = belief.belief[0], one[0]
        worth.append(np.log(p / (1.0 - p)) - np.log(q / (1.0 - q)))
    assert abs(worth[0] - nats) < 1e-6
    assert (np.diff(worth) <= 1e-6).all() and worth[-1] > -1e-6


@settings(max_examples=20)
@given(SEEDS)
def test_without_sound_it_goes_back_to_what_the_context_expects(seed: int) -> None:
    _, chain, share = _drawn(seed)
    share = 0.9 * share + 0.02
    still = balanced(0.9 * chain + 0.02, share)
    np.testing.assert_allclose(share @ still, share, atol=1e-8)
    belief = SequenceBelief(*[np.eye(5)[:1] * 0.95 + 0.01] * 2)
    for _ in range(1000):
        belief = next_belief(belief, None, still)
    np.testing.assert_allclose(belief.belief[0], share, atol=1e-4)


@given(SEEDS)
def test_a_posterior_moved_to_another_prior_and_back_is_itself(seed: int) -> None:
    rng, _, share = _drawn(seed)
    share, prior, said = (
        0.9 * one + 0.02 for one in (share, rng.dirichlet(np.ones(5)), rng.dirichlet(np.ones(5)))
    )
    there = at_prior(said, share, prior)
    np.testing.assert_allclose(at_prior(there, prior, share), said / said.sum(), atol=1e-12)
