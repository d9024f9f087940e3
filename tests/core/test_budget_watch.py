"""The monitor of the alarm budget: false-positive rates by simulation, and its laws in the filter."""

import json
import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from street_measurements import after, run
from watched_street import ALARM, START_NS, arrival, false_alarms

from worldstate import Measurement, WorldFilter
from worldstate.abduction.cueing.cueing_policy import uncalibrated_policy
from worldstate.abduction.sequence.sequence_model import AlarmPromise
from worldstate.core.budget_watch import (
    CLUSTER,
    RATES,
    TOLERANCE_NATS,
    BudgetWatch,
    Evidence,
    WatchedHop,
    chance_factors,
    onset_factors,
)
from worldstate.state import Budget

CHANCES = st.floats(1e-6, 1.0 - 1e-6)
HOP_NS = 10**8


@given(st.floats(0.0, 1.0), st.floats(0.1, 200.0), st.floats(0.0, 60.0), st.integers(1, int(CLUSTER)))
def test_onsets_within_the_budget_give_no_evidence_on_average(
    share: float, budget: float, step_s: float, cluster: int
) -> None:
    """Random clusters with onsets up to the budget; log E e in closed form."""
    clusters = share * budget * step_s / 3600.0 / cluster
    nothing, one = onset_factors(0, step_s, budget), onset_factors(cluster, step_s, budget)
    for none, some in zip(nothing, one, strict=True):
        assert math.log(none) + clusters * (some / none - 1.0) <= 1e-12


@given(st.tuples(CHANCES, CHANCES), st.tuples(*[st.floats(-TOLERANCE_NATS, TOLERANCE_NATS)] * 2))
def test_probabilities_within_the_tolerance_give_no_evidence_on_average(
    stated: tuple[float, float], off_nats: tuple[float, float]
) -> None:
    odds = [p / (1.0 - p) * math.exp(nats) for p, nats in zip(stated, off_nats, strict=True)]
    true = [one / (1.0 + one) for one in odds]
    mean = np.zeros(2)
    for left in (False, True):
        for right in (False, True):  # The mean needs no joint distribution
            weight = np.prod([t if y else 1.0 - t for t, y in zip(true, (left, right), strict=True)])
            mean += weight * np.array(chance_factors(stated, (left, right)))
    assert (mean <= 1.0 + 1e-9).all()


@pytest.mark.parametrize("cluster", [1, 2])
def test_the_budget_breaks_falsely_on_at_most_one_day_in_forty(cluster: int) -> None:
    rng, step_s, budget, broken, days = np.random.default_rng(3), 60.0, 25.0, 0, 200
    for _ in range(days):
        found = Evidence((1.0,) * len(RATES))
        counts = cluster * rng.poisson(budget / 60.0 / cluster, 24 * 60)
        for n in counts.tolist():
            found = found.after(onset_factors(n, step_s, budget), step_s)
            if found.broken:
                broken += 1
                break
    assert broken <= 0.025 * days


@pytest.mark.parametrize(("times", "within_h"), [(2.0, 2.0), (10.0, 0.25)])
def test_excess_is_detected_and_forgotten_after_it_ends(times: float, within_h: float) -> None:
    """Six hours at 60 % of the budget must not delay the detection of later excess."""
    rng, step_s, budget, found_h, back_h = np.random.default_rng(5), 6.0, 25.0, list[float](), list[float]()

    def hours_until(evidence: Evidence, rate: float, broken: bool) -> tuple[Evidence, float]:
        for step in range(1, 20_000):
            n = int(rng.poisson(rate * step_s / 3600.0))
            evidence = evidence.after(onset_factors(n, step_s, budget), step_s)
            if evidence.broken == broken:
                return evidence, step * step_s / 3600.0
        raise AssertionError("never")

    for _ in range(20):
        evidence = Evidence((1.0,) * len(RATES))
        for n in rng.poisson(0.6 * budget * 0.1, 60).tolist():
            evidence = evidence.after(onset_factors(n, 360.0, budget), 360.0)
        evidence, late_h = hours_until(evidence, times * budget, True)
        found_h.append(late_h)
        for n in rng.poisson(times * budget * 0.1, 60).tolist():  # Six more hours do not delay the recovery
            evidence = evidence.after(onset_factors(n, 360.0, budget), 360.0)
        evidence = replace(evidence, broken=True)
        back_h.append(hours_until(evidence, 0.6 * budget, False)[1])
    assert np.median(found_h) < (within_h if times > 2.0 else 1.5 * within_h)
    assert np.median(back_h) < 2.0


