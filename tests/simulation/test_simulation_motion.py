"""A moving ego and bodies in the open: Doppler shift, continuity and truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.simulation import (
    KINDS,
    MOVING_SITES,
    PLACES,
    SimulationSettings,
    VehicleSettings,
    draw_settings,
    place,
    preset,
    simulate_recording,
    site,
)
from worldstate.simulation.scene.driving import trajectories
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.vehicle import EgoMotion
from worldstate.simulation.sound import scatter
from worldstate.simulation.sound.delay import KNOT_SAMPLES, Emission, MovingSource
from worldstate.simulation.sound.diffraction import SPEED_OF_SOUND_MPS
from worldstate.simulation.sound.propagation import add_sources
from worldstate.simulation.sound.receiver import Receiver, Surroundings, add_turning
from worldstate.simulation.sound.scatter import add_scattered, scattering
from worldstate.simulation.sound.static_field import StaticSources

FS = 48_000.0
C = SPEED_OF_SOUND_MPS
FREE_FIELD = Site("Free1", 30.0, 30.0, 1.0, None, 30.0, 30.0, 12.0, in_the_open=True)
PAIR = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, -0.2, 0.1]])
HEAD_BLOCKS = 375
OPEN_NAMES = [place(name).site.name for name in PLACES]
THROUGH_US, BENT = ((9.0, 30.0), (0.0, 0.0)), ((5.0, -20.0), (5.2, -20.0), (-40.0, 9.0))


def listener(seconds: float, ego: EgoMotion, positions=((0.0, 0.0, 1.7),)) -> Receiver:
    knots = np.arange(int(seconds * FS / KNOT_SAMPLES) + 1) * KNOT_SAMPLES / FS
    return Receiver(np.array(positions), np.zeros(len(positions)), knots, ego)


def emission(receiver: Receiver, sound) -> Emission:
    samples = (HEAD_BLOCKS + len(receiver.knots_s) - 1) * KNOT_SAMPLES
    start = -HEAD_BLOCKS * KNOT_SAMPLES / FS
    return Emission.of(sound(start + np.arange(samples) / FS).astype(np.float32), start, FS)


def tone(frequency: float):
    return lambda time: np.cos(2 * np.pi * frequency * time)


def noise(time: np.ndarray) -> np.ndarray:
    return np.random.default_rng(1).standard_normal(len(time))


def instantaneous_hz(x: np.ndarray, f: float, step: int = 480) -> tuple[np.ndarray, np.ndarray]:
    spectrum = np.fft.fft(x)
    spectrum[np.abs(np.fft.fftfreq(len(x), 1 / FS) - f) > 0.2 * f] = 0.0
    phase = np.unwrap(np.angle(np.fft.ifft(spectrum)))
    return (np.arange(len(x) - step) + step / 2) / FS, (phase[step:] - phase[:-step]) / (
        2 * np.pi * step / FS
    )


def test_a_moving_ego_has_the_doppler_shift_of_its_speed():
    """f = f0 (1 + v cos(theta) / c) for a static source, within 1e-4."""
    ego, place = EgoMotion(8.0, 10.0), np.array([20.0, 3.0, 0.3])
    receiver = listener(2.0, ego)
    sound = emission(receiver, tone(1000.0))
    out = np.zeros((1, receiver.samples), np.float32)
    still = MovingSource(sound, place[0], np.full(len(sound.knots_s), place[1]))
    add_sources(StaticSources(out, FS), [still], Surroundings(FREE_FIELD, receiver, 40.0))
    time = np.arange(receiver.samples) / FS
    distance = np.sqrt((20.0 - ego.x_m(time)) ** 2 + 3.0**2 + 1.4**2)
    exact = np.cos(2 * np.pi * 1000.0 * (time - distance / C)) / distance
    assert 20 * np.log10(np.std(out[0] - exact) / np.std(exact)) < -60.0
    at, found = instantaneous_hz(out[0].astype(float), 1000.0)
    expected = 1000.0 * (1.0 + 8.0 / C * (20.0 - ego.x_m(at)) / np.interp(at, time, distance))
    inner = slice(12_000, -12_000)  # the ends ring
    assert np.abs(found[inner] / expected[inner] - 1.0).max() < 1e-4
    assert expected.min() > 1020.0


def test_a_static_source_keeps_its_place_for_a_moving_ego():
    """Each microphone of a moving ego has the tone of its own changing distance."""
    ego, place = EgoMotion(6.0, 10.0), np.array([6.0, 2.5, 1.7])
    receiver = listener(2.0, ego, ((0.3, 0.0, 1.7), (-0.3, 0.0, 1.7)))
    time = np.arange(receiver.samples) / FS
    distance = [np.hypot(place[0] - x - ego.x_m(time), place[1]) for x in (0.0, 0.3, -0.3)]
    centre, *wanted = (np.cos(2 * np.pi * 700.0 * (time - d / C)) for d in distance)
    out = np.zeros((2, receiver.samples), np.float32)
    add_turning(out, centre.astype(np.float32), place, np.ones(len(receiver.knots_s)), receiver)
    for ours, expected in zip(out, wanted, strict=True):
        error_db = 20 * np.log10(np.std((ours - expected)[4800:-4800]) / np.std(expected))
        assert error_db < -50.0


def test_omitted_wall_patches_have_little_energy(monkeypatch):
    """Patches below the threshold send less than 2 % of the energy of rough walls past a driving ego."""
    ego = EgoMotion(6.0, 2.0)
    receiver = listener(2.5, ego, ((0.0, 0.2, 1.7), (0.0, -0.2, 1.7)))
    sound = emission(receiver, noise)
    around = Surroundings(site("DA1"), receiver, 24.0, np.full(8, 0.3))
    source = MovingSource(sound, 12.0, np.linspace(18.0, -5.0, len(sound.knots_s)))
    heard = []
    for faintest in (scatter.FAINTEST, 0.0):
        monkeypatch.setattr(scatter, "FAINTEST", faintest)
        heard.append(np.zeros((2, receiver.samples), np.float32))
        add_scattered(StaticSources(heard[-1], FS), source, around)
    some, every = heard
    assert 0.0 < np.mean((some - every) ** 2) < 0.02 * np.mean(every**2)


HIDDEN_IN_THE_OPEN = ("SL1", "SP1", "SM1")  # behind a van, a pier, a wall
SCENES = {
    "moving": lambda: draw_settings("DA1", "right", np.random.default_rng(4)),
    **{name: (lambda n=name: scene_settings(n)) for name in HIDDEN_IN_THE_OPEN},
}


def scene_settings(name: str) -> SimulationSettings:
    return draw_settings(name, "left", np.random.default_rng(6))


def heard(scene: SimulationSettings, sound) -> np.ndarray:
    receiver = listener(10.0, scene.ego)
    emitted = emission(receiver, sound)
    (path,) = trajectories(scene, emitted.knots_s)
    out = np.zeros((1, receiver.samples), np.float32)
    source = MovingSource(emitted, *path.behind(0.9))
    static = StaticSources(out, FS)
    around = Surroundings(scene.site, receiver, 24.0, scattering(scene.preset), outdoors=True)
    add_sources(static, [source], around)
    add_scattered(static, source, around)
    static.render()
    return out[0].astype(float)


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_paths_of_a_moving_ego_change_without_clicks(name):
    """A click would spread a 500-Hz tone beyond 2 kHz."""
    sound = heard(SCENES[name](), tone(500.0))
    assert np.isfinite(sound).all()
    spectrum = np.abs(np.fft.rfft(sound * np.hanning(len(sound)))) ** 2
    frequency = np.fft.rfftfreq(len(sound), 1 / FS)
    assert 10 * np.log10(spectrum[frequency > 2000].sum() / spectrum.sum()) < -60.0


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_energy_of_a_moving_ego_is_continuous(name):
    """Noise in windows of 50 ms: no step beyond what 50 ms of movement and chance make, and no gap."""
    power = (heard(SCENES[name](), noise).reshape(200, -1) ** 2).mean(axis=1)
    # Behind a rigid wedge the level of a vehicle near the mouth rises by 20 dB within 0.3 s.
    assert np.abs(np.diff(10 * np.log10(power))).max() < 5.0


@pytest.mark.long
def test_truth_has_route_sight_and_time_of_every_vehicle():
    others = (
        VehicleSettings("right", 4.0, 9.0, kind="heavy"),
        VehicleSettings("left", 9.0),
    )
    drawn = draw_settings("DA2", "left", np.random.default_rng(2))
    # Mirror images cost time and do not affect the truth.
    bare = replace(drawn.site, side_order=0, facade_order=0)
    scene = replace(drawn, site=bare, others=others, sample_rate_hz=8e3)
    recording = simulate_recording(scene, np.random.default_rng(2), PAIR)
    truth = json.loads(json.dumps(recording.truth, allow_nan=False))
    ways = [truth["frames"], *truth["others"]]
    entries = [scene.entry_s, 4.0, 9.0]
    assert len(ways) == 3
    for frames, entry in zip(ways, entries, strict=True):
        seen = [frame["line_of_sight"] for frame in frames]
        at = seen.index(True)
        assert abs(frames[at]["time_s"] - entry) <= 0.2
        assert frames[at]["time_to_visible_s"] == pytest.approx(entry - frames[at]["time_s"], abs=1e-6)
        where = np.array([frame["position_m"] for frame in frames])
        speed = np.hypot(*np.diff(where, axis=0).T) / 0.1
        assert speed.max() < 25.0
    assert recording.t0_frame == min(
        row.index(True) for row in [[f["line_of_sight"] for f in w] for w in ways]
    )
    assert truth["ego"]["speed_mps"][0] == pytest.approx(scene.ego.speed_mps)
    assert recording.detections == ()


def test_own_noise_follows_the_speed():
    """Tyres from 500 Hz to 2 kHz exceed an empty street while driving and end at the stop."""
    ego = EgoMotion(8.0, 3.0)
    # A distant vehicle would be a noise that does not follow, and a loud town masks the own noise.
    calm = replace(preset(), far_rate=0.0, ambient_octaves_db=(45.0,) * 8)
    scene = SimulationSettings(site("DB1"), "none", duration_s=4.0, sample_rate_hz=8e3, preset=calm)
    driving, standing = (
        simulate_recording(replace(scene, ego=one), np.random.default_rng(1), PAIR).audio[:, 0]
        for one in (ego, EgoMotion())
    )
    level = [band_db(part) for part in (driving[:8000], driving[-6000:], standing)]
    assert level[0] > level[1] + 4.0
    assert level[0] > level[2] + 5.0


def band_db(x: np.ndarray) -> float:
    power, frequency = np.abs(np.fft.rfft(x)) ** 2 / len(x) ** 2, np.fft.rfftfreq(len(x), 1 / 8e3)
    return float(10 * np.log10(power[(frequency > 500) & (frequency < 2000)].sum()))


@pytest.mark.long
@settings(max_examples=8, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(st.data())
def test_no_scene_gives_silence_nan_or_a_click(data):
    """Any site, kind, way and ego: finite, never still, and no sample leaps out of its neighbourhood."""
    number = st.floats(0.0, 1.0)
    name = data.draw(st.sampled_from([*MOVING_SITES, "SA2", "SB3", *OPEN_NAMES]))
    duration = data.draw(st.floats(0.5, 1.2))
    drawn = draw_settings(name, "left", np.random.default_rng(data.draw(st.integers(0, 99))), duration)
    other = VehicleSettings(
        data.draw(st.sampled_from(["left", "right"])),
        data.draw(st.floats(-60.0, 120.0)),
        data.draw(st.floats(1.0, 30.0)),
        data.draw(st.floats(0.0, 8.0)),
        data.draw(st.sampled_from(sorted(KINDS))),
        # With bodies these routes would lead through them.
        () if drawn.site.occluders else data.draw(st.sampled_from([(), THROUGH_US, BENT])),
    )
    scene = replace(
        drawn,
        entry_s=duration * data.draw(number),
        speed_mps=data.draw(st.floats(1.0, 30.0)),
        braking_mps2=data.draw(st.floats(0.0, 8.0)),
        kind=data.draw(st.sampled_from(sorted(KINDS))),
        others=(other,) * data.draw(st.integers(0, 1)),
        sample_rate_hz=data.draw(st.floats(8_000.0, 16_000.0)),
        ego=EgoMotion(data.draw(st.floats(0.0, 20.0)), data.draw(st.floats(0.0, 120.0))),
        preset=replace(preset(), ambient_waves=8),
    )
    recording = simulate_recording(scene, np.random.default_rng(data.draw(st.integers(0, 2**32 - 1))), PAIR)
    audio = recording.audio.astype(float)
    assert audio.shape == (round(scene.duration_s * scene.sample_rate_hz), 2)
    assert np.isfinite(audio).all()
    assert audio.std(axis=0).min() > 1e-6
    # Single pulses of a motorcycle's cylinders reach 18; the same drive of a car has 6.
    pulsed = any(KINDS[one.kind].turns_hz for one in scene.traffic)
    assert pulsed or leaps(audio) < 12.0
    json.dumps(recording.truth, allow_nan=False)


def leaps(audio: np.ndarray) -> float:
    """Largest second difference against the median of the 10 to 20 ms about it."""
    bend = np.abs(np.diff(audio, 2, axis=0))
    blocks = np.array_split(bend, max(len(bend) // 160, 1))
    return float(max((block / np.median(block, axis=0)).max() for block in blocks))


def test_a_click_would_be_seen():
    sound = np.random.default_rng(1).standard_normal((8000, 2))
    assert leaps(sound) < 9.0
    sound[4000:] += 25.0
    assert leaps(sound) > 12.0
