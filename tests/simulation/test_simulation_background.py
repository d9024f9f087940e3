"""The sound of an empty street: coherence of diffuse fields and the constant background of a site."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
import scipy.special
from simulated_sound import ONE, OPEN, rendered, street_of
from worldstate_lab.streets.simulated_windows import RATE_HZ

from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.frontend.direction.feature import published_feature
from worldstate.simulation import preset, site
from worldstate.simulation.emitters.placed_sound import add_vehicle
from worldstate.simulation.scene.junction import Site, place
from worldstate.simulation.scene.vehicle import EgoMotion, Trajectory, drive, load_db
from worldstate.simulation.sound.background import (
    FLICKER_S,
    FLICKER_SHARED,
    BlockGrid,
    WaveField,
    opening_images,
)
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.diffraction import SPEED_OF_SOUND_MPS
from worldstate.simulation.sound.ego_sound import add_ego_echo, echo_gain, echo_lobes, ego_noise
from worldstate.simulation.sound.receiver import Receiver
from worldstate.simulation.sound.renderers import add_ambience
from worldstate.simulation.sound.static_field import plane_wave_delays

FS = 8000.0


def field(seconds: float, offsets_m: np.ndarray, noise: float = 0.0) -> WaveField:
    """Return a field of 72 directions, 1 Pa^2/Hz in all, with independent noise of each microphone."""
    grid, azimuth = BlockGrid(round(seconds * FS), FS), 2.0 * np.pi * np.arange(72) / 72
    delays = plane_wave_delays(azimuth, np.zeros(72), street_of(OPEN, offsets_m, 0.1, FS).receiver)
    bins, blocks = len(grid.frequencies_hz), len(grid.middles_s)
    return WaveField(grid, delays, np.ones(bins), np.full((blocks, 72), 1 / 72), np.full(bins, noise))


def heard(one: WaveField, seed: int = 1) -> np.ndarray:
    out = np.zeros((one.delays_s.shape[1], one.grid.samples), np.float32)
    one.add_to(out, np.random.default_rng(seed))
    return out


def test_a_diffuse_field_has_the_coherence_of_a_bessel_function():
    """The coherence of a diffuse field in two dimensions is J0(kd); equal independent noise halves it."""
    distance_m = 0.25
    for noise, share in ((0.0, 1.0), (1.0, 0.5)):
        pair = heard(field(12.0, np.array([[0.0, 0.0, 0.0], [0.0, distance_m, 0.0]]), noise))
        f, cross = scipy.signal.csd(*pair, fs=FS, nperseg=256)
        power = [scipy.signal.welch(one, fs=FS, nperseg=256)[1] for one in pair]
        found = cross / np.sqrt(power[0] * power[1])
        expected = share * scipy.special.j0(2.0 * np.pi * f * distance_m / SPEED_OF_SOUND_MPS)
        band = (f > 100.0) & (f < 3000.0)
        assert np.abs(found - expected)[band].max() < 0.15
        assert np.abs(power[0][band].mean() - (1.0 + noise)) < 0.03 * (1.0 + noise)


def test_the_level_is_constant_within_and_between_blocks():
    one = field(60.0, np.zeros((1, 3)))
    sound = heard(replace(one, delays_s=np.zeros((1, 1)), power=np.ones((len(one.power), 1))))[0]
    hop = one.grid.hop
    folded = (sound[: len(sound) // hop * hop].reshape(-1, hop) ** 2).mean(axis=0)
    assert folded.mean() == pytest.approx(0.5 * FS, rel=0.02)
    assert folded.std() < 0.05 * folded.mean()  # 0.35 for a window whose squares do not sum to one


def test_flicker_has_its_deviation_and_keeps_the_mean_level():
    """Levels of band-passed sound have the deviation, the common share and the correlation time."""
    seconds, deviation_db, step = 240.0, 3.0, 0.04
    one = replace(field(seconds, np.zeros((1, 3))), flicker_db=deviation_db)
    still, flickering = (
        [octave_levels_db(replace(one, flicker_db=db), middle_hz, step) for middle_hz in (500.0, 2000.0)]
        for db in (0.0, deviation_db)
    )
    chance = np.mean([levels.var() for levels in still])
    for before, after in zip(still, flickering, strict=True):
        mean_db = 10.0 * np.log10((10.0 ** (after / 10.0)).mean() / (10.0 ** (before / 10.0)).mean())
        assert abs(mean_db) < 0.3
        # The band of an octave overlaps its neighbours, and 0.04 s overlap the next interval.
        assert 0.75 < np.sqrt(after.var() - chance) / deviation_db < 1.05
        off, lag = after - after.mean(), round(FLICKER_S / step)
        kept = (off[lag:] * off[:-lag]).mean() / (after.var() - chance)
        assert kept == pytest.approx(np.exp(-1.0), abs=0.12)
    covariance = np.cov(*flickering)[0, 1]
    assert covariance / deviation_db**2 == pytest.approx(FLICKER_SHARED, abs=0.08)


def octave_levels_db(one: WaveField, middle_hz: float, step_s: float) -> np.ndarray:
    edges, step = middle_hz * np.array([0.85, 1.18]), round(step_s * FS)
    sound = scipy.signal.sosfilt(scipy.signal.butter(4, edges, "band", fs=FS, output="sos"), heard(one)[0])
    return 10.0 * np.log10((sound[: len(sound) // step * step].reshape(-1, step) ** 2).mean(axis=1))


def empty_window(name: str, seed: int, levels=None) -> np.ndarray:
    rng, positions = np.random.default_rng(seed), ovad_array().centred_m
    out = np.zeros((len(positions), round(RATE_HZ)), np.float32)
    receiver = Receiver(positions, np.zeros(len(positions)), np.array([0.0, KNOT_SAMPLES]) / RATE_HZ)
    add_ambience(out, receiver, site(name), levels or preset(), rng)
    return published_feature(out.T, ovad_array(), RATE_HZ)


def test_a_site_has_the_same_background_in_every_recording():
    calm, names = replace(preset(), far_rate=0.0, sky_share=0.2), ("SA1", "SB1", "SB2")
    log = np.log([[empty_window(name, seed, calm) for seed in range(4)] for name in names])
    pattern = log - log.mean(axis=2, keepdims=True)
    between, within = pattern.mean(axis=1).std(axis=0).mean(), pattern.std(axis=1).mean()
    alone = within / np.sqrt(4.0)  # the difference between recordings of one place
    assert between > 1.5 * alone


def test_the_background_of_a_street_has_directions():
    everywhere = replace(preset(), sky_share=1.0, far_rate=0.0, wave_fluctuation_db=0.0, wind_100hz_db=20.0)
    flat, street = (
        np.log([empty_window("SB1", seed, one) for seed in range(3)]).std(axis=1).mean()
        for one in (everywhere, replace(everywhere, sky_share=0.0))
    )
    assert 1.5 * flat < street


def test_arms_of_a_symmetric_street_are_mirror_images():
    even = Site("SB1", 2.8, 2.8, 4.5, None, 3.0, 3.0, 6.0)
    (left, loud), (right, as_loud), *_ = opening_images(even)
    order, other = np.argsort(left), np.argsort(-right)
    assert np.allclose(left[order], -right[other])
    assert np.allclose(loud[order], as_loud[other])
    assert np.degrees(opening_images(place("merge").site)[0][0]).tolist() == [90.0]


def test_an_engine_is_louder_under_load():
    time = np.arange(0.0, 6.0, 0.01)
    acceleration = np.where(time < 2.0, 0.0, np.where(time < 4.0, 1.5, -0.5))
    speed = 5.0 + np.cumsum(acceleration) * 0.01
    change = load_db(Trajectory(time, np.cumsum(speed) * 0.01, speed, 6.0, 1))
    assert change[[100, 300, 500]] == pytest.approx([0.0, 6.6, -2.2], abs=0.05)
    assert np.abs(np.diff(change)).max() < 0.5  # no click


def test_near_walls_reflect_the_own_sound_louder():
    azimuth = np.radians(np.arange(-180.0, 180.0, 5.0))
    near = replace(site("DB1"), side_wall_left_m=2.8, side_wall_right_m=2.8)
    far = replace(near, side_wall_left_m=5.6, side_wall_right_m=5.6)
    assert echo_gain(near) == pytest.approx(4.0 * echo_gain(far))
    lobes = echo_lobes(near, azimuth)
    beside = np.abs(np.abs(np.degrees(azimuth)) - 66.0) < 30.0
    assert lobes.sum() == pytest.approx(1.0)
    assert lobes[beside].mean() > 1.3 * lobes[~beside].mean()


@pytest.mark.parametrize("where", ["street", "open"])
def test_own_sound_has_no_echo_in_the_open_and_ends_at_the_stop(where):
    plan = site("DB1") if where == "street" else place("merge").site
    knots = np.arange(251) * KNOT_SAMPLES / FS
    receiver = Receiver(np.zeros((1, 3)), np.zeros(1), knots, EgoMotion(6.0, knots[-1] - 1.0))
    out = np.zeros((1, receiver.samples), np.float32)
    add_ego_echo(out, receiver, plan, -60.0, np.random.default_rng(1))
    before, after = (np.abs(part).mean() for part in (out[0, : round(FS)], out[0, -round(0.5 * FS) :]))
    assert before > 10.0 * after if where == "street" else not out.any()


def test_a_rough_road_raises_tyre_noise_and_its_echo():
    """Only tyres grow with roughness; at 8 m/s they dominate the echo."""
    knots = np.arange(251) * KNOT_SAMPLES / FS
    receiver = Receiver(ONE, np.zeros(1), knots, EgoMotion(8.0, 60.0))
    louder_db, speed = [], np.full(receiver.samples, 8.0)
    for rough_db in (0.0, 10.0):
        echo, plan = np.zeros((1, receiver.samples), np.float32), replace(site("DB1"), surface_db=rough_db)
        add_ego_echo(echo, receiver, plan, -60.0, np.random.default_rng(1))
        own = ego_noise(ONE, speed, FS, np.random.default_rng(1), -60.0, rough_db)
        louder_db.append([10.0 * np.log10((one**2).mean()) for one in (echo, np.diff(own, axis=0))])
    change = np.subtract(*louder_db[::-1])
    assert change[0] == pytest.approx(10.0, abs=1.0)
    assert 3.0 < change[1] < 10.0  # wind and airflow stay unchanged


def passing(surface_db: float, bass_db: float) -> np.ndarray:
    """Return levels of one vehicle in the open in the octaves of 125 Hz and 1 kHz."""
    plan = replace(place("merge").site, occluders=(), in_the_open=True, surface_db=surface_db)
    levels = replace(preset(), vehicle_spread_db=0.0, engine_spread_db=0.0, engine_bass_db=bass_db)
    street = street_of(plan, ONE, 2.0, FS, levels=levels)
    time = np.arange(-30, 126) * KNOT_SAMPLES / FS
    path = drive(time, entry_s=1.0, entry_y_m=2.0, lane_x_m=8.0, speed_mps=6.0)
    add_vehicle(street, path, np.random.default_rng(1))
    f, power = scipy.signal.welch(rendered(street)[0], FS, nperseg=1024)
    bands = [power[(f > 0.71 * middle) & (f < 1.41 * middle)].sum() for middle in (125.0, 1000.0)]
    return 10.0 * np.log10(bands)


def test_a_rough_road_raises_tyres_and_the_bass_level_the_engine():
    usual = passing(0.0, 0.0)
    rough, deep = passing(8.0, 0.0) - usual, passing(0.0, -12.0) - usual
    assert rough[0] < 2.5  # at 20 km/h the octave of 125 Hz has only the engine
    assert rough[1] == pytest.approx(8.0, abs=1.0)
    assert deep[0] < -6.0
    assert deep[1] == pytest.approx(0.0, abs=0.3)
