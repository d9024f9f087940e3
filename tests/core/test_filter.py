"""The filter end to end on scripted measurements: births, hand-over, two vehicles, blindness, laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from street_measurements import SILENT, car, hop

from worldstate import Context, FilterSettings, Sighting, SignatureEvidence, WorldFilter
from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.cueing.risk_map import IsotonicMap
from worldstate.belief.street_model import StreetModel
from worldstate.ground.errors import InvalidArgumentError
from worldstate.measurement import Approach, Bearing

QUIET = (0.1, 0.1, 0.1, 0.7)
LEFT = (0.97, 0.01, 0.01, 0.01)
SILENCE = (0.01, 0.01, 0.01, 0.97)
RIGHT = (0.01, 0.97, 0.01, 0.01)
FRONT = (0.01, 0.01, 0.97, 0.01)
POLICY = CueingPolicy(0.85, 3, 0.02, (0.25,) * 4, IsotonicMap((0.0, 0.5, 1.0), (0.0, 0.3, 0.95)))


def measured(time_s, classes, *sightings, answer=None, **parts):
    answer = answer or (Present if any(one.moving for one in sightings) else Absent)(0.04)
    nats = np.log(np.array(classes) / 0.25).tolist()
    return hop(10.0 * time_s, nats, *sightings, answer=answer, **parts)


def run(world, measurements):
    worlds = [world := world.update(one) for one in measurements]
    return world, [one.state for one in worlds]


def start(**options):
    return WorldFilter(policy=POLICY, **options)


def hops(first_s, last_s):
    return np.round(np.arange(first_s, last_s - 1e-9, 0.1), 3).tolist()


def approach_from_left(t0_s=5.0):
    """Yield a hidden vehicle on the left for 3 s, a visible one for 2 s, and quiet hops around them."""
    for t in hops(1.0, 2.0):
        yield measured(t, QUIET)
    for t in hops(2.0, t0_s):
        yield measured(t, LEFT, bearing=Bearing(0.6, 0.06, 1.3), approach=Approach(0.4, 0.25))
    for t in hops(t0_s, t0_s + 2.0):
        azimuth = 0.55 - 0.5 * (t - t0_s)
        yield measured(t, FRONT, car(azimuth), bearing=Bearing(azimuth, 0.06, 1.6))
    for t in hops(t0_s + 2.0, t0_s + 18.0):
        yield measured(t, QUIET)


def test_hidden_then_visible_with_the_same_id_and_its_relations():
    _, states = run(start(), approach_from_left())
    hidden = [s for s in states if any(e.status == "hidden" for e in s.entities)]
    assert hidden[0].stamp_ns < 4.0e9
    (entity,) = hidden[0].entities
    assert (entity.direction, entity.range_m, entity.position_m) == ("left", None, None)
    assert entity.azimuth_rad > 0
    assert entity.azimuth_std_rad > 0.17
    visible = [s for s in states if any(e.status == "visible" for e in s.entities)]
    assert visible[0].stamp_ns == 5_000_000_000
    assert {e.id for s in states for e in s.entities} == {entity.id}
    (seen,) = visible[3].entities
    assert seen.existence_probability > 0.95
    assert seen.azimuth_rad == pytest.approx(0.4, abs=0.03)
    assert [c.label for c in seen.classification] == ["car", "unknown"]
    assert (seen.range_m, seen.position_m) == (None, None)
    assert states[-1].entities == ()
    at = {s.stamp_ns: {r.kind: r for r in s.relations} for s in states}
    hidden = at[4_500_000_000]
    assert (hidden["occluded_by"].dst, hidden["approaching"].dst) == ("corner_left", "ego")
    assert hidden["approaching"].probability > 0.85
    assert "emerged_from" in at[5_300_000_000]


def test_the_advisory_follows_the_log_odds_and_refers_to_the_entity():
    """The mean log-odds of three hops reach logit gamma; the advisory is held for a second."""
    world, nats, named, cues = start(), [], [], []
    for measurement in approach_from_left():
        world = world.update(measurement)
        if world.stamp_ns == 5 * 10**9:
            break
        hidden = world.belief.hidden_on(None)
        nats.append(math.log(hidden / (1.0 - hidden)))
        named.append([cue.direction for cue in world.state.cues if cue.advisory])
        cues += [cue for cue in world.state.cues if cue.advisory]
    means = [np.mean(nats[max(hop - 2, 0) : hop + 1]) for hop in range(len(nats))]
    over = [mean >= math.log(0.85 / 0.15) for mean in means]
    assert named == [["left"] * any(over[max(hop - 10, 0) : hop + 1]) for hop in range(len(over))]
    assert 10 <= sum(map(len, named)) < len(named) - 10
    assert all(cue.entity_id is not None and cue.alpha == 0.02 for cue in cues)


def test_equal_sides_are_both_advised():
    """Rounding must not decide between equal sides, because the mirrored world would differ."""
    even, either = (0.49, 0.49, 0.01, 0.01), replace(POLICY, gamma=0.4)  # Of one vehicle each has half
    for classes in (even, (0.49 + 1e-15, 0.49 - 1e-15, 0.01, 0.01)):
        world, _ = run(WorldFilter(policy=either), [measured(t, classes) for t in hops(1.0, 1.5)])
        assert all(cue.advisory for cue in world.state.cues) and len(world.state.cues) == 2


def test_looming_gives_the_time_to_arrival_or_it_is_unknown():
    world, _ = run(start(), [measured(t, LEFT, approach=Approach(0.5, 0.2)) for t in hops(1.0, 4.0)])
    (entity,) = world.state.entities
    assert entity.inverse_tta_hz == pytest.approx(0.5, abs=0.15)
    assert entity.tta_s == pytest.approx(1 / entity.inverse_tta_hz)
    world, _ = run(start(), [measured(t, LEFT, approach=Approach(-0.4, 0.2)) for t in hops(1.0, 4.0)])
    assert world.state.entities[0].tta_s is None
    assert {r.kind: r.probability for r in world.state.relations}["approaching"] < 0.5
    world, _ = run(start(), [measured(t, LEFT) for t in hops(1.0, 4.0)])
    (entity,) = world.state.entities
    assert (entity.inverse_tta_hz, entity.tta_s, world.state.cues[0].horizon_s) == (None, None, None)


def test_a_hidden_azimuth_includes_the_possible_bias():
    peak = Bearing(0.6, 0.06, 1.4)
    world, _ = run(start(), [measured(t, LEFT, bearing=peak) for t in hops(1.0, 6.0)])
    spread = world.memory.tracks.azimuth_std_rad[0]
    assert world.state.entities[0].azimuth_std_rad == pytest.approx(math.hypot(spread, math.radians(10.0)))
    assert world.state.cues[0].azimuth_std_rad == pytest.approx(math.hypot(spread, math.radians(10.0)))


def test_without_a_camera_an_entity_emerges():
    """Without a camera one entity is hidden, then emerged, and never visible."""
    off = Unqueried("no detections")
    script = [measured(t, QUIET, answer=off) for t in hops(1.0, 2.0)]
    script += [measured(t, LEFT, answer=off) for t in hops(2.0, 5.0)]
    script += [measured(t, FRONT, answer=off, bearing=Bearing(0.2, 0.06, 1.6)) for t in hops(5.0, 8.0)]
    # A pass takes three seconds on average; without a camera nothing shows its end earlier.
    script += [measured(t, QUIET, answer=off) for t in hops(8.0, 16.0)]
    _, states = run(start(), script)
    assert len({e.id for s in states for e in s.entities}) == 1
    status = {e.status for s in states for e in s.entities}
    assert status == {"hidden", "emerged"}
    assert all(e.visibility.answer == "unqueried" for s in states for e in s.entities)
    emerged = next(e for s in states if s.stamp_ns == 7_900_000_000 for e in s.entities)
    assert emerged.azimuth_rad == pytest.approx(0.2, abs=0.1)
    assert states[-1].entities == ()


def test_hysteresis_keeps_one_id_through_a_dip():
    script = [measured(t, LEFT) for t in hops(1.0, 4.0)] + [measured(t, QUIET) for t in hops(4.0, 4.6)]
    script += [measured(t, LEFT) for t in hops(4.6, 7.0)]
    _, states = run(start(), script)
    assert len({e.id for s in states for e in s.entities}) == 1


@pytest.mark.parametrize("since_s", [1.0, 4.0])
def test_a_parked_car_replaces_no_hidden_entity(since_s):
    parked = [(t, [car(0.5, moving=False)] * (t >= since_s)) for t in hops(1.0, 4.1)]
    _, states = run(start(), [measured(t, LEFT, *boxes, answer=Absent(0.04)) for t, boxes in parked])
    assert {(e.status, e.moving) for e in states[-1].entities} == {("visible", False), ("hidden", True)}


def test_a_parked_car_drives_off():
    script = [measured(t, FRONT, car(0.3, moving=False)) for t in hops(1.0, 4.0)]
    script += [measured(t, FRONT, car(0.3 - 0.6 * (t - 4.0))) for t in hops(4.0, 5.0)]
    _, states = run(start(), script)
    (entity,) = states[-1].entities
    assert {e.id for s in states for e in s.entities} == {entity.id}
    assert (entity.moving, entity.azimuth_rad) == (True, pytest.approx(-0.24, abs=0.03))
    assert entity.azimuth_rate_rad_s == pytest.approx(-0.6, abs=0.1)


@pytest.mark.parametrize("answer", [Absent(0.04), Absent(0.3), Absent(0.9), Unqueried("no frame")])
@pytest.mark.parametrize("look_s", [0.1, 0.3])
def test_empty_looks_follow_the_bernoulli_update(answer, look_s):
    """Survival, then r beta / (1 - r + r beta); looks within a correlation time count in part."""
    settings_ = FilterSettings(street=StreetModel(look_s=look_s, death=1e-9))
    world = start(settings=settings_).update(measured(1.0, FRONT, car(0.0)))
    (entity,) = world.state.entities
    r, beta = entity.existence_probability, getattr(answer, "miss_rate", 1.0) ** (0.1 / look_s)
    for t in (1.1, 1.2, 1.3):
        world = world.update(measured(t, FRONT, answer=answer))
        r *= math.exp(-0.1 / 10.0)
        r *= beta / (1.0 - r + r * beta)
        (entity,) = world.state.entities
        assert entity.existence_probability == pytest.approx(r)
        assert entity.visibility.answer == ("absent" if beta < 1.0 else "unqueried")


@given(st.floats(0.01, 0.99), st.floats(0.01, 0.5))
@settings(max_examples=20, deadline=None)
def test_a_first_box_is_weighted_by_its_score_and_the_clutter(score, clutter):
    """The odds are birth against clutter times the score; a second box raises them, a miss lowers them."""
    box = Sighting(0.1, 0.02, "car", score, 0.1)
    first = measured(1.0, FRONT, box, answer=Present(0.05, clutter))
    world = start(settings=FilterSettings(street=StreetModel(death=1e-9))).update(first)
    (born,) = world.state.entities
    odds = StreetModel().births / -math.log1p(-clutter) * score / (1.0 - score)
    assert born.existence_probability == pytest.approx(odds / (1.0 + odds), rel=1e-6)
    again, gone = (
        world.update(replace(first, stamp_ns=2 * 10**9 - 9 * 10**8, sightings=boxes)).state.entities
        for boxes in ((box,), ())
    )
    assert again[0].existence_probability > gone[0].existence_probability
    assert score < 0.5 or again[0].existence_probability > born.existence_probability
    assert gone[0].existence_probability < born.existence_probability


approaches = st.one_of(st.just(SILENT), st.builds(Approach, st.floats(-2.0, 2.0), st.floats(0.05, 1.0)))


@settings(max_examples=40, deadline=None)
@given(st.lists(approaches, min_size=5, max_size=30), st.floats(-1.5, 1.5))
def test_a_hidden_entity_stays_on_its_side_for_any_looming(rates, azimuth):
    peak, times = Bearing(azimuth, 0.06), hops(1.0, 4.5)
    script = [measured(t, LEFT, approach=rate, bearing=peak) for t, rate in zip(times, rates, strict=False)]
    _, states = run(start(), script)
    hidden = [e for s in states for e in s.entities]
    assert hidden
    assert all(0.2 < e.azimuth_rad < 1.7 and 0.17 < e.azimuth_std_rad < 0.8 for e in hidden)


def test_the_same_stream_has_the_same_ids_and_another_one_others():
    worlds = start(), start(), start(settings=FilterSettings(stream="other"))
    states = [run(one, approach_from_left())[1] for one in worlds]
    first, same, other = ([one.id for state in many for one in state.entities] for many in states)
    assert first == same and not set(first) & set(other)


def test_an_old_approach_rate_fades():
    """Approach at 0.8 1/s, then visible for three seconds without an approach rate."""
    script = [measured(t, LEFT, approach=Approach(0.8, 0.1)) for t in hops(1.0, 4.0)]
    script += [measured(t, FRONT, car(0.4)) for t in hops(4.0, 7.0)]
    _, states = run(start(), script)
    assert states[29].entities[0].tta_s < 2.0
    assert states[-1].entities[0].tta_s is None
    assert abs(states[-1].entities[0].inverse_tta_hz) < 0.4


def test_two_vehicles_one_seen_and_one_hidden():
    """A visible vehicle does not explain the evidence of a hidden one on the other side."""
    script = [measured(t, RIGHT) for t in hops(1.0, 4.0)]
    script += [measured(t, FRONT, car(-0.5 + 0.02 * (t - 4.0))) for t in hops(4.0, 6.0)]
    script += [measured(t, LEFT, car(-0.46), answer=Absent(0.04)) for t in hops(6.0, 9.0)]
    trucks = [(t, replace(car(0.5 - 0.3 * (t - 9.0)), label="truck")) for t in hops(9.0, 10.0)]
    script += [measured(t, LEFT, car(-0.46), truck) for t, truck in trucks]
    _, states = run(start(), script)
    at = {s.stamp_ns: s for s in states}
    first = {e.id for e in at[3_900_000_000].entities}
    both = at[8_900_000_000].entities
    assert [(e.status, e.direction) for e in both] == [("visible", "right"), ("hidden", "left")]
    end = at[9_900_000_000].entities
    assert [(e.status, e.direction) for e in end] == [("visible", "right"), ("visible", "left")]
    assert [e.id for e in end] == [e.id for e in both]
    assert end[0].id in first


def test_two_hidden_vehicles_hand_over_to_their_own_sides():
    """If vehicles are usual on both sides, evidence of both sides makes two entities."""
    both, busy = (0.49, 0.49, 0.01, 0.01), Context(hidden_by_side={"left": 0.8, "right": 0.8})
    script = [measured(t, both) for t in hops(1.0, 4.0)]
    script += [measured(t, both, car(0.5), car(-0.5)) for t in hops(4.0, 4.5)]
    _, states = run(start(context=busy), script)
    before = {e.direction: e.id for e in states[-6].entities}
    assert set(before) == {"left", "right"}
    seen = [e for e in states[-1].entities if e.status == "visible"]
    assert {("left" if e.azimuth_rad > 0 else "right"): e.id for e in seen} == before


def test_a_faint_belief_is_not_handed_over():
    script = [measured(t, LEFT) for t in hops(1.0, 4.0)] + [measured(t, SILENCE) for t in hops(4.0, 7.0)]
    settings_ = FilterSettings(street=StreetModel(death=1e-3))
    world, states = run(WorldFilter(policy=POLICY, settings=settings_), script)
    (faint,) = states[-1].entities
    assert faint.existence_probability < 0.02
    world = world.update(measured(7.0, SILENCE, car(-0.5)))
    assert {e.status: e.id == faint.id for e in world.state.entities}["visible"] is False


def test_a_visible_vehicle_does_not_raise_the_next_hidden_one():
    """A visible vehicle has a track; the existence of the next one is only its hidden probability."""
    script = [measured(t, LEFT) for t in hops(1.0, 4.0)]
    in_view = [car(0.5 - 0.3 * (t - 4.0)) for t in hops(4.0, 7.5)]
    script += [measured(t, FRONT, one) for t, one in zip(hops(4.0, 5.5), in_view, strict=False)]
    script += [measured(t, LEFT, one) for t, one in zip(hops(5.5, 7.5), in_view[15:], strict=True)]
    world, next_ones = start(), []
    for measurement in script:
        world = world.update(measurement)
        if world.stamp_ns > 4 * 10**9:
            next_ones += [(e, world.belief) for e in world.state.entities if e.status == "hidden"]
    assert len(next_ones) > 10 and len({e.id for e, _ in next_ones}) == 1
    for entity, belief in next_ones:
        assert entity.existence_probability == pytest.approx(belief.hidden_on(None), abs=0.03)


def test_a_moving_car_drives_past_a_parked_one():
    script = [measured(t, FRONT, car(0.4 - 0.2 * (t - 1.0)), car(0.0, moving=False)) for t in hops(1.0, 5.0)]
    _, states = run(start(), script)
    first, last = ({e.moving: e.id for e in s.entities} for s in (states[0], states[-1]))
    assert first == last
    assert len(states[-1].entities) == 2


def test_a_hand_over_lowers_the_risk():
    script = [measured(t, LEFT) for t in hops(1.0, 4.0)]
    script.append(measured(4.0, LEFT, car(0.5), answer=Unqueried("sector out of view")))
    _, states = run(start(), script)
    assert states[-2].risk > 0.7
    assert states[-1].risk < 1.0 / 6.0  # As often another one follows
    assert states[-1].cues[0].hypotheses.visible > 0.7


def test_a_measurement_of_other_directions_raises_an_error_without_effect():
    world = start().update(measured(2.0, LEFT))
    before, other = world.state, SignatureEvidence(("north",), (0.0,), 0.0, 0.0)
    with pytest.raises(InvalidArgumentError, match="expected one of the directions"):
        world.update(replace(measured(2.1, LEFT), signature=other))
    assert world.state == before
