"""The joint belief of all sides against enumeration, and windows in it: eq. (6), overlap, memory."""

import itertools
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import null_space
from street_measurements import COMING, SEEDS, after, drawn_groups, hop

from worldstate import Context, FilterSettings, WorldFilter
from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.sequence.sequence_model import GROUPS
from worldstate.belief.joint_belief import (
    FIRST_BIN,
    NONE,
    PARTS,
    STATES,
    JointBelief,
    SidePrior,
    StreetPrior,
    chains,
    joint_reading,
)
from worldstate.belief.street_model import StreetModel
from worldstate.ground import FloatArray
from worldstate.measurement import Heard
from worldstate.state import Priors, Rates, blind_corner

STREET = StreetModel()
ALONE = StreetModel(follows=1e-12)  # No vehicle follows directly behind another
CERTAIN = replace(STREET, works=1.0)  # The camera works
FIRST_STATE = 2 * FIRST_BIN  # A part without and with a visible vehicle


def prior_of(rng: np.random.Generator, sides: int) -> StreetPrior:
    return StreetPrior.of(drawn_groups(rng, sides, least=0.01), STREET)


def likelihoods(rng: np.random.Generator, sides: int) -> FloatArray:
    return np.asarray(rng.uniform(0.05, 1.0, (*[PARTS] * sides, 2)))


def product(prior: StreetPrior, weights: FloatArray, step_ns: int) -> FloatArray:
    """Return a distribution a step later by one matrix over all states together."""
    chain = np.ones((1, 1))
    for one in chains(prior, STREET, step_ns):
        chain = np.kron(chain, one)
    return (weights.ravel() @ chain).reshape(weights.shape)


