"""Sequence readings in the filter: laws, alarm and snapshot."""

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import gamma
from street_measurements import (
    ABSENT,
    COMING,
    PRESENT,
    SEEDS,
    SHARE,
    SILENT,
    UNASKED,
    after,
    car,
    drawn_groups,
    hop,
    reading,
    run,
)

from worldstate import Context, Measurement, WorldFilter, WorldState
from worldstate.abduction.co_evidence import Absent, CoEvidence
from worldstate.abduction.cueing.cueing_policy import uncalibrated_policy
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, SequencePosterior
from worldstate.abduction.sequence.sequence_reader import TOO_FEW, SequenceReading
from worldstate.belief.street_model import FilterSettings, StreetModel
from worldstate.belief.track import Tracks, born
from worldstate.commissioning.stream_exam import smoothed_log_odds
from worldstate.core.memory import first_memory
from worldstate.core.site_model import site_geometry_of
from worldstate.core.step import _announced_in_view
from worldstate.core.street_belief import ArrivalRate
from worldstate.ground.values import NotUsable
from worldstate.measurement import Bearing
from worldstate.state import Priors, blind_corner

NOBODY, SURE = (-1.0, -1.0, -1.0, 1.0), (9.0, 0.0, -1.0, -1.0)
# A reading takes effect at once, and every camera works.
WHOLE = StreetModel(reading_s=1e-3, reading_gain=1.0, works=1.0)
EXACT, STREET = FilterSettings(street=WHOLE), StreetModel()


Said = SequenceReading | NotUsable | None


def drawn(rng: np.random.Generator, hops: int, threshold: float | None = None) -> list[SequenceReading]:
    return [reading(one, threshold) for one in drawn_groups(rng, hops, 2)]


def heard(number: float, said: Said, answer: CoEvidence = UNASKED) -> Measurement:
    return hop(number, NOBODY, answer=answer, sequence=said)


def all_heard(said: list[Said], answers: list[CoEvidence] | None = None, first: int = 1) -> list[Measurement]:
    """Return a measurement per reading, in consecutive hops."""
    numbers = range(first, first + len(said))
    return list(map(heard, numbers, said, answers or [UNASKED] * len(said)))


def belief(world: WorldFilter) -> np.ndarray:
    assert world.memory is not None and world.memory.belief.has_times
    return world.memory.belief.coming


@given(SEEDS)
@settings(max_examples=3)
def test_a_sequence_alone_determines_the_belief(seed: int) -> None:
    rng = np.random.default_rng(seed)
    said = drawn(rng, 12)
    numbers = np.cumsum(rng.integers(1, 21, 12))  # A longer pause needs a second measurement
    worlds = run(WorldFilter(settings=EXACT), map(heard, numbers, said))
    for world, one in zip(worlds, said, strict=True):
        comes = one.groups[:, :COMING]
        np.testing.assert_allclose(belief(world)[:, :COMING], comes, rtol=1e-6, atol=1e-9)
        none = 1.0 - comes.sum(axis=1) - one.groups[:, GROUPS.index("other")]
        least, most = 1.0 - comes.sum(), 1.0 - comes.sum(axis=1).max()
        assert world.belief.risk == pytest.approx(1.0 - np.clip(none.mean(), max(least, 0.0), most), abs=1e-8)


@given(SEEDS, st.floats(-0.8, 2.5))
@settings(max_examples=5)
def test_a_context_moves_the_odds_of_a_reading_within_limits(seed: int, nats: float) -> None:
    """The odds of a side move like those from the model's prior to the context's, by -0.5 to 2 nats."""
    said, usual = drawn(np.random.default_rng(seed), 1)[0], SHARE[:COMING].sum()
    odds = usual / (1.0 - usual) * math.exp(nats)
    hidden = 1.0 - (1.0 + odds) ** -2  # Of either side, which are independent
    context = Context(priors=Priors(hidden, 0.0, 1.0 - hidden))
    moved = belief(WorldFilter(context, settings=EXACT).update(heard(1, said)))
    now, read = (
        np.log(one) - np.log1p(-one) for one in (moved.sum(axis=1), said.groups[:, :COMING].sum(axis=1))
    )
    np.testing.assert_allclose(now - read, min(max(nats, -0.5), 2.0), atol=1e-6)


