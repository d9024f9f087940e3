"""Prominence gating: coverage against accuracy, of bearings alone and of a run beside its camera."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.cli.main import main
from worldstate.frontend.direction.bearing import gating_curve
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import NotUsable, wrap_angle
from worldstate.operations.recordings.bearing_gating import bearing_curve, bearing_figures, check_bearings
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
def test_coverage_asked_for_is_kept_and_no_more_than_needed(
    pairs: list[tuple[float, float]], share: float
) -> None:
    prominence, error = np.array(pairs).T
    threshold, median = gating_curve(prominence, error).at_coverage(share)
    kept = prominence >= threshold
    assert kept.mean() >= share - 1e-9
    assert (prominence > threshold).mean() < share
    assert median == pytest.approx(np.median(np.abs(wrap_angle(error[kept]))))


def test_bearings_are_checked_against_what_moved_when_they_were_heard() -> None:
    """A box that moves 0.1 rad a hop; bearings are 0.1 rad off and two hops old; most of them at random."""
    rng, n = np.random.default_rng(4), 400
    time_s = 0.1 * np.arange(1, n + 1)
    box = 0.1 * np.arange(n) - 3.0
    sure = rng.random(n) < 0.3
    heard = np.where(sure, np.roll(box, 2) + 0.1, rng.uniform(-np.pi, np.pi, n))
    moving = [[angle, angle + 2.0] for angle in wrap_angle(box)]
    moving[-10:] = [[]] * 10
    ages, prominence = np.full(n, 0.2), np.where(sure, 2.0, 1.2)
    run = HopTable(
        {"time_s": time_s, "bearing_age_s": ages, "bearing_rad": wrap_angle(heard), "prominence": prominence}
    )
    checks = check_bearings(run, moving)
    assert np.flatnonzero(np.isnan(checks.error_rad)).tolist() == list(range(n - 8, n))
    np.testing.assert_allclose(checks.error_rad[2:-8][sure[2:-8]], 0.1, atol=1e-9)
    found = bearing_figures(checks)
    assert found["bearings_in_view"] == n - 8
    assert found["bearing_gated_deg"] == pytest.approx(np.degrees(0.1))
    assert found["gate_prominence"] == 2.0
    assert found["bearing_median_deg"] > 2 * found["bearing_gated_deg"]


def test_nothing_in_view_is_no_accuracy() -> None:
    checks = HopTable({"prominence": np.array([1.5, 1.2, 1.1]), "error_rad": np.full(3, np.nan)})
    assert isinstance(bearing_curve(checks), NotUsable)
    found = bearing_figures(checks)
    assert (found["bearings_in_view"], found["bearing_median_deg"], found["prominence_in_view"]) == (
        0,
        None,
        None,
    )
    assert found["prominence_without"] == 1.2


def test_run_draws_the_curve_of_a_recording(approach, tmp_path, capsys) -> None:
    figure = tmp_path / "gating.png"
    assert main(["run", str(approach.folder), "--gating", str(figure), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    print({key: value for key, value in found.items() if "bearing" in key or "prominence" in key})
    assert found["bearings_in_view"] >= 5
    assert found["bearing_median_deg"] < 10.0
    assert found["gate_prominence"] > 1.0
    assert figure.read_bytes()[:4] == b"\x89PNG"
