"""Sound files: exact reading in blocks, headers that contradict the samples, and refusals with the file."""

import io
import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from worldstate.adapters.audio.plain_samples import SUBTYPES, Encoding, decoded, four_byte_form
from worldstate.adapters.audio.sound_file import RawPcm, SilentChannelsError, open_audio, open_sound
from worldstate.ground.errors import InputFileError, InvalidArgumentError

RATE_HZ = 8000
FORMATS = [
    *(("WAV", "PCM_24"), ("WAV", "PCM_16"), ("WAV", "FLOAT"), ("WAVEX", "PCM_24")),
    *(("RF64", "PCM_24"), ("W64", "PCM_24"), ("W64", "DOUBLE"), ("FLAC", "PCM_24")),
]


def noise(frames: int = 9001, channels: int = 3, scale: float = 0.1) -> np.ndarray:
    return np.random.default_rng(7).normal(0.0, scale, (frames, channels)).clip(-0.9, 0.9).astype(np.float32)


def write(path: Path, samples: np.ndarray, container: str = "WAV", encoding: str = "PCM_24") -> Path:
    soundfile.write(path, samples, RATE_HZ, format=container, subtype=encoding)
    return path


def heard(path: Path) -> np.ndarray:
    with open_audio(path) as source:
        return np.concatenate(list(source.blocks(1000)))


def refused(problem: str, path: Path, read: Callable[[Path], object] = open_audio, **more: Any) -> None:
    with pytest.raises(InputFileError, match=problem) as raised:
        read(path, **more)
    assert str(raised.value).startswith(f"{path}: ") and "\n" not in str(raised.value)


@pytest.mark.parametrize(("container", "encoding"), FORMATS)
def test_reading_returns_the_written_samples(tmp_path: Path, container: str, encoding: str) -> None:
    with open_audio(write(tmp_path / "sound", noise(), container, encoding), expect_channels=3) as source:
        blocks = list(source.blocks(4800))
        assert (source.sample_rate_hz, source.channels, source.frames) == (RATE_HZ, 3, 9001)
    assert [len(block) for block in blocks] == [4800, 4201]
    assert all(block.dtype == np.float32 for block in blocks)
    step = 2.0**-14 if encoding == "PCM_16" else 2.0**-22
    np.testing.assert_allclose(np.concatenate(blocks), noise(), atol=step)


@pytest.fixture(scope="module")
def long_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("audio") / "long.wav", noise())


@given(frames=st.integers(1, 12_000))
@settings(max_examples=25, deadline=None)
def test_block_size_does_not_matter(long_file: Path, frames: int) -> None:
    whole, _ = soundfile.read(long_file, dtype="float32")
    with open_audio(long_file) as source:
        blocks, again = list(source.blocks(frames)), next(source.blocks(frames))
    assert all(len(block) == frames for block in blocks[:-1])
    np.testing.assert_array_equal(np.concatenate(blocks), whole)
    np.testing.assert_array_equal(again, blocks[0])
    assert not np.shares_memory(again, blocks[0])


def test_blocks_need_a_length_and_an_open_file(long_file: Path) -> None:
    with open_audio(long_file) as source:
        for frames in (0, -1):
            with pytest.raises(InvalidArgumentError, match="frames"):
                next(source.blocks(frames))
    with pytest.raises(InvalidArgumentError, match="closed"):
        next(source.blocks())


def test_a_silent_file_of_one_microphone_is_a_silent_channel(tmp_path: Path) -> None:
    samples = noise(channels=4)
    samples[:, 1:3] = 0.0
    files = tuple(write(tmp_path / f"{k}.wav", samples[:, k], encoding="FLOAT") for k in range(4))
    with open_sound(files, 4, strict=False) as source:
        assert source.silent_channels == (2, 3), "half of them are enough"
        np.testing.assert_array_equal(np.concatenate(list(source.blocks())), samples)
    with pytest.raises(SilentChannelsError, match="every channel"):
        open_sound(files, 4)


