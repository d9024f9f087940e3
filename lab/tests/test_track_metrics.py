"""Track measures, GOSPA and time to visible against closed forms, brute force and laws."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from worldstate_lab.metrics.track_measures import TrackRows, TruthRows, gospa_bearing, track_measures

from worldstate.commissioning.stream_exam import visible_errors
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import wrap_angle

few = settings(max_examples=40)
bearings = st.lists(st.floats(-4, 4), max_size=4)
HOP_S = 0.1


def brute_gospa(estimates, truths, cutoff, order):
    """Return the GOSPA by trying every assignment of the smaller set to the larger, each pair cut off."""
    fewer, more = sorted((list(estimates), list(truths)), key=len)
    ways = permutations(more, len(fewer))
    costs = [
        sum(
            min(abs(np.angle(np.exp(1j * (a - b)))), cutoff) ** order for a, b in zip(fewer, way, strict=True)
        )
        for way in ways
    ]
    return (min(costs) + cutoff**order / 2 * (len(more) - len(fewer))) ** (1 / order)


@given(bearings, bearings, st.floats(0.1, 2.0), st.sampled_from([1.0, 1.5, 2.0]))
@few
def test_gospa_is_the_cheapest_of_all_assignments(estimates, truths, cutoff, order):
    errors = np.abs(np.angle(np.exp(1j * np.subtract.outer(estimates, truths))))
    # At the cut-off a pair costs as much as a miss and a false estimate, so round-off would decide.
    assume((np.abs(errors - cutoff) > 1e-9).all())
    one = gospa_bearing(estimates, truths, cutoff, order)
    assert one.total_rad == pytest.approx(brute_gospa(estimates, truths, cutoff, order), abs=1e-9)
    assert one.total_rad**order == pytest.approx(one.localisation + one.missed + one.false)
    assert (len(set(one.pairs[:, 0])), len(set(one.pairs[:, 1]))) == (len(one.pairs),) * 2
    back = gospa_bearing(truths, estimates, cutoff, order)
    assert back.total_rad == pytest.approx(one.total_rad)
    assert (back.missed, back.false) == pytest.approx((one.false, one.missed))
    mirrored = gospa_bearing(-np.array(estimates), -np.array(truths), cutoff, order)
    assert mirrored.total_rad == pytest.approx(one.total_rad)


@given(st.integers(0, 2**32), st.integers(1, 4), st.integers(1, 4), st.sampled_from([1.0, 2.0]))
@few
def test_gospa_is_stone_soups(seed, said, there, order):
    why = "Stone Soup is the oracle: pip install 'worldstate[oracles]'"
    metrics = pytest.importorskip("stonesoup.metricgenerator.ospametric", reason=why)
    from stonesoup.types.state import State

    rng, cutoff = np.random.default_rng(seed), np.radians(60.0)
    estimates, truths = (rng.uniform(-3.5, 3.5, n) for n in (said, there))

    def apart(one, other):
        return abs(float(wrap_angle(float(one.state_vector[0] - other.state_vector[0]))))

    peer = metrics.GOSPAMetric(p=order, c=cutoff, measure=apart)
    found, _ = peer.compute_gospa_metric([State([a]) for a in estimates], [State([a]) for a in truths])
    one = gospa_bearing(estimates, truths, cutoff, order)
    parts = (found.value[name] for name in ("distance", "localisation", "missed", "false"))
    assert (one.total_rad, one.localisation, one.missed, one.false) == pytest.approx(tuple(parts), abs=1e-9)


@given(bearings, bearings, bearings)
@few
def test_gospa_is_a_metric(a, b, c):
    straight, detour = gospa_bearing(a, c), gospa_bearing(a, b).total_rad + gospa_bearing(b, c).total_rad
    assert straight.total_rad <= detour + 1e-9
    assert gospa_bearing(a, a).total_rad == pytest.approx(0.0, abs=1e-9)


def truth(hops, source=1, azimuth_rad=0.0, active=True):
    """Return one source at one bearing."""
    n = len(hops)
    return TruthRows(np.array(hops), np.full(n, source), np.full(n, azimuth_rad), np.full(n, active))


def tracks(hops, names, azimuth_rad=0.0):
    """Return estimates at one bearing, or one each."""
    names = np.broadcast_to(names, len(hops))
    return TrackRows(np.array(hops), names, np.broadcast_to(azimuth_rad, len(hops)).astype(float))


def joined(*parts):
    """Return the rows of several sources or tracks together."""
    kind = type(parts[0])
    return kind(*(np.concatenate([getattr(p, f) for p in parts]) for f in kind.__slots__))


def test_one_source_and_one_late_track():
    said = track_measures(tracks(range(4, 20), 3, 0.2), truth(range(20)), HOP_S)
    assert said.latency_s == pytest.approx(0.4)
    assert (said.swap_rate_hz, said.fragmentation_rate_hz) == (0, 0)
    assert (said.detection, said.azimuth_error_rad, said.active_s) == pytest.approx((0.8, 0.2, 2.0))
    assert (said.identity_switches, said.fragmentations) == (0, 0)


def test_two_tracks_that_swap_once():
    hops, swapped = range(20), np.arange(20) >= 11
    both = joined(truth(hops, 1, 0.5), truth(hops, 2, -0.5))
    said = track_measures(
        joined(tracks(hops, 7 + swapped, 0.5), tracks(hops, 8 - swapped, -0.5)), both, HOP_S
    )
    # One swap of each source in 2 s.
    assert (said.swap_rate_hz, said.fragmentation_rate_hz) == pytest.approx((0.5, 0.5))
    assert (said.identity_switches, said.fragmentations, said.detection) == (2, 0, 1.0)


def test_a_gap_interrupts_a_track_but_not_its_identity():
    said = track_measures(tracks([*range(5), *range(8, 20)], 3), truth(range(20)), HOP_S)
    assert (said.swap_rate_hz, said.fragmentation_rate_hz) == pytest.approx((0.0, 0.5))
    assert (said.identity_switches, said.fragmentations, said.detection) == (0, 1, 0.85)


def test_a_pause_ends_a_period_and_a_new_identity_after_it_is_a_swap():
    said = track_measures(
        tracks([*range(10), *range(25, 30)], [1] * 10 + [2] * 5), truth([*range(10), *range(20, 30)]), HOP_S
    )
    assert (said.latency_s, said.detection) == pytest.approx((0.25, 0.75))
    # None in the first second, one in the other.
    assert (said.swap_rate_hz, said.fragmentation_rate_hz) == pytest.approx((0.5, 0.5))
    assert (said.identity_switches, said.fragmentations) == (1, 1)


def test_a_source_without_a_track_has_no_short_latency():
    said = track_measures(tracks([], 1), truth(range(20)), HOP_S)
    assert (said.latency_s, said.detection) == pytest.approx((2.0, 0.0))
    assert np.isnan(said.azimuth_error_rad)
    nothing = track_measures(tracks(range(3), 1), truth(range(3), active=False), HOP_S)
    assert np.isnan(nothing.latency_s)
    assert nothing.active_s == 0.0


def test_clear_mot_keeps_its_matches_if_the_nearest_would_swap():
    """Two adjacent sources, whose tracks cross between them without leaving the gate."""
    both = joined(truth(range(2), 1, 0.05), truth(range(2), 2, -0.05))
    crossing = joined(tracks(range(2), 7, [0.05, -0.05]), tracks(range(2), 8, [-0.05, 0.05]))
    said = track_measures(crossing, both, HOP_S)
    assert said.identity_switches == 0
    assert said.swap_rate_hz == pytest.approx(5.0)


def test_tracks_on_one_side_of_their_sources_keep_their_order():
    """Both assignments cost the same there, except for round-off."""
    hops, rng = range(50), np.random.default_rng(0)
    both = joined(truth(hops, 1, 0.0), truth(hops, 2, 0.1))
    beside = joined(*(tracks(hops, name, 0.1 * name + rng.uniform(0.0, 0.05, 50)) for name in (2, 3)))
    said = track_measures(beside, both, HOP_S)
    assert (said.swap_rate_hz, said.detection) == (0.0, 1.0)


@given(st.integers(0, 2**32), st.integers(1, 3), st.integers(1, 4))
@few
def test_identities_and_mirroring_change_nothing(seed, sources, names):
    rng = np.random.default_rng(seed)
    hop, source = (grid.ravel() for grid in np.indices((12, sources)))
    truths = TruthRows(hop, source, rng.uniform(-2, 2, hop.size), rng.random(hop.size) < 0.8)
    said_hop, said = (grid.ravel() for grid in np.indices((12, names)))
    kept = rng.random(said.size) < 0.8
    estimates = TrackRows(said_hop[kept], said[kept], rng.uniform(-2, 2, int(kept.sum())))
    measures = track_measures(estimates, truths, HOP_S)
    shuffled = rng.permutation(estimates.hop.size)
    relabelled = TrackRows(
        estimates.hop[shuffled],
        rng.permutation(9)[estimates.track[shuffled]],
        estimates.azimuth_rad[shuffled],
    )
    renamed = replace(truths, source=rng.permutation(9)[truths.source])
    turned = [replace(rows, azimuth_rad=wrap_angle(3.0 - rows.azimuth_rad)) for rows in (estimates, truths)]
    for other in (track_measures(relabelled, renamed, HOP_S), track_measures(*turned, HOP_S)):
        for name in measures.__slots__:
            assert getattr(other, name) == pytest.approx(getattr(measures, name), nan_ok=True), name
    assert 0 <= measures.swap_rate_hz <= measures.fragmentation_rate_hz or np.isnan(measures.swap_rate_hz)


def test_invalid_rows_are_rejected():
    with pytest.raises(InvalidArgumentError, match="azimuth_rad"):
        tracks([0, 1], 1, [0.0, np.nan])
    with pytest.raises(InvalidArgumentError, match="track"):
        TrackRows(np.arange(2), np.arange(3), np.zeros(2))
    with pytest.raises(InvalidArgumentError, match="hop_s"):
        track_measures(tracks([0], 1), truth([0]), 0.0)


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
