"""Hypotheses from windows in the joint belief: laws over random inputs, and oracles."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import null_space

from worldstate import Context, FilterSettings, Measurement, NotUsable, SignatureEvidence, WorldFilter
from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.belief.street_model import StreetModel
from worldstate.measurement import Look
from worldstate.state import Priors, Rates, blind_corner

SIDES = ("left", "right", "rear")
CORNERS = (blind_corner("left", 1), blind_corner("right", -1), replace(blind_corner("rear", 1), id="rear"))
UNASKED = Unqueried("-")
# The camera works, and a window takes full effect because the memory is shorter than any step.
AT_ONCE = FilterSettings(street=StreetModel(works=1.0, fails_s=1e6, window_s=1e-3))
nats = st.floats(-5.0, 5.0)
steps_ns = st.integers(5 * 10**7, 2 * 10**9)
chances = st.tuples(*[st.floats(0.05, 1.0)] * 3).map(lambda one: tuple(np.array(one) / sum(one)))
answers = st.one_of(
    st.builds(Absent, st.floats(0.0, 1.0), st.floats(0.0, 0.5)),
    st.builds(Present, st.floats(0.0, 1.0), st.floats(0.001, 0.5)),
    st.just(UNASKED),
)


def window(stamp_ns: int, values: tuple[float, ...], answer: CoEvidence = UNASKED) -> Measurement:
    """Return a window with log-likelihoods of hidden by side, visible and none, and a look."""
    *hidden, visible, none = values
    heard = SignatureEvidence(SIDES[: len(hidden)], tuple(hidden), visible, none)
    look = None if isinstance(answer, Unqueried) else Look("camera", stamp_ns, answer)
    return Measurement(stamp_ns, heard, answer, NotUsable("-"), NotUsable("-"), look=look)


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
        stamp_ns += data.draw(steps_ns)
        values = data.draw(st.tuples(*[st.floats(-4.0, 4.0)] * (k + 2)).filter(lambda one: np.ptp(one) > 0.0))
        world = world.update(window(stamp_ns, values))
        assert world.belief.hypotheses == pytest.approx(tuple(eq_6(priors, values)), abs=1e-6)
        if k == 1:
            assert world.belief.hidden[0] == pytest.approx(world.belief.hypotheses[0])


@pytest.mark.parametrize("k", [1, 2, 3])
@given(st.data())
@settings(max_examples=6, deadline=None)
def test_hypotheses_sum_to_one_and_stay_finite(k: int, data: st.DataObject) -> None:
    world, stamp_ns = street(k), 0
    for _ in range(4):
        stamp_ns += data.draw(steps_ns)
        values = data.draw(st.tuples(*[st.floats(-1000.0, 1000.0)] * (k + 2)))
        world = world.update(window(stamp_ns, values, data.draw(answers)))
        belief = world.belief
        every = np.array([*belief.hypotheses, *belief.hidden, *belief.emerged, belief.both])
        assert np.isfinite(every).all() and (every >= 0.0).all() and (every <= 1.0 + 1e-9).all()
        assert sum(belief.hypotheses) == pytest.approx(1.0, abs=1e-9)
        assert max(belief.hidden) - 1e-9 <= belief.hypotheses[0] <= sum(belief.hidden) + 1e-9


@given(st.tuples(nats, nats, nats, nats))
@settings(max_examples=20, deadline=None)
def test_a_blind_camera_changes_nothing_and_a_perfect_one_excludes_visible(
    values: tuple[float, float, float, float],
) -> None:
    """Law 2 for miss rates of one and zero."""
    unasked, blind, perfect = (
        street(2).update(window(10**9, values, answer)).belief
        for answer in (UNASKED, Absent(1.0), Absent(0.0))
    )
    assert blind.hypotheses == pytest.approx(unasked.hypotheses, abs=1e-9)
    assert blind.hidden == pytest.approx(unasked.hidden, abs=1e-9)
    assert perfect.hypotheses[1] < 1e-6


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


def test_an_emerged_vehicle_keeps_its_side() -> None:
    """A hidden vehicle that becomes visible keeps its side of origin."""
    world = WorldFilter()
    for hop in range(1, 61):
        heard = (5.0, 0.0, 0.0, 0.0) if hop <= 30 else (0.0, 0.0, 5.0, 0.0)
        world = world.update(window(hop * 10**8, heard))
    assert world.belief.hypotheses[1] > 0.8
    assert world.belief.emerged[0] > 5.0 * world.belief.emerged[1]