def test_missing_lossy_short_and_empty_sound_and_other_channels_are_refused(tmp_path: Path) -> None:
    refused("no such file", tmp_path / "no.wav")
    refused("found a folder", tmp_path)
    refused("plain samples, got OGG VORBIS", write(tmp_path / "a.ogg", noise(channels=2), "OGG", "VORBIS"))
    lossy = write(tmp_path / "a.wav", noise(channels=2), encoding="IMA_ADPCM")
    refused("got WAV IMA_ADPCM", lossy)
    refused("at least 1 s", write(tmp_path / "short.wav", noise(frames=RATE_HZ - 1)))
    refused("empty", write(tmp_path / "empty.wav", noise(frames=0)))
    other = write(tmp_path / "b.wav", noise())
    refused("expected 56 channels, one per microphone, got 3", other, expect_channels=56)
    descriptors = Path("/proc/self/fd")
    opened = len(list(descriptors.iterdir())) if descriptors.is_dir() else 0
    for _ in range(20):  # A refused file is closed again
        refused("channels", other, expect_channels=5)
    assert not opened or len(list(descriptors.iterdir())) <= opened


@pytest.mark.parametrize("container", ["WAV", "WAVEX", "RF64", "W64", "FLAC"])
@pytest.mark.parametrize("kept", [0.999, 0.9, 0.5])
def test_truncated_sound_is_refused(tmp_path: Path, container: str, kept: float) -> None:
    name = write(tmp_path / "cut", noise(12_000), container)
    name.write_bytes(name.read_bytes()[: int(kept * name.stat().st_size)])
    refused("cut short", name)


