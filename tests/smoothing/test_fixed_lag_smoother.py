"""The smoother against filterpy's RTS; late observations, a moving ego, corners and walls learned."""

import math

import numpy as np
import pytest
from smoothing_problem import (
    HOP_NS,
    HOP_S,
    PRIOR,
    crossing,
    heard_then_seen,
    hidden_errors_m,
    slots_of_a_street,
)

from worldstate.belief.kinematics.cartesian import CartesianBelief
from worldstate.ground.errors import InvalidArgumentError
from worldstate.measurement import Approach, Bearing, Position
from worldstate.smoothing import (
    AngularHeight,
    EgoStep,
    FixedLagSmoother,
    PastEdge,
    Range,
    ReflectedBearing,
    SmoothingSettings,
    graph,
)

EXACT = SmoothingSettings(robust_k=1e4)


def test_rts_of_filterpy_agrees():
    from filterpy.kalman import KalmanFilter

    rng = np.random.default_rng(0)
    t = 0.1
    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.x, kalman.P = np.array([20.0, 10.0, -3.0, -2.0]), np.diag([4.0, 4.0, 1.0, 1.0])
    kalman.F, kalman.H, kalman.R = np.eye(4) + t * np.eye(4, k=2), np.eye(2, 4), np.diag([0.5, 0.8])
    kalman.Q = np.kron([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]], np.eye(2))
    start = CartesianBelief(kalman.x.copy(), kalman.P.copy())
    truth = np.array([20.5, 9.0, -3.2, -2.1])
    measured = [(truth[:2] + k * t * truth[2:] + rng.normal(0.0, 0.8, 2)).tolist() for k in range(40)]
    smoother = FixedLagSmoother()
    smoother.begin("car", 0, start)
    for k, place in enumerate(measured):
        smoother.update(k * HOP_NS, {"car": [Position(tuple(place), ((0.5, 0.0), (0.0, 0.8)))]})
    # filterpy predicts before its first update, where the belief is already that of the first measurement.
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


def test_hidden_phase_is_corrected_by_what_is_seen_later():
    filtered, smoothed = np.array([hidden_errors_m(seed) for seed in range(5)]).T
    assert np.sqrt((smoothed**2).mean()) < 0.25 * np.sqrt((filtered**2).mean())


@pytest.mark.slow
def test_a_fifth_of_the_filters_error_in_sixty_runs():
    filtered, smoothed = np.array([hidden_errors_m(seed) for seed in range(60)]).T
    assert np.sqrt((smoothed**2).mean()) < 0.2 * np.sqrt((filtered**2).mean())


@pytest.mark.parametrize(("own_state", "within_m"), [(True, 1e-6), (False, 0.1)])
def test_what_comes_late_counts_as_in_order(own_state, within_m):
    observations = heard_then_seen(np.random.default_rng(3)).observations
    tracks = []
    for late_hops in (0, 3):
        smoother = FixedLagSmoother(EXACT)
        smoother.begin("car", 0, PRIOR)
        for hop in range(len(observations) + late_hops):
            # Bearings in order, where the states come from them; the rest of every other hop some hops late.
            if hop < len(observations) and (own_state or hop % 2 == 0):
                bearings = [one for one in observations[hop] if isinstance(one, Bearing)]
                smoother.update(hop * HOP_NS, {"car": bearings})
            at = hop - late_hops
            if at > 0 and at % 2 == 1:
                smoother.update(at * HOP_NS, {"car": observations[at][1:]})
        tracks.append(smoother.track("car"))
    ordered, late = tracks
    # Without a state of its own, in order or not, it hangs on one beside it at constant velocity.
    both, places = np.intersect1d(ordered.stamps_ns, late.stamps_ns), []
    for one in tracks:
        places.append(one.states[np.isin(one.stamps_ns, both), :2][:-4])
    assert np.abs(places[0] - places[1]).max() < within_m


