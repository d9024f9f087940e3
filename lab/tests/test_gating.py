"""Prominence gating: coverage against accuracy, for bearings alone and for a recording with a camera."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worldstate_lab.metrics.track_measures import bearing_curve, gated_median_deg, gating_curve

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import NotUsable, wrap_angle
from worldstate.operations.recordings.hop_table import HopTable

PAIRS = st.lists(
    st.tuples(st.sampled_from([1.0, 1.1, 1.4, 2.0, 3.5]), st.floats(-7, 7)), min_size=1, max_size=40
)


@given(pairs=PAIRS)
def test_every_point_is_what_its_threshold_keeps(pairs: list[tuple[float, float]]) -> None:
    prominence, error = np.array(pairs).T
    curve = gating_curve(prominence, error)
    wrapped = np.abs(np.angle(np.exp(1j * error)))
    assert curve.threshold.tolist() == sorted(set(prominence.tolist()))
    assert curve.coverage[0] == 1.0
    assert (np.diff(curve.coverage) < 0).all()
    for threshold, coverage, median in zip(
        curve.threshold, curve.coverage, curve.median_error_rad, strict=True
    ):
        kept = prominence >= threshold
        assert coverage == pytest.approx(kept.mean())
        assert median == pytest.approx(np.median(wrapped[kept]), abs=1e-9)


def test_points_are_spread_over_the_coverage() -> None:
    rng = np.random.default_rng(0)
    curve = gating_curve(1 + rng.exponential(1, 5000), rng.standard_normal(5000))
    assert len(curve.coverage) == 200 and curve.coverage[0] == 1.0
    np.testing.assert_allclose(np.diff(curve.coverage), -1.0 / 200, atol=1e-3)


@pytest.mark.parametrize(
    ("prominence", "error", "message"),
    [([], [], "at least one"), ([1.0], [1.0, 2.0], "error_rad"), ([np.nan], [1.0], "prominence")],
)
def test_bad_input(prominence: list[float], error: list[float], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        gating_curve(prominence, error)


@given(pairs=PAIRS, share=st.floats(0.01, 1.0))
def test_the_requested_coverage_is_kept_and_no_more(pairs: list[tuple[float, float]], share: float) -> None:
    prominence, error = np.array(pairs).T
    threshold, median = gating_curve(prominence, error).at_coverage(share)
    kept = prominence >= threshold
    assert kept.mean() >= share - 1e-9
    assert (prominence > threshold).mean() < share
    assert median == pytest.approx(np.median(np.abs(wrap_angle(error[kept]))))


def test_the_prominent_share_of_the_checked_bearings_is_counted() -> None:
    """Three in ten bearings are prominent with errors of 0.1 rad, the others random; some have no box."""
    rng, n = np.random.default_rng(4), 400
    sure = rng.random(n) < 0.3
    error = np.where(sure, 0.1, rng.uniform(-np.pi, np.pi, n))
    error[-10:] = np.nan
    checks = HopTable({"prominence": np.where(sure, 2.0, 1.2), "error_rad": error})
    assert gated_median_deg(checks) == pytest.approx(np.degrees(0.1))
    curve = bearing_curve(checks)
    assert not isinstance(curve, NotUsable)
    assert curve.at_coverage(0.16)[0] == 2.0 and np.degrees(curve.median_error_rad[0]) > np.degrees(0.2)


def test_without_a_vehicle_in_view_there_is_no_accuracy() -> None:
    checks = HopTable({"prominence": np.array([1.5, 1.2, 1.1]), "error_rad": np.full(3, np.nan)})
    assert isinstance(bearing_curve(checks), NotUsable)
    assert np.isnan(gated_median_deg(checks))
