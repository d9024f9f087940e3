"""Recordings are read exactly as soundfile wrote them, in blocks of any size."""

from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.adapters.audio.sound_file import SilentChannelsError, open_audio, open_sound
from worldstate.ground.errors import InvalidArgumentError

RATE_HZ = 8000
FORMATS = [
    ("WAV", "PCM_24"),
    ("WAV", "PCM_16"),
    ("WAV", "FLOAT"),
    ("WAVEX", "PCM_24"),
    ("RF64", "PCM_24"),
    ("W64", "PCM_24"),
    ("W64", "DOUBLE"),
    ("FLAC", "PCM_24"),
]


def noise(frames: int = 9001, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(7).uniform(-0.5, 0.5, (frames, channels)).astype(np.float32)


def write(path: Path, samples: np.ndarray, container: str = "WAV", encoding: str = "PCM_24") -> Path:
    soundfile.write(path, samples, RATE_HZ, format=container, subtype=encoding)
    return path


@pytest.mark.parametrize(("container", "encoding"), FORMATS)
def test_reading_returns_the_written_samples(tmp_path: Path, container: str, encoding: str) -> None:
    samples = noise()
    with open_audio(write(tmp_path / "sound", samples, container, encoding), expect_channels=3) as source:
        blocks = list(source.blocks(4800))
        assert (source.sample_rate_hz, source.channels, source.frames) == (RATE_HZ, 3, 9001)
    assert [len(block) for block in blocks] == [4800, 4201]
    assert all(block.dtype == np.float32 for block in blocks)
    step = 2.0**-14 if encoding == "PCM_16" else 2.0**-22
    np.testing.assert_allclose(np.concatenate(blocks), samples, atol=step)


@pytest.fixture(scope="module")
def long_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("audio") / "long.wav", noise())


@given(frames=st.integers(1, 12_000))
@settings(max_examples=25, deadline=None)
def test_block_size_does_not_matter(long_file: Path, frames: int) -> None:
    whole, _ = soundfile.read(long_file, dtype="float32")
    with open_audio(long_file) as source:
        blocks = list(source.blocks(frames))
    assert all(len(block) == frames for block in blocks[:-1])
    np.testing.assert_array_equal(np.concatenate(blocks), whole)


def test_blocks_start_over_and_do_not_share_memory(long_file: Path) -> None:
    with open_audio(long_file) as source:
        first, second = next(source.blocks(100)), next(source.blocks(100))
    np.testing.assert_array_equal(first, second)
    assert not np.shares_memory(first, second)


def test_odd_rate_and_56_channels_of_24_bit(tmp_path: Path) -> None:
    name = tmp_path / "out_multi.wav"
    soundfile.write(name, noise(50_000, 56), 47_998, subtype="PCM_24")
    with open_audio(name, expect_channels=56) as source:
        assert source.sample_rate_hz == 47_998
        assert source.duration_s == pytest.approx(50_000 / 47_998)


def test_one_channel_is_still_two_dimensional(tmp_path: Path) -> None:
    with open_audio(write(tmp_path / "mono.wav", noise(channels=1))) as source:
        assert next(source.blocks(10)).shape == (10, 1)


def test_closes_its_file(long_file: Path) -> None:
    with open_audio(long_file) as source:
        pass
    with pytest.raises(InvalidArgumentError, match="closed"):
        next(source.blocks())


@pytest.mark.parametrize("frames", [0, -1])
def test_refuses_empty_blocks(long_file: Path, frames: int) -> None:
    with open_audio(long_file) as source, pytest.raises(InvalidArgumentError, match="frames"):
        next(source.blocks(frames))


def test_a_silent_file_of_one_microphone_is_a_silent_channel(tmp_path: Path) -> None:
    samples = noise(channels=4)
    samples[:, 2] = 0.0
    files = tuple(write(tmp_path / f"{k}.wav", samples[:, k]) for k in range(4))
    with open_sound(files, 4, strict=False) as source:
        assert source.silent_channels == (3,)
        assert np.array_equal(np.concatenate(list(source.blocks()))[:, 2], samples[:, 2])
    with pytest.raises(SilentChannelsError, match="every channel"):
        open_sound(files, 4)
