"""Isotonic regression on a grid against a general quadratic solver and scikit-learn in one dimension."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import LinearConstraint, minimize
from sklearn.isotonic import IsotonicRegression

from worldstate.abduction.co_evidence import isotonic_grid

shapes = st.tuples(st.integers(1, 5), st.integers(1, 5))
grids = shapes.flatmap(
    lambda shape: st.tuples(
        arrays(float, shape, elements=st.floats(0.0, 1.0)),
        arrays(float, shape, elements=st.floats(0.5, 50.0)),
    )
)


def cost(grid, values, weights):
    return float((weights * (grid - values) ** 2).sum())


def by_solver(values, weights):
    index = np.arange(values.size).reshape(values.shape)
    pairs = [(a, b) for low, high in ((index[:-1], index[1:]), (index[:, :-1], index[:, 1:]))
             for a, b in zip(low.ravel(), high.ravel(), strict=True)]  # fmt: skip
    if not pairs:
        return values
    rows = np.zeros((len(pairs), values.size))
    for i, (a, b) in enumerate(pairs):
        rows[i, a], rows[i, b] = -1.0, 1.0
    w, v = weights.ravel() / weights.mean(), values.ravel()
    found = minimize(
        lambda g: (w * (g - v) ** 2).sum(), np.full(v.size, v.mean()), jac=lambda g: 2 * w * (g - v),
        constraints=LinearConstraint(rows, 0.0, np.inf),
        method="SLSQP", options={"ftol": 1e-12, "maxiter": 500},
    )  # fmt: skip
    return found.x.reshape(values.shape)


@settings(deadline=None, max_examples=50)
@given(grids)
def test_the_grid_is_monotone_and_optimal(grid):
    values, weights = grid
    found = isotonic_grid(values, weights)
    assert (np.diff(found, axis=0) >= 0).all()
    assert (np.diff(found, axis=1) >= 0).all()
    best = cost(by_solver(values, weights), values, weights)
    assert cost(found, values, weights) <= best + 1e-6 * weights.max() + 1e-4 * best


@given(arrays(float, st.integers(1, 30), elements=st.floats(0.0, 1.0)))
def test_a_single_row_is_isotonic_regression(values):
    expected = IsotonicRegression().fit_transform(np.arange(values.size), values)
    assert isotonic_grid(values[None], np.ones((1, values.size)))[0] == pytest.approx(expected, abs=1e-7)


@given(grids)
@settings(deadline=None)
def test_an_ordered_grid_and_the_weighted_mean_are_unchanged(grid):
    values, weights = grid
    found = isotonic_grid(values, weights)
    assert isotonic_grid(found, weights) == pytest.approx(found, abs=1e-8)
    assert np.average(found, weights=weights) == pytest.approx(np.average(values, weights=weights), abs=1e-5)
