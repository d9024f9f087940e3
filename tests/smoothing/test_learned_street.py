"""The learned street: passes, moved edges and forgetting."""

import math

import numpy as np
import pytest

from worldstate.smoothing.learned_street import (
    DAY_S,
    LearnedEdge,
    LearnedStreet,
    Moments,
    NormalPrior,
    StreetPass,
    context_of,
    forgotten,
    watched,
    with_pass,
)
from worldstate.state.context import Context

LEFT, RIGHT = math.radians(24.0), math.radians(-29.0)


def street_of(passes: int, seed: int = 0) -> LearnedStreet:
    rng, street = np.random.default_rng(seed), LearnedStreet("Elm Street")
    for i in range(passes):
        edge = (LEFT, RIGHT)[i % 2] + rng.normal(0.0, math.radians(0.3))
        street = with_pass(
            street, StreetPass(("left", "right")[i % 2], edge, rng.lognormal(math.log(0.7), 0.2))
        )
    return street


def test_ten_passes_determine_edges_and_pace():
    left, right = context_of(street_of(10)).occluders
    assert abs(left.edge_azimuth_rad - LEFT) < math.radians(0.5)
    assert abs(right.edge_azimuth_rad - RIGHT) < math.radians(0.5)
    assert left.pace_hz > 0.55 > Context().occluders[0].pace_hz
    assert not (left.assumed or right.assumed)


def test_moments_are_those_of_the_sample_under_a_flat_prior():
    values = np.random.default_rng(1).normal(3.0, 2.0, 50)
    moments = Moments()
    for value in values.tolist():
        moments = moments.plus(value)
    mean, mean_std, spread = moments.posterior(NormalPrior(0.0, 1e6, 2.0, freedom=1e-9))
    assert mean == pytest.approx(values.mean())
    assert spread == pytest.approx(values.std())
    assert mean_std == pytest.approx(values.std() / math.sqrt(50))


def test_the_predictive_density_is_that_of_scipy():
    from scipy.stats import t

    moments, prior = Moments().plus(0.4).plus(0.5), NormalPrior(0.56, 0.09, 0.02)
    mean, mean_std, spread = moments.posterior(prior)
    told = t.logpdf(0.47, prior.freedom + 2.0, mean, math.hypot(mean_std, spread))
    assert moments.log_predictive(0.47, prior) == pytest.approx(told)


@pytest.mark.parametrize(
    ("passes_deg", "edge_deg", "within_deg", "changes"),
    [
        ((30.0, 30.2, 29.9, 30.1, 30.0, 24.0, 24.1, 24.0), 24.0, 0.5, 1),  # The edge has moved
        ((30.0, 30.2, 12.0, 29.9, 30.1, 30.0), 30.0, 0.5, 0),  # A stray pass
        ((15.0, 30.0, 30.1, 29.9), 30.0, 1.0, 0),  # A first stray pass
    ],
)
def test_a_moved_edge_is_learned_and_a_stray_pass_is_not(passes_deg, edge_deg, within_deg, changes):
    edge = LearnedEdge()
    for one in passes_deg:
        edge = edge.with_pass(math.radians(one))
    assert edge.changes == changes
    assert abs(math.degrees(edge.mean_rad) - edge_deg) < within_deg


def test_forgetting_reduces_weights_and_keeps_means():
    street = watched(street_of(10), 600.0)
    later = forgotten(street, 30.0 * DAY_S)
    for before, after in zip(street.arms, later.arms, strict=True):
        assert after.arrivals == pytest.approx(before.arrivals / math.e)
        assert after.exposure_s == pytest.approx(before.exposure_s / math.e)
        assert after.edge.mean_rad == pytest.approx(before.edge.mean_rad, abs=math.radians(0.2))
        assert after.edge.std_rad > before.edge.std_rad