@pytest.mark.parametrize("container", ["WAV", "RF64", "W64", "FLAC"])
@given(cut=st.integers(0, 400), seed=st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_a_cut_header_is_refused_and_a_damaged_one_read_or_refused(
    tmp_path_factory, container: str, cut: int, seed: int
) -> None:
    name, rng = tmp_path_factory.mktemp("cut") / "cut", np.random.default_rng(seed)
    data = bytearray(write(name, noise(9000), container, "PCM_16").read_bytes())
    name.write_bytes(data[:cut])
    refused("expected", name)
    for position in rng.integers(0, 120, 4):
        data[position] = rng.integers(0, 256)
    name.write_bytes(data)
    try:
        heard(name)
    except InputFileError as error:
        assert str(name) in str(error)


def test_silent_channels_are_refused(tmp_path: Path) -> None:
    samples = noise(12_000, 4)
    samples[:RATE_HZ, [0, 2]] = [0.0, 0.25]
    refused("on channel 1, 3$", write(tmp_path / "a.wav", samples))
    samples[RATE_HZ - 1, [0, 2]] = 0.1
    with open_audio(write(tmp_path / "b.wav", samples)) as source:
        assert source.channels == 4


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_samples_that_are_no_numbers_are_refused(tmp_path: Path, value: float) -> None:
    for sample, encoding, read in ((50, "FLOAT", open_audio), (9000, "DOUBLE", heard)):
        samples = noise(12_000, 4).astype(float)
        samples[sample, 1] = value
        name = write(tmp_path / "a.wav", samples, encoding=encoding)
        refused(rf"expected finite samples, got \S+ in channel 2, sample {sample}$", name, read)


# arecord, SoX and ffmpeg; the last of each pair is rounded to whole samples of three channels.
OPEN_SIZES = (0, 0x80000000, 0x7FFFFFFE, 0x7FFFFF00, 0x7FFFF000, 0xFFFFFFFF, 0xFFFFFFFC, 0xFFFFF000)


def size_at(data: bytes, container: str) -> tuple[int, str]:
    """Return the offset and the format of the size of the samples in a header."""
    if container in ("RF64", "BW64"):
        return data.index(b"ds64") + 16, "<Q"
    return data.index(b"data") + (16 if container == "W64" else 4), "<Q" if container == "W64" else "<I"


def with_size(path: Path, container: str, size: int, subtype: str = "PCM_16", tail: bytes = b"") -> Path:
    """Write a file with another size in its header and optional chunks after the samples."""
    kind = {"BW64": "RF64"}.get(container, container)
    soundfile.write(path, noise(), RATE_HZ, format=kind, subtype=subtype)
    data = bytearray(path.read_bytes() + tail)
    at, packed = size_at(data, container)
    struct.pack_into(packed, data, at, size)
    data[:4] = b"BW64" if container == "BW64" else data[:4]
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24", "FLOAT"])
@pytest.mark.parametrize("container", ["WAV", "WAVEX", "RF64", "BW64", "W64"])
def test_a_file_with_an_open_size_is_read_with_a_warning(tmp_path, container, subtype, caplog) -> None:
    for size in OPEN_SIZES if container.startswith("WAV") else (0, *OPEN_SIZES[1:5], 2**64 - 1):
        caplog.clear()
        found = heard(
            with_size(tmp_path / "a.wav", container, size + 24 * (container == "W64") & 2**64 - 1, subtype)
        )
        np.testing.assert_allclose(found, noise(), atol=2.0**-15)
        assert "a.wav: its header states" in caplog.text, size


@given(
    share=st.floats(0.0, 0.999),
    more=st.integers(1, 2**30),
    container=st.sampled_from(["WAV", "RF64", "BW64"]),
)
@settings(max_examples=40, deadline=None)
def test_a_wrong_size_never_drops_samples_silently(tmp_path_factory, share, more, container) -> None:
    path, there = tmp_path_factory.mktemp("size") / "a.wav", 9001 * 6
    with_size(path, container, int(share * there))
    assert len(heard(path)) == 9001
    with pytest.raises(InputFileError, match=r"cut short.*sox --ignore-length"):
        heard(with_size(path, container, there + more))


CHUNK = b"LIST" + struct.pack("<I", 10) + b"INFOISFTab"


@pytest.mark.parametrize("tail", [b"", CHUNK, CHUNK + b"id3 " + struct.pack("<I", 3) + b"abc\0", b"\0"])
@pytest.mark.parametrize("container", ["WAV", "RF64"])
def test_chunks_after_the_samples_are_ignored(tmp_path, container, tail, caplog) -> None:
    np.testing.assert_allclose(
        heard(with_size(tmp_path / "a.wav", container, 9001 * 6, tail=tail)), noise(), atol=2e-4
    )
    assert not caplog.text


@pytest.mark.parametrize("tail", [b"", CHUNK])
def test_a_size_beyond_32_bits_is_recovered(tmp_path, tail, caplog) -> None:
    """A sparse file: 8,000 samples, a hole of 4 GiB and one more sample."""
    name, frame = tmp_path / "long.wav", 6
    frames = (2**32 + 48_000) // frame
    soundfile.write(name, noise(), RATE_HZ, subtype="PCM_16")
    data = bytearray(name.read_bytes()[: 44 + 48_000])
    struct.pack_into("<I", data, 40, frames * frame % 2**32)
    with name.open("wb") as file:
        file.write(data)
        file.seek(44 + (frames - 1) * frame)
        file.write(b"\x00\x20" * 3 + tail)
    with open_audio(name) as source:
        assert source.frames == frames
        np.testing.assert_array_equal(source.span(frames - 1, 1), 0.25)
    assert "its header states" in caplog.text


def stored(samples: np.ndarray, encoding: Encoding) -> bytes:
    """Return the bytes of samples in an encoding, by NumPy."""
    if encoding == "f32":
        return samples.astype("<f4").tobytes()
    bits = int(encoding[1:3])
    whole = np.round(samples * (2 ** (bits - 1) - 1)).astype("<i4")
    if encoding == "s24":
        return whole.reshape(-1, 1).view(np.uint8)[:, :3].tobytes()
    return whole.astype("<i2" if bits == 16 else "<i4").tobytes()


def wav_of_24_bits(path: Path, data: bytes, channels: int, tag: int = 1) -> Path:
    """Write 24 bits in four bytes each, as arecord does and as the standard requires."""
    about = struct.pack("<HHIIHH", tag, channels, RATE_HZ, RATE_HZ * 4 * channels, 4 * channels, 24)
    if tag != 1:
        about += struct.pack("<HHIH", 22, 24, 0, 1) + b"\0\0\0\0\x10\0\x80\0\0\xaa\0\x38\x9b\x71"
    body = b"WAVEfmt " + struct.pack("<I", len(about)) + about + b"data" + struct.pack("<I", len(data))
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body) + len(data)) + body + data)
    return path


