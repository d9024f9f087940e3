"""Recordings, read in blocks and checked when opened: one file, one file per microphone, or a pipe."""

import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeAlias

import numpy as np
import soundfile

from worldstate.adapters.files.array_match import by_number
from worldstate.ground import InputFileError, InvalidArgumentError, in_range
from worldstate.ground.checks import one_of
from worldstate.ground.typing import Float32Array

from .plain_samples import (
    MAX_CHANNELS,
    MAX_RATE_HZ,
    SUBTYPES,
    Encoding,
    PlainSamples,
    decoded,
    four_byte_form,
    plain_samples,
    smooth_form,
)

_LOG = logging.getLogger(__name__)

CONTAINERS = ("WAV", "WAVEX", "RF64", "W64", "FLAC")
_EXPECTED = "WAV, RF64, W64 or FLAC"
_WAYS_ON = {
    ".bag": "; a bag of ROS 1: `rosbags-convert --src IN.bag --dst OUT` makes one of ROS 2",
    ".raw": "; samples without a header are read from standard input: pcm:RATE:CHANNELS:FORMAT",
}
# Lossy codecs are refused, because they lose the phase between microphones.
FLOATING = ("FLOAT", "DOUBLE")
ENCODINGS = ("PCM_U8", "PCM_S8", "PCM_16", "PCM_24", "PCM_32", *FLOATING)
SHORTEST_S = 1.0
# Floats may slightly exceed full scale; integers stored as floats exceed it by thousands.
_OVER_FULL_SCALE = 16.0
_MAGIC = b"RIFF", b"RF64", b"riff", b"fLaC", b"FORM"


class Audio(ABC):
    """An open recording. It is a context manager that closes its files."""

    path: Path
    sample_rate_hz: int
    channels: int
    frames: int
    silent_channels: tuple[int, ...]

    @property
    def duration_s(self) -> float:
        """Length in seconds; for a pipe, the length read so far."""
        return self.frames / self.sample_rate_hz

    @abstractmethod
    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the recording from its start in blocks of `frames` samples; the last one may be shorter."""

    @abstractmethod
    def close(self) -> None:
        """Close the recording's files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def check_channels(self, expect_channels: int | None) -> None:
        """Refuse a number of channels that differs from the number of microphones."""
        if expect_channels is not None and self.channels != expect_channels:
            expected = f"expected {expect_channels} channels, one per microphone"
            way_out = '; "channels" in the JSON file of the array selects the microphones'
            way_out = way_out if self.channels > expect_channels else ""
            raise InputFileError(self.path, f"{expected}, got {self.channels}{way_out}")

    def check_size(self, expect_channels: int | None) -> None:
        """Refuse a wrong number of channels, or a recording shorter than one second."""
        self.check_channels(expect_channels)
        if self.duration_s < SHORTEST_S:
            raise InputFileError(self.path, f"expected at least 1 s of audio, got {self.duration_s:.3f} s")

    def check_silence(self, strict: bool) -> None:
        """Refuse silent channels; if not strict, only if at least half of the channels are silent."""
        silent = self.silent_channels
        if silent and (strict or 2 * len(silent) > self.channels):
            expected = "every channel" if strict else f"at least half of {self.channels} channels"
            raise SilentChannelsError(self.path, silent, expected)


