"""Factors: shapes are checked before gtsam sees them, derivatives are those of the error."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.ground.errors import InvalidArgumentError
from worldstate.measurement import Approach, Bearing, Position
from worldstate.smoothing import AngularHeight, PastEdge, Range, ReflectedBearing, SmoothingSettings
from worldstate.smoothing import factors as f
from worldstate.smoothing.factors import key_of, vector_factor

SETTINGS = SmoothingSettings(robust_k=1e6, edge_std_rad=0.2)
X, Y, EGO, EDGE, WALL, TALL = (key_of(kind, n) for n, kind in enumerate("xxecwh"))


def test_ten_thousand_wrong_shapes_raise_and_none_crashes():
    rng = np.random.default_rng(0)
    raised = 0
    for _ in range(10_000):
        rows, *shapes = rng.integers(1, 6, 5).tolist()
        noise = gtsam.noiseModel.Unit.Create(rows)
        error, one, two = np.zeros(shapes[0]), np.zeros((shapes[1], 4)), np.zeros((shapes[2], shapes[3]))
        start = [np.zeros(4), np.zeros(2)]
        right = shapes[0] == shapes[1] == shapes[2] == rows and shapes[3] == 2
        try:
            factor = vector_factor([X, EDGE], noise, lambda x, c, e=error, j=(one, two): (e, j), start)
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


@given(st.lists(numbers, min_size=12, max_size=12), st.sampled_from(range(8)), st.booleans(), st.booleans())
def test_derivatives_are_those_of_the_error(drawn, which, drives, late):
    state = np.array([drawn[0], 0.3 * drawn[1], 0.3 * drawn[2], 2.7 + 0.5 * drawn[3]])
    pose, edge, wall = np.array(drawn[4:7]), np.array([5.0, 3.0]) + drawn[7:9], np.array([drawn[9], 9.0])
    anchor = np.array(drawn[10:12]) if drives else np.zeros(2)
    ego = {"ego_key": EGO, "pose": pose, "ego_velocity_mps": (3.0, 0.2)} if drives else {}
    node = f.Node(X, state, anchor, offset_s=0.05 if late else 0.0, **ego)
    factor = _factor(node, which, edge, wall)
    values = gtsam.Values()
    values.insert(Y, state + 0.01)
    for key, value in ((X, state), (EDGE, edge), (WALL, wall), (TALL, np.array([0.3]))):
        values.insert(key, value)
    values.insert(EGO, gtsam.Pose2(*pose))
    jacobian, _ = factor.linearize(values).jacobian()
    found, column = [], 1e-5
    for key, size in ((key, 3 if key == EGO else values.atVector(key).size) for key in list(factor.keys())):
        for i in range(size):
            ahead, behind = (_whitened(factor, values, key, i, sign * column) for sign in (1.0, -1.0))
            found.append((ahead - behind) / (2.0 * column))
    np.testing.assert_allclose(
        jacobian, np.stack(found, axis=1), rtol=1e-4, atol=2e-4 * np.abs(jacobian).max() + 1e-4
    )


def _factor(node, which, edge, wall):
    place = Position((10.0, 3.0), tuple(map(tuple, np.diag([1.0, 2.0, 0.5, 0.4]))), velocity_mps=(1.0, -2.0))
    after = f.Node(Y, node.state + 0.01, node.anchor_m)
    made = (
        lambda: f.bearing_factor(node, Bearing(0.2, 0.1), SETTINGS),
        lambda: f.approach_factor(node, Approach(0.2, 0.1), SETTINGS),
        lambda: f.range_factor(node, Range(12.0, 1.0), SETTINGS),
        lambda: f.position_factor(node, place),
        lambda: f.height_factor(node, TALL, AngularHeight(0.1, 0.05), SETTINGS),
        lambda: f.reflected_factor(node, WALL, wall, ReflectedBearing("w", 0.3, 0.1), SETTINGS),
        lambda: f.edge_factor(node, EDGE, edge, 1, PastEdge("c", seen=True), SETTINGS),
        lambda: f.motion_factor(node, after, 0.1, f.motion_noise(SETTINGS, 0.1)),
    )
    return made[which]()


def _whitened(factor, values, key, i, step):
    moved = gtsam.Values(values)
    if key == EGO:
        moved.update(key, values.atPose2(key).retract(np.eye(3)[i] * step))
    else:
        size = values.atVector(key).size
        moved.update(key, values.atVector(key) + np.eye(size)[i] * step)
    return (
        factor.whitenedError(moved)
        if hasattr(factor, "whitenedError")
        else -factor.linearize(moved).jacobian()[1]
    )
