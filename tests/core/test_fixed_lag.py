"""Late, repeated, reordered and misdated measurements give the belief of measurements in order."""

import json
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from street_measurements import (
    ABSENT,
    PRESENT,
    SEEDS,
    UNASKED,
    Timed,
    after,
    car,
    hop,
    ordinary,
    ordinary_scan,
    run,
)

from worldstate import Measurement, WorldFilter
from worldstate.abduction.co_evidence import Absent
from worldstate.measurement import Odometry
from worldstate.state import Delivery, WorldState


def script(rng: np.random.Generator, hops: int = 18) -> list[Timed]:
    """Return sound with a camera every 0.1 s, and sometimes a radio, a radar and odometry."""
    measured: list[Timed] = []
    for number in range(1, hops + 1):
        seen = [car(float(rng.uniform(-0.5, 0.5)))] * (rng.random() < 0.3)
        own = ordinary(rng, number, spread=1.0)
        own = replace(own, co_evidence=PRESENT if seen else ABSENT, look=None, sightings=tuple(seen))
        measured.append(own)
        if rng.random() < 0.4:
            stamp_ns = own.stamp_ns + int(rng.integers(0, 10**8))
            measured.append(replace(own, stamp_ns=stamp_ns, co_evidence=UNASKED, sightings=(), source="v2x"))
        if rng.random() < 0.2:
            measured.append(ordinary_scan(rng, number + rng.random(), rng.random() < 0.5))
        if rng.random() < 0.2:
            twist = float(rng.uniform(0.0, 2.0)), float(rng.normal(0.0, 0.1))
            measured.append(Odometry("wheels", own.stamp_ns + int(rng.integers(0, 10**8)), *twist))
    return sorted(measured, key=lambda one: (one.stamp_ns, one.source))


def content(world: WorldFilter) -> WorldState:
    return replace(world.state, delivery=Delivery(), events=())  # Both depend on the time of delivery


def arrived_late(rng: np.random.Generator, told: list[Timed]) -> list[Timed]:
    """Return measurements in the order of arrival, each held up by less than the lag."""
    arrival_s = [one.stamp_ns * 1e-9 + rng.uniform(0.0, 1.8) for one in told]
    return [told[i] for i in np.argsort(arrival_s)]


@given(SEEDS)
@settings(max_examples=3)
def test_the_order_of_arrival_does_not_matter_within_the_lag(seed: int) -> None:
    rng = np.random.default_rng(seed)
    in_order = script(rng)
    shuffled = arrived_late(rng, in_order)
    late = after(*shuffled)
    assert content(late) == content(after(*in_order))
    assert late.state.delivery.too_late == late.state.delivery.repeated == 0
    assert (late.state.delivery.replayed > 0) == (shuffled != in_order)


@given(SEEDS)
@settings(max_examples=5)
def test_events_explain_changes_between_snapshots_with_late_data(seed: int) -> None:
    rng, world, counted = np.random.default_rng(seed), WorldFilter(), set()
    for one in arrived_late(rng, script(rng, 80)):
        before, world = world, world.update(one)
        was, now = ({one.id: one.status == "visible" for one in it.state.entities} for it in (before, world))
        kinds = {event.entity_id: event.kind for event in world.state.events}
        assert all(event.stamp_ns == world.stamp_ns for event in world.state.events)
        assert all((event.kind == "merged") == (event.into is not None) for event in world.state.events)
        counted |= set(kinds.values()) if world.state.delivery.replayed else set()
        for name in was.keys() | now.keys() | kinds.keys():
            if name not in was or name not in now:
                assert kinds[name] in (("born",) if name in now else ("died", "merged"))
            elif was[name] != now[name]:
                assert kinds[name] == ("handed_over" if now[name] else "hidden_again")
            else:
                assert kinds.get(name, "coasting") == "coasting"
    assert {"born", "handed_over", "died"} <= counted


@given(SEEDS)
@settings(max_examples=3)
def test_stamps_of_zero_and_below_are_ordinary(seed: int) -> None:
    """Stamps before zero and at zero behave like others; the camera never misses a vehicle."""
    told, found = script(np.random.default_rng(seed)), []
    is_empty = [isinstance(one, Measurement) and isinstance(one.co_evidence, Absent) for one in told]
    pairs = zip(told, is_empty, strict=True)
    told = [replace(one, co_evidence=Absent(0.0, 0.01)) if empty else one for one, empty in pairs]
    for since_ns in (10**10, 0, -(10**9), -(10**10), -(10**13)):
        moved = (replace(one, stamp_ns=one.stamp_ns + since_ns - 10**9) for one in told)
        state = after(*moved, world=WorldFilter(start_ns=since_ns - 10**9)).state
        rows = [(one.id, one.status, one.existence_probability, one.azimuth_rad) for one in state.entities]
        cues = [(cue.risk, cue.advisory is None, cue.evidence.compared_nats) for cue in state.cues]
        found.append((rows, cues))
    assert found[0][1] and all(one == found[0] for one in found)


@given(SEEDS)
@settings(max_examples=3)
def test_a_repeated_delivery_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    once = script(rng)
    often = [copy for one in once for copy in [one] * int(rng.integers(1, 4))]
    repeated = after(*often)
    assert content(repeated) == content(after(*once))
    assert repeated.state.delivery == Delivery(repeated=len(often) - len(once))


