"""Motion in modified polar coordinates, against straight lines and filterpy."""

import math

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from worldstate.belief.kinematics.motion import (
    AZIMUTH,
    RADIAL_RATE,
    MotionBelief,
    predict,
    process_noise,
    propagate,
    relax,
    update,
)
from worldstate.ground.serialisation import decode, encode
from worldstate.ground.values import wrap_angle

states = st.tuples(st.floats(-3.0, 3.0), st.floats(-0.8, 0.8), st.floats(-0.8, 0.8), st.floats(1.5, 4.5)).map(
    np.array
)
times = st.floats(0.01, 0.8)
PRIOR = MotionBelief.around((0.9, 0.0, -0.2, 3.2), (0.35, 0.15, 0.25, 0.6))


def to_cartesian(state):
    theta, omega, rho, log_range = state
    r = np.exp(log_range)
    along, across = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    return r * along, r * rho * along + r * omega * across


def to_polar(position, velocity):
    x, y = position
    r2 = x * x + y * y
    omega, rho = (x * velocity[1] - y * velocity[0]) / r2, (position @ velocity) / r2
    return np.array([np.arctan2(y, x), omega, rho, 0.5 * np.log(r2)])


def wrapped(difference):
    difference = np.array(difference)
    difference[0] = np.arctan2(np.sin(difference[0]), np.cos(difference[0]))
    return difference


@given(states, times)
def test_motion_is_a_straight_line(state, time_s):
    position, velocity = to_cartesian(state)
    expected = to_polar(position + time_s * velocity, velocity)
    assert wrapped(propagate(state, time_s)[0] - expected) == pytest.approx(0.0, abs=1e-9)


@given(states, times)
def test_the_jacobian_is_the_derivative(state, time_s):
    h = 1e-6
    ahead = np.array([propagate(state + h * axis, time_s)[0] for axis in np.eye(4)])
    behind = np.array([propagate(state - h * axis, time_s)[0] for axis in np.eye(4)])
    assert propagate(state, time_s)[1] == pytest.approx((ahead - behind).T / (2 * h), rel=1e-4, abs=1e-6)


def test_process_noise_composes():
    """Two steps of the noise-driven linear part add up to one step of twice the length."""
    step = np.eye(4) + 0.5 * np.array([[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0]])
    half = process_noise(2.0, 10.0, 0.5)
    assert step @ half @ step.T + half == pytest.approx(process_noise(2.0, 10.0, 1.0))


seeds = st.integers(0, 2**32 - 1)


def random_belief(seed):
    """Return a belief whose components are correlated."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4)) * 0.2
    mean = rng.uniform((-3.0, -0.8, -0.8, 1.5), (3.0, 0.8, 0.8, 4.5))
    return MotionBelief(mean, root @ root.T + 1e-3 * np.eye(4))


@given(seeds, st.floats(-1.0, 1.0), st.floats(0.01, 1.0), st.floats(0.0, 1.0))
def test_association_mixes_the_two_outcomes(seed, rate, std, weight):
    """Mean and covariance are the moments of the mixture with association probability w."""
    belief, sure = random_belief(seed), update(random_belief(seed), RADIAL_RATE, -rate, std, weight=1.0)
    got = update(belief, RADIAL_RATE, -rate, std, weight)
    mean = weight * sure.mean + (1 - weight) * belief.mean
    spread = sum(
        w * (part.covariance + np.outer(part.mean - mean, part.mean - mean))
        for w, part in ((weight, sure), (1 - weight, belief))
    )
    assert got.mean == pytest.approx(mean, abs=1e-9)
    assert got.covariance == pytest.approx(spread, abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_covariance_stays_valid_under_extreme_inputs(seed):
    """Tiny deviations, extreme rates and thirty years without measurements keep the covariance valid."""
    rng, n = np.random.default_rng(seed), 500
    prior = MotionBelief(
        np.tile([0.9, 0.0, -0.2, 3.2], (n, 1)), np.tile(np.diag([0.1, 0.02, 0.06, 0.4]), (n, 1, 1))
    )
    belief = prior
    for _ in range(12):
        if rng.random() < 0.5:
            step_s = float(rng.choice([1e-9, 0.1, 0.5, 2.0, 3600.0, 1e6, 1e9]))
            belief = predict(belief, step_s, rng.choice([2.0, 1e-4], n))
            assert np.linalg.eigvalsh(belief.covariance).min() > 0.0
            kept = np.exp(-step_s * rng.choice([0.0, 1e-9, 1.0], n))
            belief = relax(belief, prior, kept, np.full(n, np.exp(-step_s)))
        else:
            row, most = (AZIMUTH, 3.1) if rng.random() < 0.5 else (RADIAL_RATE, 1e3)
            stds, weights = 10.0 ** rng.uniform(-9.0, 6.0, n), rng.choice([1.0, 0.5, 1e-12], n)
            belief = update(belief, row, rng.uniform(-most, most, n), stds, weights)
        assert np.isfinite(belief.mean).all() and (abs(belief.mean[:, AZIMUTH]) <= math.pi).all()
        assert (belief.covariance == belief.covariance.mT).all()
        assert np.linalg.eigvalsh(belief.covariance).min() > 0.0
    for one in belief.each()[:20]:
        assert decode(MotionBelief, encode(one), "belief").covariance.tolist() == one.covariance.tolist()


def test_relaxation_returns_to_the_prior_and_no_further():
    belief = MotionBelief.around((-0.5, 0.5, -1.0, 2.0), (0.02, 0.05, 0.1, 0.1))
    for _ in range(400):
        belief = relax(belief, PRIOR, 0.967, 0.9)
    assert belief.mean == pytest.approx(PRIOR.mean, abs=1e-4)
    assert belief.covariance == pytest.approx(PRIOR.covariance, abs=1e-4)


def test_relaxation_may_leave_the_bearing_alone():
    belief = random_belief(1)
    after = relax(belief, PRIOR, 1.0, 0.0)
    assert after.mean == pytest.approx([*belief.mean[:2], *PRIOR.mean[2:]])
    assert after.covariance[:2, :2] == pytest.approx(belief.covariance[:2, :2])
    assert after.covariance[2:, 2:] == pytest.approx(PRIOR.covariance[2:, 2:])


def engine(belief):
    """Return filterpy's filter for a belief."""
    kalman = ExtendedKalmanFilter(dim_x=4, dim_z=1)
    kalman.x, kalman.P = belief.mean.copy(), belief.covariance.copy()
    return kalman


