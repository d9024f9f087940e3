"""Factors: shapes are checked before gtsam sees them, derivatives are those of the error."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.ground.errors import InvalidArgumentError
from worldstate.measurement import Approach, Bearing, Position
from worldstate.smoothing import AngularHeight, Range, SmoothingSettings
from worldstate.smoothing import factors as f
from worldstate.smoothing.factors import vector_factor

SETTINGS = SmoothingSettings(robust_k=1e6)
X, Y, TALL = range(3)


def test_ten_thousand_wrong_shapes_raise_without_a_crash():
    rng = np.random.default_rng(0)
    raised = 0
    for _ in range(10_000):
        rows, *shapes = rng.integers(1, 6, 5).tolist()
        noise = gtsam.noiseModel.Unit.Create(rows)
        error, one, two = np.zeros(shapes[0]), np.zeros((shapes[1], 4)), np.zeros((shapes[2], shapes[3]))
        start = [np.zeros(4), np.zeros(2)]
        right = shapes[0] == shapes[1] == shapes[2] == rows and shapes[3] == 2
        try:
            factor = vector_factor([X, Y], noise, lambda x, c, e=error, j=(one, two): (e, j), start)
        except InvalidArgumentError:
            raised += 1
            assert not right
        else:
            assert right
            assert factor.dim() == rows
    assert raised > 9000


def test_a_shape_that_changes_later_raises_and_does_not_crash():
    def error(x):
        rows = 1 if x[0] < 1.0 else 3
        return np.zeros(rows), [np.zeros((rows, 4))]

    factor = vector_factor([X], gtsam.noiseModel.Unit.Create(1), error, [np.zeros(4)])
    values = gtsam.Values()
    values.insert(X, np.full(4, 2.0))
    for _ in range(100):
        with pytest.raises(ValueError, match="expected shape"):
            factor.linearize(values)


numbers = st.floats(-1.0, 1.0)


@given(st.lists(numbers, min_size=4, max_size=4), st.sampled_from(range(6)), st.booleans())
def test_derivatives_are_those_of_the_error(drawn, which, late):
    state = np.array([drawn[0], 0.3 * drawn[1], 0.3 * drawn[2], 2.7 + 0.5 * drawn[3]])
    factor = _factor(f.Node(X, state, offset_s=0.05 if late else 0.0), which)
    values = gtsam.Values()
    for key, value in ((X, state), (Y, state + 0.01), (TALL, np.array([0.3]))):
        values.insert(key, value)
    jacobian, _ = factor.linearize(values).jacobian()
    found, column = [], 1e-5
    for key, size in ((key, values.atVector(key).size) for key in list(factor.keys())):
        for i in range(size):
            ahead, behind = (_whitened(factor, values, key, i, sign * column) for sign in (1.0, -1.0))
            found.append((ahead - behind) / (2.0 * column))
    np.testing.assert_allclose(
        jacobian, np.stack(found, axis=1), rtol=1e-4, atol=2e-4 * np.abs(jacobian).max() + 1e-4
    )


def _factor(node, which):
    place = Position((10.0, 3.0), tuple(map(tuple, np.diag([1.0, 2.0, 0.5, 0.4]))), velocity_mps=(1.0, -2.0))
    after = f.Node(Y, node.state + 0.01)
    made = (
        lambda: f.bearing_factor(node, Bearing(0.2, 0.1), SETTINGS),
        lambda: f.approach_factor(node, Approach(0.2, 0.1), SETTINGS),
        lambda: f.range_factor(node, Range(12.0, 1.0), SETTINGS),
        lambda: f.position_factor(node, place),
        lambda: f.height_factor(node, TALL, AngularHeight(0.1, 0.05), SETTINGS),
        lambda: f.motion_factor(node, after, 0.1, f.motion_noise(SETTINGS, 0.1)),
    )
    return made[which]()


def _whitened(factor, values, key, i, step):
    moved = gtsam.Values(values)
    size = values.atVector(key).size
    moved.update(key, values.atVector(key) + np.eye(size)[i] * step)
    return (
        factor.whitenedError(moved)
        if hasattr(factor, "whitenedError")
        else -factor.linearize(moved).jacobian()[1]
    )