@pytest.mark.parametrize("tag", [1, 0xFFFE])
@pytest.mark.parametrize("upper", ["sign", "zero", "full scale"])
def test_24_bits_in_four_bytes_keep_their_level(tmp_path: Path, upper: str, tag: int) -> None:
    whole = np.frombuffer(stored(noise(), "s24_32"), "<i4")
    data = {"sign": whole, "zero": whole & 0xFFFFFF, "full scale": whole << 8}[upper]
    found = heard(wav_of_24_bits(tmp_path / "a.wav", data.astype("<i4").tobytes(), 3, tag))
    np.testing.assert_allclose(found, noise(), atol=2e-7)


@pytest.mark.parametrize("encoding", SUBTYPES)
@given(scale=st.floats(1e-3, 0.3), channels=st.integers(1, 9))
@settings(max_examples=15, deadline=None)
def test_every_encoding_is_decoded(encoding: Encoding, scale: float, channels: int) -> None:
    samples = noise(9000, channels, scale)
    data = stored(samples, encoding)
    np.testing.assert_allclose(decoded(data, SUBTYPES[encoding], channels), samples, atol=5e-5)
    with open_sound(RawPcm(io.BytesIO(data), RATE_HZ, channels, encoding)) as audio:
        assert sum(map(len, audio.blocks())) == 9000
    assert four_byte_form(data) in (encoding, None)


def test_a_quiet_32_bit_recording_logs_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    quiet = stored(noise(9000, 4, 5e-4), "s32")
    with caplog.at_level(logging.WARNING), open_sound(RawPcm(io.BytesIO(quiet), RATE_HZ, 4, "s32")) as audio:
        assert audio.silent_channels == ()
    assert "use s24_32" in caplog.text


def street_sound(frames: int, channels: int, scale: float, dead: int) -> np.ndarray:
    """Return red sound 40 dB above the noise of its channels; one channel may be almost dead."""
    steps = np.random.default_rng(3).normal(0.0, 1.0, (frames, channels))
    sound = lfilter([1.0], [1.0, -0.95], steps, axis=0)
    sound = scale * (sound / sound.std() + 0.01 * steps)
    if dead < channels:
        sound[:, dead] = 1e-4 * steps[:, dead]
    return sound.clip(-0.9, 0.9)


FORMS: tuple[str, ...] = (*SUBTYPES, "s16, big-endian")


@pytest.mark.parametrize("read_as", SUBTYPES)
@pytest.mark.parametrize("encoding", FORMS)
@given(
    scale=st.floats(0.01, 0.3),
    channels=st.sampled_from([1, 2, 4, 6, 7, 8, 16]),
    dead=st.sampled_from([0, 3, 99]),
)
@settings(max_examples=8, deadline=None)
def test_sound_of_one_encoding_is_refused_as_another(encoding, read_as, scale, channels, dead) -> None:
    form = cast("Encoding", encoding.partition(",")[0])
    data = stored(street_sound(12_000, channels, scale, dead if encoding == read_as else 99), form)
    if encoding == "s16, big-endian":
        data = np.frombuffer(data, "<i2").astype(">i2").tobytes()
    raw = RawPcm(io.BytesIO(data), RATE_HZ, channels, read_as)
    if encoding == read_as:
        with open_sound(raw, strict=False):
            return
    if (encoding, read_as) == ("s24_32", "s32"):  # Only a factor differs, and a warning is logged
        return
    with pytest.raises(InputFileError, match="expected"):
        open_sound(raw)


