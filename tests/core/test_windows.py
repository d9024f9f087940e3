"""Windows in the joint belief: eq. (6), and overlapping windows of one source as one piece of evidence."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import null_space
from street_measurements import after, hop

from worldstate import Context, FilterSettings, WorldFilter
from worldstate.belief.street_model import StreetModel
from worldstate.measurement import Heard
from worldstate.state import Priors, Rates, blind_corner

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
    settled = null_space(flow.T)[:, 0]
    priors = Rates(*rates).priors(k)
    np.testing.assert_allclose(
        [priors.hidden, priors.visible, priors.none], settled / settled.sum(), atol=1e-9
    )
    assert street(k, rates=Rates(*rates)).belief.hypotheses == pytest.approx(
        settled / settled.sum(), abs=1e-6
    )


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

    A window without information or of unusable sound does not count.
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
    told = [
        heard(10**9 + at * MEMORY_NS // 20, *one)
        for at in range(hops)
        for one in ((sound, "acoustic"), (radar, "radar"))
    ]
    assert believed(told) == pytest.approx(by_hand([(sound, 1.0), (radar, 1.0)]), abs=1e-4)


@given(signatures, st.integers(1, 20), st.integers(1, 3 * MEMORY_NS))
def test_consecutive_windows_count_each_if_multiplied_as_likelihoods(signature, hops, step_ns):
    times = 1.0 + (hops - 1) * min(step_ns / MEMORY_NS, 1.0)
    told = [heard(10**9 + at * step_ns, signature) for at in range(hops)]
    got = believed(told, replace(SETTINGS, windows="likelihood"))
    assert got == pytest.approx(by_hand([(signature, times)]), abs=1e-4)
