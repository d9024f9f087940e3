"""Association over all joint events: Stone Soup's JPDA and plain enumeration are the oracles."""

import itertools
import math
from datetime import datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from street_measurements import after, car, diagonal, hop

from worldstate import Sighting, WorldFilter
from worldstate.abduction.co_evidence import Absent, Present
from worldstate.belief.association import FORBIDDEN, association_probabilities, joint_association, propagated
from worldstate.measurement import Position, PositionScan, SearchedSector, Sector

FOUND, CLUTTER, RANGE_M, BIRTHS = 0.7, 0.1, 1e3, 0.05
RADAR = SearchedSector(Sector(0.0, 1.2), RANGE_M, FOUND, CLUTTER)
SCAN_S, STD = 0.5, 1.0
NOISE = diagonal(*[STD] * 4)


def scan(number, places):
    stated = tuple(Position(place, NOISE, (0.0, 0.0)) for place in places)
    return PositionScan("radar", round(1e9 * SCAN_S * number), stated, RADAR)


def stone_soup_chances(before, places):
    """Return P(a position belongs to the entity) of every entity by Stone Soup's JPDA."""
    from stonesoup.dataassociator.probability import JPDA
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, RandomWalk
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.numeric import Probability
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import KalmanUpdater

    now, existence = datetime(2000, 1, 1), {}
    for one in before:
        mean = np.array([*one.position_m[:2], *one.velocity_mps[:2]])
        existence[Track([GaussianState(mean, np.array(one.covariance), now)])] = one.existence_probability

    class OfExistence(PDAHypothesiser):
        """An entity that exists with r is detected with r p_D."""

        def hypothesise(self, track, *rest, **options):
            self.prob_detect = Probability(existence[track] * FOUND)
            return super().hypothesise(track, *rest, **options)

    model = LinearGaussian(4, (0, 1, 2, 3), np.eye(4) * STD**2)
    # A scan includes velocities; those of new vehicles have a spread of 15 m/s beside the noise.
    anybody = 1.0 / (2.0 * math.pi * (STD**2 + 15.0**2))
    density = (BIRTHS - math.log1p(-CLUTTER)) / (RADAR.sector.half_width_rad * RANGE_M**2) * anybody
    still = CombinedLinearGaussianTransitionModel([RandomWalk(0.0)] * 4)
    options = {"clutter_spatial_density": density, "prob_gate": 1.0, "include_all": True}
    association = JPDA(OfExistence(KalmanPredictor(still), KalmanUpdater(model), **options))
    found = [Detection(np.array([*place, 0.0, 0.0]), now, measurement_model=model) for place in places]
    joint = association.associate(set(existence), set(found), now)
    return [sum(float(one.probability) for one in joint[track] if one) for track in existence]


@pytest.mark.parametrize("seed", range(3))
def test_existence_is_summed_over_the_joint_events_of_stone_soups_jpda(seed):
    pytest.importorskip("stonesoup", reason="Stone Soup is the oracle: pip install 'worldstate[oracles]'")
    rng = np.random.default_rng(seed)
    # The vehicles are so close that every position may belong to each of them.
    places = np.array([20.0, 0.0]) + rng.normal(0.0, 1.0, (3, 2))
    again = places[: rng.integers(1, 4)] + rng.normal(0.0, 0.5, (1, 2))
    world = WorldFilter().update(scan(1, places.tolist()))
    before = world.predict(SCAN_S).state.entities
    now = {one.id: one.existence_probability for one in world.update(scan(2, again.tolist())).state.entities}
    for one, chance in zip(before, stone_soup_chances(before, again.tolist()), strict=True):
        r, p = one.existence_probability, FOUND
        missed = r * (1 - p) / (1 - r * p)
        assert now[one.id] == pytest.approx(chance + (1 - chance) * missed, abs=1e-9)


def counted(log_ratios):
    """Return the association probabilities by going through all joint events."""
    rows, columns = log_ratios.shape
    chances, total = np.zeros((rows, columns)), 0.0
    for event in itertools.product(range(rows + 1), repeat=columns):
        taken = [row for row in event if row < rows]
        if len(set(taken)) < len(taken):
            continue
        pairs = [(row, column) for column, row in enumerate(event) if row < rows]
        weight = math.prod(math.exp(log_ratios[pair]) for pair in pairs)
        total += weight
        for pair in pairs:
            chances[pair] += weight
    return chances / total


