"""All values of a snapshot are marginals of one belief: laws over random inputs."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from snapshot_laws import broken_laws

from worldstate import Context, Measurement, Sighting, WorldFilter, WorldState
from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.cueing.cueing_policy import uncalibrated_policy
from worldstate.abduction.cueing.risk_map import PlattMap
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import TOO_FEW, SequenceReading
from worldstate.belief.street_model import StreetModel
from worldstate.ground import LEAST_HEARD
from worldstate.ground.values import NotUsable
from worldstate.measurement import Heard, Look, Odometry, Position, PositionScan
from worldstate.state import Priors

SEEDS = st.integers(0, 2**32 - 1)
SILENT = NotUsable("not scripted")
COMING, SLACK = len(COMING_S), 1e-9
SHARE = 0.9 * np.random.default_rng(0).dirichlet(np.ones(len(GROUPS))) + 0.1 / len(GROUPS)


def reading(rng: np.random.Generator, threshold: float = 0.0) -> SequenceReading:
    groups = 0.999 * rng.dirichlet(np.full(len(GROUPS), 0.2), 2) + 0.001 / len(GROUPS)
    return SequenceReading(groups, SHARE, 0.1, SequenceAlarm(threshold, 20.0))


def hop(rng: np.random.Generator, number: int, *, sequence: bool) -> Measurement:
    """Return a random hop of sound, with a look and boxes near either edge."""
    stamp_ns = number * 10**8
    answer = (Absent(0.04, 0.01), Present(0.04, 0.01), Unqueried("-"))[rng.integers(3)]
    said = SignatureEvidence(("left", "right"), tuple(rng.uniform(-3, 3, 2)), *rng.uniform(-3, 3, 2).tolist())
    sightings = tuple(
        Sighting(float(rng.uniform(-0.6, 0.6)), 0.02, "car", 0.9) for _ in range(rng.integers(0, 3))
    )
    return Measurement(
        stamp_ns, said, answer, SILENT, SILENT,
        sightings if not isinstance(answer, Unqueried) else (),
        look=Look("camera", stamp_ns, answer),
        sequence=reading(rng) if sequence else None,
    )  # fmt: skip


def scan(rng: np.random.Generator, number: int) -> PositionScan:
    """Return a message with a vehicle behind the left or right corner, or in view."""
    side = rng.choice([-1.0, 0.0, 1.0])
    place = (10.0, 30.0 * side - 0.8 * side * number)
    car = Position(
        place, tuple(map(tuple, np.diag([0.5] * 4))), (0.0, -8.0 * side), float(rng.uniform(0.5, 0.99))
    )
    return PositionScan("v2x", number * 10**8 - 10**7, (car,))


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

    The looks of that camera enter the mean that decides; the last one of each hop counts.
    """
    rng, flat = np.random.default_rng(seed), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    # A given prior is not changed by the observed traffic.
    alone = crowded = WorldFilter(Context(priors=Priors(0.2, 0.3, 0.5)))
    near_ns = [0, 0]  # Last time near enough to the threshold that the dynamics may cross it
    for number in range(1, 30):
        said = replace(hop(rng, number, sequence=True), sightings=())
        alone, crowded = alone.update(said), crowded.update(said)
        for k, (mine, its) in enumerate(zip(alone.state.cues, crowded.state.cues, strict=True)):
            assert mine.evidence is not None and its.evidence is not None
            assert its.evidence.compared_nats == pytest.approx(mine.evidence.compared_nats, abs=1e-6)
            near_ns[k] = said.stamp_ns if abs(mine.evidence.compared_nats) < 0.3 else near_ns[k]
            if said.stamp_ns - near_ns[k] > 1_200_000_000:
                assert (its.advisory is None) == (mine.advisory is None)
        for later_ns in sorted(rng.choice([0, *range(10**7, 9 * 10**7, 10**7)], rng.integers(0, 4)).tolist()):
            at_ns = said.stamp_ns + later_ns
            nothing = Measurement(at_ns, flat, Unqueried("-"), SILENT, SILENT, source="second")
            blind = replace(nothing, look=Look("blind", at_ns, Absent(1.0 - 1e-12)))
            extra = (nothing, PositionScan("v2x", at_ns), Odometry("wheels", at_ns, 0.0), blind)
            crowded = crowded.update(extra[rng.integers(4)])


