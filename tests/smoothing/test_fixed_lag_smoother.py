"""The fixed-lag smoother against the RTS smoother of filterpy, late observations, first sight; its factors.

The synthetic problem: bearing and looming while hidden, then range, for a standing ego.
"""

import math

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.belief.kinematics import motion
from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.ground import wrap_angle
from worldstate.ground.errors import InvalidArgumentError
from worldstate.measurement import Approach, Bearing, Position
from worldstate.smoothing import AngularHeight, FixedLagSmoother, Range, SmoothedTrack, SmoothingSettings
from worldstate.smoothing import factors as f
from worldstate.smoothing.factors import vector_factor

EXACT = SmoothingSettings(robust_k=1e4)
HOP_S, HOP_NS, HOPS, HIDDEN_HOPS = 0.1, 100_000_000, 60, 35
PSD = 1.0  # Of the acceleration of vehicles, m^2/s^3
HIDDEN_STD_RAD, SEEN_STD_RAD, LOOMING_STD_HZ, RANGE_STD_M = math.radians(4.0), math.radians(1.0), 0.25, 0.5
PRIOR = MotionBelief.around((0.9, -0.1, -0.2, math.log(25.0)), (0.35, 0.15, 0.15, 0.5))


def heard_then_seen(rng: np.random.Generator) -> tuple[np.ndarray, list]:
    """Return the places of a vehicle drawn from the prior at a suitable distance, and its measurements."""
    places, azimuth, rate = _drawn(rng)
    r = np.hypot(*places.T)
    observations = []
    for hop in range(HOPS):
        hidden = hop < HIDDEN_HOPS
        std = HIDDEN_STD_RAD if hidden else SEEN_STD_RAD
        seen = [Bearing(wrap_angle(azimuth[hop] + rng.normal(0.0, std)), std)]
        seen.append(Approach(rate[hop] + rng.normal(0.0, LOOMING_STD_HZ), LOOMING_STD_HZ))
        if not hidden:
            seen.append(Range(max(r[hop] + rng.normal(0.0, RANGE_STD_M), 1.0), RANGE_STD_M))
        observations.append(seen)
    return places, observations


def _drawn(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = HOP_S
    flow = np.eye(4) + t * np.eye(4, k=2)
    jolt = np.linalg.cholesky(PSD * np.kron([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]], np.eye(2)))
    while True:
        theta, turning, closing, log_m = rng.normal(PRIOR.mean, np.sqrt(np.diag(PRIOR.covariance)))
        z = np.exp(log_m + 1j * theta)
        v = z * (closing + 1j * turning)
        states = [np.array([z.real, z.imag, v.real, v.imag])]
        for _ in range(HOPS - 1):
            states.append(flow @ states[-1] + jolt @ rng.standard_normal(4))
        x, y, vx, vy = np.array(states).T
        r = np.hypot(x, y)
        if r.min() > 4.0 and r.max() < 70.0:
            return np.stack([x, y], axis=1), np.arctan2(y, x), -(x * vx + y * vy) / r**2


def hidden_errors_m(seed: int) -> tuple[float, float]:
    """Return the rms error of hidden positions of filter and smoother."""
    places, observations = heard_then_seen(np.random.default_rng(seed))
    belief, filtered = PRIOR, []
    smoother = FixedLagSmoother(SmoothingSettings(acceleration_psd=PSD))
    smoother.begin("car", 0, belief)
    for hop, observed in enumerate(observations):
        smoother.update(hop * HOP_NS, {"car": observed})
        if hop < HIDDEN_HOPS:
            belief = motion.predict(belief, HOP_S, PSD) if hop else belief
            bearing, approach = observed
            belief = motion.update(belief, motion.AZIMUTH, bearing.azimuth_rad, bearing.std_rad, 1.0)
            belief = motion.update(belief, motion.RADIAL_RATE, -approach.inverse_tta_hz, approach.std_hz, 1.0)
            filtered.append(np.exp(belief.mean[3] + 1j * belief.mean[0]))
    z = np.array(filtered)
    true = places[:HIDDEN_HOPS]
    smoothed = smoother.track("car").states[:HIDDEN_HOPS, :2]
    return tuple(
        math.sqrt(((found - true) ** 2).sum(axis=1).mean())
        for found in (np.stack([z.real, z.imag], axis=1), smoothed)
    )


