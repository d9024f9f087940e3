"""Positions of radar and radio: Cartesian motion, existence, association, hand-over; filterpy as oracle."""

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from street_measurements import ABSENT, PRESENT, SEEDS, after, car, diagonal, hop, reading

from worldstate import Context, FilterSettings, Measurement, Sighting, WorldFilter, WorldState
from worldstate.abduction.co_evidence import Absent
from worldstate.belief.hidden_bearing import time_to_visible
from worldstate.belief.kinematics.cartesian import CartesianBelief, polar_motion, update_bearing
from worldstate.belief.site_geometry import SideGeometry, SiteGeometry
from worldstate.belief.street_model import StreetModel
from worldstate.measurement import Odometry, Position, PositionScan, SearchedSector, Sector
from worldstate.state.context import corner_at

RADAR = SearchedSector(Sector(0.0, 1.05), range_m=70.0, detection_probability=0.5)


def radar(time_s: float, *positions: Position, **options: float | Sector) -> PositionScan:
    return PositionScan("radar", round(time_s * 1e9), positions, replace(RADAR, **options))


def radio(time_s: float, *positions: Position) -> PositionScan:
    return PositionScan("v2x", round(time_s * 1e9), positions)


def heard(time_s: float, left: float = 0.0, boxes: tuple[Sighting, ...] = ()) -> Measurement:
    return hop(10 * time_s, (left, 0.0, 0.0, 0.0), *boxes, answer=PRESENT if boxes else ABSENT)


def crossing(time_s: float, trust: float = 0.95, noise: tuple[float, ...] = (0.0,) * 4) -> Position:
    """Return a car on the cross street 10 m ahead, behind the left corner until 4.1 s."""
    x, y, vx, vy = np.array([10.0, 7.0 + 8.0 * (4.0 - time_s), 0.0, -8.0]) + noise
    return Position((x, y), diagonal(0.5, 0.5, 0.3, 0.3), (vx, vy), trust, (("car", 0.9),))


def covariances(rng: np.random.Generator, size: int) -> np.ndarray:
    turn, _ = np.linalg.qr(rng.normal(size=(size, size)))
    spread = turn @ np.diag(rng.uniform(0.1, 1.0, size)) @ turn.T
    return 0.5 * (spread + spread.T)


@given(SEEDS)
@settings(max_examples=20)
def test_published_positions_equal_a_kalman_filter(seed: int) -> None:
    """One car, positions with and without velocity, at uneven times; filterpy is the oracle."""
    rng, now_ns, world = np.random.default_rng(seed), 10**9, WorldFilter()
    truth, kalman = np.array([30.0, 5.0, -4.0, 1.0]), KalmanFilter(dim_x=4, dim_z=2)
    unknown = StreetModel().speed_mps ** 2
    for step in range(12):
        step_ns = int(rng.integers(3 * 10**7, 3 * 10**8)) if step else 0
        now_ns, dt_s = now_ns + step_ns, step_ns * 1e-9
        known = 4 if rng.random() < 0.5 else 2
        R = covariances(rng, known)
        truth = truth + np.array([*truth[2:], 0.0, 0.0]) * dt_s
        z = rng.multivariate_normal(truth[:known], R)
        velocity = (z[2], z[3]) if known == 4 else None
        found = Position((z[0], z[1]), tuple(map(tuple, R)), velocity)
        world = world.update(radar(now_ns * 1e-9, found, detection_probability=0.9))
        if step == 0:
            kalman.x, kalman.P = np.zeros(4), np.diag([0.0, 0.0, unknown, unknown])
            kalman.x[:known], kalman.P[:known, :known] = z, R
            continue
        kalman.F = np.eye(4) + dt_s * np.eye(4, k=2)
        kalman.Q = Q_continuous_white_noise(2, dt_s, 2.0, block_size=2, order_by_dim=False)
        kalman.predict()
        kalman.update(z, R=R, H=np.eye(4)[:known])
    (car,) = world.state.entities
    assert car.velocity_mps is not None and car.position_m is not None
    assert (*car.position_m[:2], *car.velocity_mps[:2]) == pytest.approx(kalman.x, abs=1e-9)
    np.testing.assert_allclose(car.covariance, kalman.P, atol=1e-9)


