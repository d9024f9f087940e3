"""Bearings and their standard deviations: counts, and a source with a known position."""

import numpy as np
import pytest
from worldstate_lab.cli.bearings import Bearings, drawn_scene, scene_bearings


def test_calibrated_errors_give_one_and_the_surest_bearings_have_the_smallest_deviation() -> None:
    rng = np.random.default_rng(0)
    std_rad = np.radians(rng.permutation(np.linspace(1.0, 60.0, 6000)))
    bearings = Bearings(std_rad * rng.standard_normal(6000), std_rad, {"peer": np.full(6000, 0.1)})
    told = Bearings.joined([bearings, bearings]).figures()
    assert told["hops"] == 12_000
    assert told["z"] == pytest.approx(1.0, abs=0.03)
    assert told["surest_half"] == pytest.approx(1.0, abs=0.06)
    assert told["surest_sixth_median_deg"] < told["surest_half_median_deg"] < told["median_deg"]
    assert told["peer_deg"] == pytest.approx(np.degrees(0.1))


def test_hops_without_a_bearing_are_the_least_sure_ones() -> None:
    std_rad = np.array([np.inf, 0.1, np.inf, 0.1])
    told = Bearings(np.array([3.0, 0.1, 3.0, 0.1]), std_rad, {}).figures()
    assert (told["stated"], told["z"], told["surest_half"]) == (0.5, 1.0, 1.0)


def test_a_source_in_the_open_is_located_by_the_front_end_and_by_peers() -> None:
    # The first seed with a scene in the open.
    number = next(n for n in range(20) if not drawn_scene(np.random.default_rng((1, n)))[3])
    indoors, bearings = scene_bearings(number, 1)
    assert not indoors
    for errors in (bearings.error_rad, *bearings.peers_rad.values()):
        assert np.median(np.abs(errors)) < np.radians(3.0)