@given(SEEDS)
@settings(max_examples=2)
def test_the_order_of_a_contexts_sides_does_not_matter(seed: int) -> None:
    """Sides are matched by name."""
    rng = np.random.default_rng(seed)
    said, seen = drawn(rng, 10, 0.0), rng.choice([ABSENT, PRESENT, UNASKED], 10).tolist()
    turned = Context(occluders=(blind_corner("right", -1), blind_corner("left", 1)))
    worlds = (run(WorldFilter(context), all_heard(said, seen)) for context in (Context(), turned))
    for one, other in zip(*worlds, strict=True):
        np.testing.assert_allclose(belief(one), belief(other)[::-1], atol=1e-9)
        pairs = zip(one.state.cues, other.state.cues, strict=True)
        assert all((a.direction, a.advisory) == (b.direction, b.advisory) for a, b in pairs)


@given(SEEDS)
@settings(max_examples=3)
def test_sources_with_equal_stamps_commute(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, now = drawn(rng, 2)
    world = run(WorldFilter(), [heard(1, before, PRESENT)])[0]
    pair = [heard(2, now), replace(heard(2, None, ABSENT), source="camera")]
    one, other = run(world, pair)[-1], run(world, pair[::-1])[-1]
    np.testing.assert_allclose(belief(one), belief(other), atol=1e-12)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_alarm_equals_that_of_the_stream_of_beliefs(seed: int) -> None:
    r"""The mean of three hops; the less likely side has at most gamma + log P(here) / P(only elsewhere)."""
    said = drawn(np.random.default_rng(seed), 40, 0.5)
    worlds = run(WorldFilter(settings=EXACT), all_heard(said))
    decided = smoothed_log_odds(SequencePosterior(np.stack([belief(world) for world in worlds]), 0.1))
    for row, world in zip(decided, worlds, strict=True):
        here, less = belief(world).sum(axis=1), int(np.argmin(row))
        only_elsewhere = 1.0 - world.memory.belief.joint.none_comes - here[less]
        row[less] = min(row[less], 0.5 + math.log(here[less] / only_elsewhere))
    over = decided >= 0.5
    # The mean needs three hops, and an earlier alarm is held for a second.
    raised = [[cue.advisory is not None for cue in world.state.cues] for world in worlds]
    # Held for a second, unless the risk falls below 0.1 or the single vehicle changes sides.
    likely = np.array([[cue.risk >= 0.1 for cue in world.state.cues] for world in worlds])
    one_alone = [world.memory.belief.both_come <= 0.5 for world in worlds]
    for side in (0, 1):
        last = -np.inf
        for at in range(40):
            elsewhere = over[at, 1 - side] and not over[at, side] and one_alone[at]
            last = -np.inf if elsewhere or not likely[at, side] else at if over[at, side] else last
            assert at < 13 or raised[at][side] == (at - last <= 10)
    assert all(cue.alpha is None for cue in worlds[-1].state.cues)


def test_the_alarm_is_held_for_a_second_at_any_hop() -> None:
    coming = reading({GROUPS[0]: (1.0, 1e-6), GROUPS[-1]: (1e-6, 1.0)}, 2.0, rest=1e-6)
    # Late, but likely enough to hold the advisory
    over = reading({"coming_8s": 0.2, GROUPS[-1]: 1.0}, 2.0, rest=1e-6)
    world = after(*all_heard([coming] * 4), world=WorldFilter(settings=EXACT))
    for step in (0.5, 1.0, 2.0):
        hops = np.arange(5, 20, step)
        later = run(world, [heard(number, over) for number in hops])
        named = [[cue.direction for cue in one.state.cues if cue.advisory] for one in later]
        off = hops[named.index([])]
        # The mean over 0.3 s falls below the threshold at once if a step spans several hops.
        assert {tuple(one) for one in named} == {("left",), ()} and 14 <= off <= 17
    assert not any(cue.advisory for cue in world.predict(1.2).state.cues)


def test_one_vehicle_is_advised_on_one_side() -> None:
    """In twenty demos a sixth of the advisory hops are on the wrong side (was a quarter)."""
    left = reading({GROUPS[0]: (0.75, 0.2), GROUPS[-1]: (0.25, 0.8)}, -0.5, rest=1e-4)
    right = replace(left, groups=left.groups[::-1])
    worlds = run(WorldFilter(settings=EXACT), all_heard([right] * 6 + [left] * 6, first=0))
    named = [tuple(cue.direction for cue in world.state.cues if cue.advisory) for world in worlds]
    assert named[5] == ("right",) and named[-1] == ("left",)
    assert ("left", "right") not in named


def test_a_hand_over_resets_the_alarm_of_its_side() -> None:
    said = reading({"coming_2s": 1.0}, -2.0)
    sequence = after(*all_heard([said] * 8)).memory.belief
    other = sequence.handed_over({0: 0.02}, (), sequence.stamp_ns, WHOLE)
    assert min(sequence.decided) > -2.0 and other.decided[0] <= -20.0
    assert other.decided[1] == sequence.decided[1] and other.over_ns == (None, sequence.over_ns[1])


def test_the_threshold_is_higher_for_five_seconds_after_a_hand_over() -> None:
    """The sound after a pass resembles another vehicle; half of the single vehicles were announced twice."""
    said = drawn(np.random.default_rng(5), 1, -0.8)[0]
    sequence = after(*all_heard([said] * 8)).memory.belief
    beside = sequence.handed_over({0: 0.02}, (), sequence.stamp_ns, WHOLE)
    stood = [replace(beside, stamp_ns=beside.stamp_ns + after_ns) for after_ns in (0, 49 * 10**8, 51 * 10**8)]
    thresholds = [one.threshold_nats(uncalibrated_policy(), WHOLE) for one in (sequence, *stood)]
    assert thresholds == pytest.approx([-0.8, 0.4, 0.4, -0.8])


def test_an_announced_vehicle_may_emerge_on_either_side() -> None:
    context = Context()
    hidden = born("left", 0, 0.9, 0, site_geometry_of(context, FilterSettings()))
    before, now = (first_memory(context, FilterSettings(), 0) for _ in range(2))
    before.tracks, seen = Tracks.of([hidden]), replace(hidden, seen=True)
    for track, sides in ((hidden, []), (replace(seen, id="another"), []), (replace(seen, side=1), [0])):
        now.tracks = Tracks.of([track])
        assert _announced_in_view(before, now) == sides


def test_without_a_sequence_there_are_no_times() -> None:
    alone = after(*all_heard([None] * 4)).state
    refused = NotUsable("the model was made for a standing ego, this one moves")
    silent = after(*all_heard([refused] * 4)).state
    assert {(cue.within, cue.time_to_visible_s) for cue in alone.cues} == {(None, None)}
    assert (alone.no_sequence, silent.no_sequence) == (None, refused)
    assert WorldState.from_json(silent.to_json()) == silent
    assert replace(silent, no_sequence=None) == alone


def test_the_snapshot_has_times_for_an_expected_vehicle() -> None:
    said = reading({"coming_1.5s": (1.0, 1e-3), GROUPS[-1]: (1e-3, 1.0)})
    state = after(heard(1, said)).state
    left, right = state.cues
    assert left.time_to_visible_s is not None and right.time_to_visible_s is None
    assert left.time_to_visible_s[1] == left.horizon_s == pytest.approx(1.25, abs=0.05)
    assert list(left.within) == ["0.5", "1", "2", "3"] and left.within["1"] < 0.01 < 0.98 < left.within["2"]
    assert WorldState.from_json(state.to_json()) == state


def approach(in_view: float = 0.98) -> list[SequenceReading]:
    """Return readings of a vehicle from the left that comes into view and stays for 2 s.

    `in_view` is P(visible) in the last readings; the rest is none.
    """
    said = []
    for number in range(50):
        sure = 0.98 if number < 30 else in_view
        groups = np.full((2, len(GROUPS)), 1e-5)
        groups[:, GROUPS.index("none")] = 1.0 - sure
        groups[0, np.searchsorted(COMING_S, 3.0 - 0.1 * number) if number < 30 else COMING] = sure
        groups[1, COMING + (number < 30)] = sure
        said.append(reading(groups, 0.0))
    return said


def passed_by(street: StreetModel) -> list[tuple[float, ...]]:
    """Return risks, hypotheses and thresholds while a vehicle comes, is detected and stays audible."""
    world, told = WorldFilter(settings=FilterSettings(street=street)), list[tuple[float, ...]]()
    for number, said in enumerate(approach(in_view=0.8), 1):
        boxes = [car(0.53)] * (number in (31, 32))
        world = world.update(hop(number, NOBODY, *boxes, answer=PRESENT if boxes else ABSENT, sequence=said))
        cues = world.state.cues
        told += [(one.risk, *astuple(one.hypotheses), one.evidence.threshold_nats) for one in cues]
    return told


NUMBERS = """
    passage_s arrival_s far_s leak reading_s reading_gain by_sound look_s works fails_s recovers_s
    unheard side_confusion follows follows_s traffic_like beside_s beside_nats masked_s
"""


@pytest.mark.parametrize("name", NUMBERS.split())
def test_every_number_of_the_street_model_has_an_effect(name: str) -> None:
    changed = replace(STREET, **{name: 0.2 * getattr(STREET, name)})
    assert not np.allclose(passed_by(changed), passed_by(STREET), atol=1e-6)


@pytest.mark.parametrize("kind", ["sequence", "posterior", "likelihood"])
@settings(max_examples=6, deadline=None)
@given(SEEDS)
def test_evidence_is_ignored_for_1_5_s_after_a_hand_over(kind: str, seed: int) -> None:
    """For readings, for windows by posterior and for windows by likelihood."""
    rng, moved = np.random.default_rng(seed), list[bool]()
    said, nats = drawn(rng, 2), rng.uniform(-3.0, 3.0, (2, 4)).tolist()

    def at(number: float, k: int) -> Measurement:
        return hop(number, nats[k], sequence=said[k] if kind == "sequence" else None)

    windows = FilterSettings(windows="likelihood" if kind == "likelihood" else "posterior")
    before = after(*(at(number, 0) for number in range(8)), world=WorldFilter(settings=windows))
    kept = before.memory.belief.handed_over({0: 0.02}, (), before.stamp_ns, STREET)
    masked = replace(before, memory=replace(before.memory, belief=kept), lag=None)
    for after_s in (0.1, 1.2, 1.5):
        number = masked.stamp_ns * 1e-8 + 10 * after_s
        risks = [masked.update(at(number, k)).belief.risks for k in (0, 1)]
        moved.append(not np.allclose(*risks, atol=1e-9))
    assert moved == [False, False, True]


@settings(max_examples=20)
@given(SEEDS, st.floats(0.001, 0.1), st.floats(0.0, 2000.0), st.integers(0, 50))
def test_arrival_rates_are_a_gamma_posterior_with_a_limit(
    seed: int, usual_hz: float, watched_s: float, count: int
) -> None:
    # Oracle: the mean of scipy's gamma distribution with a prior of two arrivals at the usual rate.
    posterior = gamma(2.0 + count, scale=1.0 / (2.0 / usual_hz + watched_s))
    expected = float(np.clip(math.log(posterior.mean() / usual_hz), -0.5, 0.5))
    assert ArrivalRate(float(count), watched_s).shift_nats(usual_hz, STREET) == pytest.approx(
        expected, abs=0.05001
    )


def test_an_empty_street_lowers_the_learned_arrival_rate() -> None:
    readings = drawn(np.random.default_rng(3), 1)
    world = after(*(heard(number, readings[0], Absent(0.04)) for number in range(0, 6000, 4)))
    watched = world.memory.belief
    moved = np.log(watched.groups / watched.usual)
    assert [one.watched_s for one in watched.arrivals] == pytest.approx([553.0] * 2, abs=5.0)
    assert moved[:, 0] - moved[:, -1] == pytest.approx([-0.5, -0.5], abs=1e-9)


@pytest.mark.parametrize("believed", ["left", "right"])
def test_peaks_move_an_unseen_emerged_vehicle(believed: str) -> None:
    """Peaks move an emerged vehicle to its azimuth, whichever side was likelier.

    A vehicle drives from 28 degrees left to 46 degrees right. In the first half second all peaks are
    reflections from the other side, and each peak describes the last second.
    """
    here = {"left": (0.52, 0.43), "right": (0.43, 0.52)}[believed]
    coming = reading({"coming_0.5s": here, "other": here[::-1]})
    readings = [coming, reading({"seen": 1.0})]
    world, azimuths = WorldFilter(settings=EXACT), np.radians(np.linspace(28.0, -46.0, 25))
    for number in range(30):
        bearing: Bearing | NotUsable = SILENT
        if number >= 5:
            late = math.radians(-48.0) if number < 10 else float(azimuths[number - 8])
            bearing = Bearing(late, math.radians(20.0), 3.0)
        world = world.update(replace(heard(number, readings[number >= 5]), bearing=bearing))
        if number >= 24:
            (one,) = world.state.entities
            assert one.status == "emerged"
            assert one.azimuth_rad == pytest.approx(azimuths[number - 5], abs=math.radians(15.0))


def test_an_emerged_vehicle_decays_with_the_passage_time() -> None:
    """The sound ends before the vehicle leaves the view; an empty look ends the entity at once."""
    said = approach()[:45]
    said += [reading({"none": 1.0}, rest=1e-4)] * 40
    world = run(WorldFilter(settings=EXACT), all_heard(said))
    (before,) = world[44].state.entities
    for since_s in (0.5, 1.0, 1.5):
        (now,) = world[44 + round(10 * since_s)].state.entities
        expected = before.existence_probability * math.exp(-since_s / STREET.passage_s)
        assert now.status == "emerged" and now.id == before.id
        assert now.existence_probability == pytest.approx(expected, abs=0.01)
    looked = world[49].update(heard(51, said[51], ABSENT))
    assert not [one for one in looked.state.entities if one.existence_probability > 0.1]


def test_visible_sound_makes_an_entity_without_a_camera() -> None:
    before = reading({"none": 1.0, "coming_0.5s": (0.8, 1e-4)}, rest=1e-4)
    said = [before] * 5 + approach()[35:50]
    for answer, found in ((UNASKED, 1), (ABSENT, 0)):
        world = run(WorldFilter(settings=EXACT), all_heard(said, [UNASKED] * 5 + [answer] * 15, first=0))
        assert not world[4].state.entities and len(world[-1].state.entities) == found


def test_a_tracked_vehicle_stays_one_entity_without_further_looks() -> None:
    """The continuing sound belongs to the tracked vehicle."""
    world, said = WorldFilter(settings=EXACT), approach()
    for number, one in enumerate(said + said[-1:] * 8, 1):
        boxes = [car(0.53 - 0.04 * (number - 31))] * (31 <= number <= 34)
        answer = UNASKED if number > 34 else PRESENT if boxes else ABSENT
        world = world.update(hop(number, NOBODY, *boxes, answer=answer, sequence=one))
        if number == 30:
            (before,) = world.state.entities
        elif number > 30:
            (now,) = world.state.entities
            assert now.id == before.id and now.status != "hidden"


def test_no_window_alarm_before_the_first_sequence() -> None:
    def warned(said: NotUsable | None) -> bool:
        world = after(*(hop(number, SURE, sequence=said) for number in range(1, 9)))
        return any(cue.advisory is not None for cue in world.state.cues)

    assert warned(None) and warned(NotUsable("made for another array"))
    assert not warned(TOO_FEW)


def test_early_windows_raise_no_alarm_of_the_sequence() -> None:
    """Windows give P(hidden), the sequence gives P(visible within three seconds)."""
    said = reading({"coming_8s": 0.4, GROUPS[-1]: 0.6}, -2.0)
    early = [hop(number, SURE, sequence=TOO_FEW) for number in range(1, 9)]
    worlds = run(WorldFilter(), [*early, *(heard(number, said) for number in range(9, 20))])
    assert not any(cue.advisory for world in worlds for cue in world.state.cues)
    assert min(cue.risk for cue in worlds[-1].state.cues) > 0.1