def belief(rng: np.random.Generator) -> CartesianBelief:
    away = rng.uniform(-3.0, 3.0)
    mean = [*(rng.uniform(5.0, 60.0) * np.array([math.cos(away), math.sin(away)])), *rng.normal(0.0, 8.0, 2)]
    return CartesianBelief(np.array(mean), covariances(rng, 4))


@given(SEEDS, st.floats(-0.2, 0.2), st.floats(0.01, 0.2))
@settings(max_examples=30)
def test_a_bearing_update_equals_an_extended_kalman_filter(seed: int, off: float, std: float) -> None:
    start = belief(np.random.default_rng(seed))
    x, y = start.mean[:2]
    azimuth = math.atan2(y, x) + off
    kalman = ExtendedKalmanFilter(dim_x=4, dim_z=1)
    kalman.x, kalman.P = start.mean.copy(), start.covariance.copy()
    kalman.update(
        np.array([azimuth]),
        HJacobian=lambda m: np.array([[-m[1], m[0], 0.0, 0.0]]) / (m[0] ** 2 + m[1] ** 2),
        Hx=lambda m: np.array([math.atan2(m[1], m[0])]),
        R=np.array([[std**2]]),
    )
    now = update_bearing(start, azimuth, std)
    np.testing.assert_allclose(now.mean, kalman.x, atol=1e-9)
    np.testing.assert_allclose(now.covariance, kalman.P, atol=1e-9)


@given(SEEDS)
@settings(max_examples=30)
def test_polar_motion_equals_numerical_derivatives(seed: int) -> None:
    """Its rates and their covariance are those of difference quotients of azimuth and log range."""
    start, small = belief(np.random.default_rng(seed)), 1e-5
    speed_mps = 3.0

    def polar(mean: np.ndarray) -> np.ndarray:
        ahead = [mean[:2] + sign * small * (mean[2:] - [speed_mps, 0.0]) for sign in (-1.0, 1.0)]
        before, then = (np.array([math.atan2(y, x), math.log(math.hypot(x, y))]) for x, y in ahead)
        rates = (then - before) / (2.0 * small)
        middle = (then + before) / 2.0
        return np.array([middle[0], *rates, middle[1]])

    motion = polar_motion(start, speed_mps)
    np.testing.assert_allclose(motion.mean, polar(start.mean), atol=1e-6)
    slope = np.stack(
        [(polar(start.mean + 1e-4 * e) - polar(start.mean - 1e-4 * e)) / 2e-4 for e in np.eye(4)], 1
    )
    np.testing.assert_allclose(motion.covariance, slope @ start.covariance @ slope.T, atol=1e-4)


@pytest.mark.parametrize("searched", [{"range_m": 15.0}, {"sector": Sector(0.9, 0.2)}])
def test_a_scan_of_another_sector_changes_no_existence(searched: dict[str, float | Sector]) -> None:
    there = Position((20.0, 2.0), diagonal(0.1, 0.1, 0.1, 0.1), (0.0, 0.0))
    world = after(*[radar(t, there) for t in (0.1, 0.2, 0.3)])
    later = world.update(radar(0.4, **searched))
    before, now = (one.state.entities[0].existence_probability for one in (world.predict(0.1), later))
    assert now == pytest.approx(before, abs=1e-9)


def test_a_message_alone_makes_a_hidden_entity_with_a_position() -> None:
    rng, inside = np.random.default_rng(2), []
    world, noises = WorldFilter(), rng.normal(0.0, (0.5, 0.5, 0.3, 0.3), (40, 4))
    for at in range(1, 36):
        world = world.update(radio(at / 10, crossing(at / 10, noise=tuple(noises[at]))))
        (car,) = world.state.entities
        low, _, high = car.time_to_visible_s
        inside.append(low <= 4.0 + (7.0 - 10.0 * math.tan(math.radians(32.0))) / 8.0 - at / 10 <= high)
    assert (car.status, car.direction, car.sources) == ("hidden", "left", ("v2x",))
    assert car.existence_probability == pytest.approx(0.95, abs=1e-9)  # Repetitions of one source count once
    assert np.hypot(car.position_m[0] - 10.0, car.position_m[1] - 11.0) < 1.0
    assert car.velocity_mps[1] == pytest.approx(-8.0, abs=1.0)
    assert np.mean(inside) > 0.8
    left, right = world.state.cues
    assert left.advisory and not right.advisory and left.risk > 0.9 > 0.1 > right.risk
    assert left.entity_id == car.id and left.time_to_visible_s == car.time_to_visible_s
    assert (left.statistic, left.log_lambda) == (None, None)  # There was no window
    assert WorldState.from_json(world.state.to_json()) == world.state