def test_a_denied_alarm_stays_denied_when_the_risk_rises_with_time() -> None:
    """The threshold is below the usual log-odds, so the evidence exceeds it while the risk is below 0.1."""
    groups = np.full((2, len(GROUPS)), 1e-4)
    groups[:, :COMING], groups[:, -1] = 0.06 / COMING, 0.0
    groups[:, -1] = 1.0 - groups.sum(axis=1)
    said = SequenceReading(groups, SHARE, 0.1, SequenceAlarm(-6.0, 20.0))
    heard, world = hop(np.random.default_rng(1), 1, sequence=False), WorldFilter()
    for number in range(1, 8):
        look = replace(heard, stamp_ns=number * 10**8, sightings=(), look=None, co_evidence=Unqueried("-"))
        world = world.update(replace(look, sequence=said))
    before, lifted = world.state, world.predict_to(world.stamp_ns + 9 * 10**8).state
    assert max(cue.risk for cue in before.cues) < 0.1 < min(cue.risk for cue in lifted.cues)
    assert broken_laws(before, None) == broken_laws(lifted, before) == []


@pytest.mark.parametrize("nats", [7.0, 9.0])
def test_the_window_alarm_does_not_depend_on_the_window_rate(nats: float) -> None:
    """After two empty seconds a vehicle comes; only the new part of overlapping windows counts."""
    empty, loud = (SignatureEvidence(("left", "right"), (one, -nats), 0.0, 0.0) for one in (-nats, nats))
    onsets_s = list[float]()
    for rate_hz in (5, 10, 20, 40, 100):
        world, number, named = WorldFilter(), 0, [False]
        while not any(named) and number < 4 * rate_hz:
            stamp_ns = 10**9 + number * 10**9 // rate_hz
            said = empty if number < 2 * rate_hz else loud
            world = world.update(Measurement(stamp_ns, said, Unqueried("-"), SILENT, SILENT))
            named, number = [cue.advisory is not None for cue in world.state.cues], number + 1
        assert named == [True, False]
        onsets_s.append((number - 1) / rate_hz - 2.0)
    assert min(onsets_s) > 0.3 and max(onsets_s) - min(onsets_s) < 0.1 + SLACK


def both_sides(coming: tuple[float, float], other: tuple[float, float], bin_: str) -> SequenceReading:
    """Return a reading with P(coming) of each side and P(coming on the other side only)."""
    groups = np.full((2, len(GROUPS)), 1e-4)
    groups[:, GROUPS.index(bin_)] = coming
    groups[:, GROUPS.index("other")] = other
    groups[:, GROUPS.index("none")] = 1.0 - np.array(coming) - np.array(other)
    return SequenceReading(groups / groups.sum(axis=1, keepdims=True), SHARE, 0.1, SequenceAlarm(0.0, 20.0))


def seen_from_left(said: SequenceReading) -> tuple[WorldState, WorldState]:
    """Return the states before and after a vehicle came into view past the left edge."""
    world, quiet = WorldFilter(), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    for number in range(1, 12):
        answer = Absent(0.04, 0.01) if number < 11 else Present(0.04, 0.01)
        look = Look("camera", number * 10**8, answer)
        boxes = (Sighting(0.53, 0.02, "car", 0.9),) if number == 11 else ()
        before, world = (
            world,
            world.update(
                Measurement(number * 10**8, quiet, answer, SILENT, SILENT, boxes, look=look, sequence=said)
            ),
        )
    return before.state, world.state


def cue_of(state: WorldState, side: str):
    return next(cue for cue in state.cues if cue.direction == side)


def test_a_sighting_removes_a_vehicle_of_unknown_side_from_the_other_side() -> None:
    before, after = seen_from_left(both_sides((0.55, 0.42), (0.42, 0.55), "coming_1s"))
    assert cue_of(before, "right").risk > 0.3
    assert cue_of(after, "right").risk < 0.2
    assert cue_of(before, "left").hypotheses.none < 0.2