@settings(max_examples=20, deadline=None)
@given(
    arrays(float, st.tuples(st.integers(1, 3), st.integers(1, 4)), elements=st.floats(-8.0, 8.0)), st.data()
)
def test_probabilities_are_those_of_all_joint_events(log_ratios, data):
    gated = data.draw(arrays(bool, log_ratios.shape))
    ratios = np.where(gated, log_ratios, FORBIDDEN)
    found = joint_association(ratios, np.ones(ratios.shape[1], bool))
    np.testing.assert_allclose(association_probabilities(ratios), counted(ratios), atol=1e-12)
    np.testing.assert_allclose(found.chances, counted(ratios).sum(axis=0), atol=1e-12)
    assert all(gated[row, column] for column, row in found.found.items())


@settings(max_examples=30, deadline=None)
@given(arrays(float, st.just((4, 4)), elements=st.floats(-6.0, 6.0)))
def test_belief_propagation_is_near_the_sum_over_all_events(log_ratios):
    near, exact = propagated(log_ratios), counted(log_ratios)
    assert np.abs(near - exact).mean() < 0.05 and np.abs(near.sum(axis=0) - exact.sum(axis=0)).max() < 0.2
    assert (near.sum(axis=0) <= 1.0 + 1e-9).all() and (near.sum(axis=1) <= 1.0 + 2e-3).all()


def test_a_crowd_uses_the_likeliest_event_and_all_for_existence():
    crowd = np.full((8, 8), -2.0) + 6.0 * np.eye(8)
    found = joint_association(crowd, np.ones(8, bool))
    assert found.found == {i: i for i in range(8)}
    # The diagonal has e^4 against 1 and seven pairs of e^-2.
    assert found.chances == pytest.approx([0.98] * 8, abs=0.01)


def looked(number, nats, *boxes, **parts):
    answer = Present(0.04) if boxes else Absent(0.04)
    return hop(number, (*nats, 0.0, 0.0), *boxes, answer=answer, **parts)


def heard(nats, **parts):
    """Return the filter after three seconds of a hidden vehicle, and its id."""
    world = after(*(looked(number, nats, **parts) for number in range(1, 30)))
    (hidden,) = world.state.entities
    return world, hidden.id


@pytest.mark.parametrize(
    ("label", "same"), [("car", True), ("bus", True), ("bicycle", False), ("person", False)]
)
def test_a_hand_over_needs_a_matching_class(label, same):
    """At the edge of the other side; detectors label a van as a car or as a truck."""
    world, name = heard((3.0, 0.0), kinds=(("truck", 0.4), ("van", 0.6)))
    seen = world.update(looked(30, (3.0, 0.0), Sighting(-0.75, 0.02, label, 0.9))).state.entities
    assert {one.status: one.id == name for one in seen}["visible"] == same


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("azimuth_rad", "width_rad", "same"), [(0.44, 0.08, True), (0.25, 0.27, False)])
def test_a_hand_over_needs_a_box_at_the_edge(sign, azimuth_rad, width_rad, same):
    """A vehicle that leaves a parking space is wholly visible, so the hidden one is another vehicle."""
    world, name = heard((3.0, 0.0)[:: int(sign)])
    box = car(sign * azimuth_rad, width_rad=width_rad)
    seen = world.update(looked(30, (0.0, 0.0), box)).state.entities
    assert {one.status: one.id == name for one in seen}["visible"] == same
    assert name in {one.id for one in seen}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("azimuth_rad", "width_rad", "leaves"), [(0.34, 0.4, True), (0.53, 0.05, False)])
def test_a_leaving_vehicle_does_not_take_the_identity_of_a_coming_one(sign, azimuth_rad, width_rad, leaves):
    """A leaving vehicle has passed the edge; a box at the edge belongs to the hidden vehicle behind it."""
    nats = (3.0, 0.0)[:: int(sign)]
    world, name = heard(nats)
    boxes = [[car(sign * (0.045 * at - 0.02), width_rad=0.5)] * (at < 7) for at in range(10)]
    boxes.append([car(sign * azimuth_rad, width_rad=width_rad)])
    world = after(*(looked(number, nats, *one) for number, one in enumerate(boxes, 30)), world=world)
    (seen,) = (one for one in world.state.entities if one.last_seen_ns == 4e9)
    assert (seen.id != name) == leaves
