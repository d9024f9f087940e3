"""Microphones through a stand-in for PortAudio."""

import json
import sys
import time
from importlib.machinery import ModuleSpec
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

from worldstate.adapters.live import live_sound
from worldstate.adapters.live.live_sound import LiveSound, MissingPortAudioError, PortAudioInput, portaudio
from worldstate.cli.main import main
from worldstate.ground.errors import InvalidArgumentError, MissingExtraError

RATE = 8_000
LENGTH = RATE // 40


class StandIn:
    """Stand-in for sounddevice with one device of four channels; it gives these blocks when it starts."""

    class PortAudioError(Exception):
        pass

    def __init__(self):
        self.stream, self.blocks = None, []

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
        self.stream = SimpleNamespace(**settings, start=self.give, close=lambda: None)
        return self.stream

    def give(self):
        for block, taken_s, overflow in self.blocks:
            mine = np.array(np.broadcast_to(block, (LENGTH, 4))[:, : self.stream.channels], np.float32)
            times = SimpleNamespace(inputBufferAdcTime=taken_s, currentTime=taken_s + LENGTH / RATE + 0.01)
            self.stream.callback(mine, LENGTH, times, SimpleNamespace(input_overflow=overflow))
            mine[:] = 99.0  # PortAudio writes the next one there


@pytest.fixture
def stand_in(monkeypatch):
    module = StandIn()
    module.__spec__ = ModuleSpec("sounddevice", None)
    monkeypatch.setitem(sys.modules, "sounddevice", module)
    return module


@pytest.fixture
def noise(stand_in):
    """Return 1.5 s of noise that the device gives."""
    sound = np.random.default_rng(5).normal(0.0, 0.1, (60, LENGTH, 4)).astype(np.float32)
    stand_in.blocks = [(block, 1.0 + number / 40, False) for number, block in enumerate(sound)]
    return sound


def heard(module, *blocks):
    """Return the sound and samples of blocks: value, time of capture, overflow."""
    module.blocks, sound = blocks, LiveSound(PortAudioInput(4, RATE, "roof"))
    chunks = sound.blocks()
    found = [next(chunks)]
    sound.close()
    return sound, np.concatenate([*found, *chunks])


def test_blocks_are_copied_in_order(stand_in):
    sound, samples = heard(stand_in, (0.1, 5.0, False), (0.2, 5.025, False))
    assert samples[[0, LENGTH]].tolist() == [[pytest.approx(0.1)] * 4, [pytest.approx(0.2)] * 4]
    assert (str(sound.path), stand_in.stream.channels, stand_in.stream.blocksize) == ("roof array", 4, LENGTH)


def test_an_overflow_is_counted_and_filled(stand_in):
    blocks = (0.1, 5.0, False), (0.2, 5.025, False), (0.3, 5.125, True)  # 75 ms are lost
    sound, samples = heard(stand_in, *blocks)
    assert (sound.overruns, sound.lost_samples) == (1, 600)
    assert np.flatnonzero(samples[:, 0] == 0.0).tolist() == list(range(2 * LENGTH, 2 * LENGTH + 600))


def test_an_overflow_without_capture_times_is_counted(stand_in):
    sound, samples = heard(stand_in, (0.1, 0.0, False), (0.2, 0.0, True))
    assert (sound.overruns, sound.lost_samples, len(samples)) == (1, 0, 2 * LENGTH)


def test_the_age_of_a_block_is_that_of_its_last_sample(stand_in):
    sound, _ = heard(stand_in, (0.1, 5.0, False))
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


@pytest.mark.parametrize(("chosen", "opened"), [([4, 2], 4), ([3, 1], 3)])
def test_the_command_records_the_channels_of_microphones(stand_in, noise, tmp_path, capsys, chosen, opened):
    positions_m = [[0, 0.1, 0], [0, -0.1, 0.05]]
    array, kept, own = tmp_path / "mics", tmp_path / "kept.wav", tmp_path / "chosen.wav"
    array.write_text(json.dumps({"positions_m": positions_m, "channels": chosen}))
    live = ["--rate", str(RATE), "--duration", "1.2", "--keep-sound", str(kept), "--uncalibrated", "--json"]
    assert main(["live", "--array", str(array), *live]) == 0
    assert json.loads(capsys.readouterr().out)["states"] == 3
    assert stand_in.stream.channels == opened
    samples, _ = soundfile.read(kept)
    assert samples.shape[1] == opened, "what is kept is as the card gave it, and chosen again when it is read"
    soundfile.write(own, samples[:, [one - 1 for one in chosen]], RATE, subtype="PCM_24")
    (tmp_path / "two.csv").write_text("0,0.1,0\n0,-0.1,0.05")
    found = []
    for sound, positions in ((kept, array), (own, tmp_path / "two.csv")):
        out = tmp_path / "b.csv"
        assert main(["array", "bearings", str(sound), "--array", str(positions), "--out", str(out)]) == 0
        found.append(out.read_text())
    assert found[0] == found[1]


def test_the_command_needs_an_array(stand_in, refused):
    assert "--array: expected the positions of the microphones, or --car" in refused(["live"])