def heard_as(*said: SequenceReading, hops: int = 6) -> list[WorldState]:
    """Return the states of some readings, each for some hops, without looks."""
    world, quiet, states = WorldFilter(), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0), []
    for number in range(hops * len(said)):
        reading_ = said[number // hops]
        world = world.update(
            Measurement((number + 1) * 10**8, quiet, Unqueried("-"), SILENT, SILENT, sequence=reading_)
        )
        states.append(world.state)
    return states


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
    left, right = entity.on_each_side()
    assert left.id == entity.id != right.id and right.azimuth_rad < 0.0 < left.azimuth_rad
    assert left.existence_probability + right.existence_probability == pytest.approx(
        entity.existence_probability
    )
    assert WorldState.from_json(state.to_json()) == state


def test_an_entity_that_changes_its_likelier_side_keeps_its_id() -> None:
    *_, before = heard_as(ONE)
    *_, after = heard_as(ONE, OTHER_WAY)
    assert [one.id for one in after.entities] == [one.id for one in before.entities]
    assert [one.direction for one in (*before.entities, *after.entities)] == ["left", "right"]


def test_entities_split_and_merge_with_the_joint_belief() -> None:
    states = heard_as(OTHER_WAY, TWO, ONE)
    one, two, last = (states[hop].entities for hop in (5, 11, 17))
    # The id stays on the side that was likelier at the split.
    assert {entity.direction: entity.id == one[0].id for entity in two} == {"left": False, "right": True}
    assert all(not entity.sides for entity in two)
    assert [entity.id for entity in last] == [one[0].id] and len(last[0].sides) == 2
    (merged,) = (event for state in states for event in state.events if event.kind == "merged")
    assert merged.into == one[0].id


def test_a_split_with_a_change_of_side_makes_two_entities() -> None:
    """The entity, likelier on the left before, becomes the right one; one new entity is born on the left."""
    states = heard_as(ONE, TWO)
    (one,), two = (states[hop].entities for hop in (5, 11))
    assert {entity.direction: entity.id == one.id for entity in two} == {"left": False, "right": True}
    assert len(two) == 2


def test_the_remaining_of_two_entities_keeps_its_id() -> None:
    """Almost no evidence is left on one side, so its entity dies or is merged."""
    states = heard_as(TWO, both_sides((0.9, 0.02), (0.02, 0.9), "coming_2s"))
    before = {one.direction: one.id for one in states[5].entities}
    assert set(before) == {"left", "right"}
    (last,) = states[-1].entities
    assert (last.direction, last.id, last.sides) == ("left", before["left"], ())
    (ended,) = (event for state in states[6:] for event in state.events)
    assert ended.kind in ("died", "merged") and ended.entity_id == before["right"]


@pytest.mark.parametrize("edge_rad", [0.53, -0.53])
def test_an_entity_of_unknown_side_is_handed_over_at_either_edge(edge_rad: float) -> None:
    world, quiet = WorldFilter(), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    near = both_sides((0.55, 0.42), (0.42, 0.55), "coming_0.5s")
    for number in range(1, 9):
        seen = number == 8
        answer = Present(0.04, 0.01) if seen else Absent(0.04, 0.01)
        look = Look("camera", number * 10**8, answer)
        boxes = (Sighting(edge_rad, 0.02, "car", 0.9),) if seen else ()
        before = world.state
        world = world.update(
            Measurement(number * 10**8, quiet, answer, SILENT, SILENT, boxes, look=look, sequence=near)
        )
    (hidden,), (car,) = before.entities, world.state.entities
    assert len(hidden.sides) == 2 and car.sides == () and car.status == "visible"
    assert car.id == hidden.id and car.azimuth_rad == pytest.approx(edge_rad, abs=0.05)
    assert max(cue.risk for cue in world.state.cues) < 0.3
    assert (hidden.azimuth_source, car.azimuth_source) == ("context", "measured")


def test_a_second_hidden_vehicle_stays_when_the_first_is_seen() -> None:
    before, after = seen_from_left(both_sides((0.9, 0.85), (0.04, 0.08), "coming_1s"))
    assert cue_of(after, "right").risk > 0.95 * cue_of(before, "right").risk


def test_a_masked_second_vehicle_keeps_its_existence() -> None:
    """Law 11: while the first vehicle masks the sound, no reading or look lowers the second."""
    world, quiet = WorldFilter(), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    masked = np.full((2, len(GROUPS)), 1e-3)
    masked[:, GROUPS.index("seen")] = 1.0
    alone, before = replace(TWO, groups=masked / masked.sum(axis=1, keepdims=True)), world.state
    for number in range(1, 20):
        answer = Absent(0.04, 0.01) if number < 10 else Present(0.04, 0.01)
        boxes = (Sighting(0.53 - 0.04 * (number - 10), 0.02, "car", 0.9),) if number >= 10 else ()
        said, look = TWO if number < 10 else alone, Look("camera", number * 10**8, answer)
        before = world.state if number == 10 else before
        world = world.update(
            Measurement(number * 10**8, quiet, answer, SILENT, SILENT, boxes, look=look, sequence=said)
        )
    right = {one.direction: one for one in before.entities}["right"]
    now = {one.id: one for one in world.state.entities if one.status == "hidden"}[right.id]
    assert now.existence_probability > 0.95 * right.existence_probability
    assert now.direction == "right"  # The visible vehicle on the left is the other one
    # It was due within two seconds, so it may already be visible.
    assert cue_of(world.state, "right").risk > 0.8 * cue_of(before, "right").risk


def test_the_advisory_ends_with_the_hand_over() -> None:
    before, after = seen_from_left(both_sides((0.97, 0.01), (0.01, 0.97), "coming_0.5s"))
    assert [event.kind for event in after.events] == ["handed_over"]
    assert cue_of(before, "left").advisory is not None and cue_of(after, "left").advisory is None
    # The risk is the share of vehicles that are followed by another.
    assert cue_of(after, "left").risk == pytest.approx(StreetModel().follows, abs=0.03)


def test_an_advisory_ends_without_measurements_and_with_any_hand_over() -> None:
    world, quiet = WorldFilter(), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    far, near = (both_sides((0.8, 0.15), (0.15, 0.8), bin_) for bin_ in ("coming_3s", "coming_0.5s"))
    for number in range(1, 20):
        one = Measurement(number * 10**8, quiet, Unqueried("-"), SILENT, SILENT)
        world = world.update(replace(one, sequence=far if number < 12 else near))
        if number == 11:
            assert cue_of(world.state, "left").advisory is not None
            silent = world.predict(1.5).state
            assert cue_of(silent, "left").risk > 0.3
            assert broken_laws(silent, world.state) == []
    seen = Present(0.04, 0.01)
    look, box = Look("camera", 2_000_000_000, seen), Sighting(-0.53, 0.02, "car", 0.9)
    after = world.update(
        replace(one, stamp_ns=2_000_000_000, co_evidence=seen, look=look, sightings=(box,))
    ).state
    assert [event.kind for event in after.events] == ["handed_over"]
    assert broken_laws(after, world.state) == [] and cue_of(after, "left").advisory is None


def test_a_high_risk_without_an_advisory_has_its_reason() -> None:
    far = both_sides((0.9, 0.02), (0.02, 0.9), "coming_8s")
    world, quiet = WorldFilter(), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    for number in range(1, 6):
        world = world.update(Measurement(number * 10**8, quiet, Unqueried("-"), SILENT, SILENT, sequence=far))
    cue = cue_of(world.state, "left")
    assert cue.risk > 0.7 and cue.advisory is None
    assert cue.not_advised is not None and "three seconds" in cue.not_advised


@given(SEEDS, st.integers(1, 30))
@settings(max_examples=8, deadline=None)
def test_unusable_sound_leaves_the_prior_risk(seed: int, hops: int) -> None:
    """The samples and the risk map of the policy have no effect."""
    rng, policy = np.random.default_rng(seed), replace(uncalibrated_policy(), risk_map=PlattMap(-3.0, 2.0))
    world = first = WorldFilter(policy=policy)
    for number in range(1, hops + 1):
        said = replace(hop(rng, number, sequence=False), sightings=(), heard=Heard(0.0, "no common sound"))
        world = world.update(replace(said, look=None, co_evidence=Unqueried("-")))
    settled = first.predict_to(world.stamp_ns).belief
    assert [cue.risk for cue in world.state.cues] == pytest.approx(settled.risks)
    assert min(settled.risks) > 0.08


@pytest.mark.parametrize("sequence", [False, True])
@given(SEEDS)
@settings(max_examples=5, deadline=None)
def test_an_unusable_hop_equals_a_prediction(sequence: bool, seed: int) -> None:
    rng, world = np.random.default_rng(seed), WorldFilter()
    deaf = Measurement(
        1_500_000_000, SignatureEvidence(("left", "right"), tuple(rng.uniform(-3, 3, 2)), 0.0, 0.0),
        Unqueried("-"), SILENT, SILENT, heard=Heard(0.0, "lost samples"),
        sequence=NotUsable("lost samples") if sequence else None,
    )  # fmt: skip
    for number in range(1, 15):
        world = world.update(hop(rng, number, sequence=sequence))
        at_ns = number * 10**8 + 10**8
        heard, moved = (
            {(entity.id, entity.status) for entity in one.state.entities}
            for one in (world.update(replace(deaf, stamp_ns=at_ns)), world.predict_to(at_ns))
        )
        assert heard <= moved  # No births, and no change of status except by motion
    after, carried = world.update(deaf).state, world.predict_to(1_500_000_000).state
    for told, alone in zip(after.cues, carried.cues, strict=True):
        assert told.risk == pytest.approx(alone.risk, abs=1e-12)
        assert (told.within or {}) == pytest.approx(alone.within or {}, abs=1e-12)
        assert told.hypotheses.hidden == pytest.approx(alone.hypotheses.hidden, abs=1e-12)
        # It does not extend an alarm either.
        ends_ns = [one.advisory and one.advisory.valid_until_ns for one in (told, alone)]
        assert ends_ns[0] == ends_ns[1]
    assert after.heard is not None and not after.calibrated
    assert [(one.share, one.since_ns, one.reason) for one in after.heard] == [
        (0.0, 1_500_000_000, "lost samples")
    ]


@pytest.mark.parametrize("sequence", [False, True])
@pytest.mark.parametrize("lost_s", [3.0, 10.0])
@pytest.mark.parametrize("blocks", ["zeros", "missing"])
def test_without_sound_the_belief_follows_its_dynamics(sequence: bool, lost_s: float, blocks: str) -> None:
    """Existence, risk and azimuth follow the dynamics until sound is usable again."""
    rng, said = np.random.default_rng(1), both_sides((0.97, 0.01), (0.01, 0.97), "coming_8s")
    world, loud = WorldFilter(), SignatureEvidence(("left", "right"), (3.0, 0.0), 0.0, 0.0)
    for number in range(1, 21):
        one = replace(hop(rng, number, sequence=False), signature=loud, co_evidence=Unqueried("-"), look=None)
        world = world.update(replace(one, sightings=(), sequence=said if sequence else None))
    before, hops = world, round(10 * lost_s)
    lost = NotUsable("lost samples") if sequence else None
    for number in range(21, 21 + hops) if blocks == "zeros" else [20 + hops]:
        deaf = Heard(0.0, "lost samples")
        one = Measurement(
            number * 10**8, loud, Unqueried("-"), SILENT, SILENT, heard=deaf,
            sequence=lost if blocks == "zeros" or not sequence else TOO_FEW,
        )  # fmt: skip
        world = world.predict_to(one.stamp_ns).update(one)  # In the order of a listener
    state, carried = world.state, before.predict_to(world.stamp_ns).state
    (now,), (then,) = state.entities, carried.entities
    assert now.id == then.id and now.direction == "left"
    assert now.existence_probability == pytest.approx(then.existence_probability, abs=1e-9)
    assert now.hidden_probability == pytest.approx(then.hidden_probability, abs=1e-9)
    assert now.azimuth_rad == pytest.approx(then.azimuth_rad, abs=0.02)
    assert state.stamp_ns == before.stamp_ns + round(lost_s * 1e9)
    assert 0.1 < now.existence_probability < before.state.entities[0].existence_probability
    for mine, its in zip(state.cues, carried.cues, strict=True):
        assert mine.risk == pytest.approx(its.risk, abs=1e-9)
        assert (mine.within or {}) == pytest.approx(its.within or {}, abs=1e-9)
        assert mine.hypotheses.none == pytest.approx(its.hypotheses.none, abs=1e-9)
        assert mine.advisory is None or mine.advisory.valid_until_ns <= before.stamp_ns + 1_005_000_000


@given(st.floats(0.05, 0.9), st.floats(LEAST_HEARD, 1.0))
@settings(max_examples=10, deadline=None)
def test_absence_counts_only_for_audible_vehicles(chance: float, share: float) -> None:
    """The odds of a coming vehicle fall at most to the probability that it was masked."""
    world, quiet = WorldFilter(), SignatureEvidence(("left", "right"), (-9.0, -9.0), 0.0, 0.0)
    empty = both_sides((1e-6, 1e-6), (1e-6, 1e-6), "coming_3s")
    for number in range(1, 12):
        one = Measurement(number * 10**8, quiet, Unqueried("-"), SILENT, SILENT)
        world, before = (
            world.update(replace(one, sequence=both_sides((chance, 1e-3), (1e-3, chance), "coming_3s"))),
            world,
        )
    before, windy = world.predict_to(1_200_000_000), replace(one, stamp_ns=1_200_000_000, sequence=empty)
    after = world.update(replace(windy, heard=Heard(share, "wind")))
    odds, least = (risk / (1.0 - risk) for risk in (after.belief.risk, before.belief.risk))
    assert (1.0 - share) * least - 1e-6 <= odds <= least


def passing(excess_db: float) -> list[WorldState]:
    """Return the states while a vehicle is visible for two seconds, and for four seconds after."""
    groups = np.full((2, len(GROUPS)), 0.01)
    groups[:, GROUPS.index("none")] = 1.0
    empty = SequenceReading(groups / groups.sum(axis=1, keepdims=True), SHARE, 0.1)
    quiet, world, found = SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0), WorldFilter(), []
    for number in range(1, 60):
        there = number <= 20
        answer = Present(0.04, 0.01) if there else Absent(0.04, 0.01)
        boxes = (Sighting(0.04 * (10 - number), 0.02, "car", 0.9),) if there else ()
        world = world.update(
            Measurement(
                number * 10**8, quiet, answer, SILENT, SILENT, boxes,
                look=Look("camera", number * 10**8, answer), sequence=empty, heard=Heard(excess_db=excess_db),
            )
        )  # fmt: skip
        found.append(world.state)
    return found


