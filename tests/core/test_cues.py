"""Snapshots beyond their entities: advisories over time, evidence, sensors, events, forecasts."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from street_measurements import (
    ABSENT,
    PRESENT,
    SEEDS,
    SHARE,
    after,
    car,
    diagonal,
    hop,
    ordinary,
    reading,
    run,
)

from worldstate import Context, Measurement, Sighting, WorldFilter
from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.road_users import Foreign
from worldstate.abduction.sequence.sequence_model import COMING_S
from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.belief.street_model import StreetModel
from worldstate.belief.track import Tracks
from worldstate.measurement import Look, Position, PositionScan, SearchedSector, Sector
from worldstate.state import Priors, Rates

SOON = np.array(COMING_S) <= 3.0
LOUD, SILENCE = (4.0, -1.0, -1.0, -4.0), (-4.0, -1.0, -1.0, 4.0)


def script(seed: int, hops: int, sequence: bool) -> list[Measurement]:
    """Return sound near its threshold with some looks, boxes and gaps of two seconds."""
    rng, number, measured = np.random.default_rng(seed), 0, []
    for _ in range(hops):
        number += 1 if rng.random() < 0.9 else 20
        one = ordinary(rng, number, sequence)
        left, right = one.signature.hidden
        measured.append(replace(one, signature=replace(one.signature, hidden=(left + 2.0, right))))
    return measured


def passing(begin: int, end: int, *nats: tuple[float, ...], turns: float, hops: int) -> list[Measurement]:
    """Return a vehicle that is heard until it is in view from `begin` to `end`, from 0.55 rad on."""
    told = []
    for number in range(1, hops):
        boxes = [car(0.55 - turns * (number - begin))] if begin <= number < end else []
        told.append(hop(number, nats[number >= begin], *boxes, answer=PRESENT if boxes else ABSENT))
    return told


@given(SEEDS, st.floats(0.01, 0.9))
@settings(max_examples=3)
def test_evidence_terms_of_a_sequence_sum_to_the_log_odds(seed: int, hidden: float) -> None:
    context = Context(priors=Priors(hidden, 0.0, 1.0 - hidden))
    for world in run(WorldFilter(context), script(seed, 20, sequence=True)):
        memory = world.memory
        assert memory is not None and memory.belief.has_times
        for k, cue in enumerate(world.state.cues):
            soon = memory.belief.coming[k][SOON].sum()
            assert cue.evidence is not None and cue.evidence.hypothesis == "coming"
            terms = cue.evidence.terms_nats
            assert sum(terms.values()) == pytest.approx(math.log(soon / (1.0 - soon)), abs=1e-9)
            assert next(iter(terms)) == "prior" and ("sequence" in terms) == bool(memory.belief.joint.alone)
            assert cue.within is not None and cue.within["3"] == pytest.approx(soon)


def test_a_detection_counts_against_a_coming_vehicle() -> None:
    """If the sound fits a visible and a coming vehicle, an empty look supports the coming one."""
    said, terms = reading({"coming_1s": 0.4, "seen": 0.4, "none": 0.2}), {}
    for answer in (ABSENT, PRESENT):
        evidence = after(hop(1, answer=answer, sequence=said)).state.cues[0].evidence
        terms[type(answer)] = evidence.terms_nats
    assert terms[Absent]["looks"] > 0.0 > terms[Present]["looks"]
    assert terms[Absent]["sequence"] == terms[Present]["sequence"]


@given(SEEDS)
@settings(max_examples=3)
def test_evidence_terms_of_windows_sum_to_the_log_odds(seed: int) -> None:
    """The statistic of one window is separate: it has the priors of the policy and no memory."""
    looked, two = False, False
    for world in run(WorldFilter(), script(seed, 20, sequence=False)):
        looked |= not isinstance(world.lag.arrivals[-1].measurement.co_evidence, Unqueried)
        hidden = world.belief.hidden_on(None)
        for cue in world.state.cues:
            terms = cue.evidence.terms_nats
            assert cue.evidence.hypothesis == "hidden" and next(iter(terms)) == "prior"
            assert ("window" in terms) == bool(world.memory.belief.joint.alone)
            assert sum(terms.values()) == pytest.approx(math.log(hidden / (1.0 - hidden)), abs=1e-9)
            # Gamma is 0.9, and higher while a vehicle has just come into view.
            belief = world.memory.belief
            just_come = any(belief.emerged_since(belief.stamp_ns, StreetModel().beside_s))
            higher = StreetModel().beside_nats * just_come
            assert cue.evidence.threshold_nats == pytest.approx(math.log(9.0) + higher)
            assert looked or terms["looks"] == pytest.approx(0.0, abs=1e-9)
            right, left = cue.sector_rad
            assert right < cue.azimuth_rad < left
            assert left - right == pytest.approx(2.0 * 1.6448536 * cue.azimuth_std_rad, abs=2e-6)
            two |= abs(terms["looks"]) > 0.01
    assert looked == two


@pytest.mark.parametrize("sequence", [False, True])
def test_an_advisory_of_messages_has_the_hypothesis_announced(sequence: bool) -> None:
    """Both sides are quiet; a vehicle on the left sends its position."""
    said, world = reading(SHARE, 2.5) if sequence else None, WorldFilter()
    for number in range(1, 9):
        there = Position((10.0, 30.0 - 0.8 * number), diagonal(0.7, 0.7, 0.7, 0.7), (0.0, -8.0), 0.95)
        message = PositionScan("v2x", number * 10**8 - 10**7, (there,))
        world = after(message, hop(number, (-3.0, -3.0, -1.0, 1.0), sequence=said), world=world)
    left, right = world.state.cues
    assert left.advisory is not None and right.advisory is None
    hypotheses = left.evidence.hypothesis, right.evidence.hypothesis
    assert hypotheses == ("announced", "coming" if sequence else "hidden")
    assert left.evidence.compared_nats == pytest.approx(sum(left.evidence.terms_nats.values()))
    assert left.evidence.compared_nats >= left.evidence.threshold_nats > right.evidence.compared_nats
    assert {one.sensor for one in left.advisory.sensors} == {"acoustic", "v2x"}


def test_sensors_are_working_impaired_or_silent() -> None:
    dark = Look("camera", 9 * 10**8, Absent(0.83, 0.01))
    sound = hop(10, answer=dark.answer, look=dark, domain=Foreign("sounds like speech", 2.0))
    radio = hop(11, source="v2x", fault="antenna fault")
    world = after(sound, radio)
    told = {one.sensor: (one.condition, one.stamp_ns, one.reason) for one in world.state.sensors}
    assert told == {
        "acoustic": ("impaired", 10**9, "sounds like speech"),
        "camera": ("impaired", 9 * 10**8, "misses 83% of what is in view"),
        "v2x": ("impaired", 11 * 10**8, "antenna fault"),
    }
    (view,) = world.state.searched
    assert (view.sensor, view.stamp_ns, view.found, view.miss_rate) == ("camera", 9 * 10**8, False, 0.83)
    later = world.update(replace(radio, stamp_ns=2 * 10**9, fault=None)).state
    assert [one.condition for one in later.sensors] == ["impaired", "silent", "working"]
    assert later.valid_until_ns == 3 * 10**9
    assert WorldFilter().state.valid_until_ns is None


def test_a_scan_is_a_look_at_its_own_sector_and_a_message_at_none() -> None:
    sector = SearchedSector(Sector(0.2, 0.5), range_m=70.0, detection_probability=0.9)
    there = Position((12.0, 3.0), ((0.2, 0.0), (0.0, 0.4)))
    world = after(PositionScan("radar", 10**9, (), sector), PositionScan("v2x", 10**9 + 1, (there,)))
    (view,) = world.state.searched
    assert (view.sensor, view.found) == ("radar", False)
    assert (view.miss_rate, *view.sector_rad) == pytest.approx((0.1, -0.3, 0.7))
    assert [one.condition for one in world.state.sensors] == ["working", "working"]
    assert world.state.valid_until_ns == 2 * 10**9 + 1
    assert [event.kind for event in world.state.events] == ["born"]


def test_a_high_risk_without_sound_has_its_reason() -> None:
    slow = Context(rates=Rates(emergence_hz=0.02, departure_hz=0.02))
    world = after(*(hop(number, (8.0, 0.0, 0.0, 0.0)) for number in range(1, 20)), world=WorldFilter(slow))
    assert world.state.cues[0].advisory is not None
    silent = world.predict(1.5).state.cues[0]
    assert silent.advisory is None and silent.risk > 0.7
    assert silent.not_advised == "nothing was measured for a second"


def test_a_pass_is_born_handed_over_coasts_and_dies() -> None:
    worlds = run(WorldFilter(), passing(20, 30, LOUD, SILENCE, turns=0.05, hops=120))
    told = [one for world in worlds for one in world.state.events]
    assert [one.kind for one in told] == ["born", "handed_over", "coasting", "died"]
    assert len({one.entity_id for one in told}) == 1


@given(SEEDS)
@settings(max_examples=5)
def test_the_forecast_moves_on_straight_lines(seed: int) -> None:
    """Oracle: positions and velocities drawn from the belief, each moved on a line with noise."""
    rng = np.random.default_rng(seed)
    world = after(hop(1, (-3.0, -3.0, 0.0, 0.0), car(0.1), answer=Present(0.04)))
    mean = rng.uniform((-0.5, -0.3, -0.3, math.log(15.0)), (0.5, 0.3, 0.1, math.log(40.0)))
    motion = MotionBelief.around(tuple(mean), (0.03, 0.04, 0.04, 0.01))
    tracks = Tracks.of([replace(world.memory.tracks.rows()[0], motion=motion)])
    (entity,) = replace(world, memory=replace(world.memory, tracks=tracks)).state.entities
    assert entity.forecast is not None and entity.azimuth_covariance == pytest.approx((9e-4, 0.0, 1.6e-3))
    theta, omega, rho, log_r = rng.multivariate_normal(motion.mean, motion.covariance, 20_000).T
    place, rate = np.exp(log_r + 1j * theta), rho + 1j * omega
    for after_s, (azimuth_rad, std_rad) in entity.forecast.items():
        t = float(after_s)
        shaken = rng.normal(0.0, math.sqrt(2.0 * t**3 / 3.0), (2, len(place)))
        moved = np.angle((place * (1.0 + rate * t) + shaken[0] + 1j * shaken[1]) * np.exp(-1j * azimuth_rad))
        assert np.median(moved) == pytest.approx(0.0, abs=0.1 * std_rad)
        spread = 0.5 * np.diff(np.quantile(moved, [0.159, 0.841]))[0]
        assert std_rad == pytest.approx(spread, rel=0.1)


@pytest.mark.parametrize(("twice", "entities"), [(range(2, 8), 1), (range(1, 40), 2)])
def test_a_double_detection_becomes_one_entity_and_two_cars_stay_two(twice: range, entities: int) -> None:
    boxes = [(car(0.1), car(0.13)) if number in twice else (car(0.13),) for number in range(1, 40)]
    told = (hop(number, (-1.0,) * 4, *seen, answer=Present(0.3)) for number, seen in enumerate(boxes, 1))
    assert len(after(*told).state.entities) == entities


def test_a_relation_has_its_start_and_end() -> None:
    """`occluded_by` holds from the birth to the hand-over and stays listed for five more seconds."""
    loud, quiet, told, world = (6.0, -1.0, 0.0, 0.0), (-4.0, -1.0, 0.0, 0.0), {}, WorldFilter()
    for number, one in enumerate(passing(20, 95, loud, quiet, turns=0.003, hops=95), 1):
        world = WorldFilter.from_dict(world.update(one).to_dict())
        told[number] = {one.kind: (one.since_ns, one.until_ns) for one in world.state.relations}
    (born,) = {kinds["occluded_by"][0] for kinds in told.values() if "occluded_by" in kinds}
    assert told[19]["occluded_by"] == (born, None)
    assert told[20]["occluded_by"] == told[69]["occluded_by"] == (born, 2 * 10**9)
    assert told[94] == {"emerged_from": (2 * 10**9, None)}
    graph = world.predict(0.1).state.graph()
    assert [edge["since_ns"] for _, _, edge in graph.edges(data=True)] == [2 * 10**9]
    assert set(dict(graph.nodes(data="type")).values()) == {"ego", "occluder", "entity"}


@pytest.mark.parametrize("reads", [True, False])
@pytest.mark.parametrize("none", [2.0, 4.0])
def test_a_silent_visible_person_makes_no_hidden_vehicle(reads: bool, none: float) -> None:
    """A silent person is visible for ten seconds."""
    share = reading({"none": 0.5, "seen": 0.2}, rest=0.02).groups[0]
    said = reading({"none": 0.95, "seen": 0.1 / none}, -0.5, rest=0.002, share=share) if reads else None
    person = Sighting(0.1, 0.02, "person", 0.9)
    told = (hop(at, (0.0, 0.0, 0.0, none), person, answer=PRESENT, sequence=said) for at in range(1, 101))
    for world in run(WorldFilter(), told):
        assert not any(cue.advisory for cue in world.state.cues)
    assert max(world.belief.hidden) < 0.05
