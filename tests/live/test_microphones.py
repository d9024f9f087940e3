"""Microphones through a stand-in for PortAudio."""

import json
import sys
import time
from importlib.machinery import ModuleSpec
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.live import live_sound
from worldstate.adapters.live.live_sound import LiveSound, MissingPortAudioError, PortAudioInput, portaudio
from worldstate.cli.main import main
from worldstate.ground.errors import InvalidArgumentError, MissingExtraError

RATE = 8_000
LENGTH = RATE // 40


class StandIn:
    """Stand-in for sounddevice with one device of four channels."""

    class PortAudioError(Exception):
        pass

    def __init__(self) -> None:
        self.stream = None

    def query_devices(self, device=None, kind=None):
        known = {"index": 3, "name": "roof array", "max_input_channels": 4}
        speaker = {"index": 0, "name": "speaker", "max_input_channels": 0}
        if kind is None:
            return [speaker, known]
        if device not in (None, 3, "roof"):
            raise ValueError(f"No input device matching {device!r}")
        return known

    def check_input_settings(self, device, channels, dtype, samplerate):
        if channels > 4:
            raise self.PortAudioError("Invalid number of channels")

    def InputStream(self, **settings):  # noqa: N802 - its name there
        self.stream = SimpleNamespace(**settings, start=lambda: None, close=lambda: None)
        return self.stream

    def give(self, value: float, taken_s: float, *, overflow: bool = False) -> None:
        block = np.full((LENGTH, 4), value, np.float32)
        times = SimpleNamespace(inputBufferAdcTime=taken_s, currentTime=taken_s + LENGTH / RATE + 0.01)
        self.stream.callback(block, LENGTH, times, SimpleNamespace(input_overflow=overflow))
        block[:] = 99.0  # PortAudio writes the next one there


@pytest.fixture
def stand_in(monkeypatch):
    module = StandIn()
    module.__spec__ = ModuleSpec("sounddevice", None)
    monkeypatch.setitem(sys.modules, "sounddevice", module)
    return module


def heard(module, feed, calls):
    sound = LiveSound(feed)
    blocks = sound.blocks()
    original = feed.start

    def start(into):
        original(into)
        for call in calls:
            module.give(*call[:2], overflow=len(call) > 2)
        into.close()

    feed.start = start
    return sound, np.concatenate(list(blocks))


def test_blocks_are_copied_in_order(stand_in):
    feed = PortAudioInput(4, RATE, "roof")
    _, samples = heard(stand_in, feed, [(0.1, 5.0), (0.2, 5.025)])
    assert samples[[0, LENGTH]].tolist() == [[pytest.approx(0.1)] * 4, [pytest.approx(0.2)] * 4]
    assert (feed.name, stand_in.stream.channels, stand_in.stream.blocksize) == ("roof array", 4, LENGTH)


def test_an_overflow_is_counted_and_filled(stand_in):
    sound, samples = heard(
        stand_in, PortAudioInput(4, RATE), [(0.1, 5.0), (0.2, 5.025), (0.3, 5.125, "lost 75 ms")]
    )
    assert sound.overruns == 1
    assert sound.lost_samples == 600
    assert np.flatnonzero(samples[:, 0] == 0.0).tolist() == list(range(2 * LENGTH, 2 * LENGTH + 600))


def test_an_overflow_without_capture_times_is_counted(stand_in):
    sound, samples = heard(stand_in, PortAudioInput(4, RATE), [(0.1, 0.0), (0.2, 0.0, "lost")])
    assert (sound.overruns, sound.lost_samples, len(samples)) == (1, 0, 2 * LENGTH)


def test_the_age_of_a_block_is_that_of_its_last_sample(stand_in):
    sound, _ = heard(stand_in, PortAudioInput(4, RATE), [(0.1, 5.0)])
    # The stand-in calls 10 ms after the end of the block.
    assert 0.01 <= sound.age_s(LENGTH) < 0.5
    assert sound.age_s(0) - sound.age_s(LENGTH) == pytest.approx(LENGTH / RATE, abs=5e-3)
    assert sound.stamp_ns(time.monotonic()) >= 1e9 * (LENGTH / RATE + 0.01)


@pytest.mark.parametrize(
    ("channels", "device", "said"),
    [(56, None, "56 channels at 8000 Hz"), (4, "cellar", "No input device matching 'cellar'")],
)
def test_a_wrong_device_raises_an_error_with_the_devices(stand_in, channels, device, said):
    with pytest.raises(InvalidArgumentError, match=said) as refused:
        PortAudioInput(channels, RATE, device)
    assert "3 roof array (4)" in str(refused.value)


def test_no_devices_raise_an_error(stand_in, monkeypatch):
    monkeypatch.setattr(stand_in, "query_devices", lambda *_: [])
    with pytest.raises(InvalidArgumentError, match="PortAudio finds none"):
        PortAudioInput(4, RATE)


