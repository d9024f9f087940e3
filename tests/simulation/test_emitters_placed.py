"""Sounds at a place, on a vehicle and at the microphones: direction, level and coherence."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import coherence, stft, welch
from simulated_sound import (
    ONE,
    OPEN,
    PAIR,
    QUIET,
    apart_deg,
    band_power,
    level_db,
    rendered,
    srp_spectrum,
    street_of,
)

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.simulation import (
    SITES,
    SOUNDS,
    SimulationSettings,
    SoundSettings,
    draw_settings,
    simulate_recording,
    site,
)
from worldstate.simulation.emitters.emitter import emitted
from worldstate.simulation.emitters.placed_sound import add_signal, add_sound, directivity
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate.simulation.scene.octave_bands import split_octaves
from worldstate.simulation.scene.settings import SIGNALS, sound_kind, with_sounds
from worldstate.simulation.scene.vehicle import drive
from worldstate.simulation.sound.delay import KNOT_SAMPLES

FS = 8_000.0
RING = MicrophoneArray([[0.2 * np.cos(a), 0.2 * np.sin(a), 0.0] for a in np.arange(8) * np.pi / 4])


def heard(sound, positions_m=ONE, plan=OPEN, seed=1, seconds=1.0, fs=FS):
    """Return the pressure of one sound alone at the microphones, Pa."""
    street = street_of(plan, positions_m, seconds, fs)
    add_sound(street, sound, np.random.default_rng(seed))
    return rendered(street)


def placed(kind, azimuth_deg, range_m, **more):
    angle = np.radians(azimuth_deg)
    place = range_m * np.cos(angle), range_m * np.sin(angle)
    return SoundSettings(kind, 0.0, 1.0, place, **more)


@pytest.mark.parametrize("azimuth", [20.0, -75.0, 110.0, -160.0])
@pytest.mark.parametrize("kind", ["voice", "saw"])
def test_the_bearing_of_a_sound_is_that_of_its_place(kind, azimuth):
    sound = heard(placed(kind, azimuth, 12.0), RING.positions_m + ONE)
    grid_deg = np.arange(-180.0, 180.0, 2.0)
    found_deg = grid_deg[srp_spectrum(sound, RING, FS, grid_deg, (400.0, 2000.0)).argmax()]
    assert apart_deg(found_deg, azimuth) <= 4.0


@settings(max_examples=6, deadline=None)
@given(st.floats(6.0, 56.0), st.floats(0.0, 360.0))
def test_pressure_falls_with_distance_above_hard_ground(range_m, azimuth):
    """The road doubles the energy: birds are too high for interference, 3.3 m above the array."""
    dry = emitted(sound_kind("birds"), int(FS), FS, np.random.default_rng(1))
    signal = heard(placed("birds", azimuth, range_m), seconds=1.3)[0]
    found = 10 * np.log10(np.square(signal).sum() / np.square(dry).sum())
    # Air takes some hundredths of a decibel per metre, and far away a little interference is left.
    assert found == pytest.approx(
        3.0 - 20 * np.log10(np.hypot(range_m, 3.3)) - 0.02 * range_m, abs=0.4 + 0.015 * range_m
    )


@pytest.mark.parametrize("kind", ["voice", "music", "horn"])
def test_a_directional_sound_is_weaker_behind_by_its_table(kind):
    """The same draw faces the array and away; only the levels of bands differ."""
    front, back = (heard(placed(kind, 0.0, 10.0, facing_rad=way)) for way in (np.pi, 0.0))
    octaves = [split_octaves(one[0], FS).std(axis=1) for one in (front, back)]
    loud = octaves[0] > 0.03 * octaves[0].max()
    found = 20 * np.log10(octaves[1][loud] / octaves[0][loud])
    np.testing.assert_allclose(found, np.array(sound_kind(kind).back_db)[loud], atol=1.5)


@given(st.sampled_from(sorted(SOUNDS)), st.floats(-7.0, 7.0), st.floats(0.0, 3.0))
def test_directivity_is_one_in_front_even_and_decreasing(kind, angle, more):
    near, far = np.sort(np.abs([np.arccos(np.cos(angle)), min(np.arccos(np.cos(angle)) + more, np.pi)]))
    gains = directivity(sound_kind(kind), np.array([0.0, near, far, -far]))
    np.testing.assert_allclose(gains[0], 1.0)
    assert np.all(gains[1] >= gains[2] - 1e-12)
    np.testing.assert_allclose(gains[2], gains[3])


def test_a_house_attenuates_a_siren_in_another_street():
    plan = site("SB1")
    behind = heard(placed("siren", 120.0, 60.0), plan=plan)
    free = heard(placed("siren", 120.0, 60.0))
    assert 10.0 < level_db(free) - level_db(behind) < QUIET.screen_cap_db + 1.0
    assert level_db(behind) > 55.0  # and is still audible


def test_rain_is_loud_and_incoherent_at_all_microphones():
    positions = 4 * RING.positions_m + ONE
    sound = heard(SoundSettings("rain", 0.0, 3.0), positions, seconds=3.0, fs=24_000.0)
    levels = [level_db(channel) for channel in sound]
    assert np.ptp(levels) < 3.0
    # Moderately loud: 58 dB(A), and similar without the weighting.
    assert np.mean(levels) == pytest.approx(sound_kind("rain").level_db, abs=3.0)
    frequencies, between = coherence(sound[0], sound[4], 24_000.0, nperseg=512)
    assert between[(frequencies > 500) & (frequencies < 8000)].mean() < 0.1


def test_rain_at_a_low_rate_is_the_same_rain_band_limited():
    in_band = [
        band_power(drops, fs, 300.0, 2500.0) / len(drops) ** 2
        for fs in (6_000.0, 24_000.0)
        for drops in heard(SoundSettings("rain", 0.0, 5.0), RING.positions_m[:1], seconds=5.0, fs=fs)
    ]
    # 240 drops of exponential strength determine the power within a tenth.
    assert 10 * np.log10(in_band[0] / in_band[1]) == pytest.approx(0.0, abs=1.5)


def test_gusts_affect_only_their_microphones():
    sound = heard(SoundSettings("gusts", 0.5, 3.0, channels=(1, 2)), RING.positions_m, seconds=4.0)
    assert not sound[[0, 3, 4, 5, 6, 7]].any()
    assert not sound[:, : int(0.5 * FS)].any() and not sound[:, int(3.6 * FS) :].any()
    octave = split_octaves(sound[1], FS)[:2].std(axis=1)
    assert octave.max() > 10 * split_octaves(sound[1], FS)[4].std()
    blowing = np.square(sound[[1, 2], : len(sound[0]) // 600 * 600].reshape(2, -1, 600)).mean(axis=2)
    assert (blowing > 1e-6 * blowing.max()).mean() < 0.9  # they begin and end
    assert abs(np.corrcoef(sound[1], sound[2])[0, 1]) < 0.3


@given(over_db=st.floats(-10.0, 20.0), lasts_s=st.floats(1.0, 4.0))
@settings(max_examples=10)
def test_wind_levels_are_equal_and_incoherent_at_all_microphones(over_db, lasts_s):
    wind = SoundSettings("wind", 0.5, lasts_s, level_offset_db=over_db)
    sound = heard(wind, 4 * RING.positions_m, seconds=5.0)
    within = slice(round(0.5 * FS), round((0.5 + lasts_s) * FS))
    assert not sound[:, : within.start].any()
    assert not sound[:, within.stop + 1 :].any()
    fifths = np.array([np.square(one).mean() for one in np.array_split(sound[:, within], 5, axis=1)])
    assert fifths.argmax() == 2
    frequencies, between = coherence(sound[0, within], sound[4, within], FS, nperseg=256)
    assert between[frequencies > 60.0].mean() < 3.0 * 256 / (lasts_s * FS) + 0.02
    # Within a fifth of the time around the middle the octave of 100 Hz has the requested level.
    middle = sound[:, round((0.5 + 0.4 * lasts_s) * FS) : round((0.5 + 0.6 * lasts_s) * FS)]
    frequencies, density = welch(middle, FS, nperseg=min(800, middle.shape[1]))
    octave = (frequencies >= 100.0 / np.sqrt(2.0)) & (frequencies <= 100.0 * np.sqrt(2.0))
    power = density[:, octave].mean() * 100.0 / np.sqrt(2.0)
    assert 10.0 * np.log10(power / 4e-10) == pytest.approx(77.0 + over_db, abs=3.0)
    # Three octaves higher the level is lower by 3.7 times 9 dB.
    high = (frequencies >= 600.0) & (frequencies <= 1000.0)
    fallen_db = 10.0 * np.log10(density[:, octave].mean() / density[:, high].mean())
    assert fallen_db == pytest.approx(37.0 * np.log10(780.0 / 98.0), abs=4.0)


def test_a_signal_of_a_vehicle_moves_with_it():
    """The tone of the beeper has the Doppler shift of the speed along the line of sight."""
    speed, lane = 15.0, 8.0
    street = street_of(OPEN, ONE, 4.0, FS)
    knots = np.arange(-250, 251) * KNOT_SAMPLES / FS
    path = drive(
        knots, entry_s=2.0, entry_y_m=1e-9, lane_x_m=lane, speed_mps=speed, kind=vehicle_kind("medium")
    )
    add_signal(street, "beeper", path, np.random.default_rng(2))
    (sound,) = rendered(street)
    frequencies, times, spectra = stft(sound, FS, nperseg=2048, nfft=16384, noverlap=1024)
    band = (frequencies > 900) & (frequencies < 1300)
    tone = np.abs(spectra[band])
    rear = np.interp(times, path.time_s, path.behind(path.kind.length_m)[1])
    pitch, loud = frequencies[band][tone.argmax(axis=0)], tone.max(axis=0)
    coming, going = (
        np.median(pitch[there & (loud > 0.3 * loud[there].max())]) for there in (rear > 18.0, rear < -18.0)
    )
    along = speed * np.cos(np.arctan(lane / 24.0))
    assert coming / going == pytest.approx((343.0 + along) / (343.0 - along), abs=0.01)


def test_an_added_sound_leaves_the_rest_unchanged():
    """The recording with a voice is the recording without it plus the voice."""
    scene = SimulationSettings(site("SB1"), "left", duration_s=1.0, entry_s=0.7, sample_rate_hz=FS)
    with_voice = replace(scene, sounds=(SoundSettings("voice", 0.5, 0.4, (4.0, 0.0)),))
    plain, voiced = (simulate_recording(one, np.random.default_rng(4), PAIR) for one in (scene, with_voice))
    assert plain.detections == voiced.detections and plain.truth["frames"] == voiced.truth["frames"]
    # Octave bands begin a little earlier, and sources of one rendering share rounding errors.
    begin = int(0.45 * FS)
    np.testing.assert_allclose(plain.audio[:begin], voiced.audio[:begin], atol=2e-6)
    added = voiced.audio - plain.audio
    assert added[begin:].std() > 1e-4
    (told,) = voiced.truth["sounds"]
    assert (told["kind"], told["start_s"], told["end_s"]) == ("voice", 0.5, 0.9)
    assert np.flatnonzero(told["sounding"]).tolist() == list(range(5, 9))
    assert told["azimuth_rad"][0] == 0.0 and told["range_m"][0] == 4.0


@settings(max_examples=15, deadline=None)
@given(
    st.sampled_from((*SITES, "SM1")),
    st.sampled_from(["left", "none"]),
    st.lists(st.sampled_from(sorted(SOUNDS)), max_size=4),
    st.integers(0, 2**32 - 1),
)
def test_drawn_sounds_have_the_requested_kinds(name, approach, kinds, seed):
    rng = np.random.default_rng(seed)
    drawn = with_sounds(draw_settings(name, approach, rng), kinds, 4, rng)
    signals = [kind for kind in kinds if kind in SIGNALS]
    assert drawn.signal == (signals[-1] if signals and approach != "none" else "")
    assert [sound.kind for sound in drawn.sounds] == [kind for kind in kinds if kind != drawn.signal]
    for sound in drawn.sounds:
        assert sound.start_s >= 0.0 and sound.end_s <= drawn.duration_s + 1e-9
        assert all(0 <= channel < 4 for channel in sound.channels)
