"""What a user would miss: behaviour behind settings and promises, through the public face alone."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from worldstate import (
    Absent,
    Context,
    Measurement,
    NotUsable,
    Present,
    Sighting,
    SignatureEvidence,
    Unqueried,
    WorldFilter,
    WorldstateError,
)
from worldstate.abduction import log_lambda
from worldstate.measurement import Approach, Bearing, Look

NOTHING, UNASKED = NotUsable("-"), Unqueried("-")
EVEN = SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
LEFT = SignatureEvidence(("left", "right"), (6.0, 0.0), 0.0, 0.0)
RIGHT = SignatureEvidence(("left", "right"), (0.0, 6.0), 0.0, 0.0)
FRONT = SignatureEvidence(("left", "right"), (0.0, 0.0), 6.0, 0.0)


def measured(time_s, signature=EVEN, *sightings, answer=UNASKED, bearing=NOTHING, approach=NOTHING):
    return Measurement(round(time_s * 1e9), signature, answer, bearing, approach, sightings)


def car(azimuth_rad):
    return Sighting(azimuth_rad, 0.02, "car", 0.9, 0.05)


def after(world, *measurements):
    for measurement in measurements:
        world = world.update(measurement)
    return world


def entities(world):
    return {entity.status: entity for entity in world.state.entities}


@pytest.mark.parametrize(("azimuth", "answer"), [(0.5, "unqueried"), (0.2, "absent")])
def test_an_empty_look_says_nothing_of_what_it_cannot_see(azimuth, answer):
    """A vehicle beyond the edge of the view is not there to be missed."""
    world = after(WorldFilter(Context(view_half_angle_rad=0.35)), measured(1.0, FRONT, car(azimuth)))
    before = world.state.entities[0].existence_probability
    (entity,) = after(world, measured(1.3, FRONT, answer=Absent(0.05))).state.entities
    assert entity.visibility.answer == answer
    alive = before * math.exp(-0.3 / 10.0)
    assert (entity.existence_probability == pytest.approx(alive)) == (answer == "unqueried")
    assert entity.existence_probability <= alive * (1.0 + 1e-9)


def test_a_look_ends_whom_it_would_have_seen_whatever_the_sound_asked_about():
    """Asked about a sector that it hardly sees, a camera has still looked at all that it sees."""
    world = after(WorldFilter(), measured(1.0, FRONT, car(0.2)))
    asked = measured(1.3, FRONT, answer=Absent(0.9))
    looked = replace(asked, look=Look("camera", asked.stamp_ns, Absent(0.05)))
    said = [after(world, one).state.entities for one in (asked, looked)]
    assert said[0][0].existence_probability > 0.9
    assert said[1][0].existence_probability < 0.6


@pytest.mark.parametrize(("azimuth_rad", "vehicles"), [(0.25, 2), (0.1, 1)])
def test_a_sighting_beyond_the_gate_is_another_vehicle(azimuth_rad, vehicles):
    """However uncertain an azimuth has become, a vehicle does not jump by more than the gate."""
    world = after(WorldFilter(), measured(1.0, FRONT, car(-0.2)))
    assert len(after(world, measured(1.6, FRONT, car(azimuth_rad))).state.entities) == vehicles


def test_a_vehicle_may_be_heard_on_the_wrong_side_before_it_comes_into_view():
    world = after(WorldFilter(), *[measured(t, LEFT) for t in (1.0, 2.0, 3.0)])
    (heard,) = world.state.entities
    seen = entities(after(world, measured(3.1, LEFT, car(-0.5))))
    assert {status: entity.id for status, entity in seen.items()} == {"visible": heard.id}


def test_of_two_hidden_vehicles_the_likelier_one_comes_into_view():
    both = SignatureEvidence(("left", "right"), (6.0, 6.0), 0.0, 0.0)
    busy = Context(hidden_by_side={"left": 0.8, "right": 0.8})  # Heard on both sides, there are two
    world = after(WorldFilter(busy), *[measured(t, both) for t in (1.0, 2.0, 3.0)])
    heard = {entity.direction: entity.id for entity in world.state.entities}
    assert set(heard) == {"left", "right"}
    assert entities(after(world, measured(3.1, both, car(0.5))))["visible"].id == heard["left"]


def test_a_vehicle_seen_a_moment_ago_has_not_gone_into_hiding():
    """One missed image is no occlusion: what is heard hidden beside it is another vehicle."""
    first = [measured(1.0 + hop / 10, FRONT, car(-0.5)) for hop in range(15)]
    beside = [measured(2.5 + hop / 10, RIGHT, car(-0.5)) for hop in range(20)]
    world = after(WorldFilter(), *first, *beside, measured(4.5, RIGHT, answer=Absent(0.1)))
    assert set(entities(world)) == {"visible", "hidden"}


def test_a_peak_moves_a_doubtful_entity_less():
    """What may not exist may not have made the sound."""

    def moved(clutter_rate):
        world = after(WorldFilter(), measured(1.0, FRONT, car(0.0), answer=Present(0.04, clutter_rate)))
        bearing = Bearing(0.15, 0.05, 1.6)
        (entity,) = after(world, measured(2.0, FRONT, bearing=bearing)).state.entities
        (unheard,) = after(world, measured(2.0, FRONT)).state.entities
        return entity.azimuth_rad - unheard.azimuth_rad

    assert 0.0 < moved(0.9) < 0.7 * moved(0.01)


def test_a_range_that_was_only_assumed_is_not_published():
    world = after(WorldFilter(), *[measured(t, LEFT) for t in (1.0, 2.0)])
    (hidden,) = world.state.entities
    assert (hidden.status, hidden.range_m, hidden.position_m) == ("hidden", None, None)
    seen = entities(after(world, measured(2.1, LEFT, car(0.5))))["visible"]
    assert (seen.range_m, seen.position_m) == (None, None)


@pytest.mark.parametrize("step_s", [1.0, 0.5, 0.1])
def test_an_approach_rate_sharpens_the_belief_as_data_association_says(step_s):
    r"""P = w P^+ + (1 - w) P^- + w (1 - w) K^2 nu^2, with w = P(the sound is this entity's) before it.

    Of a window that overlaps the last one, only the new share counts: R / share.
    """
    world = after(WorldFilter(), *[measured(t, LEFT, approach=Approach(0.3, 0.3)) for t in (1.0, 2.0)])
    (before,) = world.predict_to(round((2.0 + step_s) * 1e9)).state.entities
    (later,) = after(world, measured(2.0 + step_s, LEFT, approach=Approach(0.6, 0.2))).state.entities
    prior, w = before.inverse_tta_std_hz**2, before.existence_probability
    gain = prior / (prior + 0.2**2 / step_s)
    news = 0.6 - before.inverse_tta_hz
    expected = w * (1 - gain) * prior + (1 - w) * prior + w * (1 - w) * (gain * news) ** 2
    assert later.inverse_tta_hz == pytest.approx(before.inverse_tta_hz + w * gain * news)
    assert later.inverse_tta_std_hz**2 == pytest.approx(expected)


def test_a_hand_over_keeps_the_approach_that_was_heard():
    world = after(WorldFilter(), *[measured(t, LEFT, approach=Approach(0.8, 0.1)) for t in (1.0, 2.0, 3.0)])
    (before,) = world.predict_to(3_100_000_000).state.entities
    seen = entities(after(world, measured(3.1, LEFT, car(0.5))))["visible"]
    assert seen.inverse_tta_hz == pytest.approx(before.inverse_tta_hz)
    assert seen.inverse_tta_std_hz == pytest.approx(before.inverse_tta_std_hz)


def test_the_likelihood_ratio_keeps_its_promises_without_mass():
    """No prior mass on hidden: all directions weigh alike. None on the others: without bound."""
    heard = SignatureEvidence(("left", "right"), (1.0, 3.0), 0.5, -0.5)
    nobody = -np.inf
    even = np.log([0.25, 0.25, 0.25, 0.25])
    unheard = np.array([nobody, nobody, *even[2:]])
    assert log_lambda(unheard, heard, UNASKED) == pytest.approx(log_lambda(even, heard, UNASKED))
    assert log_lambda(np.array([*even[:2], nobody, nobody]), heard, UNASKED) == np.inf
    # Neither other explanation can make what the camera says, or has any mass.
    assert log_lambda(np.array([*even[:3], nobody]), heard, Absent(0.0)) == np.inf
    one_sided = np.array([even[0], nobody, *even[2:]])
    other = np.log(np.mean(np.exp([0.5, -0.5])))
    assert log_lambda(one_sided, heard, UNASKED) == pytest.approx(1.0 - other)


@pytest.mark.parametrize("stamp_ns", [math.nan, math.inf, 1.5e9, "1500000000", None, True])
def test_a_time_that_is_no_integer_is_refused_and_changes_nothing(stamp_ns):
    world = after(WorldFilter(), measured(1.0, LEFT))
    before = world.state
    with pytest.raises(WorldstateError, match="stamp_ns: expected integer nanoseconds"):
        world.predict_to(stamp_ns)
    with pytest.raises(WorldstateError, match="stamp_ns: expected integer nanoseconds"):
        world.update(replace(measured(1.1, LEFT), stamp_ns=stamp_ns))
    with pytest.raises(WorldstateError, match="start_ns: expected integer nanoseconds"):
        WorldFilter(start_ns=stamp_ns)
    assert world.state == before


def test_stamps_and_likelihoods_of_numpy_are_as_good_as_pythons():
    """Drivers stamp with numpy integers, and a likelihood may be written without its point."""
    plain = SignatureEvidence(("left", "right"), (6.0, 0.0), 1.0, 0.0)
    whole = SignatureEvidence(("left", "right"), (6, 0), 1, 0)
    world = after(WorldFilter(), measured(1.0, plain), measured(1.1, plain)).predict(0.1)
    hops = [replace(measured(t, whole), stamp_ns=np.int64(round(t * 1e9))) for t in (1.0, 1.1)]
    other = after(WorldFilter(start_ns=np.int64(0)), *hops).predict_to(np.int64(1_200_000_000))
    assert other.state.to_json() == world.state.to_json()
    assert json.dumps(other.to_dict()) == json.dumps(world.to_dict())


def test_absurd_approach_rates_do_not_end_the_filter():
    """Three rates that recede within the accepted range drove log r to where exp overflows."""
    absurd = [measured(2.0 + t / 10, LEFT, approach=Approach(-1e3, 1e-3)) for t in range(1, 4)]
    world = after(WorldFilter(), measured(1.0, LEFT), measured(2.0, LEFT), *absurd).predict(1.0)
    (entity,) = world.state.entities
    assert math.isfinite(entity.azimuth_rad)
    assert math.isfinite(entity.inverse_tta_hz)


def test_a_certain_entity_survives_a_checkpoint():
    """Rounding must not make a probability exceed one: such a checkpoint would be refused."""
    world, rng = WorldFilter(), np.random.default_rng(0)
    for hop in range(1, 300):
        certain = SignatureEvidence(("left", "right"), (float(rng.uniform(8, 40)), 0.0), 3.0, 0.0)
        world = after(world, measured(hop / 10, certain))
        if hop % 10 == 9:
            assert WorldFilter.from_dict(world.to_dict()).state == world.state


@pytest.mark.parametrize(("miss_rate", "stays"), [(0.9, True), (0.04, False)])
def test_one_box_of_a_camera_that_misses_most_is_not_lost_for_want_of_another(miss_rate, stays):
    world = after(WorldFilter(), measured(1.0, FRONT, car(0.1), answer=Present(miss_rate, 0.01)))
    (seen,) = world.state.entities
    for hop in range(1, 26):
        world = after(world, measured(1.0 + hop / 10, FRONT, answer=Absent(miss_rate, 0.01)))
    assert [one.id for one in world.state.entities if one.existence_probability > 0.5] == [seen.id] * stays


@pytest.mark.parametrize(
    ("azimuth", "rate", "answer"), [(0.42, 0.4, "unqueried"), (0.42, -0.4, "absent"), (0.0, 0.4, "absent")]
)
def test_who_has_driven_to_the_edge_ahead_is_out_of_sight_rather_than_missed(azimuth, rate, answer):
    """Its box ends where the corner begins; no box any more says that it has gone, not that it is in view."""
    hops = [(1.0 + 0.1 * hop, azimuth + 0.1 * rate * (hop - 9)) for hop in range(10)]
    boxes = [replace(car(at), width_rad=0.25) for _, at in hops]
    world = after(WorldFilter(), *[measured(t, FRONT, box) for (t, _), box in zip(hops, boxes, strict=True)])
    world = after(world, *[measured(t, FRONT, answer=Absent(0.1)) for t in (2.0, 2.1)])
    (entity,) = world.state.entities
    assert entity.visibility.answer == answer
    assert entity.status == ("hidden" if answer == "unqueried" else "visible")
    # Found once more, it is in view again.
    again = replace(car(azimuth + 0.3 * rate), width_rad=0.25)
    (entity,) = after(world, measured(2.2, FRONT, again)).state.entities
    assert (entity.status, entity.visibility.answer) == ("visible", "visible")
