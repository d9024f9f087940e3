"""Live sound: pace, completeness and counted losses; microphones through a stand-in for PortAudio."""

import json
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from stand_ins import SoundCard

from worldstate.adapters import ListenSettings, listen_steps, open_source
from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.live import live_sound
from worldstate.adapters.live.live_listening import live_steps
from worldstate.adapters.live.live_sound import (
    LiveSound,
    MissingPortAudioError,
    Playback,
    PortAudioInput,
    SoundBlock,
    portaudio,
)
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError, InvalidArgumentError, MissingExtraError
from worldstate.ground.threads import BoundedChannel

RATE, SECONDS = 8_000, 2.0


class Scripted:
    """Blocks that are available at once, with the number of the first sample of each."""

    name, sample_rate_hz, channels, speed, overflows = "scripted", RATE, 4, 1.0, 0

    def __init__(self, *blocks: SoundBlock) -> None:
        self._blocks, self.stopped = blocks, False

    def start(self, into: BoundedChannel[SoundBlock], /) -> None:
        for block in self._blocks:
            into.put(block)
        into.close()

    def stop(self) -> None:
        self.stopped = True


def block(first: int, n: int = 200, captured_s: float = 0.0) -> SoundBlock:
    return SoundBlock(np.full((n, 4), 0.5, np.float32), first, captured_s)


@pytest.fixture(scope="module")
def source(street):
    bare = ListenSettings(uncalibrated=True)
    return open_source(street / "street.wav", array=street / "mics.csv", settings=bare)


def played(source, **options):
    return replace(source, sound=LiveSound(Playback(open_sound(source.sound), **options)))


def heard(sound):
    return np.concatenate(list(sound.blocks()))


def test_lost_samples_become_silence_of_the_same_length():
    sound = LiveSound(Scripted(block(0), block(500), block(700)))
    found = heard(sound)
    assert len(found) == 900 == sound.frames
    assert np.flatnonzero(~found.any(axis=1)).tolist() == list(range(200, 500))
    assert sound.lost_samples == 300
    assert sound.lost_s == pytest.approx(300 / RATE)


@pytest.mark.parametrize(
    "wrong",
    [
        block(0),  # delivered twice
        block(200 - 1_000_000),
        block(100 * RATE + 200),  # a device that was suspended
        SoundBlock(np.full((200, 3), 0.5, np.float32), 200, 0.0),
        SoundBlock(np.full(200, 0.5, np.float32), 200, 0.0),
        *(SoundBlock(samples, 200, 0.0) for samples in (None, [[0.5] * 4] * 200, np.float32(0.5))),
        *(SoundBlock(block(0).samples.astype(kind), 200, 0.0) for kind in (object, str, complex, bool)),
        SoundBlock(np.full((200, 4), 900, np.int16), 200, 0.0),
        *(SoundBlock(block(0).samples, first, 0.0) for first in (None, "200", 200.5, np.nan)),
        *(SoundBlock(block(0).samples, 200, at_s) for at_s in (None, "0", np.nan, np.inf, 1e308, 1j)),
        None,
        "samples",
        (block(0).samples, 200, 0.0),
    ],
)
def test_blocks_out_of_order_are_dropped_and_counted(wrong):
    sound = LiveSound(Scripted(block(0), wrong, block(200)))
    found = heard(sound)
    assert found.shape == (400, 4)
    assert found.all()
    assert (sound.refused, sound.lost_samples) == (1, 0)


@pytest.mark.parametrize("sample", [np.nan, np.inf, -np.inf, 1e30])
def test_invalid_samples_become_silence_of_their_microphone(sample):
    wrong = block(200)
    wrong.samples[7, 2] = sample
    sound = LiveSound(Scripted(block(0), wrong))
    found = heard(sound)
    assert np.argwhere(found == 0.0).tolist() == [[207, 2]]
    assert np.isfinite(found).all()
    assert sound.refused == 1


class Stalling(Scripted):
    """Blocks in real time, some omitted, delayed or wrongly numbered."""

    def __init__(self, numbers, hold=(), restart=False):
        self.numbers, self.hold, self.restart, self.stopped = numbers, hold, restart, threading.Event()

    def start(self, into):
        self._thread = threading.Thread(target=self._give, args=(into,))
        self._thread.start()

    def stop(self):
        self.stopped.set()
        self._thread.join()

    def _give(self, into):
        begun_s = time.monotonic()
        for number in range(self.numbers):
            due_s = begun_s + (number + 1) / 40
            late_s = max(0.0, begun_s + max(self.hold) / 40 - due_s) if number in self.hold else 0.0
            self.stopped.wait(max(due_s + late_s - time.monotonic(), 0.0))
            past = bool(self.hold) and number > max(self.hold)
            first = 200 * (number - max(self.hold) if past and self.restart else number)
            into.put(block(first, captured_s=due_s))
        into.close()


