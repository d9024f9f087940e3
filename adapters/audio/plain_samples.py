"""Plain samples: how their bytes are decoded, and where RIFF, RF64, BW64 and W64 files keep them."""

import io
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import numpy as np
import soundfile

from worldstate.ground.typing import Float32Array

Encoding = Literal["s16", "s24", "s24_32", "s32", "f32"]
# Of libsndfile, but for the one that it lacks: 24 bits in the lower three of four bytes (ALSA's S24_LE).
PADDED_24 = "PCM_24_32"
SUBTYPES: dict[Encoding, str] = {
    "s16": "PCM_16",
    "s24": "PCM_24",
    "s24_32": PADDED_24,
    "s32": "PCM_32",
    "f32": "FLOAT",
}
MAX_CHUNKS, MAX_CHANNELS, MAX_RATE_HZ = 10_000, 1024, 10_000_000
_W64_RIFF = bytes.fromhex("726966662e91cf11a5d628db04c10000")
_UNKNOWN_SIZE = 0xFFFFFFFF
# Recorders that do not know the length yet write a size near a multiple of 2 GiB: arecord 0x80000000 or
# 0x7FFFFF00, SoX 0x7FFFF000, ffmpeg 0xFFFFFFFF, some rounded to whole samples of all channels.
_OPEN_SIZE, _NEAR_BYTES = 1 << 31, 1 << 16
# Enough samples to see how they are stored.
LOOK_BYTES = 1 << 16
# By the format's tag (1 whole numbers, 3 floats) and the bytes of a sample.
_STORED = {
    (1, 1): "PCM_U8",
    (1, 2): "PCM_16",
    (1, 3): "PCM_24",
    (1, 4): "PCM_32",
    (3, 4): "FLOAT",
    (3, 8): "DOUBLE",
}


def decoded(data: bytes, subtype: str, channels: int) -> Float32Array:
    """Return little-endian samples of full scale 1, shape (n, channels)."""
    if subtype == PADDED_24:
        whole = np.frombuffer(data, "<i4") << 8  # whatever the fourth byte holds: sign, zero or rubbish
        return (whole.astype(np.float32) * np.float32(2.0**-31)).reshape(-1, channels)
    # Rate 1: nothing of it is read.
    raw = {"format": "RAW", "subtype": subtype, "endian": "LITTLE", "samplerate": 1, "channels": channels}
    return np.asarray(soundfile.read(io.BytesIO(data), dtype="float32", always_2d=True, **raw)[0])


