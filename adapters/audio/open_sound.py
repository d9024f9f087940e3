"""A recording as users have it: one file, a file a microphone, or a stream such as a pipe."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, TypeAlias

import numpy as np

from worldstate.ground import InputFileError, InvalidArgumentError, in_range
from worldstate.ground.typing import Float32Array

from .sound_file import Audio, AudioSource, check_finite, constant_channels, open_audio

Encoding = Literal["s16", "s24", "s32", "f32"]
BYTES: dict[Encoding, int] = {"s16": 2, "s24": 3, "s32": 4, "f32": 4}
MAX_CHANNELS = 1024


class SoundStream(ABC):
    """Sound that is no file of its own: `open` gives its samples from the start on."""

    __slots__ = ()

    @property
    @abstractmethod
    def name(self) -> str:
        """For messages."""

    @property
    def start_ns(self) -> int:
        """Time of the first sample on the clock of whoever recorded it; 0 where nothing tells."""
        return 0

    @abstractmethod
    def open(self) -> Audio:
        """Open it at its start, nothing checked."""


@dataclass(frozen=True, slots=True)
class RawPcm(SoundStream):
    """Samples without a header, little-endian, one sample of every channel after the other.

    Parameters
    ----------
    stream : binary file
        Such as ``sys.stdin.buffer``; read once, from where it stands.
    sample_rate_hz : int
        Samples per second and channel.
    channels : int
        Number of microphones.
    encoding : {"s16", "s24", "s32", "f32"}
        Whole numbers of so many bits, or floats of full scale 1.
    name : str
        For messages.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or the encoding another one.

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
        in_range("sample_rate_hz", self.sample_rate_hz, 1, 10_000_000)
        in_range("channels", self.channels, 1, MAX_CHANNELS)
        if self.encoding not in BYTES:
            raise InvalidArgumentError(f"encoding: expected one of {', '.join(BYTES)}, got {self.encoding!r}")

    def open(self) -> "RawAudio":
        """Read its first second."""
        return RawAudio(self)

    @property
    def frame_bytes(self) -> int:
        """Bytes of one sample of all channels."""
        return BYTES[self.encoding] * self.channels

    def to_samples(self, data: bytes) -> Float32Array:
        """Return samples of full scale 1, shape (n, channels)."""
        if self.encoding == "f32":
            flat = np.frombuffer(data, "<f4")
        elif self.encoding == "s24":
            # The three bytes become the upper ones of four.
            wide = np.zeros((len(data) // 3, 4), np.uint8)
            wide[:, 1:] = np.frombuffer(data, np.uint8).reshape(-1, 3)
            flat = wide.view("<i4").ravel() * np.float32(2.0**-31)
        else:
            bits = 8 * BYTES[self.encoding]
            flat = np.frombuffer(data, f"<i{bits // 8}") * np.float32(2.0 ** (1 - bits))
        return flat.astype(np.float32, copy=False).reshape(-1, self.channels)


# An open recording is one whose samples come from elsewhere, such as microphones that run.
SoundInput: TypeAlias = Path | tuple[Path, ...] | SoundStream | Audio


def as_sound(given: SoundInput | str | Sequence[str]) -> SoundInput:
    """Return a path, several or a stream as such; one path in a sequence is that file."""
    if isinstance(given, Path | SoundStream | Audio):
        return given
    paths = (Path(given),) if isinstance(given, str) else tuple(map(Path, given))
    if not paths:
        raise InvalidArgumentError("expected at least one sound file")
    return paths[0] if len(paths) == 1 else paths


def path_of(sound: SoundInput) -> Path:
    """Return the name of a recording: its file, the first of several, that of a stream."""
    if isinstance(sound, SoundStream):
        return Path(sound.name)
    if isinstance(sound, Audio):
        return sound.path
    return sound if isinstance(sound, Path) else sound[0]


class RawAudio(Audio):
    """A pipe that is being read; `frames` counts what has been read."""

    def __init__(self, raw: RawPcm) -> None:
        self._raw = raw
        self.path = Path(raw.name)
        self.sample_rate_hz, self.channels, self.frames = raw.sample_rate_hz, raw.channels, 0
        self._first = self._read(raw.sample_rate_hz)
        self.silent_channels = constant_channels(self._first)

    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the samples up to the end of the stream in blocks of `frames`; the last may be shorter."""
        for start in range(0, len(self._first), frames):
            yield self._first[start : start + frames]
        while len(block := self._read(frames)):
            yield block

    def close(self) -> None:
        """Leave the stream to its owner."""

    def _read(self, frames: int) -> Float32Array:
        wanted = frames * self._raw.frame_bytes
        parts: list[bytes] = []
        # A pipe gives what it holds, which may be less than a block.
        while (missing := wanted - sum(map(len, parts))) and (data := self._raw.stream.read(missing)):
            parts.append(data)
        joined = b"".join(parts)
        if len(joined) % self._raw.frame_bytes:
            got = f"{len(joined) % self._raw.frame_bytes} bytes too many"
            raise InputFileError(self.path, f"expected whole samples of {self.channels} channels, got {got}")
        block = self._raw.to_samples(joined)
        if self._raw.encoding == "f32":
            check_finite(self.path, block, self.frames)
        self.frames += len(block)
        return block


class MonoFiles(Audio):
    """Files of one channel each, read side by side."""

    def __init__(self, sources: Sequence[AudioSource]) -> None:
        self._sources = tuple(sources)
        first = self._sources[0]
        self.path, self.sample_rate_hz, self.frames = first.path, first.sample_rate_hz, first.frames
        self.channels = len(self._sources)
        self.silent_channels = tuple(i for i, one in enumerate(self._sources, 1) if one.silent_channels)
        for other in self._sources[1:]:
            if (other.sample_rate_hz, other.frames) != (first.sample_rate_hz, first.frames):
                expected = f"{first.frames} samples at {first.sample_rate_hz} Hz as in {first.path.name}"
                got = f"{other.frames} at {other.sample_rate_hz} Hz"
                raise InputFileError(other.path, f"expected {expected}, got {got}")

    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the recording from its start in blocks of `frames` samples; the last may be shorter."""
        for parts in zip(*(source.blocks(frames) for source in self._sources), strict=True):
            yield np.hstack(parts)

    def close(self) -> None:
        """Close the files."""
        for source in self._sources:
            source.close()


def open_sound(sound: SoundInput, expect_channels: int | None = None, *, strict: bool = True) -> Audio:
    """Open whatever a recording stands in, checked as `open_audio` does.

    Parameters
    ----------
    sound : Path, tuple of Path, SoundStream or Audio
        A multichannel file, files of one channel each in the order of the microphones, a stream, or what is
        open already.
    expect_channels : int, optional
        Number of microphones of the array that it shall fit.
    strict : bool
        As `open_audio`.

    Returns
    -------
    Audio
        Open, at its start.

    Raises
    ------
    InputFileError
        As `open_audio`; of mono files, if rates or lengths differ.
    SilentChannelsError
        Channels constant over the first second.

    Examples
    --------
    >>> import io
    >>> sound = np.arange(-16_000, 16_000, dtype="<i2").tobytes()
    >>> with open_sound(RawPcm(io.BytesIO(sound), 16_000, 2)) as audio:
    ...     [block.shape for block in audio.blocks(12_000)], audio.duration_s
    ([(12000, 2), (4000, 2)], 1.0)
    """
    if isinstance(sound, Path):
        return open_audio(sound, expect_channels, strict=strict)
    if isinstance(sound, Audio):
        sound.check_size(expect_channels)
        return sound
    with ExitStack() as opened:
        audio = (
            sound.open()
            if isinstance(sound, SoundStream)
            else MonoFiles([opened.enter_context(open_audio(path, 1, strict=False)) for path in sound])
        )
        audio.check_size(expect_channels)
        audio.check_silence(strict)
        opened.pop_all()  # what is fit to be read stays open
    return audio