def test_an_announced_vehicle_keeps_its_identity_when_detected() -> None:
    announced = after(*[radio(at / 10, crossing(at / 10)) for at in range(1, 42)])
    (before,) = announced.state.entities
    for sensor in ("camera", "radar"):
        world = announced
        for at in range(42, 47):
            now = crossing(at / 10)
            azimuth = math.atan2(now.position_m[1], now.position_m[0])
            look = heard(at / 10, boxes=(car(azimuth, 0.03),)) if sensor == "camera" else radar(at / 10, now)
            world = after(look, radio(at / 10 + 0.01, crossing(at / 10 + 0.01)), world=world)
        (seen,) = world.state.entities
        assert (seen.id, seen.status) == (before.id, "visible")
        assert not any(cue.advisory for cue in world.predict(1.0).state.cues)
        assert world.state.risk < 0.2


def test_a_message_is_associated_with_the_hidden_vehicle() -> None:
    world = after(*[heard(at / 10, left=4.0) for at in range(1, 15)])
    (before,) = world.state.entities
    assert before.position_m is None
    (joined,) = after(radio(1.45, crossing(1.45)), world=world).state.entities
    assert (joined.id, joined.status) == (before.id, "hidden")
    assert joined.existence_probability > before.existence_probability
    np.testing.assert_allclose(joined.position_m, (10.0, 27.4, 0.0), atol=1e-9)


def test_a_forged_visible_claim_is_refuted_despite_repetition() -> None:
    world, ghosts = WorldFilter(), []
    forged = Position((15.0, 1.0), diagonal(0.5, 0.5, 0.3, 0.3), (-1.0, 0.0), 0.99)
    for at in range(1, 60):
        world = after(radio(at / 10, forged), heard(at / 10 + 0.02), world=world)
        ghosts.append(max((one.existence_probability for one in world.state.entities), default=0.0))
    assert max(ghosts[:2]) > 0.5 and max(ghosts[10:]) < 0.05
    # With a camera that misses 99 % the claim is believed.
    blind = replace(heard(0.0), co_evidence=Absent(0.99, 0.01))
    told = [(radio(at / 10, forged), replace(blind, stamp_ns=at * 10**8 + 2 * 10**7)) for at in range(1, 30)]
    assert after(*(one for pair in told for one in pair)).state.entities[0].existence_probability > 0.7


def test_two_cars_that_meet_keep_their_identities() -> None:
    """They pass 1 m apart at 10 m/s; position errors of 0.5 m alone would confuse them."""
    ids, world = set(), WorldFilter()
    for scan in range(1, 31):
        time_s, std = scan / 10, diagonal(0.5, 0.5, 0.5, 0.5)
        going = Position((10.0 + 10.0 * time_s, 0.5), std, (10.0, 0.0))
        coming = Position((40.0 - 10.0 * time_s, -0.5), std, (-10.0, 0.0))
        world = world.update(radar(time_s, going, coming, detection_probability=0.9))
        ids.add(tuple(one.id for one in sorted(world.state.entities, key=lambda one: one.velocity_mps)))
    assert len(ids) == 1 and len(*ids) == 2


def test_a_standing_object_approaches_a_driving_ego_vehicle() -> None:
    post = Position((40.0, 3.0), diagonal(0.1, 0.1, 0.1, 0.1), (0.0, 0.0))
    world = after(radar(1.0, post), world=WorldFilter(Context(ego_speed_mps=10.0)))
    (later,) = world.predict(1.0).state.entities
    assert (*later.position_m, *later.velocity_mps) == pytest.approx((30.0, 3.0, 0.0, 0.0, 0.0, 0.0))
    assert later.azimuth_rate_rad_s == pytest.approx(10.0 * 3.0 / (30.0**2 + 3.0**2))