def four_byte_form(data: bytes) -> Encoding | None:
    """Return what samples of four bytes each obviously are; None for all others, and for silence.

    The fourth byte decides: floats within full scale have exponents of one kind, 24 bits are followed by
    their sign or zero, and converters of 24 bits leave the first byte of 32 empty. Bytes of two or three a
    sample do not line up so, but for silence.

    Examples
    --------
    >>> quiet = np.random.default_rng(0).normal(0.0, 1e4, 4000).astype("<i4")
    >>> four_byte_form(quiet.tobytes()), four_byte_form((quiet << 8).tobytes())
    ('s24_32', 's32')
    >>> four_byte_form((quiet / 2**23).astype("<f4").tobytes()), four_byte_form(quiet.astype("<i2").tobytes())
    ('f32', None)
    """
    raw = np.frombuffer(data[: len(data) // 4 * 4], "<i4")
    raw = raw[raw != 0]
    top = raw >> 24
    if not len(raw):
        return None
    if ((top & 0x70) == 0x30).all():
        return "f32"
    if not (raw & 0xFF).any():
        return "s32"
    return "s24_32" if (top == 0).all() or (top == raw << 8 >> 31).all() else None


class _Form(NamedTuple):
    """How a kind of file lays its chunks out."""

    first: int  # Byte at which the first chunk begins
    header: struct.Struct  # Name and size
    counted: int  # Bytes of the header that the size counts
    padded: int  # Chunks begin at multiples of it


_RIFF, _W64 = _Form(12, struct.Struct("<4sI"), 0, 2), _Form(40, struct.Struct("<4s12xQ"), 24, 8)


@dataclass(frozen=True, slots=True)
class WaveLayout:
    """Where a file keeps its samples, and how."""

    path: Path
    first_byte: int
    declared_bytes: int  # As the header counts them
    n_bytes: int  # Of samples, as the file shows
    there_bytes: int  # From the first sample to the end of the file
    about: bytes  # The chunk of the format
    big: bool  # BW64, which libsndfile does not read

    def samples(self) -> "PlainSamples | None":
        """Open what libsndfile reads wrongly (24 bits in four bytes as three) or not at all; else None."""
        (subtype, whole), right = self._subtype(), self.n_bytes == self.declared_bytes
        return None if subtype is None or (right and whole and not self.big) else PlainSamples(self, subtype)

    def format(self) -> tuple[int, int, int]:
        """Return channels, samples a second, and bytes of one sample of all channels."""
        channels, rate_hz, frame_bytes = struct.unpack_from("<HI4xH", self.about, 2)
        return channels, rate_hz, frame_bytes

    def _subtype(self) -> tuple[str | None, bool]:
        """Return how samples are stored, None for no plain ones, and whether they fill their bytes."""
        if len(self.about) < 16:
            return None, True
        channels, rate_hz, frame_bytes = self.format()
        if not (1 <= channels <= MAX_CHANNELS and 1 <= rate_hz <= MAX_RATE_HZ) or frame_bytes % channels:
            return None, True
        (tag, bits), sub = struct.unpack_from("<H12xH", self.about), self.about[24:26]
        tag, each = int.from_bytes(sub, "little") if tag == 0xFFFE else tag, frame_bytes // channels
        lower = (tag, each, bits) == (1, 4, 24) and self._is_padded()
        return PADDED_24 if lower else _STORED.get((tag, each)), bits == 8 * each

    def _is_padded(self) -> bool:
        """Whether 24 bits stand in the lower bytes, as arecord writes them, or in the upper as all others."""
        with self.path.open("rb") as file:
            file.seek(self.first_byte)
            return four_byte_form(file.read(LOOK_BYTES)) == "s24_32"


class PlainSamples:
    """Samples of a layout, in what an `AudioSource` uses of `soundfile.SoundFile`."""

    def __init__(self, layout: WaveLayout, subtype: str) -> None:
        self._file, self._first, self.subtype = layout.path.open("rb"), layout.first_byte, subtype
        self.channels, self.samplerate, self._frame_bytes = layout.format()
        self.frames = layout.n_bytes // self._frame_bytes
        self.close = self._file.close

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self._file.closed

    def seek(self, frame: int) -> None:
        """Go to a sample."""
        self._file.seek(self._first + frame * self._frame_bytes)

    def read(self, frames: int, **_: object) -> Float32Array:
        """Return so many samples of all channels."""
        return decoded(self._file.read(frames * self._frame_bytes), self.subtype, self.channels)


def wave_layout(path: Path) -> WaveLayout | None:
    """Return where a RIFF, RF64, BW64 or W64 file keeps its samples; None for all others."""
    with path.open("rb") as file:
        magic = file.read(16)
        is_riff = magic[:4] in (b"RIFF", b"RF64", b"BW64") and magic[8:12] == b"WAVE"
        if not is_riff and magic != _W64_RIFF:
            return None
        form, about, wide = _RIFF if is_riff else _W64, b"", _UNKNOWN_SIZE
        for name, size, at in _chunks(file, form):
            if name == b"data":
                declared = wide if size == _UNKNOWN_SIZE else size
                there = os.fstat(file.fileno()).st_size - at
                held = _held_bytes(file, form, at, declared, there)
                return WaveLayout(path, at, declared, held, there, about, magic[:4] == b"BW64")
            if name == b"fmt ":
                about = file.read(min(size, 40))
            elif name == b"ds64" and len(sizes := file.read(16)) == 16:
                wide = struct.unpack("<8xQ", sizes)[0]
    return None


def _chunks(file: BinaryIO, form: _Form, at: int | None = None) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, size and first byte of each chunk, the file at that byte; the last may be cut."""
    at, end = form.first if at is None else at, os.fstat(file.fileno()).st_size
    for _ in range(MAX_CHUNKS):
        file.seek(min(at, end))
        if len(head := file.read(form.header.size)) < form.header.size:
            return
        name, size = form.header.unpack(head)
        size, at = max(size - form.counted, 0), at + form.header.size
        yield name, size, at
        at += size + -size % form.padded


def _held_bytes(file: BinaryIO, form: _Form, at: int, declared: int, there: int) -> int:
    """Return how many bytes of samples a file holds: as declared where nothing contradicts it."""
    if declared > there:
        far = min(declared % _OPEN_SIZE, -declared % _OPEN_SIZE)
        return there if far <= _NEAR_BYTES < declared else declared
    # A size has wrapped round if chunks follow some multiple of 4 GiB behind it.
    ends = range(declared, there + 1, 1 << 32)
    return next((end for end in ends if _only_chunks(file, form, at + end, at + there)), there)


def _only_chunks(file: BinaryIO, form: _Form, begin: int, end: int) -> bool:
    """Whether nothing but whole chunks follows; some writers do not pad what is before them."""
    for start in {begin, begin + -begin % form.padded}:
        last = start
        for name, size, at in _chunks(file, form, start):
            if not all(32 <= letter < 127 for letter in name):
                break
            last = at + size
        if abs(end - last) < form.padded:
            return True
    return False
