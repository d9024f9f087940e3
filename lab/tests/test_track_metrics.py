"""GOSPA, bearings and time to visible against closed forms, another implementation and laws."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from worldstate_lab.cli.bearings import Bearings, drawn_scene, scene_bearings
from worldstate_lab.metrics.track_measures import PUBLISHED_COVERAGE, gated_median_deg, gospa_bearing

from worldstate.commissioning.stream_exam import visible_errors
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import wrap_angle
from worldstate.operations.recordings.hop_table import HopTable

few = settings(max_examples=40)
bearings = st.lists(st.floats(-4, 4), max_size=4)


@given(st.integers(0, 2**32), st.integers(0, 4), st.integers(0, 4))
@few
def test_gospa_is_stone_soups(seed, said, there):
    why = "Stone Soup is the oracle: pip install 'worldstate[oracles]'"
    metrics = pytest.importorskip("stonesoup.metricgenerator.ospametric", reason=why)
    from stonesoup.types.state import State

    assume(said or there)  # Stone Soup defines no distance between two empty sets
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


def test_calibrated_errors_give_one_and_the_surest_bearings_have_the_smallest_deviation():
    rng = np.random.default_rng(0)
    std_rad = np.radians(rng.permutation(np.linspace(1.0, 60.0, 6000)))
    bearings = Bearings(std_rad * rng.standard_normal(6000), std_rad, {"peer": np.full(6000, 0.1)})
    told = Bearings.joined([bearings, bearings]).figures()
    assert told["hops"] == 12_000
    assert told["z"] == pytest.approx(1.0, abs=0.03)
    assert told["surest_half"] == pytest.approx(1.0, abs=0.06)
    assert told["surest_sixth_median_deg"] < told["surest_half_median_deg"] < told["median_deg"]
    assert told["peer_deg"] == pytest.approx(np.degrees(0.1))


def test_hops_without_a_bearing_are_the_least_sure_ones():
    std_rad = np.array([np.inf, 0.1, np.inf, 0.1])
    told = Bearings(np.array([3.0, 0.1, 3.0, 0.1]), std_rad, {}).figures()
    assert (told["stated"], told["z"], told["surest_half"]) == (0.5, 1.0, 1.0)


def test_a_source_in_the_open_is_located_by_the_front_end_and_by_peers():
    # The first seed with a scene in the open.
    number = next(n for n in range(20) if not drawn_scene(np.random.default_rng((1, n)))[3])
    indoors, bearings = scene_bearings(number, 1)
    assert not indoors
    for errors in (bearings.error_rad, *bearings.peers_rad.values()):
        assert np.median(np.abs(errors)) < np.radians(3.0)
