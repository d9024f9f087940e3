"""A bearing changes the likelihoods of the sides in proportion to P(direct sound)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp

from worldstate.abduction.evidence import SignatureEvidence, with_bearing_vote
from worldstate.frontend.direction.bearing import Peak, direct_probability

likelihoods = st.floats(-8.0, 8.0)
bearings = st.tuples(st.floats(-1.5, 1.5), st.floats(0.03, 0.9))
chances = st.floats(0.0, 1.0)


def of(values: tuple[float, ...]) -> SignatureEvidence:
    return SignatureEvidence(("left", "right"), values[:2], values[2], values[3])


@given(st.tuples(*[likelihoods] * 4), bearings, chances)
def test_a_vote_raises_no_likelihood_and_is_symmetric(
    values: tuple[float, ...], bearing: tuple[float, float], d: float
) -> None:
    before, voted = of(values), with_bearing_vote(of(values), *bearing, d)
    assert (voted.visible, voted.none) == (before.visible, before.none)
    assert logsumexp(voted.hidden) <= logsumexp(before.hidden) + 1e-9
    mirrored = with_bearing_vote(of((values[1], values[0], *values[2:])), -bearing[0], bearing[1], d)
    np.testing.assert_allclose(mirrored.hidden, voted.hidden[::-1], atol=1e-6)


@given(st.tuples(*[likelihoods] * 4), st.floats(0.2, 1.5))
def test_certain_direct_sound_takes_the_side_of_its_bearing(
    values: tuple[float, ...], azimuth: float
) -> None:
    voted = with_bearing_vote(of(values), azimuth, 0.1, 1.0)
    assert voted.hidden[0] - voted.hidden[1] > 3.0
    assert logsumexp(voted.hidden) <= logsumexp([voted.visible, voted.none]) + 1e-9


@given(st.tuples(*[likelihoods] * 4), bearings)
def test_reflected_sound_changes_nothing(values: tuple[float, ...], bearing: tuple[float, float]) -> None:
    assert with_bearing_vote(of(values), *bearing, 0.0) == of(values)


@pytest.mark.parametrize("value", [0.05, 0.3, 0.6, 0.95])
def test_a_single_strong_peak_is_direct_sound(value: float) -> None:
    lone, image = Peak(0.5, value, 8.0), Peak(-0.7, 0.8 * value, 6.4)
    assert (direct_probability([lone]) > 0.5) == (value > 0.45)
    assert direct_probability([lone, image]) == 0.0
    assert direct_probability([]) == 0.0
