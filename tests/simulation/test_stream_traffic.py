"""Arrivals, motion and sight of a stream, without sound."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, kstest

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.commissioning.stream_figure import FLOWS
from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation import preset, site
from worldstate.simulation.scene.kinds import LIGHT, vehicle_kind
from worldstate.simulation.scene.settings import SoundSettings
from worldstate.simulation.scene.vehicle import along
from worldstate.simulation.stream.arrivals import SoundEvent, VehicleEvent, draw_events, draw_sounds
from worldstate.simulation.stream.manoeuvres import (
    MANOEUVRES,
    Driver,
    SpeedLimit,
    draw_driver,
    emerges,
)
from worldstate.simulation.stream.settings import HAZARDS, RAIN_DB, StreamSettings, Traffic, traffic_named
from worldstate.simulation.stream.truth import (
    CLUTTER_IMAGES,
    CLUTTER_PER_HOUR,
    VehicleTruth,
    describe_events,
    detected_frames,
    vehicle_truth,
    visible_s,
)

NEVER_SEEN = {"turns_away", "parks", "far", "distant"}


def stream(where: str, traffic: str | Traffic, minutes: float = 60.0) -> StreamSettings:
    return StreamSettings(
        site(where), minutes, traffic=traffic_named(traffic) if isinstance(traffic, str) else traffic
    )


def events_of(settings: StreamSettings, seed: int) -> list[VehicleEvent]:
    return draw_events(settings, np.random.default_rng(seed))


def truths_of(settings: StreamSettings, seed: int) -> list[VehicleTruth]:
    return [vehicle_truth(i, event, settings) for i, event in enumerate(events_of(settings, seed))]


def test_counts_of_every_flow_are_poisson_over_seeds() -> None:
    rates = {"left": 120.0, "far": 300.0, "turns_away": 60.0}
    seeds, hours = 40, 0.05
    settings = stream("SB1", Traffic("test", rates), 60.0 * hours)
    counts = [Counter(e.flow for e in events_of(settings, seed)) for seed in range(seeds)]
    for flow, rate in rates.items():
        number = np.array([count[flow] for count in counts])
        expected = rate * hours
        # Index of dispersion about the requested mean: chi-square with one degree of freedom per seed.
        dispersion = ((number - expected) ** 2 / expected).sum()
        assert chi2.ppf(1e-4, seeds) < dispersion < chi2.ppf(1.0 - 1e-4, seeds), flow


@pytest.mark.parametrize(("name", "traffic"), [("SA1", "busy"), ("SB1", "busy"), ("SB1", "town-varied")])
def test_a_busy_hour_has_every_event_and_only_hazards_leave_an_arm(name: str, traffic: str) -> None:
    vehicles = truths_of(stream(name, traffic), seed=1)
    told = describe_events(vehicles, (), {})["vehicles"]
    assert {one["flow"] for one in told} == {*traffic_named(traffic).per_hour, "follows"}
    assert {one["kind"] for one in told} >= {"light", "medium", "heavy", "electric", "bicycle"}
    for one, vehicle in zip(told, vehicles, strict=True):
        assert one["hazard"] == (one["flow"] in {*HAZARDS, "follows"})
        assert (one["t0_s"] is None) == (one["flow"] in NEVER_SEEN)
        inside = vehicle.in_view & (vehicle.time_s < (one["t0_s"] or np.inf) - 0.01)
        assert not inside.any()
        if one["flow"] in {"from_behind", "from_ahead"}:  # in view, and later in its arm
            seen = np.flatnonzero(vehicle.in_view)
            assert not seen.size or seen[-1] < len(vehicle.time_s) - 5
            assert abs(vehicle.y_m[-1]) > 5.0 or one["last_s"] > 3600.0


@pytest.mark.parametrize("seed", [1, 2])
def test_approaches_have_the_requested_numbers_in_turn(seed: int) -> None:
    events = events_of(stream("SB1", "approaches", 14.4), seed)
    counts = Counter(event.flow for event in events if event.flow in (*HAZARDS, "follows"))
    assert counts == {"left": 10, "right": 10, "both": 20, "queue": 6, "follows": 6}
    entries = [visible_s(event, site("SB1")) for event in events if event.flow in HAZARDS]
    first = np.sort([entry for entry in entries if entry is not None])
    # Pairs are within some standard deviations of 0.7 s, others half a turn of 24 s apart.
    assert not ((np.diff(first) > 3.0) & (np.diff(first) < 8.0)).any()


def test_followers_keep_their_headway_and_pairs_arrive_together() -> None:
    events = events_of(stream("SB1", "busy"), seed=3)
    together = [[visible_s(e, site("SB1")) for e in events if e.flow == "both" and e.manoeuvre.arm == arm]
                for arm in ("left", "right")]  # fmt: skip
    left, right = (np.sort(np.array(times, dtype=float)) for times in together)
    assert len(left) >= 3
    assert np.abs(left[:, None] - right).min(axis=1).max() < 4 * 0.7
    for event in events:
        if event.flow != "follows":
            continue
        same = [
            e.start_s for e in events
            if e is not event and e.manoeuvre.arrives_s == event.manoeuvre.arrives_s
        ]  # fmt: skip
        assert min(abs(event.start_s - start) for start in same) > 1.4


@given(
    arm=st.sampled_from(["left", "right"]),
    where=st.sampled_from(["SA1", "SA2", "SB1", "SB3"]),
    speed=st.floats(3.0, 15.0),
    kind=st.sampled_from(["light", "heavy", "bicycle"]),
    start_s=st.floats(-5.0, 50.0),
)
def test_time_to_visible_at_constant_speed_is_distance_over_speed(arm, where, speed, kind, start_s):
    plan = site(where)
    driver = Driver(plan, vehicle_kind(kind), arm, speed, 0.0, 40.0)
    event = VehicleEvent(arm, emerges(driver, np.random.default_rng(0)), start_s)
    truth = vehicle_truth(0, event, StreamSettings(plan, 2.0))
    # The line from the eye past the corner, by similar triangles.
    eye_x, eye_y, _ = PinholeCamera.ovad().position_m
    corner = plan.corner_left_m if arm == "left" else -plan.corner_right_m
    lane = truth.x_m[0]
    entry = eye_y + (corner - eye_y) * (lane - eye_x) / (plan.corner_ahead_m - eye_x)
    assert lane in plan.lanes_m
    left = np.array(truth.time_to_visible_s(), dtype=float)
    np.testing.assert_allclose(np.diff(left), -0.1, atol=2e-3)
    np.testing.assert_allclose(left, np.abs(truth.y_m - entry) / speed * np.sign(left), atol=0.02)
    assert not truth.in_view[left > 0.011].any()
    assert truth.in_view[(left < 0.0) & (left > -0.2)].all()


@given(cruise=st.floats(2.0, 15.0), stop=st.floats(20.0, 60.0), stands_s=st.floats(0.5, 20.0))
def test_a_stop_follows_uniform_deceleration_and_acceleration(cruise, stop, stands_s):
    route = along([[6.0, 0.0], [6.0, -1.0]])
    driver = Driver(site("SB1"), LIGHT, "left", cruise, 0.0, 90.0)
    motion = driver.motion(route, (0.0, 90.0), [SpeedLimit(stop, 0.0, stands_s)])
    brake, away = cruise**2 / (2 * 2.0), cruise**2 / (2 * 1.5)
    before = (stop - brake) / cruise + cruise / 2.0 if brake < stop else None
    if before is not None:
        stood = motion.time_s[(motion.driven_m == stop)]
        np.testing.assert_allclose(stood, [before, before + stands_s], rtol=0.02, atol=0.05)
        if away < 90.0 - stop:
            after = cruise / 1.5 + (90.0 - stop - away) / cruise
            np.testing.assert_allclose(motion.duration_s, before + stands_s + after, rtol=0.02, atol=0.1)
    assert (np.diff(motion.driven_m) >= 0).all() and (np.diff(motion.time_s) >= 0).all()
    middle = np.array([motion.reaches_s(stop) - 0.5 * stands_s])
    assert motion.trajectory(middle).speed_mps[0] == 0.0


@given(st.floats(0.5, 2.0), st.sampled_from(["SA1", "SB1", "TB7"]), st.integers(0, 999))
def test_a_preset_scales_the_speed_of_vehicles_and_not_of_bicycles(factor, where, seed):
    usual = preset()
    for kind in ("light", "bicycle"):
        one, fast = (
            draw_driver(site(where), vehicle_kind(kind), levels, np.random.default_rng(seed))
            for levels in (usual, replace(usual, speed_factor=factor))
        )
        times = factor if kind == "light" else 1.0
        assert fast.speed_mps == pytest.approx(times * one.speed_mps)
        assert (fast.arm, fast.braking_mps2) == (one.arm, one.braking_mps2)


def test_boxes_have_the_rates_of_misses_and_clutter() -> None:
    settings = stream("SB1", Traffic("test", {"left": 240.0}, kinds={"light": 1}), 10.0)
    vehicles, events = truths_of(settings, 2), events_of(settings, 2)
    frames = detected_frames(settings, events, [], np.random.default_rng(1))
    alone = detected_frames(settings, [], [], np.random.default_rng(1))
    assert len(frames) == len(alone) == 6000
    added = np.array([len(a) - len(b) for a, b in zip(frames, alone, strict=True)])
    seen = np.zeros(len(frames), dtype=int)
    for one in vehicles:
        seen[np.rint(10 * one.time_s[one.in_view]).astype(int)] += 1
    clear = np.convolve(seen, np.ones(21), "same") == 0  # at least a second from any line of sight
    assert not added[clear].any()
    missed = 1.0 - np.minimum(added, seen)[seen > 0].sum() / seen[seen > 0].sum()
    assert 0.02 < missed < 0.25  # 4 to 14 % by azimuth, and partly visible boxes at the edge of the image
    boxes = sum(len(frame) for frame in alone) - (6000 if len(alone[0]) else 0)
    expected = CLUTTER_PER_HOUR / 6 * np.mean(CLUTTER_IMAGES)
    assert abs(boxes - expected) < 5 * np.sqrt(expected * 2.5)


def test_other_sounds_have_their_rate_and_rain_removes_boxes() -> None:
    rates = {"rain": 60.0, "voice": 240.0, "siren": 30.0}
    settings = stream("SB1", replace(traffic_named("busy"), sounds=rates))
    sounds = draw_sounds(settings, [4], np.random.default_rng(1))
    for kind, rate in rates.items():
        number = sum(one.sound.kind == kind for one in sounds)
        assert abs(number - rate) < 4.5 * np.sqrt(rate)
    assert all(0.0 <= one.start_s < 3600.0 for one in sounds)
    short = replace(settings, minutes=2.0)
    soaked = SoundEvent(SoundSettings("rain", 2.0, 58.0, lens_missed=0.999), 0.0)
    dry, wet = (detected_frames(short, [], rain, np.random.default_rng(9)) for rain in ([], [soaked]))
    assert sum(map(len, dry[20:600])) > 500  # this seed has a parked car
    assert sum(map(len, wet[20:600])) < 20
    assert wet[620:] == dry[620:]


@pytest.mark.parametrize("where", ["SA1", "SB3"])
def test_a_stop_lasts_2_to_10_s_before_line_of_sight(where: str) -> None:
    stopped_s = []
    for truth in truths_of(stream(where, "stops"), 1):
        motion = truth.event.manoeuvre.motion
        clock = np.arange(0.0, motion.duration_s, 0.01)
        still = clock[motion.trajectory(clock).speed_mps < 1e-3]
        stopped_s.append(np.ptp(still))
        assert truth.hazard and truth.t0_s is not None
        # From rest a vehicle needs over a second for the remaining metre or more.
        assert 1.0 < truth.t0_s - (truth.event.start_s + still[-1]) < 5.0
    assert len(stopped_s) == 150
    assert 2.0 - 0.02 < min(stopped_s) < 2.5
    assert 9.5 < max(stopped_s) < 10.0 + 0.02


@pytest.mark.parametrize(
    ("one", "other"),
    [("busy", "no-hazard"), *((n, f"{n}-{w}") for n in ("pairs", "no-hazard") for w in ("gusts", "rain"))],
)
def test_missing_hazards_gusts_and_rain_leave_other_vehicles_unchanged(one: str, other: str) -> None:
    usual, changed = (events_of(stream("SA1", name), 7) for name in (one, other))
    if traffic_named(other).hazard_free:
        usual = [e for e in usual if e.flow not in {*HAZARDS, "follows"}]
    assert [(e.flow, e.start_s, e.end_s) for e in usual] == [(e.flow, e.start_s, e.end_s) for e in changed]


def test_a_louder_background_reduces_the_range_and_not_the_sight() -> None:
    pairs = traffic_named("pairs")
    drawn = (
        events_of(stream("SB1", one, 30.0), 7) for one in (pairs, replace(pairs, background_db=(20.0, 20.0)))
    )
    usual, louder = (
        {round(e.start_s + e.manoeuvre.arrives_s, 6): e.manoeuvre.arrives_s for e in events}
        for events in drawn
    )
    shared = usual.keys() & louder.keys()
    assert len(shared) > 60
    assert all(louder[at] <= usual[at] + 1e-6 for at in shared)
    assert np.mean([louder[at] < usual[at] - 0.5 for at in shared]) > 0.5


def test_background_levels_are_uniform_and_rain_has_its_share() -> None:
    low_db, high_db = traffic_named("town-varied").background_db
    streams = [StreamSettings(site("SA1"), 1.0, seed, traffic_named("town-varied")) for seed in range(400)]
    above = np.array([one.drawn_preset.wind_100hz_db - one.preset.wind_100hz_db for one in streams])
    octaves = np.array([one.drawn_preset.ambient_octaves_db for one in streams])
    usual = np.array(streams[0].preset.ambient_octaves_db)
    np.testing.assert_allclose(octaves - usual, np.tile(above[:, None], 8))
    assert kstest(above, "uniform", (low_db, high_db - low_db)).pvalue > 1e-3
    rain_db = [one.rain_db for one in streams if one.rain_db is not None]
    share = traffic_named("town-varied").rain_share
    assert abs(len(rain_db) - 400 * share) < 4.0 * np.sqrt(400 * share * (1.0 - share))
    assert RAIN_DB[0] <= min(rain_db) < max(rain_db) <= RAIN_DB[1]
    # Nothing is drawn unless requested.
    assert StreamSettings(site("SA1"), 1.0).drawn_preset == streams[0].preset
    assert StreamSettings(site("SA1"), 1.0).rain_db is None


def test_signals_belong_to_vehicles_and_bells_to_bicycles() -> None:
    shares = {"siren": 0.3, "bicycle-bell": 0.5}
    settings = stream("SB1", replace(traffic_named("busy"), signals=shares), 120.0)
    events = events_of(settings, 4)
    leaders = [event for event in events if event.flow not in ("follows", "far")]
    riders = {
        rides: [one for one in leaders if (one.manoeuvre.motion.kind.name in ("bicycle", "scooter")) == rides]
        for rides in (True, False)
    }
    for rides, signal in ((True, "bicycle-bell"), (False, "siren")):
        warned = Counter(one.signal for one in riders[rides])
        assert set(warned) <= {"", signal}
        expected = shares[signal] * len(riders[rides])
        assert abs(warned[signal] - expected) < 4 * np.sqrt(expected)
    told = describe_events([vehicle_truth(0, leaders[0], settings)], [], {})["vehicles"][0]
    assert told["signal"] == (leaders[0].signal or None)
    with pytest.raises(InvalidArgumentError, match="signals"):
        Traffic("test", {}, signals={"voice": 0.1})


def test_every_flow_has_a_row_in_the_figure():
    assert set(FLOWS) >= set(MANOEUVRES)
