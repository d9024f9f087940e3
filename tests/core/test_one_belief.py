"""All values of a snapshot are marginals of one belief: laws over random inputs."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from snapshot_laws import broken_laws
from street_measurements import (
    ABSENT,
    COMING,
    PRESENT,
    SEEDS,
    after,
    car,
    diagonal,
    hop,
    ordinary,
    reading,
    run,
)

from worldstate import Context, Measurement, WorldFilter, WorldState
from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.cueing.cueing_policy import uncalibrated_policy
from worldstate.abduction.cueing.risk_map import PlattMap
from worldstate.abduction.sequence.sequence_model import GROUPS
from worldstate.abduction.sequence.sequence_reader import TOO_FEW, SequenceReading
from worldstate.belief.street_model import StreetModel
from worldstate.ground import LEAST_HEARD
from worldstate.ground.values import NotUsable
from worldstate.measurement import Heard, Look, Odometry, Position, PositionScan
from worldstate.state import Priors

SLACK, QUIET = 1e-9, (0.0, 0.0, 0.0, 0.0)


def scan(rng: np.random.Generator, number: int) -> PositionScan:
    """Return a message with a vehicle behind the left or right corner, or in view."""
    side, trust = float(rng.choice([-1.0, 0.0, 1.0])), float(rng.uniform(0.5, 0.99))
    there = (10.0, 30.0 * side - 0.8 * side * number)
    vehicle = Position(there, diagonal(0.7, 0.7, 0.7, 0.7), (0.0, -8.0 * side), trust)
    return PositionScan("v2x", number * 10**8 - 10**7, (vehicle,))


@pytest.mark.parametrize("sequence", [False, True])
@given(SEEDS)
@settings(max_examples=8, deadline=None)
def test_every_snapshot_obeys_the_laws(sequence: bool, seed: int) -> None:
    rng, before = np.random.default_rng(seed), None
    world = WorldFilter(policy=replace(uncalibrated_policy(), risk_map=PlattMap(-1.7, 0.3)))
    for number in range(1, 25):
        pause_s = float(rng.uniform(0.5, 3.0)) if number == 12 and rng.random() < 0.5 else 0.0
        later = [world.predict(pause_s)] if pause_s else []  # A pause without measurements
        if rng.random() < 0.3:
            world = world.update(scan(rng, number))
        world = world.update(ordinary(rng, number, sequence and rng.random() < 0.9))
        for one in (*later, world, world.predict(float(rng.uniform(0.0, 0.09)))):
            assert broken_laws(one.state, before) == []
            before, risks = one.state, [cue.risk for cue in one.state.cues]
            assert not risks or max(risks) - SLACK <= one.risk <= sum(risks) + SLACK
            for entity in before.entities:
                if entity.sources == ("acoustic",):  # Known by its sound only
                    side = None if entity.sides else ("left", "right").index(entity.direction)
                    assert entity.hidden_probability == pytest.approx(one.belief.hidden_on(side))


@given(SEEDS)
@settings(max_examples=6, deadline=None)
def test_an_alarm_does_not_depend_on_the_measurement_rate(seed: int) -> None:
    """Add empty messages, odometry, a source without evidence and a blind camera at and between hops.

    The looks of that camera enter the compared mean, which uses the last one of each hop.
    """
    rng = np.random.default_rng(seed)
    # A given prior is not changed by the observed traffic.
    alone = crowded = WorldFilter(Context(priors=Priors(0.2, 0.3, 0.5)))
    near_ns = [0, 0]  # Last time near enough to the threshold that the dynamics may cross it
    for number in range(1, 30):
        said = replace(ordinary(rng, number), sightings=())
        alone, crowded = alone.update(said), crowded.update(said)
        for k, (mine, its) in enumerate(zip(alone.state.cues, crowded.state.cues, strict=True)):
            assert mine.evidence is not None and its.evidence is not None
            assert its.evidence.compared_nats == pytest.approx(mine.evidence.compared_nats, abs=1e-6)
            near_ns[k] = said.stamp_ns if abs(mine.evidence.compared_nats) < 0.3 else near_ns[k]
            if said.stamp_ns - near_ns[k] > 1_200_000_000:
                assert (its.advisory is None) == (mine.advisory is None)
        for later_ns in sorted(rng.choice([0, *range(10**7, 9 * 10**7, 10**7)], rng.integers(0, 4)).tolist()):
            at_ns = said.stamp_ns + later_ns
            nothing = replace(hop(number), stamp_ns=at_ns, source="second")
            blind = replace(nothing, look=Look("blind", at_ns, Absent(1.0 - 1e-12)))
            extra = (nothing, PositionScan("v2x", at_ns), Odometry("wheels", at_ns, 0.0), blind)
            crowded = crowded.update(extra[rng.integers(4)])


def test_a_denied_alarm_stays_denied_when_the_risk_rises_with_time() -> None:
    """The threshold is below the usual log-odds, so the evidence exceeds it while the risk is below 0.1."""
    groups = np.append(np.full(COMING, 0.06 / COMING), np.full(len(GROUPS) - COMING, 1e-4))
    groups[-1] = 1.0 - groups[:-1].sum()
    world = after(*(hop(number, QUIET, sequence=reading(groups, -6.0)) for number in range(1, 8)))
    before, lifted = world.state, world.predict_to(world.stamp_ns + 9 * 10**8).state
    assert max(cue.risk for cue in before.cues) < 0.1 < min(cue.risk for cue in lifted.cues)
    assert broken_laws(before, None) == broken_laws(lifted, before) == []


@pytest.mark.parametrize("nats", [7.0, 9.0])
def test_the_window_alarm_does_not_depend_on_the_window_rate(nats: float) -> None:
    """After two empty seconds a vehicle comes; an overlapping window has the weight of its new part."""
    empty, loud, onsets_s = (-nats, -nats, 0.0, 0.0), (nats, -nats, 0.0, 0.0), list[float]()
    for rate_hz in (5, 10, 20, 40, 100):
        world, number, named = WorldFilter(), 0, [False]
        while not any(named) and number < 4 * rate_hz:
            world = world.update(hop(10 + 10 * number / rate_hz, empty if number < 2 * rate_hz else loud))
            named, number = [cue.advisory is not None for cue in world.state.cues], number + 1
        assert named == [True, False]
        onsets_s.append((number - 1) / rate_hz - 2.0)
    assert min(onsets_s) > 0.3 and max(onsets_s) - min(onsets_s) < 0.1 + SLACK


def both_sides(coming: tuple[float, float], other: tuple[float, float], bin_: str) -> SequenceReading:
    """Return a reading with P(coming) of each side and P(coming on the other side only)."""
    none = tuple(1.0 - np.add(coming, other))
    return reading({bin_: coming, "other": other, "none": none}, rest=1e-4)


def looks(said: SequenceReading, hops: int, *azimuths_rad: float) -> Iterator[Measurement]:
    """Yield a reading with empty looks for some hops, then with a box at each azimuth."""
    for number in range(1, hops + len(azimuths_rad) + 1):
        answer, boxes = (ABSENT, ()) if number <= hops else (PRESENT, (car(azimuths_rad[number - hops - 1]),))
        yield hop(number, QUIET, *boxes, answer=answer, sequence=said)


def cue_of(state: WorldState, side: str):
    return next(cue for cue in state.cues if cue.direction == side)


def heard_as(*said: SequenceReading, hops: int = 6) -> list[WorldState]:
    """Return the states of some readings, each for some hops, without looks."""
    told = [hop(number + 1, sequence=said[number // hops]) for number in range(hops * len(said))]
    return [world.state for world in run(WorldFilter(), told)]


ONE = both_sides((0.55, 0.42), (0.42, 0.55), "coming_2s")
OTHER_WAY = both_sides((0.42, 0.55), (0.55, 0.42), "coming_2s")
TWO = both_sides((0.9, 0.95), (0.08, 0.03), "coming_2s")


def test_a_vehicle_of_unknown_side_is_one_entity_with_shares() -> None:
    state = heard_as(ONE)[-1]
    (entity,) = state.entities
    shares = {one.direction: one.probability for one in entity.sides}
    risks = {cue.direction: cue.risk for cue in state.cues}
    assert sum(shares.values()) == pytest.approx(1.0)
    # The difference is the probability that it is already visible.
    assert shares["left"] / shares["right"] == pytest.approx(risks["left"] / risks["right"], rel=0.02)
    assert abs(entity.existence_probability - sum(risks.values())) < 0.03  # P(both) is small
    assert entity.direction == "left" and {cue.entity_id for cue in state.cues} == {entity.id}
    for one in entity.sides:
        assert one.azimuth_rad == pytest.approx(cue_of(state, one.direction).azimuth_rad)
    left, right = parts = entity.on_each_side()
    assert left.id == entity.id != right.id and right.azimuth_rad < 0.0 < left.azimuth_rad
    assert sum(one.existence_probability for one in parts) == pytest.approx(entity.existence_probability)
    assert WorldState.from_json(state.to_json()) == state


def test_an_entity_that_changes_its_likelier_side_keeps_its_id() -> None:
    *_, before = heard_as(ONE)
    *_, after = heard_as(ONE, OTHER_WAY)
    assert [one.id for one in after.entities] == [one.id for one in before.entities]
    assert [one.direction for one in (*before.entities, *after.entities)] == ["left", "right"]


@pytest.mark.parametrize("first", [ONE, OTHER_WAY])
def test_entities_split_and_merge_with_the_joint_belief(first: SequenceReading) -> None:
    """At the split one entity becomes the right one, and a new one is born on the left."""
    states = heard_as(first, TWO, ONE)
    one, two, last = (states[at].entities for at in (5, 11, 17))
    assert {entity.direction: entity.id == one[0].id for entity in two} == {"left": False, "right": True}
    assert len(two) == 2 and not any(entity.sides for entity in two)
    assert [entity.id for entity in last] == [one[0].id] and len(last[0].sides) == 2
    (merged,) = (event for state in states for event in state.events if event.kind == "merged")
    assert merged.into == one[0].id


@pytest.mark.parametrize("edge_rad", [0.53, -0.53])
def test_an_entity_of_unknown_side_is_handed_over_at_either_edge(edge_rad: float) -> None:
    near = both_sides((0.55, 0.42), (0.42, 0.55), "coming_0.5s")
    *_, before, world = run(WorldFilter(), looks(near, 7, edge_rad))
    (hidden,), (seen,) = before.state.entities, world.state.entities
    assert len(hidden.sides) == 2 and seen.sides == () and seen.status == "visible"
    assert seen.id == hidden.id and seen.azimuth_rad == pytest.approx(edge_rad, abs=0.05)
    assert max(cue.risk for cue in world.state.cues) < 0.3
    assert (hidden.azimuth_source, seen.azimuth_source) == ("context", "measured")


def test_a_masked_second_vehicle_keeps_its_existence() -> None:
    """Law 11: while the first vehicle masks the sound, no reading or look lowers the second."""
    before, seen = list(looks(TWO, 9)), list(looks(reading({"seen": 1.0}), 9, *np.arange(0.53, 0.15, -0.04)))
    worlds = run(WorldFilter(), [*before, *seen[9:]])
    before, world = worlds[8].state, worlds[-1]
    right = {one.direction: one for one in before.entities}["right"]
    now = {one.id: one for one in world.state.entities if one.status == "hidden"}[right.id]
    assert now.existence_probability > 0.95 * right.existence_probability
    assert now.direction == "right"  # The visible vehicle on the left is the other one
    # It was due within two seconds, so it may already be visible.
    assert cue_of(world.state, "right").risk > 0.8 * cue_of(before, "right").risk


def test_the_advisory_ends_with_the_hand_over() -> None:
    near = both_sides((0.97, 0.01), (0.01, 0.97), "coming_0.5s")
    before, after = (world.state for world in run(WorldFilter(), looks(near, 10, 0.53))[-2:])
    assert [event.kind for event in after.events] == ["handed_over"]
    assert cue_of(before, "left").advisory is not None and cue_of(after, "left").advisory is None
    # The risk is the share of vehicles that are followed by another.
    assert cue_of(after, "left").risk == pytest.approx(StreetModel().follows, abs=0.03)


def test_an_advisory_ends_without_measurements_and_with_any_hand_over() -> None:
    far, near = (both_sides((0.8, 0.15), (0.15, 0.8), bin_) for bin_ in ("coming_3s", "coming_0.5s"))
    told = [hop(number, sequence=far if number < 12 else near) for number in range(1, 20)]
    worlds = run(WorldFilter(), told)
    heard, silent = worlds[10], worlds[10].predict(1.5).state
    assert cue_of(heard.state, "left").advisory is not None and cue_of(silent, "left").risk > 0.3
    assert broken_laws(silent, heard.state) == []
    seen = worlds[-1].update(hop(20, QUIET, car(-0.53), answer=PRESENT, sequence=near)).state
    assert [event.kind for event in seen.events] == ["handed_over"]
    assert broken_laws(seen, worlds[-1].state) == [] and cue_of(seen, "left").advisory is None


@given(SEEDS, st.integers(1, 30))
@settings(max_examples=8, deadline=None)
def test_unusable_sound_leaves_the_prior_risk(seed: int, hops: int) -> None:
    """The samples and the risk map of the policy have no effect."""
    rng, policy = np.random.default_rng(seed), replace(uncalibrated_policy(), risk_map=PlattMap(-3.0, 2.0))
    world = first = WorldFilter(policy=policy)
    for number in range(1, hops + 1):
        nats = rng.uniform(-3.0, 3.0, 4).tolist()
        world = world.update(hop(number, nats, heard=Heard(0.0, "no common sound")))
    settled = first.predict_to(world.stamp_ns).belief
    assert [cue.risk for cue in world.state.cues] == pytest.approx(settled.risks)
    assert min(settled.risks) > 0.08


@pytest.mark.parametrize("sequence", [False, True])
@given(SEEDS, st.integers(1, 100), st.booleans())
@settings(max_examples=5, deadline=None)
def test_unusable_hops_equal_a_prediction(sequence: bool, seed: int, hops: int, gap: bool) -> None:
    """Of noise for any number of hops, and of the first hop after a gap."""
    rng, world = np.random.default_rng(seed), WorldFilter()
    lost = (TOO_FEW if gap else NotUsable("lost samples")) if sequence else None
    nats = (*rng.uniform(-3, 3, 2), 0.0, 0.0)
    deaf = hop(15, nats, heard=Heard(0.0, "lost samples"), sequence=lost)
    for number in range(1, 15):
        world = world.update(ordinary(rng, number, sequence))
        at_ns = number * 10**8 + 10**8
        heard, moved = (
            {(entity.id, entity.status) for entity in one.state.entities}
            for one in (world.update(replace(deaf, stamp_ns=at_ns)), world.predict_to(at_ns))
        )
        assert heard <= moved  # No births, and no change of status except by motion
    later = [replace(deaf, stamp_ns=number * 10**8) for number in range(15, 15 + hops)]
    carried = world.predict_to(later[-1].stamp_ns).state
    for one in later[-1:] if gap else later:
        world = world.predict_to(one.stamp_ns).update(one)  # In the order of a listener
    last, alive = world.state, {one.id: one for one in carried.entities}
    for entity in (one for one in last.entities if one.sources == ("acoustic",)):
        other = alive[entity.id]
        assert entity.existence_probability == pytest.approx(other.existence_probability, abs=1e-9)
        assert entity.hidden_probability == pytest.approx(other.hidden_probability, abs=1e-9)
        assert entity.azimuth_rad == pytest.approx(other.azimuth_rad, abs=0.02)
    for told, alone in zip(last.cues, carried.cues, strict=True):
        assert told.risk == pytest.approx(alone.risk, abs=1e-12)
        assert (told.within or {}) == pytest.approx(alone.within or {}, abs=1e-12)
        assert told.hypotheses.hidden == pytest.approx(alone.hypotheses.hidden, abs=1e-12)
        # It does not extend an alarm either.
        ends_ns = [one.advisory and one.advisory.valid_until_ns for one in (told, alone)]
        assert ends_ns[0] == ends_ns[1]
    (ear,) = last.heard
    since_ns = later[-1 if gap else 0].stamp_ns
    assert (ear.share, ear.since_ns, ear.reason) == (0.0, since_ns, "lost samples") and not last.calibrated


def passing(excess_db: float) -> list[WorldState]:
    """Return the states while a vehicle is visible for two seconds, and for four seconds after."""
    empty, heard = reading({"none": 1.0}, None, rest=0.01), Heard(excess_db=excess_db)
    boxes = [[car(0.04 * (10 - number))] * (number <= 20) for number in range(1, 60)]
    told = (
        hop(number, QUIET, *one, answer=PRESENT if one else ABSENT, sequence=empty, heard=heard)
        for number, one in enumerate(boxes, 1)
    )
    return [world.state for world in run(WorldFilter(), told)]


def test_a_visible_vehicle_masks_by_its_excess_level_which_does_not_change_the_belief() -> None:
    faint, loud = passing(6.0), passing(30.0)
    for one, other in zip(faint, loud, strict=True):
        assert [cue.risk for cue in one.cues] == [cue.risk for cue in other.cues]
        assert one.entities == other.entities
    for states in (faint, loud):
        (beside,), (later,) = states[15].heard, states[-1].heard
        assert beside.reason == "masked by a vehicle in view" and beside.since_ns < 10**9
        # The sound is still usable, so the budget holds.
        assert LEAST_HEARD <= beside.share < 0.75 and states[15].calibrated == states[-1].calibrated
        assert (later.share, later.reason) == (1.0, None)
    assert loud[15].heard[0].share < faint[15].heard[0].share


def test_a_silent_source_is_reported() -> None:
    rng = np.random.default_rng(0)
    world = after(*(ordinary(rng, number) for number in range(1, 5)))
    assert world.state.heard is not None and [one.sensor for one in world.state.heard] == ["acoustic"]
    silent = world.predict(2.0).state
    assert silent.heard == () and not silent.calibrated
    assert [(one.condition, one.stamp_ns) for one in silent.sensors if one.sensor == "acoustic"] == [
        ("silent", 400_000_000)
    ]