def test_a_visible_vehicle_is_reported_as_masking() -> None:
    shares = []
    for excess_db in (6.0, 30.0):
        states = passing(excess_db)
        (beside,), (later,) = states[15].heard or (), states[-1].heard or ()
        assert beside.reason == "masked by a vehicle in view" and beside.since_ns < 10**9
        # The sound is still usable, so the belief follows it and the budget holds.
        assert LEAST_HEARD <= beside.share < 0.75 and states[15].calibrated == states[-1].calibrated
        assert (later.share, later.reason) == (1.0, None)
        shares.append(beside.share)
    assert shares[1] < shares[0]


def test_the_excess_level_of_a_masker_does_not_change_the_belief() -> None:
    for faint, loud in zip(passing(0.0), passing(30.0), strict=True):
        assert [cue.risk for cue in faint.cues] == [cue.risk for cue in loud.cues]
        assert faint.entities == loud.entities


def test_a_silent_source_is_reported() -> None:
    rng, world = np.random.default_rng(0), WorldFilter()
    for number in range(1, 5):
        world = world.update(hop(rng, number, sequence=True))
    assert world.state.heard is not None and [one.sensor for one in world.state.heard] == ["acoustic"]
    silent = world.predict(2.0).state
    assert silent.heard == () and not silent.calibrated
    assert [(one.condition, one.stamp_ns) for one in silent.sensors if one.sensor == "acoustic"] == [
        ("silent", 400_000_000)
    ]


@given(SEEDS)
@settings(max_examples=5, deadline=None)
def test_without_windows_the_hypotheses_stay_at_equilibrium(seed: int) -> None:
    """Without windows the equilibrium stays, whatever the steps."""
    rng, world = np.random.default_rng(seed), WorldFilter(Context())
    start = world.belief.hypotheses
    for step_s in rng.uniform(0.0, 2.0, 10).tolist():
        world = world.predict(step_s)
        assert world.belief.hypotheses == pytest.approx(start, abs=2e-2)
        assert math.isclose(sum(world.belief.hypotheses), 1.0, abs_tol=1e-9)