def test_the_latency_of_a_scan_is_subtracted_from_its_stamp() -> None:
    late = replace(radar(1.3, crossing(1.0)), latency_s=0.3)
    assert after(late).state == after(radar(1.0, crossing(1.0))).state


def test_radar_and_camera_are_fused() -> None:
    world, boxes = WorldFilter(), (car(0.1), car(-0.2))
    cars = [Position((20.0 * math.cos(a), 20.0 * math.sin(a)), diagonal(0.5, 0.5)) for a in (0.1, -0.2)]
    for at in range(1, 8):
        world = after(heard(at / 10, boxes=boxes), radar(at / 10 + 0.05, *cars), world=world)
    entities = world.state.entities
    assert [one.sources for one in entities] == [("radar", "vision")] * 2
    # The box is more precise across; only the radar measures along.
    across = [math.sqrt(np.linalg.eigvalsh(np.array(one.covariance)[:2, :2])[0]) for one in entities]
    assert max(across) < 0.25


def passed_s(place: np.ndarray, corners: np.ndarray, speed_mps: float, step_s: float) -> np.ndarray:
    """Return when each road user (n, 4) crosses the line of sight past its corner (n, 2).

    Infinite if it does not cross within eight seconds, negative if it is already visible.
    """
    first = np.full(len(place), math.inf)
    for time_s in np.arange(0.0, 8.0, step_s)[::-1]:
        ray, off = (
            one - (speed_mps * time_s, 0.0) for one in (corners, place[:, :2] + time_s * place[:, 2:])
        )
        first[ray[:, 0] * off[:, 1] <= ray[:, 1] * off[:, 0]] = time_s if time_s else -1.0
    return first


@given(SEEDS)
@settings(max_examples=20)
def test_the_risk_of_a_message_equals_the_share_of_draws(seed: int) -> None:
    rng = np.random.default_rng(seed)
    edge_rad, edge_std = rng.uniform(0.2, 1.0), rng.uniform(0.001, 0.07)
    azimuth_rad, range_m = edge_rad + rng.uniform(0.0, 0.7), rng.uniform(5.0, 50.0)
    mean = np.array(
        [range_m * math.cos(azimuth_rad), range_m * math.sin(azimuth_rad), *rng.uniform(-8, 8, 2)]
    )
    turn, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    covariance = turn @ np.diag(np.exp(rng.uniform(-2.0, 2.2, 4))) @ turn.T
    edges_rad = edge_rad + edge_std * rng.standard_normal(20_000)
    draws = rng.multivariate_normal(mean, covariance, 20_000)
    passed = passed_s(draws, np.stack([np.cos(edges_rad), np.sin(edges_rad)], axis=1), 0.0, 0.05)
    hidden = passed > 0.0
    share, chances = np.mean(passed[hidden] <= 8.0), []
    for way in (1.0, -1.0):  # Mirrored
        flip = np.array([1.0, way, 1.0, way])
        place = CartesianBelief(mean * flip, covariance * np.outer(flip, flip))
        side = SideGeometry("left", way * edge_rad, way * (edge_rad + 0.4), 0.35, edge_std)
        site = SiteGeometry((side,), 0.6, FilterSettings())
        chance, times_s = time_to_visible(place, side, site)
        chances.append(chance)
        assert (times_s is None) == (chance < 0.9)
        if times_s is not None:
            low_s, best_s, high_s = times_s
            assert 0.0 <= low_s <= best_s <= high_s <= 8.0
    if hidden.sum() > 2000:
        assert chances[0] == pytest.approx(share, abs=0.02)
    assert chances[1] == pytest.approx(chances[0], abs=1e-9)


