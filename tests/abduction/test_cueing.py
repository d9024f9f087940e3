"""Sustained rule, Neyman-Pearson threshold, policies."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.abduction.cueing.cueing_policy import (
    CueingPolicies,
    CueingPolicy,
    sustained_alarm,
    sustained_statistic,
)
from worldstate.abduction.cueing.risk_map import IsotonicMap, PlattMap
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import decode, encode

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


def test_consecutive_hops_do_not_cross_recordings():
    apart = [[0.1, 0.9], [0.9, 0.1]]
    together = [[0.1, 0.9, 0.9, 0.1]]
    assert neyman_pearson_threshold(apart, 0.0, 2) < 0.9 < neyman_pearson_threshold(together, 0.0, 2)


@pytest.mark.parametrize("risk_map", [IsotonicMap((0.1, 0.9), (0.0, 1.0)), PlattMap(-2.0, 0.3)])
def test_a_policy_reads_back_as_written(risk_map):
    policy = CueingPolicy(0.78, 3, 0.02, PRIOR, risk_map, 1.0)
    assert decode(CueingPolicy, encode(policy), "file") == policy


def test_policies_are_found_by_budget():
    made = [CueingPolicy(a, 1, a, PRIOR, PlattMap(-1.0, 0.0), b) for a in (0.01, 0.02) for b in (0.0, 1.0)]
    policies = CueingPolicies(tuple(made))
    assert policies.for_alpha(0.02, 1.0) is made[3]
    with pytest.raises(InvalidArgumentError, match=r"0\.01, 0\.02"):
        policies.for_alpha(0.03)
    with pytest.raises(InvalidArgumentError, match=r"miss_rate: expected .* \(0, 1\), got 0\.5"):
        policies.for_alpha(0.02, 0.5)
