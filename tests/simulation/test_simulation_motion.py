"""A moving ego and bodies in the open: Doppler shift, continuity and truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from simulated_sound import (
    ONE,
    OPEN,
    PAIR,
    C,
    at,
    band_power,
    carried,
    error_db,
    noise,
    rendered,
    source_in,
    street_of,
    tone,
)

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
from worldstate.simulation.sound.propagation import add_sources
from worldstate.simulation.sound.receiver import add_turning
from worldstate.simulation.sound.scatter import add_scattered

FS = 48_000.0
OPEN_NAMES = [place(name).site.name for name in PLACES]
THROUGH_US, BENT = ((9.0, 30.0), (0.0, 0.0)), ((5.0, -20.0), (5.2, -20.0), (-40.0, 9.0))


def test_a_moving_ego_has_the_waveform_of_its_changing_distance():
    """The tone of a static source with its delay, level and Doppler shift."""
    street = street_of(OPEN, ONE, 2.0, FS, EgoMotion(8.0, 10.0))
    (found,) = carried(street, source_in(street, tone(1000.0), at(20.0, 3.0)))
    time = np.arange(len(found)) / FS
    distance = np.sqrt((20.0 - street.receiver.ego.x_m(time)) ** 2 + 3.0**2 + 1.4**2)
    assert error_db(found, tone(1000.0)(time - distance / C) / distance) < -60.0


def test_a_static_source_keeps_its_place_for_a_moving_ego():
    """Each microphone of a moving ego has the tone of its own changing distance."""
    source = np.array([6.0, 2.5, 1.7])
    street = street_of(OPEN, [[0.3, 0.0, 1.7], [-0.3, 0.0, 1.7]], 2.0, FS, EgoMotion(6.0, 10.0))
    receiver, out = street.receiver, street.static.out
    time = np.arange(receiver.samples) / FS
    distance = [np.hypot(source[0] - x - receiver.ego.x_m(time), source[1]) for x in (0.0, 0.3, -0.3)]
    centre, *wanted = (tone(700.0)(time - d / C) for d in distance)
    add_turning(out, centre.astype(np.float32), source, np.ones(len(receiver.knots_s)), receiver)
    for ours, expected in zip(out, wanted, strict=True):
        assert error_db(ours[4800:-4800], expected[4800:-4800]) < -50.0


def test_omitted_wall_patches_have_little_energy(monkeypatch):
    """Patches below the threshold send less than 2 % of the energy of rough walls past a driving ego."""
    rough, heard = replace(preset(), wall_scattering=0.3), []
    for faintest in (scatter.FAINTEST, 0.0):
        monkeypatch.setattr(scatter, "FAINTEST", faintest)
        street = street_of(site("DA1"), PAIR.centred_m + ONE, 2.5, FS, EgoMotion(6.0, 2.0), rough)
        add_scattered(street, source_in(street, noise, lambda time: (12.0, 18.0 - 6.6 * (time + 1.0)), 1.0))
        heard.append(street.static.out)
    some, every = heard
    assert 0.0 < np.mean((some - every) ** 2) < 0.02 * np.mean(every**2)


# An ego that moves, vehicles that a van, a pier or a wall in the open hides, and streets of both types.
SCENES = {
    "moving": lambda: draw_settings("DA1", "right", np.random.default_rng(4)),
    **{
        name: (lambda n=name: draw_settings(n, "left", np.random.default_rng(6)))
        for name in ("SL1", "SP1", "SM1", "SA1", "SA2", "SB1")
    },
}


def heard(scene: SimulationSettings, sound) -> np.ndarray:
    street = street_of(scene.site, ONE, 10.0, FS, scene.ego, scene.preset)
    source = source_in(street, sound, lambda time: trajectories(scene, time)[0].behind(0.9), 1.0)
    add_sources(street, [source])
    add_scattered(street, source)
    return rendered(street)[0]


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_paths_change_without_clicks(name):
    """A click would spread a 500-Hz tone beyond 2 kHz."""
    sound = heard(SCENES[name](), tone(500.0))
    assert np.isfinite(sound).all()
    windowed = sound * np.hanning(len(sound))
    assert band_power(windowed, FS, 2000.0) < 1e-6 * band_power(windowed, FS, -1.0)


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_energy_on_the_way_is_continuous(name):
    """Noise in windows of 50 ms: no step beyond what 50 ms of movement and chance make, and no gap."""
    sound = heard(SCENES[name](), noise)
    power = (sound[: len(sound) // 2400 * 2400].reshape(-1, 2400) ** 2).mean(axis=1)
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
    level = [
        10 * np.log10(band_power(part, 8e3, 500.0, 2000.0) / len(part) ** 2)
        for part in (driving[:8000], driving[-6000:], standing)
    ]
    assert level[0] > level[1] + 4.0
    assert level[0] > level[2] + 5.0


unit = st.floats(0.0, 1.0)


@st.composite
def plans(draw) -> Site:
    """Return any junction with a wall opposite or none."""
    left, right = draw(st.tuples(st.floats(1.0, 6.0), st.floats(1.0, 6.0)))
    ahead, street = draw(st.tuples(st.floats(1.0, 8.0), st.floats(3.0, 12.0)))
    opposite, walls = draw(st.sampled_from([None, ahead + street])), (left + draw(unit), right + draw(unit))
    return Site(
        *("Any1", left, right, ahead, opposite, *walls, street, 0.98 * draw(unit), 0.98 * draw(unit)),
        side_order=draw(st.integers(0, 3)),
        facade_order=draw(st.integers(0, 4)),
    )


@pytest.mark.long
@settings(max_examples=16, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(st.data())
def test_no_scene_gives_silence_nan_or_a_click(data):
    """Any site, kind, way and ego: finite, never still, and no sample leaps out of its neighbourhood."""
    where = data.draw(st.one_of(st.sampled_from([*MOVING_SITES, "SA2", "SB3", *OPEN_NAMES]), plans()))
    duration, approach = data.draw(st.floats(0.5, 1.2)), "left"
    if isinstance(where, Site):
        approach = data.draw(st.sampled_from(["left", "none", "right"]))
        drawn = SimulationSettings(where, approach, duration, entry_s=0.0)
    else:
        drawn = draw_settings(where, "left", np.random.default_rng(data.draw(st.integers(0, 99))), duration)
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
        entry_s=duration * data.draw(unit),
        speed_mps=data.draw(st.floats(1.0, 30.0)),
        braking_mps2=data.draw(st.floats(0.0, 8.0)),
        parked_car=data.draw(st.booleans()),
        kind=data.draw(st.sampled_from(sorted(KINDS))),
        others=(other,) * data.draw(st.integers(0, 1)),
        sample_rate_hz=data.draw(st.floats(8_000.0, 24_000.0)),
        ego=EgoMotion(data.draw(st.floats(0.0, 20.0)), data.draw(st.floats(0.0, 120.0))),
        preset=replace(preset(), ambient_waves=8, late_decay_s=data.draw(st.floats(0.05, 2.0))),
    )
    recording = simulate_recording(scene, np.random.default_rng(data.draw(st.integers(0, 2**32 - 1))), PAIR)
    audio, frames = recording.audio.astype(float), max(round(10 * scene.duration_s), 1)
    assert audio.shape == (round(scene.duration_s * scene.sample_rate_hz), 2)
    assert np.isfinite(audio).all()
    assert audio.std(axis=0).min() > 1e-6
    assert 0 <= recording.t0_frame < frames
    assert len(recording.detections) == (frames if scene.ego.stands else 0)
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