def test_a_stalling_microphone_gives_states_in_time(source):
    # Silent from 1.25 s to 2.75 s, when all delayed blocks arrive at once.
    sound = LiveSound(Stalling(160, hold=range(50, 110)))
    lives = []
    for live in live_steps(replace(source, sound=sound)):
        lives.append((time.monotonic(), live.step.state))
    stamps_ns = [state.stamp_ns for _, state in lives]
    assert np.diff(stamps_ns).tolist() == [100_000_000] * (len(stamps_ns) - 1)
    assert max(np.diff([at for at, _ in lives])) < 1.0
    assert stamps_ns[-1] == pytest.approx(4e9, abs=2e8)
    assert lives[-1][1].delivery.refused == sound.refused > 30
    assert {one.condition for _, state in lives for one in state.sensors} > {"working"}


def test_a_device_that_restarts_its_count_is_read_again():
    sound = LiveSound(Stalling(120, hold=[40], restart=True))
    found = heard(sound)
    assert found[-200:].all()
    assert len(found) == pytest.approx(3.0 * RATE, abs=0.2 * RATE)
    assert 10 < sound.refused < 40


@pytest.mark.parametrize("given", [None, "one", -1, float("nan"), 1.5e300, ZeroDivisionError("own"), [1]])
def test_a_failing_user_function_is_counted_and_the_run_continues(source, given, caplog):
    def hand_in(listener):
        if isinstance(given, Exception):
            raise given
        return given

    *_, last = live_steps(played(source, speed=20.0), lambda listener: 0, hand_in)
    assert last.step.state.stamp_ns == 2_000_000_000
    assert last.step.state.delivery.refused == 81  # one per block and one at the end
    assert caplog.text.count("hand_in") == 1


def test_unread_blocks_are_overruns():
    feed = Scripted(*(block(200 * number) for number in range(100)))
    sound = LiveSound(feed)
    found = heard(sound)
    # At most 80 blocks of 25 ms are queued, so twenty were dropped, and the others keep their time.
    assert sound.overruns == 20
    assert len(found) == 100 * 200
    assert not found[: 20 * 200].any()
    assert found[20 * 200 :].all()
    assert feed.stopped


def test_after_lost_seconds_the_time_is_kept():
    kept = []
    sound = LiveSound(Scripted(*(block(200 * number) for number in range(140))), kept.append)
    found = heard(sound)
    # Sixty blocks were dropped, then all queued ones but the newest.
    assert sound.overruns == 139
    assert 0.9 * RATE <= len(found) - 200 < RATE
    assert not found[:-200].any() and found[-200:].all()
    assert sound.start_ns % 10**8 == 0
    assert sound.start_ns == pytest.approx((140 * 200 - len(found)) / RATE * 1e9)
    assert sound.lost_samples == 139 * 200 and sum(map(len, kept)) == 140 * 200


def test_an_image_is_stamped_on_the_clock_of_the_sound():
    now_s = time.monotonic()
    sound = LiveSound(Scripted(block(0, RATE, now_s), block(RATE, RATE, now_s + 1.0)))
    list(sound.blocks())
    # The last sample, of second 2, was captured at now + 1, 0.25 s after the image.
    assert sound.stamp_ns(now_s + 0.75) == pytest.approx(1.75e9, abs=1e3)


def test_a_wrong_number_of_channels_raises_an_error(source):
    three = replace(source, sound=LiveSound(Scripted()), array=MicrophoneArray(source.array.positions_m[:3]))
    with pytest.raises(InputFileError, match="expected 3 channels, one per microphone, got 4"):
        list(live_steps(three))


def test_a_recording_has_no_latency(source):
    with pytest.raises(InvalidArgumentError, match="LiveSound"):
        next(live_steps(source))


def test_playback_is_exact_and_in_real_time(source):
    begun_s = time.monotonic()
    lives = list(live_steps(played(source, speed=2.0)))
    took_s = time.monotonic() - begun_s
    assert [one.step.state for one in lives] == [step.state for step in listen_steps(source)]
    assert took_s >= SECONDS / 2.0
    assert all(0.0 < one.latency_s < took_s for one in lives)
    assert (lives[-1].overruns, lives[-1].lost_s) == (0, 0.0)