def test_what_comes_later_than_the_lag_is_dropped_and_counted():
    smoother = FixedLagSmoother(SmoothingSettings(lag_s=2.0))
    for hop in range(50):
        smoother.update(hop * HOP_NS, {"car": [Bearing(0.5, 0.1)]})
    before = smoother.track("car").states
    smoother.update(0, {"car": [Bearing(-0.5, 0.001)], "other": [Bearing(0.1, 0.1)]})
    assert smoother.n_dropped == 2
    assert smoother.entities == ("car",)
    np.testing.assert_array_equal(smoother.track("car").states, before)


def test_an_entity_that_is_silent_beyond_the_lag_begins_anew():
    smoother = FixedLagSmoother(SmoothingSettings(lag_s=2.0))
    smoother.update(0, {"car": [Bearing(0.5, 0.1)]})
    smoother.update(100 * HOP_NS, {"bus": [Bearing(0.1, 0.1)]})
    assert smoother.entities == ("bus",)
    smoother.update(101 * HOP_NS, {"car": [Bearing(-0.5, 0.1)]})
    assert smoother.track("car").stamps_ns.tolist() == [101 * HOP_NS]


def test_entities_with_heights_come_and_go():
    # At the 581st step a height that had outlived its states was refused by gtsam.
    assert slots_of_a_street(620, np.random.default_rng(0)) > 0


def test_an_outlier_among_bearings_costs_little():
    def final(outlier: float) -> np.ndarray:
        smoother = FixedLagSmoother()
        for hop in range(30):
            bearing = Bearing(0.6 - 0.01 * hop + (outlier if hop == 12 else 0.0), 0.05)
            smoother.update(hop * HOP_NS, {"car": [bearing, Range(15.0, 0.5)]})
        return smoother.track("car").motion.mean[:, 0]

    assert np.abs(final(1.0) - final(0.0)).max() < 0.02


def test_who_stops_at_once_in_view_drove_on_before_it():
    # Hidden for 2.5 s at 8 m/s, then seen, and at a walk from 2.8 s on.
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


def test_a_wall_is_learned_from_images_and_a_height_from_boxes():
    rng = np.random.default_rng(1)
    smoother = FixedLagSmoother()
    smoother.add_wall("far", 0.1, 13.0, (0.2, 2.0))
    for hop in range(60):
        x, y = 8.0, 12.0 - 0.35 * hop
        r, height = math.hypot(x, y), 1.8 / math.hypot(x, y)
        observed = [
            Bearing(math.atan2(y, x) + rng.normal(0.0, 0.01), 0.01),
            Range(r + rng.normal(0.0, 0.3), 0.3),
            ReflectedBearing("far", math.atan2(y, 24.0 - x) + rng.normal(0.0, 0.03), 0.03),
            AngularHeight(height, 0.03),
        ]
        smoother.update(hop * HOP_NS, {"van": observed})
    (azimuth, distance), spread = smoother.landmark("far")
    assert abs(azimuth) < 0.03
    assert abs(distance - 12.0) < 3.0 * math.sqrt(spread[1, 1]) < 1.5


@pytest.mark.parametrize("side", [1, -1])
def test_first_sight_and_its_edge_are_learned_from_looks(side):
    smoother, late_s = FixedLagSmoother(), []
    smoother.add_corner("edge", side, (5.0, side * 3.4), (1e-3, 0.8))
    true_edge, rng = math.atan2(3.0, 5.0), np.random.default_rng(2)
    for number in range(4):
        start = 30_000_000_000 * number
        # Passes the edge's line of sight, y = 4.8 at x = 8, after 1.8 s.
        for hop in range(45):
            y = 12.0 - 0.4 * hop
            beyond = math.atan2(y, 8.0) > true_edge
            observed = [PastEdge("edge", seen=not beyond and rng.random() < 0.9)]
            if observed[0].seen:
                observed += [Bearing(side * math.atan2(y, 8.0), 0.01), Range(math.hypot(8.0, y), 0.3)]
            else:
                observed += [Bearing(side * (math.atan2(y, 8.0) + rng.normal(0.0, 0.1)), 0.1)]
            smoother.update(start + hop * HOP_NS, {str(number): observed})
        first = smoother.first_sight(str(number), "edge")
        assert first.std_s < 0.3
        late_s.append(first.time_s - 1e-9 * start - 1.8)
    assert np.abs(late_s).max() < 0.2
    mean, _ = smoother.landmark("edge")
    assert abs(math.atan2(*mean[::-1]) - side * true_edge) < math.radians(3.0)


