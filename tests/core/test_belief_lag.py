"""Windows that overlap are one piece of evidence; windows that do not are two."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.evidence import SignatureEvidence, abduce
from worldstate.core.filter import WorldFilter
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement
from worldstate.state import Context, Priors, Rates

STILL = Context(rates=Rates(*[1e-12] * 6), priors=Priors(0.3, 0.3, 0.4))
NOTHING, UNASKED = NotUsable("-"), Unqueried("-")
nats = st.floats(-4.0, 4.0)
signatures = st.builds(
    lambda left, right, visible, none: SignatureEvidence(("left", "right"), (left, right), visible, none),
    nats, nats, nats, nats,
)  # fmt: skip


def heard(time_s, signature, source="acoustic"):
    return Measurement(round(time_s * 1e9), signature, UNASKED, NOTHING, NOTHING, source=source)


def hidden(measurements):
    world = WorldFilter(context=STILL)
    for measurement in measurements:
        world = world.update(measurement)
    return np.array([*world.belief.hidden, world.belief.hypotheses[1], world.belief.hypotheses[2]])


def counted(times, signature):
    """The posterior by hand: the prior times the likelihood, so many times."""
    start = WorldFilter(context=STILL).belief
    log = np.log([*start.hidden, *start.hypotheses[1:]])
    for _ in range(times):
        log = np.array(abduce(log, signature, UNASKED).log_probabilities)
    return np.exp(log)


@given(signatures, st.integers(1, 10))
def test_windows_that_overlap_count_once(signature, hops):
    got = hidden([heard(1.0 + hop / 10, signature) for hop in range(hops)])
    assert got == pytest.approx(counted(1, signature), abs=1e-5)


@given(signatures, st.integers(1, 3))
def test_windows_end_to_end_count_each(signature, windows):
    got = hidden([heard(1.0 + hop / 10, signature) for hop in range(10 * windows)])
    assert got == pytest.approx(counted(windows, signature), abs=1e-5)


@given(signatures)
def test_the_same_window_again_changes_nothing(signature):
    once = [heard(1.0, signature)]
    assert hidden(once * 3) == pytest.approx(hidden(once), abs=1e-12)


@given(signatures)
def test_another_modality_is_news(signature):
    both = [heard(1.0, signature), heard(1.0, signature, "radar")]
    interleaved = [heard(1.0 + hop / 20, signature, ("acoustic", "radar")[hop % 2]) for hop in range(20)]
    assert hidden(both) == pytest.approx(counted(2, signature), abs=1e-5)
    assert hidden(interleaved) == pytest.approx(counted(2, signature), abs=1e-5)


def test_it_keeps_one_window_and_no_more():
    signature = SignatureEvidence(("left", "right"), (1.0, 0.0), 0.0, 0.0)
    world = WorldFilter(context=STILL)
    for hop in range(200):
        world = world.update(heard(1.0 + hop / 10, signature))
    assert len(world._memory.belief.past) == 11


def test_a_loud_second_is_believed_at_once():
    loud = SignatureEvidence(("left", "right"), (4.0, 0.0), 0.0, 0.0)
    quiet = replace(loud, hidden=(-4.0, -4.0))
    first = WorldFilter().update(heard(1.0, quiet))
    assert first.belief.hypotheses[0] < 0.05
    assert first.update(heard(1.1, loud)).belief.hypotheses[0] > 0.7