def test_playback_repeats_or_ends_with_the_run(source):
    twice = list(live_steps(played(source, speed=50.0, duration_s=2 * SECONDS)))
    assert twice[-1].step.state.stamp_ns == 4_000_000_000
    short = list(live_steps(played(source, speed=50.0, duration_s=1.3)))
    assert short[-1].step.state.stamp_ns == 1_300_000_000


def test_a_damaged_recording_stops_the_run_with_its_error(source, tmp_path):
    class Torn(Playback):
        def _blocks(self):
            yield np.zeros((200, 4), np.float32)
            raise InputFileError("street.wav", "cut short")

    torn = replace(source, sound=LiveSound(Torn(open_sound(source.sound), speed=50.0)))
    with pytest.raises(InputFileError, match="cut short"):
        list(live_steps(torn))


LENGTH = RATE // 40


@pytest.fixture
def stand_in(monkeypatch):
    monkeypatch.setitem(sys.modules, "sounddevice", card := SoundCard(4))
    return card


def recorded(module, *blocks):
    """Return the sound and samples of blocks: value, time of capture, overflow."""
    module.blocks = [(np.full((LENGTH, 4), value), *about) for value, *about in blocks]
    sound = LiveSound(PortAudioInput(4, RATE, "roof"))
    chunks = sound.blocks()
    found = [next(chunks)]
    sound.close()
    return sound, np.concatenate([*found, *chunks])


def test_blocks_are_copied_in_order(stand_in):
    sound, samples = recorded(stand_in, (0.1, 5.0, False), (0.2, 5.025, False))
    assert samples[[0, LENGTH]].tolist() == [[pytest.approx(0.1)] * 4, [pytest.approx(0.2)] * 4]
    assert (str(sound.path), stand_in.stream.channels, stand_in.stream.blocksize) == ("roof array", 4, LENGTH)


def test_an_overflow_is_counted_and_filled(stand_in):
    blocks = (0.1, 5.0, False), (0.2, 5.025, False), (0.3, 5.125, True)  # 75 ms are lost
    sound, samples = recorded(stand_in, *blocks)
    assert (sound.overruns, sound.lost_samples) == (1, 600)
    assert np.flatnonzero(samples[:, 0] == 0.0).tolist() == list(range(2 * LENGTH, 2 * LENGTH + 600))


def test_an_overflow_without_capture_times_is_counted(stand_in):
    sound, samples = recorded(stand_in, (0.1, 0.0, False), (0.2, 0.0, True))
    assert (sound.overruns, sound.lost_samples, len(samples)) == (1, 0, 2 * LENGTH)


def test_the_age_of_a_block_is_that_of_its_last_sample(stand_in):
    sound, _ = recorded(stand_in, (0.1, 5.0, False))
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
def test_the_command_records_the_channels_of_microphones(stand_in, tmp_path, capsys, chosen, opened):
    sound = np.random.default_rng(5).normal(0.0, 0.1, (60, LENGTH, 4))
    stand_in.blocks = [(block, 1.0 + number / 40, False) for number, block in enumerate(sound)]
    positions_m = [[0, 0.1, 0], [0, -0.1, 0.05]]
    array, kept, own = tmp_path / "mics", tmp_path / "kept.wav", tmp_path / "chosen.wav"
    array.write_text(json.dumps({"positions_m": positions_m, "channels": chosen}))
    live = ["--rate", str(RATE), "--duration", "1.2", "--keep-sound", str(kept), "--uncalibrated", "--json"]
    assert main(["live", "--array", str(array), *live]) == 0
    assert json.loads(capsys.readouterr().out)["states"] == 3
    assert stand_in.stream.channels == opened
    samples, _ = soundfile.read(kept)
    assert samples.shape[1] == opened, "the file has all channels of the card; reading it selects them again"
    soundfile.write(own, samples[:, [one - 1 for one in chosen]], RATE, subtype="PCM_24")
    (tmp_path / "two.csv").write_text("0,0.1,0\n0,-0.1,0.05")
    found = []
    for file, positions in ((kept, array), (own, tmp_path / "two.csv")):
        out = tmp_path / "b.csv"
        assert main(["array", "bearings", str(file), "--array", str(positions), "--out", str(out)]) == 0
        found.append(out.read_text())
    assert found[0] == found[1]
