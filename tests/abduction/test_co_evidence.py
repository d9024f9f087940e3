"""Miss rates over azimuth and degradation: the table, and the isotonic regression that makes one."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import LinearConstraint, minimize
from sklearn.isotonic import IsotonicRegression

from worldstate.abduction.co_evidence import MissRateTable, isotonic_grid
from worldstate.ground.serialisation import decode, encode


def floats(n, low, high):
    return st.lists(st.floats(low, high), min_size=n, max_size=n)


@st.composite
def tables(draw):
    n_azimuths, n_levels = draw(st.integers(2, 5)), draw(st.integers(2, 5))
    azimuths = np.cumsum(draw(floats(n_azimuths - 1, 1, 20)))
    steps = np.cumsum(draw(floats(n_levels - 1, 0.05, 0.2)))
    rises = np.array(draw(floats(n_azimuths * n_levels, 0, 1)))
    beta = np.cumsum(np.cumsum(rises.reshape(n_azimuths, n_levels), 0), 1)
    beta /= max(1.0, beta[-1, -1])
    rows = tuple(map(tuple, beta.tolist()))
    return MissRateTable((0.0, *azimuths.tolist()), (0.0, *steps.tolist()), rows, {"car": rows})


@given(tables(), st.floats(-1.5, 1.5), st.floats(0, 1))
def test_the_table_is_bilinear_inside_its_range_and_one_outside(table, azimuth_rad, level):
    magnitude = abs(np.degrees(azimuth_rad))
    value = table(azimuth_rad, level)
    if magnitude > table.azimuth_deg[-1] or level > table.degradation[-1]:
        assert value == 1.0
    else:
        oracle = RegularGridInterpolator((table.azimuth_deg, table.degradation), np.array(table.beta))
        assert value == pytest.approx(float(oracle([[magnitude, level]])[0]), abs=1e-9)
    assert table(azimuth_rad, level, "car") == value


@given(tables())
def test_reads_back_what_it_wrote(table):
    assert decode(MissRateTable, json.loads(json.dumps(encode(table))), "file") == table


def test_a_class_may_have_rows_of_its_own():
    table = MissRateTable((0, 30), (0, 1), ((0.0, 1.0), (0.2, 1.0)), {"bicycle": ((0.5, 1.0), (0.5, 1.0))})
    assert table(0.0, 0.0, "bicycle") == 0.5
    assert table(0.0, 0.0, "car") == 0.0


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