def part_of(states: tuple[int, ...]) -> tuple[int, ...]:
    seen = states[-1] == 1 or any(state % 2 for state in states[:-1])
    return (*(state // 2 for state in states[:-1]), int(seen))


def every_state(sides: int) -> list[tuple[int, ...]]:
    return list(itertools.product(*[range(STATES)] * sides, range(2)))


@pytest.mark.parametrize("sides", [1, 2])
@given(SEEDS)
@settings(max_examples=3, deadline=None)
def test_the_belief_equals_enumeration_of_all_states(sides: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior = prior_of(rng, sides)
    belief, by_hand = JointBelief(prior.weights), prior.weights
    for step_ns in rng.integers(5 * 10**7, 2 * 10**9, 3).tolist():
        told = likelihoods(rng, sides)
        belief = belief.carried(prior, STREET, step_ns).told(told)
        by_hand = product(prior, by_hand, step_ns)
        for states in every_state(sides):
            by_hand[states] *= told[part_of(states)]
        by_hand /= by_hand.sum()
    np.testing.assert_allclose(belief.weights, by_hand, atol=1e-12)
    hidden, visible, none = belief.explanations
    parts = {part_of(states): 0.0 for states in every_state(sides)}
    for states in every_state(sides):
        parts[part_of(states)] += by_hand[states]
    assert visible == pytest.approx(parts[(*[NONE] * sides, 1)], abs=1e-12)
    assert none == pytest.approx(parts[(*[NONE] * sides, 0)], abs=1e-12)
    assert hidden + visible + none == pytest.approx(1.0, abs=1e-12)


@given(SEEDS)
@settings(max_examples=2, deadline=None)
def test_three_sides_have_the_marginals_of_an_explicit_sum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior, told = prior_of(rng, 3), likelihoods(rng, 3)
    belief = JointBelief(prior.weights).told(told).carried(prior, STREET, 3 * 10**8)
    before = JointBelief(prior.weights).told(told).weights
    by_hand = np.einsum("abce,ai,bj,ck,em->ijkm", before, *chains(prior, STREET, 3 * 10**8), optimize=True)
    for k in range(3):
        own = np.moveaxis(by_hand, k, 0).reshape(PARTS, 2, -1)
        np.testing.assert_allclose(belief.hidden[k], own.sum(axis=(1, 2)), atol=1e-12)
        assert belief.emerged_from[k] == pytest.approx(own[:FIRST_BIN, 1].sum(), abs=1e-12)
    nobody = by_hand[:FIRST_STATE, :FIRST_STATE, :FIRST_STATE].sum()
    assert belief.none_comes == pytest.approx(nobody, abs=1e-12)


@given(SEEDS, st.sampled_from([1, 2]))
def test_a_distant_vehicle_on_several_sides_counts_once(seed: int, sides: int) -> None:
    """A sum over the sides would contain a distant vehicle several times.

    If no vehicle comes, the hypotheses are the groups of the reading.
    """
    rng = np.random.default_rng(seed)
    seen, far = 0.5 * rng.random(), 0.5 * rng.random(sides)
    groups = np.full((sides, len(GROUPS)), 1e-12)
    groups[:, GROUPS.index("seen")], groups[:, GROUPS.index("rising")] = seen, far
    groups[:, GROUPS.index("none")] = 1.0 - seen - far
    joint = joint_reading(groups / groups.sum(axis=1, keepdims=True), 0.2, STREET.by_sound)
    nothing, in_view = joint[(*[NONE] * sides, 0)], joint[(*[NONE] * sides, 1)]
    assert nothing == pytest.approx(1.0 - seen - far.max(), abs=1e-9)
    assert in_view == pytest.approx(seen, abs=1e-9)
    for k in range(sides):
        others = tuple(j for j in range(sides + 1) if j != k)
        assert joint.sum(axis=others)[NONE + 1] == pytest.approx(far[k], abs=1e-9)


@given(SEEDS)
@settings(max_examples=3, deadline=None)
def test_readings_of_the_same_chain_give_the_exact_filter(seed: int) -> None:
    """A reading is the posterior of the sound alone; other evidence keeps its full effect."""
    rng = np.random.default_rng(seed)
    prior = prior_of(rng, 2)
    belief = sound = exact = JointBelief(prior.weights)
    for step_ns in rng.integers(5 * 10**7, 10**9, 5).tolist():
        heard, message = likelihoods(rng, 2), likelihoods(rng, 2)
        belief, sound, exact = (one.carried(prior, STREET, step_ns) for one in (belief, sound, exact))
        sound, exact = sound.told(heard), exact.told(heard).told(message)
        belief = belief.read("ear", sound.by_part, prior, (0, 1)).told(message)
        np.testing.assert_allclose(belief.weights, exact.weights, atol=1e-9)


def read_often(looks_ns: list[int], street: StreetModel, miss: float = 0.05) -> JointBelief:
    """Return the belief after empty looks and a constant reading: visible 0.8, coming 0.15."""
    groups = np.full((1, len(GROUPS)), 1e-9)
    groups[0, [GROUPS.index("seen"), GROUPS.index("coming_2s"), GROUPS.index("none")]] = 0.8, 0.15, 0.05
    # There is one side; visible and coming exclude each other.
    reading = np.zeros((PARTS, 2))
    reading[NONE], reading[FIRST_BIN + 3, 0] = (0.05, 0.8), 0.15
    reading = np.maximum(reading, 1e-12) / reading.sum()
    prior = StreetPrior((SidePrior.of(groups[0], 0.3, street),), 0.1)
    belief = JointBelief(prior.weights).read("ear", reading, prior, (0,))
    for stamp_ns in looks_ns:
        belief = belief.looked("camera", Absent(miss, 0.0), stamp_ns, street)
    return belief


@given(st.integers(1, 6), st.floats(0.01, 0.6))
@settings(max_examples=20, deadline=None)
def test_empty_looks_a_correlation_time_apart_count_in_full(count: int, miss: float) -> None:
    """Law 15 with a working camera: the odds of a visible vehicle are eq. (6) with beta^n."""
    belief = read_often([k * 3 * 10**8 for k in range(count)], CERTAIN, miss)
    assert belief.in_view / (1.0 - belief.in_view) == pytest.approx(4.0 * miss**count, rel=1e-6)


def test_a_second_of_empty_looks_excludes_a_visible_vehicle() -> None:
    after, within = (read_often([k * step_ns for k in range(10)], CERTAIN) for step_ns in (10**8, 10**7))
    assert 0.0001 <= after.in_view <= 0.0004
    assert within.in_view == pytest.approx(0.8 * 0.05 / (0.8 * 0.05 + 0.2), rel=1e-6)


def test_empty_looks_saturate_at_the_probability_of_a_dead_camera() -> None:
    last = read_often([k * 3 * 10**8 for k in range(200)], STREET)
    assert last.in_view / (1.0 - last.in_view) == pytest.approx(4.0 * (1.0 - STREET.works), rel=0.05)
    works = last.trust["camera"].works
    assert works.sum() > 0.9 and 1.0 - works.sum() >= 0.9 * last.in_view


@given(SEEDS)
@settings(max_examples=5, deadline=None)
def test_a_hand_over_removes_an_unknown_side_but_not_a_second_vehicle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior = prior_of(rng, 2)
    one, two = np.full((PARTS, PARTS, 2), 1e-6), np.full((PARTS, PARTS, 2), 1e-6)
    one[FIRST_BIN, NONE, 0] = one[NONE, FIRST_BIN, 0] = 0.5
    two[FIRST_BIN, FIRST_BIN + 1, 0] = 1.0
    # The remaining probability is that of an unheard vehicle.
    for reading, left in ((one, 1.2 * STREET.unheard), (two, 0.95)):
        before = JointBelief(prior.weights).read("ear", reading / reading.sum(), prior, (0, 1))
        after = before.emerged(0, 0.02, False, ALONE)
        assert after.emerged_from[0] > 0.9
        assert (after.hidden[1, FIRST_BIN:].sum() < left) == (reading is one)
        kept = before.emerged(0, 0.02, True, ALONE)
        np.testing.assert_allclose(kept.hidden[1], before.hidden[1], atol=1e-9)


@pytest.mark.parametrize("sides", [2, 3])
@given(st.integers(0, COMING - 1))
@settings(max_examples=9, deadline=None)
def test_a_sighting_on_the_other_side_is_rarely_a_second_vehicle(sides: int, bin_: int) -> None:
    """Evidence of side 1 and a sighting on side 0 leave a hidden vehicle with odds (1 - c) p_u to c."""
    weights = np.zeros((*[STATES] * sides, 2))
    weights[(2 * NONE, 2 * (FIRST_BIN + bin_), *[2 * NONE] * (sides - 2), 0)] = 1.0
    after = JointBelief(weights).emerged(0, 0.0, False, ALONE)
    confused = STREET.side_confusion / (sides - 1)  # Confused with one of the other sides
    two = (1.0 - confused) * STREET.unheard
    assert after.hidden[1, FIRST_BIN:].sum() == pytest.approx(two / (confused + two))
    assert after.emerged_from[0] == pytest.approx(1.0)
    apart = JointBelief(weights).emerged(0, 0.0, True, ALONE)
    assert apart.hidden[1, FIRST_BIN:].sum() == pytest.approx(1.0)


CORNERS = (blind_corner("left", 1), blind_corner("right", -1), replace(blind_corner("rear", 1), id="rear"))
# The camera works, and a window takes full effect because the memory is shorter than any step.
AT_ONCE = FilterSettings(street=StreetModel(works=1.0, fails_s=1e6, window_s=1e-3))
pauses_ns = st.integers(5 * 10**7, 2 * 10**9)
chances = st.tuples(*[st.floats(0.05, 1.0)] * 3).map(lambda one: tuple(np.array(one) / sum(one)))
PRIORS = Priors(0.3, 0.3, 0.4)
# The steps are so short that the dynamics change nothing and only the evidence acts.
MEMORY_NS = 10_000
SETTINGS = FilterSettings(window_s=MEMORY_NS / 1e9, street=StreetModel(window_s=MEMORY_NS / 1e9))
FLAT = (0.0, 0.0, 0.0, 0.0)
signatures = st.tuples(*[st.floats(-4.0, 4.0)] * 4)
steps_ns = st.integers(0, 3 * MEMORY_NS)
windows = st.lists(st.tuples(st.just(FLAT) | signatures, steps_ns, st.booleans()), min_size=1, max_size=8)


def street(k: int, **options: Priors | Rates | None) -> WorldFilter:
    return WorldFilter(Context(occluders=CORNERS[:k], **options), settings=AT_ONCE)


def eq_6(priors: tuple[float, ...], values: tuple[float, ...]) -> np.ndarray:
    """Return the posteriors of eq. (6) by sums over subsets of sides, which are independent."""
    *hidden, visible, none = np.exp(np.array(values) - max(values))
    k, (p_hidden, p_visible, p_none) = len(hidden), priors
    each, total = 1.0 - (1.0 - p_hidden) ** (1.0 / k), 0.0
    for subset in range(1, 2**k):
        comes = [one for j, one in enumerate(hidden) if subset >> j & 1]
        total += each ** len(comes) * (1.0 - each) ** (k - len(comes)) * float(np.mean(comes))
    weights = np.array([total, p_visible * visible, p_none * none])
    return weights / weights.sum()


@pytest.mark.parametrize("k", [1, 2, 3])
@given(chances, st.data())
@settings(max_examples=8, deadline=None)
def test_a_window_gives_eq_6_after_any_past(
    k: int, priors: tuple[float, float, float], data: st.DataObject
) -> None:
    world, stamp_ns = street(k, priors=Priors(*priors)), 0
    for _ in range(3):
        stamp_ns += data.draw(pauses_ns)
        values = data.draw(st.tuples(*[st.floats(-4.0, 4.0)] * (k + 2)).filter(lambda one: np.ptp(one) > 0.0))
        world = world.update(hop(stamp_ns / 1e8, values))
        assert world.belief.hypotheses == pytest.approx(tuple(eq_6(priors, values)), abs=1e-6)
        if k == 1:
            assert world.belief.hidden[0] == pytest.approx(world.belief.hypotheses[0])


@given(st.tuples(*[st.floats(0.01, 3.0)] * 6), st.sampled_from([1, 2, 3]))
@settings(deadline=None)
def test_the_prior_of_rates_is_their_equilibrium(rates: tuple[float, ...], k: int) -> None:
    """Oracle: the null space of the generator of hidden, visible, none."""
    arrival, emergence, departure, reocclusion, visible_arrival, visible_departure = rates
    flow = np.array(
        [
            [-(emergence + departure), emergence, departure],
            [reocclusion, -(reocclusion + visible_departure), visible_departure],
            [k * arrival, visible_arrival, -(k * arrival + visible_arrival)],
        ]
    )
    settled = null_space(flow.T)[:, 0] / null_space(flow.T).sum()
    np.testing.assert_allclose(astuple(Rates(*rates).priors(k)), settled, atol=1e-9)
    assert street(k, rates=Rates(*rates)).belief.hypotheses == pytest.approx(settled, abs=1e-6)


def heard(stamp_ns, signature, source="acoustic", usable=True):
    return hop(stamp_ns / 1e8, signature, source=source, heard=Heard() if usable else Heard(0.0, "wind"))


def believed(measurements, settings=SETTINGS):
    world = after(*measurements, world=WorldFilter(context=Context(priors=PRIORS), settings=settings))
    return np.array([*world.belief.hidden, *world.belief.hypotheses])


def by_hand(weighted):
    """Eq. (6) with likelihoods raised to weights; two hidden vehicles have the mean of both likelihoods.

    Evidence against a visible vehicle also counts against one beside a hidden vehicle.
    """
    chance, seen = 1.0 - np.sqrt(1.0 - PRIORS.hidden), PRIORS.visible / (1.0 - PRIORS.hidden)
    one = chance * (1.0 - chance)
    sides = np.array([one, one, chance**2])
    explanations = np.log([*((1.0 - seen) * sides), *(seen * sides), PRIORS.visible, PRIORS.none])
    for (left, right, visible, none), weight in weighted:
        denied = min(visible - none, 0.0)
        hidden = np.array([left, right, np.logaddexp(left, right) - np.log(2.0)])
        hidden -= np.log(1.0 - seen + seen * np.exp(denied))
        explanations += weight * np.array([*hidden, *(hidden + denied), visible, none])
    chances = np.exp(explanations - np.logaddexp.reduce(explanations))
    left, right, both = chances[:3] + chances[3:6]
    return np.array([left + both, right + both, left + right + both, *chances[6:]])


@given(windows)
def test_only_the_new_part_of_a_window_counts(told):
    """Log-likelihoods are averaged over the memory.

    A window without information, or of unusable sound, has no weight.
    """
    stamp_ns, since_ns, measurements, weighted = 10**9, None, [], []
    for signature, step_ns, usable in told:
        stamp_ns += step_ns
        measurements.append(heard(stamp_ns, signature, usable=usable))
        is_first = stamp_ns not in [one.stamp_ns for one in measurements[:-1]]
        if usable and np.ptp(signature) and is_first:
            new = 1.0 if since_ns is None else -np.expm1(-(stamp_ns - since_ns) / MEMORY_NS)
            weighted = [(one, (1.0 - new) * weight) for one, weight in weighted] + [(signature, new)]
            since_ns = stamp_ns
    assert believed(measurements) == pytest.approx(by_hand(weighted), abs=1e-4)


@given(signatures, signatures, st.integers(1, 10))
def test_windows_of_another_modality_count_in_full(sound, radar, hops):
    stamps_ns = [10**9 + at * MEMORY_NS // 20 for at in range(hops)]
    told = [one for ns in stamps_ns for one in (heard(ns, sound), heard(ns, radar, "radar"))]
    assert believed(told) == pytest.approx(by_hand([(sound, 1.0), (radar, 1.0)]), abs=1e-4)


@given(signatures, st.integers(1, 20), st.integers(1, 3 * MEMORY_NS))
def test_consecutive_windows_count_each_if_multiplied_as_likelihoods(signature, hops, step_ns):
    times = 1.0 + (hops - 1) * min(step_ns / MEMORY_NS, 1.0)
    told = [heard(10**9 + at * step_ns, signature) for at in range(hops)]
    got = believed(told, replace(SETTINGS, windows="likelihood"))
    assert got == pytest.approx(by_hand([(signature, times)]), abs=1e-4)