class AudioSource(Audio):
    """An open recording, created by `open_audio`.

    It is a context manager that closes its file.

    Attributes
    ----------
    path : Path
        The file.
    sample_rate_hz : int
        Rate in the header; OVAD's is 47,998, not 48,000.
    channels : int
        Number of microphones M.
    frames : int
        Samples per channel.
    silent_channels : tuple of int
        Channels, counted from 1, with a constant value during the first second.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "noise.wav"
    ...     soundfile.write(name, np.random.default_rng(0).uniform(-1, 1, (9600, 4)), 8000)
    ...     with open_audio(name) as source:
    ...         source.sample_rate_hz, source.frames, source.silent_channels
    (8000, 9600, ())
    """

    def __init__(self, path: Path, file: Any) -> None:
        self.path, self._file, self._floating = path, file, file.subtype in FLOATING
        self.sample_rate_hz, self.channels, self.frames = file.samplerate, file.channels, file.frames
        self.silent_channels: tuple[int, ...] = ()

    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the recording from its start in blocks of `frames` samples; the last one may be shorter.

        Parameters
        ----------
        frames : int
            Samples per channel and block, >= 1.

        Yields
        ------
        ndarray
            Shape (n, M), float32, full scale 1; each block is a new array.

        Raises
        ------
        InvalidArgumentError
            If `frames` is below 1 or the recording is closed.
        InputFileError
            If a sample is NaN or infinite, or the data ends before the length in the header.
        """
        if frames < 1:
            raise InvalidArgumentError(f"frames: expected at least 1, got {frames}")
        self._seek(0)
        for start in range(0, self.frames, frames):
            yield self._read(start, min(frames, self.frames - start))

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def span(self, start: int, frames: int) -> Float32Array:
        """Return `frames` samples from sample `start`, shape (frames, M)."""
        self._seek(start)
        return self._read(start, frames)

    def _seek(self, frame: int) -> None:
        if self._file.closed:
            raise InvalidArgumentError(f"{self.path}: expected an open recording, but it is closed")
        try:
            self._file.seek(frame)
        except soundfile.SoundFileError as error:
            raise _cut_short(self.path, self.frames) from error

    def _read(self, start: int, frames: int) -> Float32Array:
        try:
            block: Float32Array = self._file.read(frames, dtype="float32", always_2d=True)
        except soundfile.SoundFileError as error:
            raise _cut_short(self.path, self.frames) from error
        if len(block) < frames:
            raise _cut_short(self.path, self.frames)
        if self._floating:
            check_finite(self.path, block, start)
        return block


class SilentChannelsError(InputFileError):
    """Some channels of a recording have a constant value during the first second."""

    def __init__(self, path: Path, channels: tuple[int, ...], expected: str) -> None:
        numbers = ", ".join(map(str, channels))
        got = f"got one constant value for a second on channel {numbers}"
        super().__init__(path, f"expected sound on {expected}, {got}")
        self.channels = channels


def open_audio(
    path: str | Path, expect_channels: int | None = None, *, strict: bool = True, short: bool = False
) -> AudioSource:
    """Open a WAV, RF64, W64 or FLAC recording and check it before the first block.

    FLAC is limited to 8 channels and WAV to 4 GiB (nine minutes of 56 channels); use RF64 or W64 beyond that.

    Parameters
    ----------
    path : str or Path
        The file.
    expect_channels : int, optional
        Required number of channels: the microphones of the array.
    strict : bool
        True: a silent channel is an error. False: it is an error only if at least half of the channels are
        silent. `AudioSource.silent_channels` lists them, and the front-end excludes them.
    short : bool
        Whether the recording may be shorter than 1 s.

    Raises
    ------
    InputFileError
        If the file is missing, not audio, lossy, empty, shorter than 1 s, truncated (shorter than its header
        states), has another number of channels, or has a sample in the first second that is NaN or infinite;
        the message contains the file's name.
    SilentChannelsError
        If channels are constant during the first second; they are numbered from 1.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "noise.wav"
    ...     soundfile.write(name, np.random.default_rng(0).uniform(-1, 1, (9600, 4)), 8000)
    ...     with open_audio(name, expect_channels=4) as source:
    ...         source.channels, source.duration_s, [block.shape for block in source.blocks(4800)]
    (4, 1.2, [(4800, 4), (4800, 4)])
    """
    with ExitStack() as opened:
        source = _opened(Path(path), opened)
        (source.check_channels if short else source.check_size)(expect_channels)
        source.check_silence(strict)
        opened.pop_all()  # a valid recording stays open
    return source


def _opened(path: Path, opened: ExitStack) -> AudioSource:
    """Open a file on the stack, also with silent channels."""
    source = opened.enter_context(AudioSource(path, _open_file(path)))
    if source.frames == 0:
        raise InputFileError(path, "expected samples, but the recording is empty")
    source.span(source.frames - 1, 1)  # fails for a truncated FLAC file
    source.silent_channels = constant_channels(source.span(0, min(source.sample_rate_hz, source.frames)))
    return source


def _open_file(path: Path) -> Any:
    if not path.is_file():
        problem = "expected an audio file, found a folder" if path.is_dir() else "no such file"
        raise InputFileError(path, problem)
    try:
        if (plain := _open_plain(path)) is not None:
            return plain
        # soundfile encodes names itself, and fails for names that are not UTF-8.
        file = soundfile.SoundFile(os.fsencode(path) if os.name == "posix" else path)
    except (soundfile.SoundFileError, OSError, TypeError) as error:
        way = _WAYS_ON.get(path.suffix.lower(), f"; `sox {path.name} out.wav` converts other forms")
        raise InputFileError(path, f"expected {_EXPECTED} audio, found something else{way}") from error
    if file.format not in CONTAINERS or file.subtype not in ENCODINGS:
        kind = f"{file.format} {file.subtype}"
        file.close()
        problem = f"expected {_EXPECTED} with plain samples, got {kind}"
        raise InputFileError(path, f"{problem}; `sox {path.name} out.wav` converts lossless files")
    return file


def _open_plain(path: Path) -> PlainSamples | None:
    """Open a file whose header does not match its data, with a warning; refuse a truncated file."""
    if (plain := plain_samples(path)) is None:
        return None
    with ExitStack() as opened:
        opened.callback(plain.close)
        for stated in (name for name, kind in SUBTYPES.items() if kind == plain.subtype):
            check_encoding(str(path), plain.look, stated, plain.channels)
        declared, there = plain.declared_bytes, plain.there_bytes
        if plain.n_bytes > there:
            problem = f"cut short: expected {declared} bytes of samples by its header, got {there}"
            raise InputFileError(path, f"{problem}; `sox --ignore-length IN OUT` keeps the existing samples")
        if not plain.needed:
            return None
        if declared != plain.n_bytes:
            told = "%s: its header states %d bytes of samples, but the file has %d: all of them are read"
            _LOG.warning(told, path, declared, plain.n_bytes)
        opened.pop_all()
    return plain


def constant_channels(first: Float32Array) -> tuple[int, ...]:
    """Return the channels, counted from 1, with a constant value."""
    return tuple(int(channel) + 1 for channel in np.flatnonzero((first == first[:1]).all(axis=0)))


def _cut_short(path: Path, frames: int) -> InputFileError:
    return InputFileError(path, f"cut short or damaged: expected {frames} samples per channel by its header")


def check_finite(path: Path, block: Float32Array, start: int) -> None:
    """Refuse NaN and infinity, and warn of overflow; `start` is the number of the block's first sample."""
    if start == 0 and (most := float(np.abs(block).max(initial=0.0))) > _OVER_FULL_SCALE:
        _LOG.warning("%s: samples reach %.3g, beyond the full scale of 1: rescale them to it", path, most)
    finite = np.isfinite(block)
    if not finite.all():
        sample, channel = np.argwhere(~finite)[0]
        where = f"channel {channel + 1}, sample {start + sample}"
        raise InputFileError(path, f"expected finite samples, got {block[sample, channel]} in {where}")