PASS_HOPS, ENTITIES = 160, 3


def slots_of_a_street(hops: int, rng: np.random.Generator) -> int:
    """Return the number of factor slots after a stream of three entities."""
    smoother = FixedLagSmoother()
    for hop in range(hops):
        seen = {}
        for number in range(ENTITIES):
            # Each returns after its pass with another name: 16 s, at first 24 m to 40 m away.
            after, passes = (hop + 53 * number) % PASS_HOPS, (hop + 53 * number) // PASS_HOPS
            seen[f"{number}-{passes}"] = crossing(after, number, rng)
        smoother.update(hop * HOP_NS, seen)
    return smoother.n_factor_slots


def crossing(hop: int, number: int, rng: np.random.Generator) -> list:
    """Return the measurements of one entity at a hop of its pass."""
    side = 1 if number % 2 == 0 else -1
    x, y, speed = 8.0 + number, side * (24.0 - 0.3 * hop), 3.0
    azimuth, r = math.atan2(y, x), math.hypot(x, y)
    inverse_tta = side * y * speed / r**2
    heard = [
        Bearing(wrap_angle(azimuth + rng.normal(0.0, 0.07)), 0.07),
        Approach(inverse_tta + rng.normal(0.0, 0.25), 0.25),
    ]
    hidden = side * y / x > 0.6
    if hop % 10 == 0:
        # Without any range one entity in some 300 gives gtsam's "indeterminate linear system".
        heard.append(Range(max(r + rng.normal(0.0, 2.0), 1.0), 2.0))
    if not hidden:
        heard[0] = Bearing(azimuth + rng.normal(0.0, 0.01), 0.01)
        heard.append(AngularHeight(1.5 / r * math.exp(rng.normal(0.0, 0.03)), 0.03))
    return heard


def test_rts_of_filterpy_agrees():
    from filterpy.kalman import KalmanFilter

    rng = np.random.default_rng(0)
    t = 0.1
    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.x, kalman.P = np.array([20.0, 10.0, -3.0, -2.0]), np.diag([4.0, 4.0, 1.0, 1.0])
    kalman.F, kalman.H, kalman.R = np.eye(4) + t * np.eye(4, k=2), np.eye(2, 4), np.diag([0.5, 0.8])
    kalman.Q = np.kron([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]], np.eye(2))
    # The prior is flat; the first position and velocity define the belief.
    anywhere = MotionBelief.around((0.5, 0.0, -0.2, math.log(22.0)), (1e4,) * 4)
    first = Position((20.0, 10.0), tuple(map(tuple, kalman.P.tolist())), velocity_mps=(-3.0, -2.0))
    truth = np.array([20.5, 9.0, -3.2, -2.1])
    measured = [(truth[:2] + k * t * truth[2:] + rng.normal(0.0, 0.8, 2)).tolist() for k in range(40)]
    smoother = FixedLagSmoother()
    smoother.begin("car", 0, anywhere)
    smoother.update(0, {"car": [first]})
    for k, place in enumerate(measured):
        smoother.update(k * HOP_NS, {"car": [Position(tuple(place), ((0.5, 0.0), (0.0, 0.8)))]})
    # The first update of filterpy has no prediction before it.
    kalman.update(np.array(measured[0]))
    means, covariances = [kalman.x.copy()], [kalman.P.copy()]
    for place in measured[1:]:
        kalman.predict()
        kalman.update(np.array(place))
        means.append(kalman.x.copy())
        covariances.append(kalman.P.copy())
    expected, spread, *_ = kalman.rts_smoother(np.array(means), np.array(covariances))
    track = smoother.track("car")
    np.testing.assert_allclose(track.states, expected, atol=1e-6)
    np.testing.assert_allclose(track.covariance, spread, atol=1e-6)


