"""From the posterior over six window classes to four hypotheses and two sides."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from worldstate.abduction.signature.window_classes import (
    CLASSES,
    WINDOW_CLASSES,
    explained,
    side_ratios,
    window_evidence,
)

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


@given(shares(4), shares(4))
def test_four_classes_give_side_ratios_against_visible_and_none(posterior, prior):
    evidence = window_evidence(posterior[None], CLASSES, prior)
    above = np.array(evidence.hidden) - np.logaddexp(evidence.visible, evidence.none)
    np.testing.assert_allclose(evidence.sides.log_ratios, above, atol=1e-9)
    assert (evidence.sides.both, evidence.sides.direct) == (0.0, 0.0)
    np.testing.assert_array_equal(explained(posterior[None], CLASSES, prior)[0], posterior)