def test_a_moving_ego_sees_a_standing_vehicle_stand():
    rng = np.random.default_rng(4)
    smoother = FixedLagSmoother(SmoothingSettings(acceleration_psd=0.01))
    for hop in range(50):
        # Along a bend: 4 m/s, .1 rad/s.
        heading = 0.01 * hop
        ego = np.array([40.0 * math.sin(heading), 40.0 * (1.0 - math.cos(heading))])
        x, y = np.array([30.0, 6.0]) - ego
        azimuth = math.atan2(y, x) - heading + rng.normal(0.0, 0.01)
        rate = 4.0 * math.cos(azimuth) / math.hypot(x, y) + rng.normal(0.0, 0.05)
        odometry = EgoStep(0.4, 0.002, 0.01) if hop else None
        smoother.update(hop * HOP_NS, {"parked": [Bearing(azimuth, 0.01), Approach(rate, 0.05)]}, odometry)
    track = smoother.track("parked")
    off = track.states[-1] - [30.0, 6.0, 0.0, 0.0]
    assert off @ np.linalg.solve(track.covariance[-1], off) < 13.3  # .99 of chi-square, four degrees
    assert np.abs(off).max() < 3.0


def test_what_cannot_be_is_refused():
    smoother = FixedLagSmoother()
    with pytest.raises(InvalidArgumentError, match="begin with a bearing or position"):
        smoother.update(0, {"car": [Approach(0.1, 0.1)]})
    smoother.update(HOP_NS, {"car": [Bearing(0.1, 0.1)]})
    with pytest.raises(InvalidArgumentError, match="expected one of"):
        smoother.update(2 * HOP_NS, {"car": [PastEdge("nowhere", seen=True)]})
    with pytest.raises(InvalidArgumentError, match="late"):
        smoother.update(0, {}, EgoStep(1.0, 0.0, 0.0))
    with pytest.raises(InvalidArgumentError, match="'nobody'"):
        smoother.track("nobody")


def test_what_marginalised_entities_left_may_be_summed_at_any_time(monkeypatch):
    def landmarks(every: int) -> list[np.ndarray]:
        monkeypatch.setattr(graph, "_SUMMED_EVERY", every)
        smoother, rng = FixedLagSmoother(), np.random.default_rng(3)
        smoother.add_corner("left", 1, (5.0, 3.0), (1.0, 0.5))
        smoother.add_corner("right", -1, (5.0, -3.0), (1.0, 0.5))
        smoother.add_wall("opposite", 0.0, 8.0, (0.05, 0.5))
        for hop in range(700):
            seen = {f"{k}-{(hop + 53 * k) // 160}": crossing((hop + 53 * k) % 160, k, rng) for k in (0, 1)}
            smoother.update(hop * HOP_NS, seen)
        found = [part for name in ("left", "right", "opposite") for part in smoother.landmark(name)]
        return [*found, np.array([smoother.n_factor_slots])]

    summed, apart = landmarks(100), landmarks(10**9)
    for one, other in zip(summed[:-1], apart[:-1], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    assert summed[-1] < apart[-1]


@pytest.mark.slow
def test_an_hour_leaves_memory_and_graph_as_they_were():
    import tracemalloc

    def grown(hours: float) -> tuple[int, int, int]:
        tracemalloc.start()
        slots = slots_of_a_street(round(3600.0 * hours / HOP_S), np.random.default_rng(0))
        return *tracemalloc.get_traced_memory(), slots

    _, peak_early, slots_early = grown(0.02)
    _, peak_late, slots_late = grown(1.0)
    assert slots_late < 1.3 * slots_early
    assert peak_late < peak_early + 5e6
