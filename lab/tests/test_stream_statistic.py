"""The statistic over a stream, with switches for the parts that an ablation removes."""

import numpy as np
import pytest
from hop_tables import blank_stream
from hypothesis import given
from hypothesis import strategies as st
from worldstate_lab.metrics.stream_statistic import stream_statistic

from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.evidence import SignatureEvidence, statistic
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement
from worldstate.operations.recordings.hop_table import hop_stream

PRIOR = (0.3, 0.3, 0.2, 0.2)
answers = st.one_of(
    st.just(Unqueried("-")),
    st.builds(Absent, st.floats(0.01, 1.0), st.floats(0.0, 0.5)),
    st.builds(Present, st.floats(0.0, 0.99), st.floats(0.01, 0.5)),
)
nats = st.floats(-8.0, 8.0)


@given(st.lists(st.tuples(st.tuples(nats, nats, nats, nats), answers), min_size=1, max_size=8))
def test_over_a_stream_the_statistic_is_that_of_every_hop(rows):
    measured = [
        Measurement(
            (i + 10) * 10**8, SignatureEvidence(("left", "right"), row[:2], row[2], row[3]), answer,
            NotUsable("-"), NotUsable("-"),
        )
        for i, (row, answer) in enumerate(rows)
    ]  # fmt: skip
    stream = hop_stream(measured, name="x")
    expected = [statistic(m.signature, m.co_evidence, PRIOR) for m in measured]
    assert stream_statistic(stream, PRIOR) == pytest.approx(expected, rel=1e-9)
    alone = [statistic(m.signature, Unqueried("-"), PRIOR) for m in measured]
    switched = stream_statistic(stream, PRIOR, use_absence=False)
    assert switched == pytest.approx(alone, rel=1e-9)


def test_the_approach_term_shifts_the_log_odds_by_its_weight_and_only_if_usable():
    stream = blank_stream("x", 4).replace(approach=np.array([np.nan, 0.0, 1.5, -9.0]))
    plain, looming = (stream_statistic(stream, PRIOR, approach_weight=w) for w in (0.0, 0.4))
    shift = np.log(looming / (1 - looming)) - np.log(plain / (1 - plain))
    assert shift == pytest.approx([0.0, 0.0, 0.6, -1.2], abs=1e-9)