@pytest.mark.parametrize("speed_mps", [0.0, 2.0, 5.0, 8.3])
@pytest.mark.parametrize("told_by", ["context", "odometry"])
def test_the_line_of_sight_turns_with_the_approach_to_the_corner(speed_mps, told_by) -> None:
    sides = corner_at("left", (30.0, 5.0), 34.0), corner_at("right", (30.0, -5.0), 34.0)
    start, corner, errors = np.array([[34.0, 22.0, 0.0, -4.0]]), np.array([[30.0, 5.0]]), []
    true_s = float(passed_s(start, corner, speed_mps, 0.001)[0])
    world = WorldFilter(Context(occluders=sides, ego_speed_mps=speed_mps if told_by == "context" else None))
    for time_s in np.arange(0.0, true_s + 0.2, 0.1):
        if told_by == "odometry":
            world = world.update(Odometry("wheels", round(time_s * 1e9), speed_mps))
        at = 34.0 - speed_mps * time_s, 22.0 - 4.0 * time_s
        world = world.update(radio(time_s, Position(at, diagonal(0.3, 0.3, 0.2, 0.2), (0.0, -4.0), 0.95)))
        (entity,), cues = world.state.entities, world.state.cues
        if entity.status == "hidden":
            errors.append(entity.time_to_visible_s[1] - (true_s - time_s))
            assert cues[0].risk > 0.8 and world.risk == world.state.risk
            assert cues[0].advisory or not 0.25 < time_s < true_s - 0.1
    assert entity.status != "hidden" and np.abs(errors).max() < 0.05 and len(errors) >= true_s * 10.0
    # With a corner at unknown distance the line of sight is assumed constant, so no cue is lost.
    usual = [Context(ego_speed_mps=speed_mps), Context()]
    moving, standing = (after(heard(0.1), radio(0.1, crossing(0.1)), world=WorldFilter(one)) for one in usual)
    assert moving.risk == pytest.approx(standing.risk, abs=1e-9)


def test_messages_on_both_sides_raise_both_advisories() -> None:
    """With a sequence model below its threshold, and without one."""
    for said in (None, reading({}, 1.0)):
        world = WorldFilter()
        for at in range(1, 8):
            left = crossing(at / 10)
            right = replace(left, position_m=(10.0, -left.position_m[1]), velocity_mps=(0.0, 8.0))
            sound = replace(heard(at / 10), sequence=said)
            world = after(sound, radio(at / 10 + 0.05, left, right), world=world)
        cues = world.state.cues
        assert [bool(cue.advisory) for cue in cues] == [True, True]
        assert {cue.evidence.hypothesis for cue in cues} == {"announced"}
        assert sorted(one.direction for one in world.state.entities) == ["left", "right"]
        assert not any(cue.advisory for cue in world.predict(1.2).state.cues)


def test_a_position_is_published_only_while_it_is_precise() -> None:
    world = after(*[radio(at / 10, crossing(at / 10 - 40.0)) for at in range(1, 5)])
    later = [world.predict(wait_s).state.entities for wait_s in (0.0, 2.0, 4.5, 7.0)]
    told = [[one.position_m is not None for one in entities] for entities in later]
    assert told == [[True], [True], [False], []]


def test_a_radar_detection_at_the_edge_is_a_hand_over() -> None:
    world = after(*[heard(at / 10, left=4.0) for at in range(1, 15)])
    (before,) = world.state.entities
    edge, elsewhere = (
        Position((r * math.cos(a), r * math.sin(a)), diagonal(0.3, 0.3)) for r, a in ((12, 0.5), (30, 0.0))
    )
    (found,) = after(radar(1.45, edge), world=world).state.entities
    assert (found.id, found.status) == (before.id, "visible")
    both = after(radar(1.45, elsewhere), world=world).state.entities
    assert [one.status for one in both] == ["hidden", "visible"] and both[0].id == before.id


@given(st.integers(1, 4), SEEDS)
@settings(max_examples=10, deadline=None)
def test_certain_visible_vehicles_exclude_the_hypothesis_none(cars: int, seed: int) -> None:
    rng, world = np.random.default_rng(seed), WorldFilter()
    lanes = [(15.0 + 8.0 * k, float(rng.uniform(-4.0, 4.0))) for k in range(cars)]
    for at in range(1, 12):
        there = [Position((x + 0.3 * at, y), diagonal(0.4, 0.4, 0.3, 0.3), (3.0, 0.0)) for x, y in lanes]
        scan = radar(at / 10 + 0.02, *there, detection_probability=0.9)
        world = after(heard(at / 10), scan, world=world)
    for cue in world.state.cues:
        said = cue.hypotheses
        assert said.none < 0.05 and said.hidden + said.visible + said.none == pytest.approx(1.0)