def test_missing_packages_and_libraries_raise_an_error(monkeypatch):
    def without_library(name):
        raise OSError("PortAudio library not found")

    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises(MissingExtraError, match=r"worldstate\[live\]"):
        portaudio()
    monkeypatch.setattr(live_sound, "optional", without_library)
    with pytest.raises(MissingPortAudioError, match="apt-get install libportaudio2"):
        portaudio()


def test_the_command_records_from_the_device_until_the_duration(stand_in, tmp_path, capsys, monkeypatch):
    array = tmp_path / "mics.csv"
    array.write_text("0,0.1,0\n0,0.02,0.05\n0,-0.04,0\n0,-0.1,0.03\n")
    rng = np.random.default_rng(5)
    original = PortAudioInput.start

    def start(feed, into):
        original(feed, into)
        for number in range(60):
            block = rng.normal(0.0, 0.1, (LENGTH, 4)).astype(np.float32)
            times = SimpleNamespace(inputBufferAdcTime=1.0 + number / 40, currentTime=1.0 + (number + 1) / 40)
            stand_in.stream.callback(block, LENGTH, times, SimpleNamespace(input_overflow=False))

    monkeypatch.setattr(PortAudioInput, "start", start)
    command = ["live", "--array", str(array), "--rate", str(RATE), "--uncalibrated", "--duration", "1.2"]
    assert main([*command, "--json"]) == 0
    assert '"states": 3' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "opened"),
    [
        ('{"positions_m": [[0, 0.1, 0], [0, -0.1, 0.05]], "channels": [4, 2]}', 4),
        ('{"positions_m": [[0, 0.1, 0], [0, -0.1, 0.05]], "channels": [3, 1]}', 3),
    ],
)
def test_the_command_selects_the_channels_of_microphones(
    stand_in, tmp_path, capsys, monkeypatch, given, opened
):
    (tmp_path / "mics").write_text(given)
    sound = np.random.default_rng(5).normal(0.0, 0.1, (60, LENGTH, 4)).astype(np.float32)
    original = PortAudioInput.start

    def start(feed, into):
        original(feed, into)
        for number, block in enumerate(sound):
            times = SimpleNamespace(inputBufferAdcTime=1.0 + number / 40, currentTime=1.0 + (number + 1) / 40)
            none_lost = SimpleNamespace(input_overflow=False)
            stand_in.stream.callback(block[:, : stand_in.stream.channels].copy(), LENGTH, times, none_lost)

    monkeypatch.setattr(PortAudioInput, "start", start)
    kept, options = tmp_path / "kept.wav", ["--array", str(tmp_path / "mics"), "--uncalibrated"]
    live = ["--rate", str(RATE), "--duration", "1.2", "--keep-sound", str(kept)]
    assert main(["live", *options, *live]) == 0
    assert stand_in.stream.channels == opened
    samples, _ = soundfile.read(kept)
    assert samples.shape[1] == opened, "what is kept is as the card gave it, and chosen again when it is read"
    chosen = tmp_path / "chosen.wav"
    soundfile.write(chosen, samples[:, [3, 1] if opened == 4 else [2, 0]], RATE, subtype="PCM_24")
    (tmp_path / "two.csv").write_text("0,0.1,0\n0,-0.1,0.05")

    def bearings(sound, *options):
        out = str(tmp_path / "b.csv")
        assert main(["array", "bearings", str(sound), *options, "--out", out]) == 0
        return (tmp_path / "b.csv").read_text()

    options.remove("--uncalibrated")
    assert bearings(kept, *options) == bearings(chosen, "--array", str(tmp_path / "two.csv"))


def test_channels_of_a_played_recording_are_selected(tmp_path, capsys):
    sound = np.random.default_rng(5).normal(0.0, 0.1, (RATE * 3 // 2, 6))
    soundfile.write(tmp_path / "card.wav", sound, RATE)
    soundfile.write(tmp_path / "chosen.wav", sound[:, [4, 2, 3, 1]], RATE)
    found = []
    positions_m = read_array("respeaker-4").positions_m.tolist()
    for name, channels in (("card.wav", [5, 3, 4, 2]), ("chosen.wav", [1, 2, 3, 4])):
        out = tmp_path / "states.jsonl"
        (tmp_path / "mics.json").write_text(json.dumps({"positions_m": positions_m, "channels": channels}))
        command = ["live", "--play", str(tmp_path / name), "--array", str(tmp_path / "mics.json")]
        assert main([*command, "--uncalibrated", "--speed", "20", "--out", str(out)]) == 0
        bearings = [json.loads(line).get("evidence") for line in out.read_text().splitlines()]
        found.append(bearings)
    assert found[0] == found[1]
    assert found[0]


def test_the_command_needs_an_array(stand_in, capsys):
    assert main(["live"]) == 2
    assert "--array: expected the positions of the microphones, or --car" in capsys.readouterr().err