@pytest.mark.parametrize(("passes", "share"), [(5, 0.25), pytest.param(60, 0.2, marks=pytest.mark.slow)])
def test_later_positions_correct_the_hidden_phase(passes, share):
    filtered, smoothed = np.array([hidden_errors_m(seed) for seed in range(passes)]).T
    assert np.sqrt((smoothed**2).mean()) < share * np.sqrt((filtered**2).mean())


@pytest.mark.parametrize(("own_state", "within_m"), [(True, 1e-6), (False, 0.1)])
def test_late_observations_equal_those_in_order(own_state, within_m):
    observations = heard_then_seen(np.random.default_rng(3))[1]
    tracks = []
    for late_hops in (0, 3):
        smoother = FixedLagSmoother(EXACT)
        smoother.begin("car", 0, PRIOR)
        for hop in range(len(observations) + late_hops):
            # Bearings in order, which create the states; the rest of every second hop some hops late.
            if hop < len(observations) and (own_state or hop % 2 == 0):
                bearings = [one for one in observations[hop] if isinstance(one, Bearing)]
                smoother.update(hop * HOP_NS, {"car": bearings})
            at = hop - late_hops
            if at > 0 and at % 2 == 1:
                smoother.update(at * HOP_NS, {"car": observations[at][1:]})
        tracks.append(smoother.track("car"))
    ordered, late = tracks
    # Without a state of its own it uses the adjacent one at constant velocity, in order or not.
    both, places = np.intersect1d(ordered.stamps_ns, late.stamps_ns), []
    for one in tracks:
        places.append(one.states[np.isin(one.stamps_ns, both), :2][:-4])
    assert np.abs(places[0] - places[1]).max() < within_m


def test_observations_later_than_the_lag_are_dropped_and_counted():
    smoother = FixedLagSmoother(SmoothingSettings(lag_s=2.0))
    for hop in range(50):
        smoother.update(hop * HOP_NS, {"car": [Bearing(0.5, 0.1)]})
    before = smoother.track("car").states
    smoother.update(0, {"car": [Bearing(-0.5, 0.001)], "other": [Bearing(0.1, 0.1)]})
    assert smoother.n_dropped == 2
    assert smoother.entities == ("car",)
    np.testing.assert_array_equal(smoother.track("car").states, before)


def test_an_entity_without_observations_beyond_the_lag_restarts():
    smoother = FixedLagSmoother(SmoothingSettings(lag_s=2.0))
    smoother.update(0, {"car": [Bearing(0.5, 0.1)]})
    smoother.update(100 * HOP_NS, {"bus": [Bearing(0.1, 0.1)]})
    assert smoother.entities == ("bus",)
    smoother.update(101 * HOP_NS, {"car": [Bearing(-0.5, 0.1)]})
    assert smoother.track("car").stamps_ns.tolist() == [101 * HOP_NS]


@pytest.mark.long
def test_entities_with_heights_come_and_go_in_bounded_memory():
    # At step 581 gtsam refused a height that had outlived its states.
    early, late = (slots_of_a_street(hops, np.random.default_rng(0)) for hops in (320, 620))
    assert late < 1.3 * early


def test_an_outlier_among_bearings_costs_little():
    def final(outlier: float) -> np.ndarray:
        smoother = FixedLagSmoother()
        for hop in range(30):
            bearing = Bearing(0.6 - 0.01 * hop + (outlier if hop == 12 else 0.0), 0.05)
            smoother.update(hop * HOP_NS, {"car": [bearing, Range(15.0, 0.5)]})
        return smoother.track("car").motion.mean[:, 0]

    assert np.abs(final(1.0) - final(0.0)).max() < 0.02


