"""Prominence gating: coverage against accuracy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.errors import InvalidArgumentError
from worldstate.frontend.gating import gating_curve
from worldstate.values import NotUsable

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


@given(pairs=PAIRS, limit=st.floats(0, 3))
def test_the_threshold_keeps_its_promise_from_there_on(
    pairs: list[tuple[float, float]], limit: float
) -> None:
    curve = gating_curve(*np.array(pairs).T)
    threshold = curve.threshold_for(limit)
    if isinstance(threshold, NotUsable):
        assert curve.median_error_rad[-1] > limit
        return
    above = curve.threshold >= threshold
    assert (curve.median_error_rad[above] <= limit).all()
    below = np.flatnonzero(~above)
    assert not len(below) or curve.median_error_rad[below[-1]] > limit


def test_points_are_spread_over_the_coverage() -> None:
    rng = np.random.default_rng(0)
    curve = gating_curve(1 + rng.exponential(1, 5000), rng.standard_normal(5000), max_points=11)
    np.testing.assert_allclose(curve.coverage[:-1], np.linspace(1, 0, 11)[:-1], atol=1e-3)


@pytest.mark.parametrize(
    ("prominence", "error", "message"),
    [([], [], "at least one"), ([1.0], [1.0, 2.0], "error_rad"), ([np.nan], [1.0], "prominence")],
)
def test_bad_input(prominence: list[float], error: list[float], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        gating_curve(prominence, error)