def hop(number: int, over: bool = False, came: int | None = None, looked: bool = True) -> WatchedHop:
    emerged_ns = (None if came is None else came * HOP_NS, None)
    return WatchedHop(number * HOP_NS, looked, (over, False), emerged_ns, (0.01, 0.01))


def test_an_onset_is_false_without_a_vehicle_within_eight_seconds() -> None:
    def told(onsets: set[int], came: int | None, blind: set[int]) -> tuple[int, float]:
        watch = BudgetWatch()
        for number in range(401):
            seen = came if came is not None and number >= came else None
            watch = watch.after(hop(number, number in onsets, seen, number not in blind), 25.0)
        return watch.tally.false_onsets, watch.tally.quiet_ns / 1e9

    assert told({100, 105, 300}, None, set()) == (2, pytest.approx(24.0))  # One alarm is held for a second
    assert told({50}, None, set())[0] == 0  # Eight seconds before it are not known
    assert told({100, 240, 300}, 175, set()) == (1, pytest.approx(7.9))  # 8 to 9.4 s and 25.5 to 32 s
    assert told({100}, 175, set())[0] == 0
    assert told({100}, None, {150}) == (0, pytest.approx(8.9))
    assert told({100}, None, set(range(401))) == (0, 0.0)


def budgets(measured: Iterable[Measurement]) -> list[Budget]:
    return [world.state.budget for world in run(WorldFilter(start_ns=START_NS), measured)]


def test_false_alarms_break_the_budget_and_keep_the_threshold() -> None:
    *_, world = worlds = run(WorldFilter(start_ns=START_NS), false_alarms())
    *_, last = told = [one.state for one in worlds]
    verdicts = [state.budget.verdict for state in told]
    assert sorted(set(verdicts), key=verdicts.index) == ["kept", "in doubt", "broken"]
    assert last.budget.why == "more false onsets than the budget"
    policed = replace(world, policy=replace(world.policy, alpha=0.1)).state
    assert not policed.calibrated and policed.budget == last.budget
    assert last.budget.tally.false_onsets > 4
    for state in told:
        assert state.budget.onsets_per_hour == 4.0
        for cue in state.cues:
            assert cue.evidence.threshold_nats == 0.0
    assert world.predict(3.0).state.budget.verdict == "unwatched"


def test_the_requested_alpha_and_the_promise_are_published_with_a_budget() -> None:
    promise = AlarmPromise(4.0, 1.0, 9.0, 0.01, 0.002, 0.03)
    for asked_alpha, stated in ((None, 0.02), (0.015, 0.02), (None, 0.0)):
        alarm = replace(ALARM, asked_alpha=asked_alpha, promise=promise)
        world = WorldFilter(policy=replace(uncalibrated_policy(), alpha=stated), start_ns=START_NS)
        alarms = (replace(one, sequence=replace(one.sequence, alarm=alarm)) for one in false_alarms(hops=20))
        world = after(*alarms, world=world)
        budget = world.state.budget
        assert (budget.asked_alpha, budget.promise) == (asked_alpha, promise)
        assert {cue.alpha for cue in world.state.cues} == {promise.alpha if stated else None}


def test_checkpoints_and_late_measurements_leave_the_budget_unchanged() -> None:
    measured = list(false_alarms(hops=400))
    here = budgets(measured)
    world = WorldFilter(start_ns=START_NS)
    for number, one in enumerate(measured):
        if number % 233 == 100:
            world = WorldFilter.from_dict(json.loads(json.dumps(world.to_dict())))
        world = world.update(one)
    assert world.state.budget == here[-1]
    late = measured.copy()
    for at in range(20, len(late) - 1, 31):
        late[at : at + 7] = late[at + 1 : at + 7] + late[at : at + 1]
    assert budgets(late)[-1] == here[-1]


def test_an_arrival_is_counted_with_its_warning() -> None:
    """A vehicle is audible on the left for two seconds before it is visible, then a weak one."""
    tally = budgets(list(arrival(1)))[-1].tally
    assert (tally.arrivals, tally.warned, tally.false_onsets) == (1, 1, 0)
    *_, last = budgets([*false_alarms(), *arrival(500, level=2.0)])
    assert (last.tally.arrivals, last.tally.warned) == (1, 1)