def test_braking_in_view_does_not_change_the_hidden_phase():
    # Hidden for 2.5 s at 8 m/s, then in view, and at a walk from 2.8 s on.
    rng, time_s = np.random.default_rng(0), np.arange(45) * 0.1
    true_y = 26.0 - np.concatenate([[0.0], np.cumsum(np.where(time_s < 2.8, 0.8, 0.05))[:-1]])
    noise_m, noise_rad = rng.normal(0.0, 0.6, 45), rng.normal(0.0, 0.01, 45)

    def hidden_error_m(manoeuvre_k: float | None) -> float:
        settings = SmoothingSettings(lag_s=30.0, relinearize_every=1000, manoeuvre_k=manoeuvre_k)
        smoother = FixedLagSmoother(settings)
        smoother.begin("car", 0, PRIOR)
        for hop, y in enumerate(true_y.tolist()):
            seen = [
                Bearing(math.atan2(y, 9.0) + noise_rad[hop], 0.01),
                Range(math.hypot(y, 9.0) + noise_m[hop], 0.6),
            ]
            smoother.update(hop * HOP_NS, {"car": seen if hop >= 25 else []})
        return float(np.abs(smoother.track("car").states[:25, 1] - true_y[:25]).max())

    assert hidden_error_m(1.0) < 0.5 * hidden_error_m(None)


def test_a_height_is_learned_from_boxes():
    rng, smoother = np.random.default_rng(1), FixedLagSmoother()
    for hop in range(60):
        x, y = 8.0, 12.0 - 0.35 * hop
        r = math.hypot(x, y)
        # The last ones without a range, of a body that is higher than most.
        observed = [Bearing(math.atan2(y, x) + rng.normal(0.0, 0.01), 0.01), AngularHeight(1.8 / r, 0.03)]
        ranged = [Range(r + rng.normal(0.0, 0.3), 0.3)] if hop < 40 else []
        smoother.update(hop * HOP_NS, {"van": observed + ranged})
    x, y, *_ = smoother.track("van").states[-1]
    assert math.hypot(x - 8.0, y - (12.0 - 0.35 * 59)) < 0.5


@pytest.mark.parametrize("side", [1, -1])
def test_first_sight_is_the_passing_of_the_edge(side):
    smoother, rng = FixedLagSmoother(), np.random.default_rng(2)
    edge_rad, errors_s = side * math.atan2(3.0, 5.0), []
    for number in range(4):
        # Passes the line of sight of the edge, y = 4.8 at x = 8, after 1.8 s.
        start = 30_000_000_000 * number
        for hop in range(45):
            y = 12.0 - 0.4 * hop
            std = 0.01 if y < 4.8 else 0.1
            observed = [Bearing(side * (math.atan2(y, 8.0) + rng.normal(0.0, std)), std)]
            observed += [Range(math.hypot(8.0, y), 0.3)] if y < 4.8 else []
            smoother.update(start + hop * HOP_NS, {str(number): observed})
        track = smoother.track(str(number))
        first, sharp = (track.first_sight(side, edge_rad, std) for std in (math.radians(2.0), 0.0))
        assert first.time_s == sharp.time_s
        assert sharp.std_s < first.std_s < 0.3
        errors_s.append(first.time_s - 1e-9 * start - 1.8)
    assert np.abs(errors_s).max() < 0.2
    assert track.first_sight(side, 1.5 * side, 0.0) is None


@pytest.mark.parametrize("side", [1, -1])
def test_an_overtaking_vehicle_passes_only_the_edge_of_its_side(side):
    azimuths = [side * (math.pi - 0.2 * hop) for hop in range(15)]
    passed = [MotionBelief.around((at, -2.0 * side, 0.0, 2.0), (0.03, 0.1, 0.1, 0.2)) for at in azimuths]
    track = SmoothedTrack("car", np.arange(15) * HOP_NS, MotionBelief.stacked(passed))
    assert track.first_sight(-side, -0.55 * side, 0.04) is None
    assert track.first_sight(side, 0.55 * side, 0.04).time_s == pytest.approx(1.3, abs=0.01)


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