@pytest.mark.parametrize("kind", ["WAV", "RF64", "W64"])
def test_a_file_on_standard_input_is_no_raw_sound(tmp_path: Path, kind: str) -> None:
    soundfile.write(tmp_path / "a", noise(), RATE_HZ, format=kind, subtype="PCM_16")
    with pytest.raises(InputFileError, match="give it as INPUT"):
        open_sound(RawPcm(io.BytesIO((tmp_path / "a").read_bytes()), RATE_HZ, 3, "s16"))


@pytest.mark.parametrize("held", ["floats", "whole numbers"])
def test_a_header_with_another_encoding_is_refused(tmp_path: Path, held: str) -> None:
    samples = noise(9000, 3)
    data = stored(samples, "f32" if held == "floats" else "s32")
    path = wav_of_24_bits(tmp_path / "a.wav", data, 3)
    kind = struct.pack("<H", 1 if held == "floats" else 3)
    path.write_bytes(path.read_bytes().replace(struct.pack("<HH", 1, 3), kind + struct.pack("<H", 3), 1))
    path.write_bytes(path.read_bytes().replace(struct.pack("<HH", 12, 24), struct.pack("<HH", 12, 32), 1))
    with pytest.raises(InputFileError, match=r"got samples like those of|finite"):
        open_audio(path)


@pytest.mark.parametrize(("scale", "said"), [(1.0, False), (3.0, False), (32_768.0, True), (2.0**31, True)])
def test_floats_beyond_full_scale_log_a_warning(tmp_path, scale, said, caplog) -> None:
    soundfile.write(tmp_path / "a.wav", noise() * scale, RATE_HZ, subtype="DOUBLE")
    with open_audio(tmp_path / "a.wav"):
        assert ("beyond the full scale" in caplog.text) is said


NAMES = {
    "as a shell lists them": ([1, 10, 11, 12, 2, 3, 4, 5, 6, 7, 8, 9], True),
    "as a shell of another locale": ([10, 11, 12, 1, 2, 3, 4, 5, 6, 7, 8, 9], True),
    "in order": (list(range(1, 13)), False),
    "in an order of their own": ([3, 1, 2, 5, 4, 6, 7, 12, 8, 9, 10, 11], None),
}


@pytest.mark.parametrize(
    "pattern", ["mic_{}.wav", "ch{}.wav", "2024-05-01 street {} left.wav", "m{}/rec.wav"]
)
@pytest.mark.parametrize("case", NAMES)
def test_numbered_files_are_ordered_by_number_or_log_a_warning(tmp_path, case, pattern, caplog) -> None:
    numbers, by_number = NAMES[case]
    samples, names = noise(channels=12), [tmp_path / pattern.format(number) for number in numbers]
    names = [name.with_name(name.name.upper()) if i % 2 else name for i, name in enumerate(names)]
    for name, number in zip(names, numbers, strict=True):
        name.parent.mkdir(exist_ok=True)
        soundfile.write(name, samples[:, number - 1], RATE_HZ, subtype="FLOAT")
    with open_sound(tuple(names)) as audio:
        found = np.concatenate(list(audio.blocks()))
    order = sorted(numbers) if by_number else numbers
    np.testing.assert_array_equal(found, samples[:, [number - 1 for number in order]])
    assert ("not in the order of their numbers" in caplog.text) is (by_number is not False)


@pytest.mark.parametrize(
    ("name", "way"),
    [("a.bag", "rosbags-convert"), ("a.raw", "pcm:RATE"), ("a.au", "`sox a.au out.wav`"), ("a.mp3", "`sox")],
)
def test_other_sound_formats_are_refused_with_a_remedy(tmp_path: Path, name: str, way: str) -> None:
    (tmp_path / name).write_bytes(b"#ROSBAG V2.0\n" + bytes(1000))
    if name == "a.au":
        soundfile.write(tmp_path / name, noise(), RATE_HZ)
    with pytest.raises(InputFileError, match=way):
        open_audio(tmp_path / name)
