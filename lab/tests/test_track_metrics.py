"""GOSPA, gated bearings and time to visible against closed forms, brute force and laws."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from worldstate_lab.metrics.track_measures import PUBLISHED_COVERAGE, gated_median_deg, gospa_bearing

from worldstate.commissioning.stream_exam import visible_errors
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import wrap_angle
from worldstate.operations.recordings.hop_table import HopTable

few = settings(max_examples=40)
bearings = st.lists(st.floats(-4, 4), max_size=4)


def brute_gospa(estimates, truths, cutoff):
    """Return the GOSPA by trying every assignment of the smaller set to the larger, each pair cut off."""
    fewer, more = sorted((list(estimates), list(truths)), key=len)
    ways = permutations(more, len(fewer))
    costs = [
        sum(min(abs(np.angle(np.exp(1j * (a - b)))), cutoff) for a, b in zip(fewer, way, strict=True))
        for way in ways
    ]
    return min(costs) + cutoff / 2 * (len(more) - len(fewer))


@given(bearings, bearings, st.floats(0.1, 2.0))
@few
def test_gospa_is_the_cheapest_of_all_assignments(estimates, truths, cutoff):
    errors = np.abs(np.angle(np.exp(1j * np.subtract.outer(estimates, truths))))
    # At the cut-off a pair costs as much as a miss and a false estimate, so round-off would decide.
    assume((np.abs(errors - cutoff) > 1e-9).all())
    one = gospa_bearing(estimates, truths, cutoff)
    assert one.total_rad == pytest.approx(brute_gospa(estimates, truths, cutoff), abs=1e-9)
    back = gospa_bearing(truths, estimates, cutoff)
    assert back.total_rad == pytest.approx(one.total_rad)
    assert (back.missed, back.false) == pytest.approx((one.false, one.missed))
    mirrored = gospa_bearing(-np.array(estimates), -np.array(truths), cutoff)
    assert mirrored.total_rad == pytest.approx(one.total_rad)


@given(st.integers(0, 2**32), st.integers(1, 4), st.integers(1, 4))
@few
def test_gospa_is_stone_soups(seed, said, there):
    why = "Stone Soup is the oracle: pip install 'worldstate[oracles]'"
    metrics = pytest.importorskip("stonesoup.metricgenerator.ospametric", reason=why)
    from stonesoup.types.state import State

    rng, cutoff = np.random.default_rng(seed), np.radians(60.0)
    estimates, truths = (rng.uniform(-3.5, 3.5, n) for n in (said, there))

    def apart(one, other):
        return abs(float(wrap_angle(float(one.state_vector[0] - other.state_vector[0]))))

    peer = metrics.GOSPAMetric(p=1.0, c=cutoff, measure=apart)
    found, _ = peer.compute_gospa_metric([State([a]) for a in estimates], [State([a]) for a in truths])
    one = gospa_bearing(estimates, truths, cutoff)
    parts = (found.value[name] for name in ("distance", "localisation", "missed", "false"))
    assert (one.total_rad, one.localisation, one.missed, one.false) == pytest.approx(tuple(parts), abs=1e-9)


@given(bearings, bearings, bearings)
@few
def test_gospa_is_a_metric(a, b, c):
    straight, detour = gospa_bearing(a, c), gospa_bearing(a, b).total_rad + gospa_bearing(b, c).total_rad
    assert straight.total_rad <= detour + 1e-9
    assert gospa_bearing(a, a).total_rad == pytest.approx(0.0, abs=1e-9)


@given(st.lists(st.floats(0, 20), min_size=1, max_size=25), st.integers(0, 2**32))
@few
def test_no_constant_beats_the_printed_constants(true, seed):
    true = np.array(true)
    spread = np.random.default_rng(seed).uniform(0, 3, (true.size, 3)) * [-1, 0, 1]
    errors = visible_errors(7.0 + spread, true)
    assert errors.rmse_s >= errors.constant_rmse_s - 1e-9
    every = np.sqrt(np.square(true - np.linspace(0, 20, 2001)[:, None]).mean(axis=1))
    assert errors.constant_rmse_s == pytest.approx(every.min(), abs=0.01)


def test_errors_of_stated_times_in_closed_form():
    true = np.array([1.0, 2.0, 3.0, np.nan, 5.0])
    stated = np.array([[0, 1, 2], [2, 3, 4], [0, 1, 2], [0, 1, 2], [0, np.nan, 2]], dtype=float)
    errors = visible_errors(stated, true)
    assert (errors.count, errors.rmse_s) == (3, pytest.approx((5 / 3) ** 0.5))
    assert (errors.coverage, errors.width_s) == pytest.approx((2 / 3, 2.0))
    # A method may give a time without an interval, like a cue: its error counts, its coverage does not.
    stated[0, 0] = stated[1, 2] = np.nan
    alone = visible_errors(stated, true)
    assert (alone.count, alone.intervals, alone.rmse_s) == (3, 1, errors.rmse_s)
    assert alone.coverage == 0.0
    with pytest.raises(InvalidArgumentError, match="stated"):
        visible_errors(np.zeros((2, 2)), np.zeros(2))


PAIRS = st.lists(
    st.tuples(st.sampled_from([1.0, 1.1, 1.4, 2.0, 3.5]), st.floats(-7, 7)), min_size=1, max_size=40
)


@given(pairs=PAIRS, unseen=st.integers(0, 5))
@few
def test_the_gated_error_is_that_of_the_highest_prominence_with_enough_bearings(pairs, unseen):
    prominence, error = np.array(pairs).T
    enough = max(one for one in prominence if (prominence >= one).mean() >= PUBLISHED_COVERAGE)
    expected = np.median(np.abs(np.angle(np.exp(1j * error)))[prominence >= enough])
    checks = {"prominence": np.append(prominence, np.full(unseen, 9.0))}
    checks["error_rad"] = np.append(error, np.full(unseen, np.nan))
    assert gated_median_deg(HopTable(checks)) == pytest.approx(np.degrees(expected), abs=1e-6)


def test_without_a_vehicle_in_view_there_is_no_gated_error():
    checks = {"prominence": np.array([1.5, 1.2, 1.1]), "error_rad": np.full(3, np.nan)}
    assert np.isnan(gated_median_deg(HopTable(checks)))
