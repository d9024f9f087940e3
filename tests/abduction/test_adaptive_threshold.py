"""The threshold that follows drift without labels: its budget, its bounds, its state."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.cueing.cueing_policy import (
    MOST_DOWN_NATS,
    MOST_UP_NATS,
    STEP_NATS,
    AdaptiveBudget,
    AdaptiveThreshold,
    CueingPolicy,
    uncalibrated_policy,
)
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.core.filter import WorldFilter
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import decode, encode
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement

HOP_S = 0.1
NO_CAMERA = Unqueried("no camera")
budgets = st.builds(
    AdaptiveBudget,
    rate_per_hour=st.floats(0.1, 500.0),
    highest=st.floats(0.5, 0.999),
)
beliefs = st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)).map(lambda p: (p[0] * (1 - p[1]), p[1]))
hops = st.lists(st.tuples(beliefs, st.booleans(), st.floats(0.0, 60.0)), max_size=60)


def play(budget, script, state=None):
    states = [state or AdaptiveThreshold()]
    for (visible, none), alarm, elapsed_s in script:
        states.append(
            states[-1].advance(budget, visible=visible, none=none, alarm=alarm, elapsed_s=elapsed_s)
        )
    return states


@given(budgets, hops, st.floats(0.01, 0.9999))
def test_it_never_goes_deaf_whatever_happens(budget, script, calibrated):
    for state in play(budget, script):
        gamma = budget.gamma(calibrated, state.shift_nats)
        assert -MOST_DOWN_NATS <= state.shift_nats <= MOST_UP_NATS
        assert gamma <= max(calibrated, budget.highest)
        odds = calibrated / (1 - calibrated) * math.exp(MOST_UP_NATS)
        assert gamma <= odds / (1 + odds) + 1e-12


@given(budgets, hops)
def test_the_false_alarms_counted_keep_the_budget_unless_the_upper_bound_is_met(budget, script):
    """The bound of the docstring, on any sequence of beliefs and alarms."""
    states = play(budget, script)
    if max(state.shift_nats for state in states) >= MOST_UP_NATS:
        return
    raised = sum(after.shift_nats > before.shift_nats for before, after in itertools.pairwise(states))
    hours = sum(elapsed_s for (_, none), alarm, elapsed_s in script if none >= 0.5 and not alarm) / 3600.0
    allowed = budget.rate_per_hour * hours + (MOST_DOWN_NATS + MOST_UP_NATS) / STEP_NATS
    assert raised <= allowed + 1 + 1e-9


@given(budgets, hops, hops)
def test_written_and_read_back_it_continues_the_same(budget, first, second):
    state = play(budget, first)[-1]
    again = decode(AdaptiveThreshold, json.loads(json.dumps(encode(state))), "file")
    kept = decode(AdaptiveBudget, json.loads(json.dumps(encode(budget))), "file")
    assert (again, kept) == (state, budget)
    assert play(kept, second, again)[-1] == play(budget, second, state)[-1]


def test_an_alarm_after_which_something_comes_teaches_nothing():
    budget = AdaptiveBudget(10.0)
    came = [((0.1, 0.1), True, 1.0), ((0.8, 0.1), False, 1.0), ((0.1, 0.1), False, 1.0)]
    assert play(budget, came)[-1].shift_nats == 0.0
    nothing = [((0.1, 0.1), True, 1.0), ((0.2, 0.2), False, 1.0), ((0.1, 0.9), False, 1.0)]
    assert play(budget, nothing)[-1].shift_nats == pytest.approx(STEP_NATS)


def test_an_alarm_that_never_ends_counts_again_and_again():
    """A generator behind the fence: the rule stays in alarm, so no rising edge would ever come."""
    states = play(AdaptiveBudget(10.0), [((0.1, 0.1), True, 1.0)] * 46)
    assert states[-1].shift_nats == pytest.approx(3 * 0.25)


def test_while_the_street_is_not_believed_empty_nothing_is_learned():
    states = play(AdaptiveBudget(100.0), [((0.4, 0.4), False, 60.0)] * 100)
    assert states[-1].shift_nats == 0.0


def drifting_street(budget, hours, drift_nats, seed):
    """False alarms in each hour of empty street whose log-odds drift upward, and the state."""
    rng, run, state, calibrated = np.random.default_rng(seed), 0, AdaptiveThreshold(), 0.93
    count = int(hours * 3600 / HOP_S)
    sound = lfilter([math.sqrt(1 - 0.9**2)], [1.0, -0.9], rng.normal(size=count)) * 1.0 - 1.0
    sound = sound + np.linspace(0.0, drift_nats, count)
    onsets, before = np.zeros(count, dtype=bool), False
    for i, score in enumerate((1.0 / (1.0 + np.exp(-sound))).tolist()):
        gamma = calibrated if budget is None else budget.gamma(calibrated, state.shift_nats)
        run = run + 1 if score >= gamma else 0
        alarm = run >= 3
        onsets[i], before = alarm and not before, alarm
        if budget is not None:
            none = 0.2 if alarm else 0.8
            state = state.advance(budget, visible=0.1, none=none, alarm=alarm, elapsed_s=HOP_S)
    return onsets.reshape(hours, -1).sum(axis=1), state


def test_it_keeps_the_budget_under_drift_where_a_fixed_threshold_does_not():
    budget = AdaptiveBudget(rate_per_hour=20.0)
    fixed, _ = drifting_street(None, 4, 2.0, seed=5)
    kept, state = drifting_street(budget, 4, 2.0, seed=5)
    assert fixed[-1] > 3 * budget.rate_per_hour
    assert kept.sum() <= 4 * budget.rate_per_hour + (MOST_DOWN_NATS + MOST_UP_NATS) / STEP_NATS + 1
    assert kept[-1] < fixed[-1] / 2
    assert 0.5 < state.shift_nats < MOST_UP_NATS


@pytest.mark.parametrize(
    "bad",
    [
        {"rate_per_hour": 0.0},
        {"rate_per_hour": math.nan},
        {"rate_per_hour": 1.0, "highest": 1.0},
        {"rate_per_hour": 1.0, "highest": -1.0},
    ],
)
def test_numbers_out_of_range_are_refused(bad):
    with pytest.raises(InvalidArgumentError):
        AdaptiveBudget(**bad)


@pytest.mark.parametrize(
    "damaged",
    [None, [], {}, {"shift_nats": "0", "pending_s": None, "alarm": True}, {"shift_nats": 0.0, "alarm": 1},
     {"shift_nats": math.inf, "pending_s": None, "alarm": True},
     {"shift_nats": 0.0, "pending_s": -1.0, "alarm": True}],
)  # fmt: skip
def test_damaged_state_is_refused(damaged):
    with pytest.raises(InvalidArgumentError):
        decode(AdaptiveThreshold, damaged, "file")
    with pytest.raises(InvalidArgumentError):
        decode(AdaptiveBudget, damaged, "file")
    policy = encode(uncalibrated_policy())
    if damaged is not None:
        with pytest.raises(InvalidArgumentError):
            decode(CueingPolicy, policy | {"adaptive": damaged}, "file")


def evidence_at(hop, log_odds, answer):
    heard = SignatureEvidence(("left", "right"), (log_odds, log_odds), 0.0, 0.0)
    return Measurement(hop * 100_000_000, heard, answer, NotUsable("-"), NotUsable("-"))


def listen(world, log_odds, answer=NO_CAMERA):
    """Alarm onsets and the filter at the end of a stream of log-odds."""
    onsets, before = 0, False
    for score in log_odds:
        hop = round(world.stamp_ns / 1e8) + 1
        world = world.predict(0.1).update(evidence_at(hop, score, answer))
        alarm = any(cue.advisory for cue in world.state.cues)
        onsets, before = onsets + (alarm and not before), alarm
    return onsets, world


def adaptive_world():
    policy = replace(uncalibrated_policy(), adaptive=AdaptiveBudget(rate_per_hour=20.0))
    return WorldFilter(policy=policy)


BURST = [*[-4.0] * 30, *[2.6] * 4, *[-4.0] * 30]


@pytest.mark.long
def test_in_the_filter_false_alarms_raise_the_threshold_and_a_checkpoint_keeps_it():
    fixed, _ = listen(WorldFilter(), BURST * 8)
    adapted, world = listen(adaptive_world(), BURST * 8)
    assert fixed == 8
    assert 1 <= adapted < fixed
    assert world.policy.gamma < world.gamma < 0.99
    again = WorldFilter.from_dict(json.loads(json.dumps(world.to_dict())))
    assert again.gamma == world.gamma
    assert listen(again, BURST)[1].to_dict() == listen(world, BURST)[1].to_dict()


def test_in_the_filter_a_loud_hazard_is_announced_after_any_number_of_false_alarms():
    _, world = listen(adaptive_world(), BURST * 12)
    heard, _ = listen(world, [4.6] * 10)
    assert heard == 1


def test_it_is_off_by_default_here_and_in_a_policy_of_before():
    _, world = listen(WorldFilter(), BURST)
    assert world.gamma == world.policy.gamma
    old = world.to_dict()
    del old["policy"]["adaptive"]
    assert WorldFilter.from_dict(old).gamma == world.policy.gamma
