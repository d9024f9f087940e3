"""Synthesised, recorded, close and placed sounds: level, spectrum, rhythm, direction and coherence."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import bilinear_zpk, butter, coherence, find_peaks, sosfilt, stft, welch, zpk2sos
from simulated_sound import (
    ONE,
    OPEN,
    PAIR,
    QUIET,
    apart_deg,
    band_power,
    level_db,
    made,
    refusal,
    rendered,
    srp_spectrum,
    street_of,
)

from worldstate.adapters.files.array_file import write_array_xml
from worldstate.commissioning.heard_stream import junction_named
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError
from worldstate.simulation import (
    SITES,
    SimulationSettings,
    SoundSettings,
    draw_settings,
    preset,
    simulate_recording,
    site,
)
from worldstate.simulation.emitters.emitter import SYNTHESES, emitted, recorded_kinds
from worldstate.simulation.emitters.placed_sound import add_signal, add_sound, directivity
from worldstate.simulation.emitters.syntheses import BREAKER_BLOWS_HZ, DRILL_BLOWS_HZ, hammered, motor_sound
from worldstate.simulation.scene.kinds import KINDS, vehicle_kind
from worldstate.simulation.scene.octave_bands import REFERENCE_PA, split_octaves
from worldstate.simulation.scene.settings import MICROPHONES, SIGNALS, SOUNDS, sound_kind, with_sounds
from worldstate.simulation.scene.vehicle import Trajectory, crank_turns_hz, drive, exhaust_pulses
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.stream.close_sounds import close_sound, close_vehicle, idling_vehicle, recorded
from worldstate.simulation.stream.settings import StreamSettings

FS, SECONDS = 32_000.0, 6


@pytest.fixture(scope="module")
def sounds():
    return {
        name: emitted(SOUNDS[name], int(SECONDS * FS), FS, np.random.default_rng(7)) for name in SYNTHESES
    }


def a_weighting_filter(fs):
    """Return A-weighting by the poles of IEC 61672-1, independent of the formula of the library."""
    poles = -2 * np.pi * np.array([20.598997, 20.598997, 107.65265, 737.86223, 12194.217, 12194.217])
    gain = (2 * np.pi * 12194.217) ** 2 * 10 ** (1.9997 / 20)
    return zpk2sos(*bilinear_zpk(np.zeros(4), poles, gain, fs))


def envelope(x, fs=FS, rate=100):
    """Return the RMS 100 times per second."""
    block = int(fs / rate)
    return np.sqrt((x[: len(x) // block * block].reshape(-1, block).astype(float) ** 2).mean(axis=1))


@pytest.mark.long
@pytest.mark.parametrize("name", SYNTHESES)
def test_every_sound_has_the_level_of_the_table(sounds, name):
    power = envelope(sosfilt(a_weighting_filter(FS), sounds[name].astype(float)), rate=8) ** 2
    level = 10 * np.log10(power[power > power.max() / 10].mean() / 20e-6**2)
    # The delay of the filter moves a blast from one eighth of a second into two.
    assert level == pytest.approx(SOUNDS[name].level_db, abs=1.5 if name == "shots" else 1.0)


def test_a_raised_voice_has_the_level_and_the_spectrum_of_the_standards(sounds):
    """ISO 9921: 66 dB(A) with pauses; ANSI S3.5-1997: octaves of raised speech, 125 Hz to 4 kHz."""
    heard = sosfilt(a_weighting_filter(FS), sounds["voice"].astype(float))
    assert 20 * np.log10(heard.std() / 20e-6) == pytest.approx(66.0, abs=1.5)
    octaves = 20 * np.log10(split_octaves(sounds["voice"], FS).std(axis=1) / 20e-6)
    np.testing.assert_allclose(octaves[1:7], [53.0, 60.5, 64.9, 62.7, 57.2, 51.2], atol=4.0)


def test_a_voice_is_modulated_by_its_syllables(sounds):
    swell = envelope(sounds["voice"])
    power = np.abs(np.fft.rfft(swell - swell.mean())) ** 2
    rate = np.fft.rfftfreq(len(swell), 0.01)
    bands = [power[(rate >= low) & (rate < 2 * low)].sum() for low in (0.75, 1.5, 3.0, 6.0, 12.0)]
    assert np.argmax(bands) == 2


def test_a_siren_alternates_between_two_tones_a_fourth_apart(sounds):
    frequencies, _, spectra = stft(sounds["siren"], FS, nperseg=6400)
    low, high = (np.abs(spectra[np.argmin(abs(frequencies - tone))]) for tone in (410.0, 547.0))
    upper = high > low
    assert 0.4 < upper.mean() < 0.6
    # The tone changes every 0.75 s.
    assert np.abs(np.diff(upper.astype(int))).sum() == pytest.approx(SECONDS / 0.75, abs=2)
    clear = np.maximum(low, high) / np.minimum(low, high)
    assert np.median(clear) > 5.0


def test_a_wail_sweeps_between_its_ends(sounds):
    frequencies, _, spectra = stft(sounds["wail"], FS, nperseg=3200)
    pitch = frequencies[np.abs(spectra).argmax(axis=0)][2:-2]
    assert 580 <= pitch.min() <= 700 and 1300 <= pitch.max() <= 1420
    assert np.abs(np.diff(pitch)).max() < 200.0


def test_a_beeper_is_on_and_off_once_a_second(sounds):
    swell = envelope(sounds["beeper"])
    on = swell > 0.5 * swell.max()
    assert np.diff(on.astype(int)).clip(0).sum() == pytest.approx(SECONDS, abs=1)
    assert on.mean() == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize(
    ("name", "low_hz", "high_hz", "least"),
    [
        # UN Regulation No. 28, 6.1.5: the band from 1.8 to 3.55 kHz exceeds every higher band.
        ("horn", 1800.0, 3550.0, 0.5),
        ("beeper", 990.0, 1210.0, 0.95),
        ("birds", 2000.0, 8000.0, 0.98),
    ],
)
def test_sounds_have_their_energy_in_their_band(sounds, name, low_hz, high_hz, least):
    assert band_power(sounds[name], FS, low_hz, high_hz) > least * band_power(sounds[name], FS, -1.0)


def test_lines_of_a_machine_follow_its_speed():
    matched, unmoved = [], []
    for seed in range(8):
        sounds = (
            motor_sound(np.full(int(2 * FS), speed), FS, np.random.default_rng(seed)) for speed in (1.0, 0.5)
        )
        # At a resolution of 4 Hz.
        (hz, fast), (_, slow) = (welch(one, FS, "hann", int(FS / 4)) for one in sounds)
        # Noise has the same octaves at either speed; only lines change.
        for found, spectrum in ((matched, np.interp(hz / 2.0, hz, slow)), (unmoved, slow)):
            found.append(np.corrcoef(np.log(spectrum), np.log(fast))[0, 1])
    assert np.mean(matched) > np.mean(unmoved) + 0.1


@given(st.integers(0, 1000), st.floats(BREAKER_BLOWS_HZ[0], DRILL_BLOWS_HZ[1]))
@settings(max_examples=12, deadline=None)
def test_a_hammer_is_modulated_at_its_blows(seed, blows_hz):
    samples = int(8 * FS)
    sound = hammered(samples, FS, [(0.0, 8.0)], (blows_hz, blows_hz), np.random.default_rng(seed))
    swell = np.log(envelope(sound, rate=400))
    power = np.abs(np.fft.rfft((swell - swell.mean()) * np.hanning(len(swell)))) ** 2
    over = np.fft.rfftfreq(len(swell), 1.0 / 400) / blows_hz
    at, below, above = (power[(over > low) & (over < low + 0.3)].mean() for low in (0.85, 0.45, 1.3))
    assert at > 2.0 * max(below, above)


def test_steps_have_the_rate_of_a_walker(sounds):
    swell = envelope(sounds["steps"])
    # Heel and sole are 0.14 s apart, so a further step is at least a third of a second later.
    heels = find_peaks(swell, height=0.3 * swell.max(), distance=33)[0]
    assert np.diff(heels).mean() / 100 == pytest.approx(1 / 1.9, rel=0.15)


@settings(max_examples=6, deadline=None)
@given(
    st.sampled_from(sorted(SYNTHESES)),
    st.floats(6_000.0, 50_000.0),
    st.integers(1, 40_000),
    st.integers(0, 2**32 - 1),
)
def test_any_rate_and_length_is_reproducible_by_seed(name, rate, samples, seed):
    first, again = (emitted(SOUNDS[name], samples, rate, np.random.default_rng(seed)) for _ in range(2))
    assert first.shape == (samples,) and first.dtype == np.float32
    assert np.isfinite(first).all()
    assert first.tobytes() == again.tobytes()


@pytest.mark.parametrize("name", ["horn", "saw", "bell"])
def test_a_low_rate_gives_the_same_sound_band_limited(name):
    """Sounds are drawn at 24 kHz; at a quarter of this rate the spectrum below 2.8 kHz is the same."""
    low = emitted(SOUNDS[name], 12_000, 6_000.0, np.random.default_rng(5))
    high = emitted(SOUNDS[name], 48_000, 24_000.0, np.random.default_rng(5))
    spectrum = np.fft.rfft(high)[: len(low) // 2 + 1] / 4
    inside = np.fft.rfftfreq(len(low), 1 / 6_000.0) < 2_800.0
    np.testing.assert_allclose(np.fft.rfft(low)[inside], spectrum[inside], atol=1e-3 * np.abs(spectrum).max())


def test_the_documentation_lists_every_sound_with_its_level():
    text = (Path(__file__).parents[2] / "docs/evidence/simulation.md").read_text()
    rows = {line.split("`")[1]: line for line in text.splitlines() if line.startswith("| `")}
    for kind in SOUNDS.values():
        cells = [cell.strip() for cell in rows[kind.name].strip("|").split("|")]
        assert cells[1] == kind.label
        assert float(cells[2].split()[0]) == kind.level_db
        if kind.origin != MICROPHONES:
            assert cells[3].startswith(f"{kind.back_db[4]:g} / {kind.back_db[6]:g}")
            assert cells[4] == f"{kind.height_m:g} m"


def band_noise(seconds: float, rate: float, low_hz: float = 950.0, high_hz: float = 1050.0) -> np.ndarray:
    white = np.random.default_rng(1).standard_normal(round(seconds * rate))
    noise = sosfilt(butter(4, (low_hz, high_hz), "bandpass", fs=rate, output="sos"), white)
    return np.asarray(0.1 * noise / np.abs(noise).max())


def folder_of(root: Path, kind: str, sound: np.ndarray, rate: int, suffix: str = "wav") -> str:
    (root / kind).mkdir(parents=True, exist_ok=True)
    soundfile.write(root / kind / f"one.{suffix}", sound, rate)
    return str(root)


@pytest.mark.parametrize("rate", [6_000.0, 47_998.0])
@pytest.mark.parametrize("suffix", ["wav", "flac"])
def test_recorded_sounds_have_their_spectrum_and_the_level_of_their_kind(tmp_path, rate, suffix):
    """A-weighting is 0 dB around 1 kHz; the second channel is ignored."""
    sound = np.column_stack([band_noise(5.0, 44_100), band_noise(5.0, 44_100, 200.0, 300.0)])
    folder = folder_of(tmp_path, "dog", sound, 44_100, suffix)
    heard = emitted(SOUNDS["dog"], round(3.0 * rate), rate, np.random.default_rng(2), folder)
    assert heard.shape == (round(3.0 * rate),) and heard.dtype == np.float32
    assert level_db(heard) == pytest.approx(SOUNDS["dog"].level_db, abs=1.0)
    assert band_power(heard, rate, 900.0, 1100.0) > 0.98 * band_power(heard, rate, -1.0)


def test_short_recordings_are_repeated_and_pauses_kept(tmp_path):
    folder = folder_of(tmp_path, "dog", band_noise(0.3, 16_000), 16_000)
    heard = emitted(SOUNDS["dog"], 24_000, 8_000.0, np.random.default_rng(2), folder)
    assert np.square(heard).reshape(-1, 800).mean(axis=1).min() > 0.0
    # With one bark in twenty seconds, the rest of the file is not amplified to the level of the bark.
    barks = 1e-4 * np.random.default_rng(1).standard_normal(20 * 16_000)
    barks[:4_800] += band_noise(0.3, 16_000)
    folder = folder_of(tmp_path, "dog", barks, 16_000)
    levels = [
        np.square(emitted(SOUNDS["dog"], 8_000, 8_000.0, np.random.default_rng(seed), folder)).mean()
        for seed in range(20)
    ]
    assert np.median(levels) < 1e-2 * (REFERENCE_PA * 10.0 ** (SOUNDS["dog"].level_db / 20.0)) ** 2


def test_a_recorded_sound_propagates_through_the_street(tmp_path):
    """The recording is band noise, 20 dB above the street in its band and hardly above it elsewhere."""
    folder = folder_of(tmp_path, "tone", band_noise(4.0, 16_000), 16_000)
    street = SimulationSettings(site("SB1"), "none", duration_s=2.0, sample_rate_hz=6_000.0)
    sounding = replace(
        street,
        preset=replace(preset(), sounds_folder=folder),
        sounds=(SoundSettings("tone", 0.0, 2.0, (4.0, 0.0)),),
    )
    quiet, loud = (
        simulate_recording(one, np.random.default_rng(4), PAIR).audio.T for one in (street, sounding)
    )
    assert band_power(loud, 6e3, 950.0, 1050.0) > 100.0 * band_power(quiet, 6e3, 950.0, 1050.0)
    assert band_power(loud, 6e3, 2000.0, 2500.0) < 2.0 * band_power(quiet, 6e3, 2000.0, 2500.0)


def test_folders_of_recordings_have_the_names_of_kinds(tmp_path):
    folder = folder_of(tmp_path / "good", "siren", band_noise(0.3, 16_000), 16_000)
    (tmp_path / "good" / ".git").mkdir()
    assert recorded_kinds(folder) == ("siren",)
    (tmp_path / "good" / "siren" / "broken.wav").write_bytes(b"no sound")
    with pytest.raises(InputFileError, match=r"broken\.wav"):
        recorded_kinds(folder)
    for name, got in (("vuvuzela", "got vuvuzela"), ("rain", "got rain"), ("dog", "got dog with 0")):
        (tmp_path / f"bad {name}" / name).mkdir(parents=True)
        with pytest.raises(InputFileError, match=got) as refused:
            recorded_kinds(str(tmp_path / f"bad {name}"))
        assert all(kind in str(refused.value) for kind in SYNTHESES)
    with pytest.raises(InputFileError, match="got none"):
        recorded_kinds(str(tmp_path / "good" / ".git"))


def test_the_command_adds_and_reports_kinds_and_a_folder(tmp_path, capsys):
    write_array_xml(tmp_path / "pair.xml", PAIR)
    folder = folder_of(tmp_path / "own", "voice", band_noise(2.0, 16_000), 16_000)
    words = "--static 1 --scene merge --duration 0.5 --bandwidth 2000"
    words += f" --array {tmp_path / 'pair.xml'} --sounds"
    audio = []
    for out, jobs in (("a", "1"), ("b", "2")):
        told = made(capsys, tmp_path / out, f"{words} siren,gusts,{folder} --jobs {jobs}")
        assert told["sounds"] == ["siren", "gusts", "voice"]
        audio.append((tmp_path / out / told["folders"][0] / "out_multi.wav").read_bytes())
    assert audio[0] == audio[1]
    truth = json.loads((tmp_path / "a" / told["folders"][0] / "truth.json").read_text())
    assert truth["settings"]["signal"] == "siren"
    assert [sound["kind"] for sound in truth["sounds"]] == ["gusts", "voice"]
    assert truth["settings"]["preset"]["sounds_folder"] == folder
    assert "one folder at most" in refusal(capsys, tmp_path / "c", f"{words} {folder},{tmp_path}")
    assert "vuvuzela" in refusal(capsys, tmp_path / "c", f"{words} vuvuzela")


RATE_HZ, PASS_S, STREET = 6000.0, 5.0, StreamSettings(junction_named("SA1"), 1.0)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["light", "heavy", "tram"])
def test_a_passing_vehicle_swells_and_an_idling_one_does_not(kind: str) -> None:
    of_street, drawn = (KINDS[kind], STREET.preset, STREET.site, PASS_S, RATE_HZ), []
    for rng in np.random.default_rng(1).spawn(6):
        sounds = close_vehicle(*of_street, rng), idling_vehicle(*of_street, rng)
        drawn.append([np.ptp(20.0 * np.log10(envelope(sound, RATE_HZ, rate=2))) for sound in sounds])
    passes, idles = np.median(drawn, axis=0)
    # A tram is 30 m long, so it is beside the recorder for two seconds.
    assert passes > idles + (1.0 if kind == "tram" else 4.0)


@given(st.integers(0, 10_000), st.floats(3.0, 16.0))
@settings(max_examples=15, deadline=None)
def test_a_motorcycle_fires_at_multiples_of_half_its_turns(seed: int, speed_mps: float) -> None:
    time = np.arange(0.0, 4.0, 1.0 / RATE_HZ)
    knots = np.arange(0.0, 4.1, 0.1)
    still = np.zeros_like(knots)
    path = Trajectory(knots, still, np.full_like(knots, speed_mps), 0.0, 1, KINDS["motorcycle"])
    turns, pulses = (
        draw(path, time, np.random.default_rng(seed)) for draw in (crank_turns_hz, exhaust_pulses)
    )
    assert pulses.std() == pytest.approx(1.0, abs=0.15) and 17.0 < turns.min() <= turns.max() < 300.0
    # As a function of the crank angle a line has constant frequency.
    angle = np.pi * np.cumsum(turns) / RATE_HZ
    at, between = (
        sum(abs((pulses * np.exp(-1j * (order + shift) * angle)).mean()) ** 2 for order in range(1, 9))
        for shift in (0.0, 0.5)
    )
    assert at > 3.0 * between


@given(st.integers(0, 1000), st.sampled_from(["dog", "horns", "sweeps", "shots", "tune"]))
@settings(max_examples=10, deadline=None)
def test_close_sounds_are_finite_and_within_full_scale(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    heard = recorded(close_sound(kind, 3.0, RATE_HZ, rng), RATE_HZ, rng)
    assert np.isfinite(heard).all()
    assert np.abs(heard).max() == pytest.approx(0.5, rel=1e-3)


PLACED_HZ = 8_000.0
RING = MicrophoneArray([[0.2 * np.cos(a), 0.2 * np.sin(a), 0.0] for a in np.arange(8) * np.pi / 4])


def heard(sound, positions_m=ONE, plan=OPEN, seed=1, seconds=1.0, fs=PLACED_HZ):
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
    found_deg = grid_deg[srp_spectrum(sound, RING, PLACED_HZ, grid_deg, (400.0, 2000.0)).argmax()]
    assert apart_deg(found_deg, azimuth) <= 4.0


@settings(max_examples=6, deadline=None)
@given(st.floats(6.0, 56.0), st.floats(0.0, 360.0))
def test_pressure_falls_with_distance_above_hard_ground(range_m, azimuth):
    """The road doubles the energy without interference, because birds sing 3.3 m above the array."""
    dry = emitted(sound_kind("birds"), int(PLACED_HZ), PLACED_HZ, np.random.default_rng(1))
    signal = heard(placed("birds", azimuth, range_m), seconds=1.3)[0]
    found = 10 * np.log10(np.square(signal).sum() / np.square(dry).sum())
    # Air takes some hundredths of a decibel per metre, and far away a little interference is left.
    assert found == pytest.approx(
        3.0 - 20 * np.log10(np.hypot(range_m, 3.3)) - 0.02 * range_m, abs=0.4 + 0.015 * range_m
    )


@pytest.mark.parametrize("kind", ["voice", "music", "horn"])
def test_a_directional_sound_is_weaker_behind_by_its_table(kind):
    """The same sound faces the array or the opposite direction; only the levels of bands differ."""
    front, back = (heard(placed(kind, 0.0, 10.0, facing_rad=way)) for way in (np.pi, 0.0))
    octaves = [split_octaves(one[0], PLACED_HZ).std(axis=1) for one in (front, back)]
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
    assert not sound[:, : int(0.5 * PLACED_HZ)].any() and not sound[:, int(3.6 * PLACED_HZ) :].any()
    octave = split_octaves(sound[1], PLACED_HZ)[:2].std(axis=1)
    assert octave.max() > 10 * split_octaves(sound[1], PLACED_HZ)[4].std()
    blowing = np.square(sound[[1, 2], : len(sound[0]) // 600 * 600].reshape(2, -1, 600)).mean(axis=2)
    assert (blowing > 1e-6 * blowing.max()).mean() < 0.9  # they begin and end
    assert abs(np.corrcoef(sound[1], sound[2])[0, 1]) < 0.3


@given(over_db=st.floats(-10.0, 20.0), lasts_s=st.floats(1.0, 4.0))
@settings(max_examples=10)
def test_wind_levels_are_equal_and_incoherent_at_all_microphones(over_db, lasts_s):
    wind = SoundSettings("wind", 0.5, lasts_s, level_offset_db=over_db)
    sound = heard(wind, 4 * RING.positions_m, seconds=5.0)
    within = slice(round(0.5 * PLACED_HZ), round((0.5 + lasts_s) * PLACED_HZ))
    assert not sound[:, : within.start].any()
    assert not sound[:, within.stop + 1 :].any()
    fifths = np.array([np.square(one).mean() for one in np.array_split(sound[:, within], 5, axis=1)])
    assert fifths.argmax() == 2
    frequencies, between = coherence(sound[0, within], sound[4, within], PLACED_HZ, nperseg=256)
    assert between[frequencies > 60.0].mean() < 3.0 * 256 / (lasts_s * PLACED_HZ) + 0.02
    # In the middle fifth of the time the octave of 100 Hz has the requested level.
    middle = sound[:, round((0.5 + 0.4 * lasts_s) * PLACED_HZ) : round((0.5 + 0.6 * lasts_s) * PLACED_HZ)]
    frequencies, density = welch(middle, PLACED_HZ, nperseg=min(800, middle.shape[1]))
    octave = (frequencies >= 100.0 / np.sqrt(2.0)) & (frequencies <= 100.0 * np.sqrt(2.0))
    power = density[:, octave].mean() * 100.0 / np.sqrt(2.0)
    assert 10.0 * np.log10(power / 4e-10) == pytest.approx(77.0 + over_db, abs=3.0)
    # The level falls by 37 dB per decade from about 98 to 780 Hz.
    high = (frequencies >= 600.0) & (frequencies <= 1000.0)
    fallen_db = 10.0 * np.log10(density[:, octave].mean() / density[:, high].mean())
    assert fallen_db == pytest.approx(37.0 * np.log10(780.0 / 98.0), abs=4.0)


def test_a_signal_of_a_vehicle_moves_with_it():
    """The tone of the beeper has the Doppler shift of the speed along the line of sight."""
    speed, lane = 15.0, 8.0
    street = street_of(OPEN, ONE, 4.0, PLACED_HZ)
    knots = np.arange(-250, 251) * KNOT_SAMPLES / PLACED_HZ
    path = drive(
        knots, entry_s=2.0, entry_y_m=1e-9, lane_x_m=lane, speed_mps=speed, kind=vehicle_kind("medium")
    )
    add_signal(street, "beeper", path, np.random.default_rng(2))
    (sound,) = rendered(street)
    frequencies, times, spectra = stft(sound, PLACED_HZ, nperseg=2048, nfft=16384, noverlap=1024)
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
    scene = SimulationSettings(site("SB1"), "left", duration_s=1.0, entry_s=0.7, sample_rate_hz=PLACED_HZ)
    with_voice = replace(scene, sounds=(SoundSettings("voice", 0.5, 0.4, (4.0, 0.0)),))
    plain, voiced = (simulate_recording(one, np.random.default_rng(4), PAIR) for one in (scene, with_voice))
    assert plain.detections == voiced.detections and plain.truth["frames"] == voiced.truth["frames"]
    # Octave bands begin a little earlier, and sources of one rendering share rounding errors.
    begin = int(0.45 * PLACED_HZ)
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