class SoundStream(ABC):
    """Sound without a file of its own, such as a pipe or a topic of a bag."""

    __slots__ = ()

    start_ns: int = 0  # Time of the first sample on the recorder's clock; 0 if unknown

    @property
    @abstractmethod
    def name(self) -> str:
        """Name for error messages."""

    @abstractmethod
    def open(self) -> Audio:
        """Open the stream at its start without checks."""


@dataclass(frozen=True, slots=True)
class RawPcm(SoundStream):
    """Little-endian samples without a header, channels interleaved.

    Parameters
    ----------
    stream : binary file
        For example ``sys.stdin.buffer``; it is read once from its current position.
    sample_rate_hz : int
        Samples per second and channel.
    channels : int
        Number of microphones.
    encoding : {"s16", "s24", "s24_32", "s32", "f32"}
        Integers of this many bits, or floats of full scale 1; "s24_32" has 24 bits in the lower three of four
        bytes (ALSA's S24_LE).
    name : str
        Name for error messages.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or the encoding is unknown.

    Examples
    --------
    >>> import io
    >>> RawPcm(io.BytesIO(), 48_000, 8, "s24").frame_bytes
    24
    """

    stream: BinaryIO
    sample_rate_hz: int
    channels: int
    encoding: Encoding = "s16"
    name: str = "/dev/stdin"

    def __post_init__(self) -> None:
        in_range("sample_rate_hz", self.sample_rate_hz, 1, MAX_RATE_HZ)
        in_range("channels", self.channels, 1, MAX_CHANNELS)
        one_of("encoding", self.encoding, SUBTYPES)

    def open(self) -> "PcmAudio":
        """Open the stream and read its first second."""
        return PcmAudio(self)

    @property
    def frame_bytes(self) -> int:
        """Number of bytes of one sample of all channels."""
        return int(self.encoding.rpartition("_")[2].lstrip("sf")) // 8 * self.channels

    def to_samples(self, data: bytes) -> Float32Array:
        """Return samples of full scale 1, shape (n, channels)."""
        return decoded(data, SUBTYPES[self.encoding], self.channels)

    def check_encoding(self, data: bytes) -> None:
        """Refuse samples that obviously have another encoding; warn if that is uncertain."""
        check_encoding(self.name, data, self.encoding, self.channels)