@given(SEEDS, st.integers(1, 12))
@settings(max_examples=3)
def test_a_checkpoint_accepts_late_measurements_as_the_filter_does(seed: int, cut: int) -> None:
    in_order = script(np.random.default_rng(seed))
    late = in_order.pop(cut)
    until = [one for one in in_order if one.stamp_ns <= late.stamp_ns + 15 * 10**8]
    world = after(*until).predict(0.03)
    copy = WorldFilter.from_dict(json.loads(json.dumps(world.to_dict())))
    rest = [late, *in_order[len(until) :]]
    assert after(*rest, world=copy).state == after(*rest, world=world).state
    assert after(*rest, world=world).state.delivery.replayed == 1


def test_a_measurement_beyond_the_lag_is_counted_and_ignored() -> None:
    in_order = script(np.random.default_rng(1), hops=40)
    world = after(*in_order[1:])
    late = world.update(in_order[0])
    assert late.state == replace(world.state, delivery=Delivery(too_late=1))
    # A single stray stamp is no clock change, however old it is.
    again = after(in_order[0], *script(np.random.default_rng(2), hops=50)[-10:], world=late)
    assert again.state.delivery.reanchored == 0


def test_the_filter_continues_two_seconds_after_a_clock_is_set_back() -> None:
    hour_ns = 3600 * 10**9
    before = [replace(one, stamp_ns=one.stamp_ns + hour_ns) for one in script(np.random.default_rng(1))]
    later = script(np.random.default_rng(2), hops=30)
    world = after(*before)
    taken_ns = [(world := world.update(one)).state.stamp_ns == one.stamp_ns for one in later]
    waits = [one for one, taken in zip(later, taken_ns, strict=True) if not taken]
    assert waits[-1].stamp_ns - later[0].stamp_ns <= 2 * 10**9 and taken_ns[-1]
    assert world.state.delivery.reanchored == 1
    assert world.state.cues


@given(SEEDS, st.integers(1, 25), st.floats(2.2, 1e9) | st.floats(2.2, 4.0), st.booleans(), st.booleans())
@settings(max_examples=6)
def test_one_stray_stamp_has_no_later_effect(
    seed: int, at: int, ahead_s: float, again: bool, clocked: bool
) -> None:
    in_order = script(np.random.default_rng(seed), hops=30)
    stray = replace(in_order[at], stamp_ns=in_order[at].stamp_ns + round(ahead_s * 1e9))
    straight = stricken = after(*in_order[:at])
    for one in (stray, stray) if again else (stray,):
        stricken = stricken.update(one)
    assert stricken.state.delivery == Delivery(held_back=1, repeated=int(again))
    for one in in_order[at:]:
        if clocked:  # The caller predicts to the time of each measurement
            straight, stricken = straight.predict_to(one.stamp_ns), stricken.predict_to(one.stamp_ns)
        straight, stricken = straight.update(one), stricken.update(one)
        assert content(stricken) == content(straight)


@given(SEEDS, st.floats(2.2, 1e9), st.booleans())
@settings(max_examples=5)
def test_two_agreeing_stamps_confirm_a_clock_step(seed: int, pause_s: float, other: bool) -> None:
    """After a pause or a clock step, the next measurement of any source confirms the new time."""
    *before, one = script(np.random.default_rng(seed))
    ahead_ns = one.stamp_ns + round(pause_s * 1e9)
    both = [replace(one, source="another") if other else one, one]
    first, second = (replace(it, stamp_ns=ahead_ns + k * 10**8) for k, it in enumerate(both))
    world = after(*before)
    once, twice = world.update(first), after(first, second, world=world)
    assert content(once) == content(world)
    # After a prediction to that time it is not ahead.
    expected = after(first, second, world=world.predict_to(first.stamp_ns))
    # If the caller predicts to that time in between, the first measurement is not lost.
    for got in (twice, once.predict_to(second.stamp_ns).update(second)):
        assert content(got) == content(expected) and got.state.delivery == world.state.delivery
    copy = WorldFilter.from_dict(json.loads(json.dumps(once.to_dict())))
    assert copy.update(second).state == twice.state


def test_a_slow_stream_keeps_its_pace() -> None:
    *_, last = worlds = run(WorldFilter(), (hop(50 * number) for number in range(1, 7)))
    assert [world.stamp_ns // 10**9 for world in worlds] == [5, 5, 15, 20, 25, 30]
    assert last.state.seq == 6 and last.state.delivery == Delivery()


def test_equal_stamps_are_not_late() -> None:
    measured = script(np.random.default_rng(4))
    twins = [replace(one, source=source) for one in measured for source in ("z", "a")]
    assert after(*twins).state.delivery == Delivery()
    assert after(twins[2], twins[0]).state.delivery == Delivery(replayed=1)


@given(SEEDS)
@settings(max_examples=3)
def test_many_small_predictions_are_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    measured = script(rng, hops=12)
    often = WorldFilter()
    for one in measured:
        between_ns = rng.integers(often.stamp_ns, max(one.stamp_ns, often.stamp_ns + 1), 3).tolist()
        for stamp_ns in sorted([*between_ns, max(one.stamp_ns, often.stamp_ns)]):
            often = often.predict_to(stamp_ns)
        often = often.update(one)
    assert often.state == after(*measured).state