@given(seeds, st.integers(1, 5))
def test_stacked_entities_equal_single_ones(seed, n):
    rng = np.random.default_rng(seed)
    beliefs = [random_belief(int(one)) for one in rng.integers(0, 2**32, n)]
    values, stds, weights, kept = rng.normal(0, 1, n), rng.uniform(0.01, 1, n), rng.random(n), rng.random(n)

    def moved(belief, value, std, weight, bearing_kept):
        after = relax(predict(belief, 0.1, 2.0), beliefs[0], bearing_kept, 0.9)
        return update(update(after, AZIMUTH, value, std, weight), RADIAL_RATE, -value, std, weight)

    at_once = moved(MotionBelief.stacked(beliefs), values, stds, weights, kept).each()
    for *one, together in zip(beliefs, values, stds, weights, kept, at_once, strict=True):
        alone = moved(*one)
        assert together.mean == pytest.approx(alone.mean, abs=1e-12)
        assert together.covariance == pytest.approx(alone.covariance, abs=1e-12)


@given(seeds, times)
def test_predict_equals_an_extended_kalman_filter(seed, time_s):
    belief = random_belief(seed)
    kalman, state = engine(belief), belief.mean
    assume(state[2] * time_s > -0.5)  # No vehicle covers half its range within a step
    kalman.F = propagate(state, time_s)[1]
    kalman.Q = process_noise(2.0, float(np.clip(np.exp(state[3]), 3.0, 200.0)), time_s)
    kalman.predict()
    after = predict(belief, time_s, 2.0)
    assert wrapped(after.mean - propagate(state, time_s)[0]) == pytest.approx(0.0, abs=1e-12)
    assert after.covariance == pytest.approx(kalman.P, abs=1e-12)


measured = st.sampled_from([(0, 0.0), (0, 0.3), (0, 1.0), (2, 0.0)])


@given(seeds, st.floats(-3.1, 3.1), st.floats(0.01, 1.0), measured)
def test_update_equals_an_extended_kalman_filter(seed, value, std, measured):
    """A late bearing measures the azimuth minus its rate times the delay."""
    (row, ago_s), belief = measured, random_belief(seed)
    kalman, pick = engine(belief), np.eye(4)[row : row + 1]
    if row == 0:
        pick[0, 1] = -ago_s
    kalman.update(
        np.array([value]),
        HJacobian=lambda x: pick,
        Hx=lambda x: pick @ x,
        R=np.array([[std**2]]),
        residual=(lambda z, x: wrap_angle(z - x)) if row == 0 else np.subtract,
    )
    after = update(belief, row, value, std, 1.0, ago_s)
    assert wrapped(after.mean - kalman.x) == pytest.approx(0.0, abs=1e-12)
    assert after.covariance == pytest.approx(kalman.P, abs=1e-12)