def check_encoding(name: str, data: bytes, stated: Encoding, channels: int) -> None:
    """Refuse samples that obviously have another encoding; warn if that is uncertain."""
    by_bytes: str | None = four_byte_form(data)
    padded = (stated, by_bytes) == ("s32", "s24_32")
    # A dead or hardly used 16-bit channel looks like four-byte integers.
    unsure = by_bytes is None or padded or (stated == "s16" and by_bytes != "f32")
    form = smooth_form(data, stated, channels) if unsure else by_bytes
    if form not in (None, stated):
        raise InputFileError(name, f"expected samples of {stated}, got samples like those of {form}")
    if padded:
        told = "%s: samples of s32 fill 24 of 32 bits; if they are 24 bits in four bytes, use s24_32"
        _LOG.warning(told, name)


# `Audio` is an open recording, such as of live microphones.
SoundInput: TypeAlias = Path | tuple[Path, ...] | SoundStream | Audio


def as_sound(given: SoundInput | str | Sequence[Path | str]) -> SoundInput:
    """Convert strings to paths; of a sequence with a single path, return that path."""
    if isinstance(given, Path | SoundStream | Audio):
        return given
    paths = (Path(given),) if isinstance(given, str) else tuple(map(Path, given))
    if not paths:
        raise InvalidArgumentError("expected at least one sound file")
    return paths[0] if len(paths) == 1 else paths


def path_of(sound: SoundInput) -> Path:
    """Return the name of a recording: its file, the first of several files, or the name of a stream."""
    if isinstance(sound, SoundStream):
        return Path(sound.name)
    if isinstance(sound, Audio):
        return sound.path
    return sound if isinstance(sound, Path) else sound[0]


class PcmAudio(Audio):
    """Sound of an open pipe; `frames` is the number of samples read so far."""

    def __init__(self, raw: RawPcm) -> None:
        self._raw = raw
        self.path = Path(raw.name)
        self.sample_rate_hz, self.channels, self.frames = raw.sample_rate_hz, raw.channels, 0
        data = self._read_bytes(raw.sample_rate_hz)
        if data.startswith(_MAGIC):
            raise InputFileError(self.path, "expected samples without a header, got a file: give it as INPUT")
        raw.check_encoding(data)
        self._first = self._block(data)
        self.silent_channels = constant_channels(self._first)

    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the samples until the stream ends in blocks of `frames`; the last one may be shorter."""
        yield from (self._first[start : start + frames] for start in range(0, len(self._first), frames))
        while data := self._read_bytes(frames):
            yield self._block(data)

    def close(self) -> None:
        """Do nothing: the owner closes the stream."""

    def _read_bytes(self, frames: int) -> bytes:
        wanted = frames * self._raw.frame_bytes
        parts: list[bytes] = []
        # A pipe returns the available data, which may be less than a block.
        while (missing := wanted - sum(map(len, parts))) and (data := self._raw.stream.read(missing)):
            parts.append(data)
        joined = b"".join(parts)
        if more := len(joined) % self._raw.frame_bytes:
            expected = f"expected whole samples of {self.channels} channels"
            raise InputFileError(self.path, f"{expected}, got {more} bytes too many")
        return joined

    def _block(self, data: bytes) -> Float32Array:
        block = self._raw.to_samples(data)
        if self._raw.encoding == "f32":
            check_finite(self.path, block, self.frames)
        self.frames += len(block)
        return block


class ChosenChannels(Audio):
    """Selected channels of an open recording, counted from 1, in any order."""

    def __init__(self, audio: Audio, channels: Sequence[int]) -> None:
        if max(channels) > audio.channels:
            expected = f"expected at least {max(channels)} channels, the largest selected number"
            raise InputFileError(audio.path, f"{expected}, got {audio.channels}")
        self._audio, self._taken = audio, [channel - 1 for channel in channels]
        self.path, self.sample_rate_hz, self.frames = audio.path, audio.sample_rate_hz, audio.frames
        self.channels, silent = len(channels), audio.silent_channels
        self.silent_channels = tuple(i for i, channel in enumerate(channels, 1) if channel in silent)

    def check_size(self, expect_channels: int | None) -> None:
        """Refuse a wrong number of channels, or a recording shorter than one second."""
        self.check_channels(expect_channels)
        self._audio.check_size(None)

    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the recording from its start in blocks of `frames` samples; the last one may be shorter."""
        for block in self._audio.blocks(frames):
            self.frames = self._audio.frames
            yield block.take(self._taken, axis=1)

    def close(self) -> None:
        """Close the recording."""
        self._audio.close()


