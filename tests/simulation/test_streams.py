"""Streams: arrivals, motion, sight, sum of sounds, levels, seams, determinism and memory."""

import csv
import json
import tracemalloc
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import coherence, welch
from scipy.stats import chi2, kstest
from simulated_sound import PAIR, made, refusal

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.datasets.ovad import Recording, choose_array, read_true_tracks
from worldstate.commissioning.heard_stream import junction_named
from worldstate.commissioning.stream_figure import FLOWS
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Float32Array
from worldstate.simulation import preset, site
from worldstate.simulation.scene.junction import drawn_site
from worldstate.simulation.scene.kinds import LIGHT, vehicle_kind
from worldstate.simulation.scene.presets import site_ambience
from worldstate.simulation.scene.settings import SoundSettings
from worldstate.simulation.scene.vehicle import along
from worldstate.simulation.stream.arrivals import Event, SoundEvent, VehicleEvent, draw_events, draw_sounds
from worldstate.simulation.stream.manoeuvres import (
    MANOEUVRES,
    Driver,
    SpeedLimit,
    draw_driver,
    emerges,
)
from worldstate.simulation.stream.rendering import (
    EVENT,
    OVERLAP_S,
    EventSound,
    StreamScene,
    draw_microphones,
    event_sound,
    loudness_db,
    render_blocks,
    row_times,
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
from worldstate.simulation.stream.writing import draw_stream

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
    # Vehicles of a pair are within some standard deviations of 0.7 s, all others at least 12 s apart.
    assert not ((np.diff(first) > 3.0) & (np.diff(first) < 8.0)).any()


def test_followers_keep_their_headway_and_pairs_arrive_together() -> None:
    events = events_of(stream("SB1", "busy"), seed=3)
    both = [(e.manoeuvre.arm, visible_s(e, site("SB1"))) for e in events if e.flow == "both"]
    left, right = (np.array([s for side, s in both if side == arm], float) for arm in ("left", "right"))
    assert len(left) >= 3
    assert np.abs(left[:, None] - right).min(axis=1).max() < 4 * 0.7
    for event in (one for one in events if one.flow == "follows"):
        others = (one for one in events if one is not event)
        same = [one.start_s for one in others if one.manoeuvre.arrives_s == event.manoeuvre.arrives_s]
        assert np.abs(np.array(same) - event.start_s).min() > 1.4


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
    if brake < stop:
        before, stood = (stop - brake) / cruise + cruise / 2.0, motion.time_s[motion.driven_m == stop]
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
    frames, alone = (
        detected_frames(settings, events, [], np.random.default_rng(1))
        for events in (events_of(settings, 2), [])
    )
    assert len(frames) == len(alone) == 6000
    added = np.array([len(a) - len(b) for a, b in zip(frames, alone, strict=True)])
    seen = np.zeros(len(frames), dtype=int)
    for one in truths_of(settings, 2):
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
    numbers = Counter(one.sound.kind for one in sounds)
    assert all(abs(numbers[kind] - rate) < 4.5 * np.sqrt(rate) for kind, rate in rates.items())
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
        # From rest a vehicle needs more than a second for the last metre or more.
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
    traffic, usual = traffic_named("town-varied"), preset()
    streams = [StreamSettings(site("SA1"), 1.0, seed, traffic) for seed in range(400)]
    above = np.array([one.drawn_preset.wind_100hz_db for one in streams]) - usual.wind_100hz_db
    octaves = np.array([one.drawn_preset.ambient_octaves_db for one in streams]) - usual.ambient_octaves_db
    np.testing.assert_allclose(octaves, np.tile(above[:, None], 8))
    assert kstest(above, "uniform", (traffic.background_db[0], np.ptp(traffic.background_db))).pvalue > 1e-3
    rain_db = [one.rain_db for one in streams if one.rain_db is not None]
    share = traffic.rain_share
    assert abs(len(rain_db) - 400 * share) < 4.0 * np.sqrt(400 * share * (1.0 - share))
    assert RAIN_DB[0] <= min(rain_db) < max(rain_db) <= RAIN_DB[1]
    # Nothing is drawn unless requested.
    calm = StreamSettings(site("SA1"), 1.0)
    assert calm.drawn_preset == usual and calm.rain_db is None


def test_signals_belong_to_vehicles_and_bells_to_bicycles() -> None:
    shares = {"siren": 0.3, "bicycle-bell": 0.5}
    settings = stream("SB1", replace(traffic_named("busy"), signals=shares), 120.0)
    leaders = [event for event in events_of(settings, 4) if event.flow not in ("follows", "far")]
    ridden = [one.manoeuvre.motion.kind.name in ("bicycle", "scooter") for one in leaders]
    for rides, signal in ((True, "bicycle-bell"), (False, "siren")):
        warned = Counter(
            one.signal for one, is_ridden in zip(leaders, ridden, strict=True) if is_ridden == rides
        )
        assert set(warned) <= {"", signal}
        expected = shares[signal] * warned.total()
        assert abs(warned[signal] - expected) < 4 * np.sqrt(expected)
    told = describe_events([vehicle_truth(0, leaders[0], settings)], [], {})["vehicles"][0]
    assert told["signal"] == (leaders[0].signal or None)
    with pytest.raises(InvalidArgumentError, match="signals"):
        Traffic("test", {}, signals={"voice": 0.1})


def test_every_flow_has_a_row_in_the_figure():
    assert set(FLOWS) >= set(MANOEUVRES)


# No source changes its level, so the rest is stationary.
STILL = replace(preset(), name="still", far_rate=0.0, wave_fluctuation_db=0.0, ambient_waves=8)


def scene_of(minutes: float, rate_hz: float = 6000.0) -> StreamScene:
    settings = StreamSettings(site("SB1"), minutes, preset=STILL, sample_rate_hz=rate_hz)
    microphones = draw_microphones(settings, PAIR, np.random.default_rng(3))
    return StreamScene(settings, site_ambience(settings.site, STILL), microphones)


def event_at(start_s: float, flow: str = "left", reach_m: float = 20.0) -> VehicleEvent:
    driver = Driver(site("SB1"), LIGHT, "left", 9.0, 0.0, reach_m)
    return VehicleEvent(flow, MANOEUVRES[flow](driver, np.random.default_rng(1)), start_s)


def alone_in(scene: StreamScene, event: Event, rng: np.random.Generator | None = None) -> EventSound:
    rng = rng or np.random.default_rng(2)
    return event_sound(event, site("SB1"), scene.settings.preset, scene.microphones, rng)


def sound_of(scene: StreamScene, events: Sequence[Event]) -> Float32Array:
    return np.concatenate([block.pressure_pa for block in render_blocks(scene, events)], axis=1)


def test_a_stream_is_the_sum_of_background_and_events() -> None:
    scene = scene_of(36.0 / 60.0, rate_hz=3000.0)
    # The first begins before the stream, the second and third overlap the edge of a piece (30 s), the
    # last ends after the stream.
    early, late = event_at(-1.0, reach_m=8.0), event_at(34.5, reach_m=8.0)
    steps = SoundEvent(SoundSettings("steps", 2.0, 3.0, (3.0, 2.0)), 27.0)
    events = [early, event_at(28.5, reach_m=8.0), event_at(29.5, "turns_away", 10.0), late, steps]
    # The two pieces of 30 s do not depend on the number of processes that render them.
    blocks = list(render_blocks(scene, events, jobs=2))
    added = np.concatenate([block.pressure_pa for block in blocks], axis=1) - sound_of(scene, ())
    told_db = {number: levels[0] for block in blocks for number, levels in block.loudness_db.items()}
    expected = np.zeros((2, 36 * 3000))
    for number, event in enumerate(events):
        alone = alone_in(scene, event, scene.settings.generator(EVENT, number))
        begin, end = max(alone.first, 0), min(alone.first + alone.pressure_pa.shape[1], expected.shape[1])
        expected[:, begin:end] += alone.pressure_pa[:, begin - alone.first : end - alone.first]
        rows_s = row_times(event, scene.settings)
        levels = [loudness_db(alone, rows_s, 3000.0, banded=banded) for banded in (False, True)]
        np.testing.assert_allclose(told_db[number], levels, atol=1e-6)
    assert np.abs(expected).max() > 0.05
    np.testing.assert_allclose(added, expected, atol=1e-6)


@pytest.mark.parametrize("where", ["SB1", "TA1"])
@pytest.mark.parametrize("level_db", [-17.0, 5.0])
def test_the_background_level_scales_the_background(where: str, level_db: float) -> None:
    """Electronic noise does not follow the level of the street."""
    silent = replace(preset(), self_noise_db=0.0, ambient_waves=8)
    traffic = Traffic("test", {}, background_db=(level_db, level_db))
    usual = StreamSettings(junction_named(where), 0.2, 5, replace(traffic, background_db=(0.0, 0.0)), silent)
    heard = [
        sound_of(draw_stream(replace(one, sample_rate_hz=3000.0), PAIR).scene, ())
        for one in (usual, replace(usual, traffic=traffic))
    ]
    factor = 10.0 ** (level_db / 20.0)
    np.testing.assert_allclose(heard[1], factor * heard[0], rtol=2e-3, atol=1e-4 * np.abs(heard[1]).max())


def test_rain_of_a_stream_is_continuous_and_incoherent() -> None:
    dry = StreamSettings(site("SB1"), 1.2, 4, Traffic("test", {}), STILL, 3000.0)
    showers = [replace(dry, seed=seed, traffic=Traffic("test", {}, rain_share=1.0)) for seed in (1, 7)]
    rain_db, rain = [one.rain_db for one in showers], []
    assert None not in rain_db
    for one in showers:
        wet, alone = (draw_stream(stream, PAIR).scene for stream in (one, replace(dry, seed=one.seed)))
        rain.append(sound_of(wet, ()) - sound_of(alone, ()))
    # Pieces of 30 s join at 30 and 60 s. Two seconds of two channels have 160 drops of exponential strength.
    seconds_db = 10.0 * np.log10(np.square(rain[0]).reshape(2, -1, 6000).mean(axis=(0, 2)))
    assert np.abs(seconds_db - np.median(seconds_db)).max() < 4.0
    frequencies, between = coherence(*rain[0], 3000.0, nperseg=256)
    assert between[frequencies > 500.0].mean() < 0.1
    found_db = 10.0 * np.log10([np.square(one).mean() for one in rain])
    assert np.diff(rain_db)[0] > 10.0
    np.testing.assert_allclose(np.diff(found_db), np.diff(rain_db), atol=1.0)


def test_events_rise_to_line_of_sight_from_silence_to_silence() -> None:
    scene, event = scene_of(0.5, rate_hz=3000.0), event_at(2.0, reach_m=42.0)
    alone, rows = alone_in(scene, event), row_times(event, scene.settings)
    levels, t0_s = loudness_db(alone, rows, 3000.0), visible_s(event, site("SB1"))
    assert t0_s is not None
    seconds = [levels[(rows > t0_s - i - 1) & (rows <= t0_s - i)].mean() for i in range(5)]
    assert all(later > earlier for later, earlier in pairwise(seconds))
    assert seconds[0] > seconds[4] + 6.0
    assert levels.argmax() == pytest.approx(np.searchsorted(rows, t0_s) + 4, abs=8)
    edge = np.abs(alone.pressure_pa[:, [0, -1]]).max()
    assert edge < 1e-4 * np.abs(alone.pressure_pa).max()
    # An independent oracle is the level of one microphone around one row.
    at = round((rows[50] - 2.0) * 3000)
    around = alone.pressure_pa[:, at - 150 : at + 150].astype(float)
    assert levels[50] == pytest.approx(10 * np.log10((around**2).mean() / 4e-10), abs=0.02)


def test_a_signal_is_added_to_the_unchanged_vehicle() -> None:
    scene, event = scene_of(0.5, rate_hz=3000.0), event_at(2.0, reach_m=20.0)
    plain, warning = (alone_in(scene, one).pressure_pa for one in (event, replace(event, signal="siren")))
    frequency, power = welch((warning - plain)[0], 3000.0, nperseg=1024)
    # The vehicle approaches in the hidden arm, so both tones are up to 3 % higher.
    tones = [(frequency > tone) & (frequency < 1.04 * tone) for tone in (400.0, 535.0)]
    assert sum(power[tone].sum() for tone in tones) > 0.5 * power[frequency < 700.0].sum()
    assert (warning - plain).std() > 3 * plain.std()


def test_pieces_of_background_join_without_a_seam() -> None:
    scene = scene_of(2.0, rate_hz=2000.0)
    sound = sound_of(scene, ())
    edges, overlap = [scene.piece * i for i in range(1, 4)], round(OVERLAP_S * 2000)
    seam = np.zeros(sound.shape[1], bool)
    for edge in edges:
        seam[edge : edge + overlap] = True
    spectra = [
        np.mean([welch(channel[part], 2000.0, nperseg=256)[1] for channel in sound], axis=0)
        for part in (seam, ~seam)
    ]
    ratio_db = 10.0 * np.log10(spectra[0] / spectra[1])[8:]  # from 60 Hz
    assert abs(ratio_db.mean()) < 0.3
    assert np.abs(ratio_db).max() < 2.0
    # A click is a sample that its neighbours do not predict.
    jump = np.abs(np.diff(sound, n=3)).max(axis=0)
    near = max(jump[edge - 20 : edge + overlap + 20].max() for edge in edges)
    assert near < 1.2 * jump.max() and near < 8.0 * jump.std() + jump.mean()


@pytest.mark.parametrize("place", ["SB1", "TA101", "DB102"])
@given(seed=st.integers(0, 10_000), microphones=st.lists(st.integers(1, 5), min_size=2, max_size=2))
@settings(max_examples=2, deadline=None)
def test_an_array_is_independent_of_other_arrays(place: str, seed: int, microphones: list[int]) -> None:
    """Wind, drops and gusts of each array do not depend on the other arrays."""
    traffic = Traffic("all", {"left": 1200, "joins": 600}, sounds={"gusts": 1200, "rain": 600, "voice": 600})
    moment = StreamSettings(drawn_site(place), 0.08, seed, traffic, sample_rate_hz=2000.0)
    draw = np.random.default_rng(seed)
    arrays = [MicrophoneArray(draw.uniform(-0.3, 0.3, (number + 1, 3))) for number in microphones]
    beside = draw_stream(moment, *arrays)
    blocks = list(beside.blocks())
    together = np.concatenate([beside.recorded(block) for block in blocks])
    for number, (array, channels) in enumerate(zip(arrays, beside.scene.microphones.slices, strict=True)):
        alone = draw_stream(moment, array)
        heard = list(alone.blocks())
        expected = np.concatenate([alone.recorded(block) for block in heard])
        assert expected.std() > 0.0
        np.testing.assert_allclose(together[:, channels], expected, atol=1e-5 * np.abs(expected).max())
        for mine, every in zip(heard, blocks, strict=True):
            for event, levels in mine.loudness_db.items():
                np.testing.assert_allclose(every.loudness_db[event][number], levels[0], atol=1e-3)


def test_memory_does_not_grow_with_the_length_of_a_stream() -> None:
    def peak(minutes: float) -> int:
        tracemalloc.start()
        for block in render_blocks(scene_of(minutes, rate_hz=2000.0), ()):
            del block
        reached = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return reached

    assert peak(3.0) < 1.05 * peak(1.5)


def test_a_stream_on_disk_reads_as_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    positions = tmp_path / "pair.json"
    positions.write_text(json.dumps(PAIR.positions_m.tolist()))
    words = "--minutes 0.25 --site SB1 --seed 33 --traffic busy --bandwidth 700 --array"
    told = made(capsys, tmp_path, f"{words} {positions}")
    folder = tmp_path / "SB1-busy-33"
    assert told["out"] == str(folder) and (folder / "stream.png").stat().st_size > 20_000
    recording = Recording.open(folder)
    with recording.open_audio() as audio:
        assert (audio.channels, audio.sample_rate_hz) == (2, round(told["sample_rate_hz"]))
        assert audio.duration_s == pytest.approx(15.0, abs=0.01)
    log = recording.read_detections()
    assert log is not None and len(log.frames) == 150
    np.testing.assert_allclose(choose_array(folder).positions_m, PAIR.positions_m, atol=1e-6)
    events = json.loads((folder / "events.json").read_text())["vehicles"]
    tracks = read_true_tracks(folder)
    with (folder / "vehicles.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(events) == told["vehicles"] == len(tracks) > 0
    for event, track in zip(events, tracks, strict=True):
        own = [row for row in rows if int(row["vehicle"]) == event["vehicle"]]
        np.testing.assert_allclose([float(row["time_s"]) for row in own], track.time_s)
        np.testing.assert_array_equal([row["in_view"] == "1" for row in own], track.in_view)
        assert all((row["time_to_visible_s"] == "") == (event["t0_s"] is None) for row in own)


def test_the_stream_command_offers_all_traffic_and_reports_bad_options(tmp_path, capsys):
    refused = {
        "--minutes 1 --site DA1": "drives are heard",
        "--minutes 1 --static 2": "--static",
        "--static 2 --bandwidth 3": "bandwidth_hz",
        "--minutes 1 --bandwidth 3": "--bandwidth",
    }
    for words, problem in refused.items():
        assert problem in refusal(capsys, tmp_path, words)
    (tmp_path / "SB1-empty-1").mkdir()
    assert "something else" in refusal(capsys, tmp_path, "--minutes 1 --site SB1 --traffic empty")
