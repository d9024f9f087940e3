"""Recorded sounds in place of synthesis: spectrum, level and errors."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from scipy.signal import butter, sosfilt
from simulated_sound import PAIR, band_power, level_db, made, refusal

from worldstate.adapters.files.array_file import write_array_xml
from worldstate.ground.errors import InputFileError
from worldstate.simulation import SOUNDS, SimulationSettings, SoundSettings, preset, simulate_recording, site
from worldstate.simulation.emitters.emitter import SYNTHESES, emitted, recorded_kinds
from worldstate.simulation.scene.octave_bands import REFERENCE_PA


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
    # One bark in twenty seconds: the rest of the file is not amplified to its level.
    barks = 1e-4 * np.random.default_rng(1).standard_normal(20 * 16_000)
    barks[:4_800] += band_noise(0.3, 16_000)
    folder = folder_of(tmp_path, "dog", barks, 16_000)
    levels = [
        np.square(emitted(SOUNDS["dog"], 8_000, 8_000.0, np.random.default_rng(seed), folder)).mean()
        for seed in range(20)
    ]
    assert np.median(levels) < 1e-2 * (REFERENCE_PA * 10.0 ** (SOUNDS["dog"].level_db / 20.0)) ** 2


def test_a_kind_without_recordings_is_synthesised(tmp_path):
    folder = folder_of(tmp_path, "dog", band_noise(2.0, 16_000), 16_000)
    with_folder, without = (
        emitted(SOUNDS["horn"], 8_000, 8_000.0, np.random.default_rng(3), one) for one in (folder, "")
    )
    assert with_folder.tobytes() == without.tobytes()


def test_a_recorded_sound_propagates_through_the_street(tmp_path):
    """Its line is 20 dB above the street, delayed by the path to each microphone."""
    folder = folder_of(tmp_path, "tone", band_noise(4.0, 16_000), 16_000)
    street = SimulationSettings(site("SB1"), "none", duration_s=2.0, sample_rate_hz=6_000.0)
    sounding = replace(
        street,
        preset=replace(preset(), sounds_folder=folder),
        sounds=(SoundSettings("tone", 0.0, 2.0, (4.0, 0.0)),),
    )
    for microphone in range(2):
        quiet, loud = (
            simulate_recording(one, np.random.default_rng(4), PAIR).audio[:, microphone]
            for one in (street, sounding)
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


def test_the_command_accepts_a_folder_among_the_kinds(tmp_path, capsys):
    write_array_xml(tmp_path / "pair.xml", PAIR)
    folder = folder_of(tmp_path / "own", "voice", band_noise(2.0, 16_000), 16_000)
    words = f"--static 1 --duration 0.5 --bandwidth 2000 --array {tmp_path / 'pair.xml'} --sounds"
    audio = []
    for out, jobs in (("a", "1"), ("b", "2")):
        told = made(capsys, tmp_path / out, f"{words} rain,{folder} --jobs {jobs}")
        assert told["sounds"] == ["rain", "voice"]
        audio.append((tmp_path / out / told["folders"][0] / "out_multi.wav").read_bytes())
    assert audio[0] == audio[1]
    truth = json.loads((tmp_path / "a" / told["folders"][0] / "truth.json").read_text())
    assert truth["settings"]["preset"]["sounds_folder"] == folder
    assert "one folder at most" in refusal(capsys, tmp_path / "c", f"{words} {folder},{tmp_path}")