class MonoFiles(Audio):
    """Files of one channel each, read together."""

    def __init__(self, sources: Sequence[AudioSource]) -> None:
        self._sources = tuple(sources)
        first = self._sources[0]
        self.path, self.sample_rate_hz, self.frames = first.path, first.sample_rate_hz, first.frames
        self.channels = len(self._sources)
        self.silent_channels = tuple(i for i, one in enumerate(self._sources, 1) if one.silent_channels)
        for other in self._sources:
            other.check_channels(1)
            if (other.sample_rate_hz, other.frames) != (first.sample_rate_hz, first.frames):
                expected = f"{first.frames} samples at {first.sample_rate_hz} Hz as in {first.path.name}"
                got = f"{other.frames} at {other.sample_rate_hz} Hz"
                raise InputFileError(other.path, f"expected {expected}, got {got}")

    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the recording from its start in blocks of `frames` samples; the last one may be shorter."""
        yield from map(np.hstack, zip(*(source.blocks(frames) for source in self._sources), strict=True))

    def close(self) -> None:
        """Close the files."""
        for source in self._sources:
            source.close()


def open_sound(
    sound: SoundInput,
    expect_channels: int | None = None,
    *,
    channels: Sequence[int] = (),
    strict: bool = True,
) -> Audio:
    """Open a recording of any kind, with the checks of `open_audio`.

    Parameters
    ----------
    sound : Path, tuple of Path, SoundStream or Audio
        A multichannel file, files of one channel each in the order of the microphones, a stream, or an open
        recording.
    expect_channels : int, optional
        Required number of channels: the microphones of the array.
    channels : sequence of int, optional
        `MicrophoneArray.channels`, to select the microphones if there are other channels. A recording with
        exactly as many channels that lacks some of these numbers contains only the microphones, and is used
        unchanged.
    strict : bool
        As for `open_audio`.

    Raises
    ------
    InputFileError
        As for `open_audio`; also if rates or lengths of mono files differ, or a channel does not exist.
    SilentChannelsError
        If channels are constant during the first second.

    Examples
    --------
    >>> import io
    >>> sound = np.arange(-16_000, 16_000, dtype="<i2").tobytes()
    >>> with open_sound(RawPcm(io.BytesIO(sound), 16_000, 2)) as audio:
    ...     [block.shape for block in audio.blocks(12_000)], audio.duration_s
    ([(12000, 2), (4000, 2)], 1.0)
    """
    with ExitStack() as opened:
        audio = sound if isinstance(sound, Audio) else _unchecked(sound, opened)
        if channels and not audio.channels == len(channels) < max(channels):
            audio = ChosenChannels(audio, channels)
        audio.check_size(expect_channels)
        if not isinstance(sound, Audio):
            audio.check_silence(strict)
        opened.pop_all()  # a valid recording stays open
    return audio


def _unchecked(sound: Path | tuple[Path, ...] | SoundStream, opened: ExitStack) -> Audio:
    """Open a recording on the stack, also with silent channels."""
    if isinstance(sound, SoundStream):
        return opened.enter_context(sound.open())
    if isinstance(sound, Path):
        return _opened(sound, opened)
    order = by_number(sound[0].parent, [str(one) for one in sound])
    return MonoFiles([_opened(sound[place], opened) for place in order])
