"""Plain samples: decoding of their bytes, and their location in RIFF, RF64, BW64 and W64 files."""

import io
import os
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, get_args

import numpy as np
import soundfile
from numpy.typing import NDArray

from worldstate.ground.typing import Float32Array, FloatArray

Encoding = Literal["s16", "s24", "s24_32", "s32", "f32"]
# The names are those of libsndfile, except for PADDED_24, which it lacks: 24 bits in the lower three of four
# bytes (ALSA's S24_LE).
PADDED_24 = "PCM_24_32"
_NAMES = "PCM_16", "PCM_24", PADDED_24, "PCM_32", "FLOAT"
SUBTYPES: dict[Encoding, str] = dict(zip(get_args(Encoding), _NAMES, strict=True))
MAX_CHUNKS, MAX_CHANNELS, MAX_RATE_HZ = 10_000, 1024, 10_000_000
_W64_RIFF = bytes.fromhex("726966662e91cf11a5d628db04c10000")
_UNKNOWN_SIZE = 0xFFFFFFFF
# While the length is unknown, recorders write a size near a multiple of 2 GiB: arecord 0x80000000 or
# 0x7FFFFF00, SoX 0x7FFFF000, ffmpeg 0xFFFFFFFF, some rounded to whole samples of all channels.
_OPEN_SIZE, _NEAR_BYTES = 1 << 31, 1 << 16
# Enough samples to determine their format.
LOOK_BYTES = 1 << 16
# By format tag (1 integers, 3 floats), then by bytes per sample.
_WHOLE, _FLOATS = {1: "PCM_U8", 2: "PCM_16", 3: "PCM_24", 4: "PCM_32"}, {4: "FLOAT", 8: "DOUBLE"}


def decoded(data: bytes, subtype: str, channels: int) -> Float32Array:
    """Return little-endian samples of full scale 1, shape (n, channels)."""
    if subtype == PADDED_24:
        whole = np.frombuffer(data, "<i4") << 8  # drops the fourth byte: sign, zero or garbage
        return (whole.astype(np.float32) * np.float32(2.0**-31)).reshape(-1, channels)
    # The rate 1 is not used.
    raw = {"format": "RAW", "subtype": subtype, "endian": "LITTLE", "samplerate": 1, "channels": channels}
    return np.asarray(soundfile.read(io.BytesIO(data), dtype="float32", always_2d=True, **raw)[0])


def four_byte_form(data: bytes) -> Encoding | None:
    """Return the format of four-byte samples if it is obvious; None otherwise, and for silence.

    The fourth byte determines it: floats within full scale have similar exponents, 24 bits are followed by
    their sign or by zero, and 24-bit converters leave the first of four bytes empty. Samples of two or three
    bytes do not match these patterns, except for silence.

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
    if (top == 0).all() or (top == raw << 8 >> 31).all():  # also true of 16 bits with an empty first byte
        return "s24_32"
    return None if (raw & 0xFF).any() else "s32"


# In sound, neighbouring samples of every channel have a correlation above the first number. If the format is
# wrong, one channel has a correlation below the second at a level above the third (of full scale).
_SMOOTH, _ROUGH, _LOUD = 0.7, 0.35, 0.3
_FORMS = {"s16": "<i2", "s24": "", "s32 or s24_32": "<i4", "s16, big-endian": ">i2", "s32, big-endian": ">i4"}


def smooth_form(data: bytes, stated: Encoding, channels: int) -> str | None:
    """If samples are loud noise in the stated format, return a format in which they are smooth, or None.

    Pairs of 16-bit samples also form smooth 32-bit numbers, but the lower halves of 32-bit samples are not
    smooth.

    Examples
    --------
    >>> steps = np.random.default_rng(0).normal(0.0, 9.0, (6000, 2))
    >>> data = (np.cumsum(steps, axis=0) * 9.0).astype("<i2").tobytes()
    >>> [smooth_form(data, stated, 2) for stated in ("s16", "s24", "s32", "f32")]
    [None, 's16', 's16', 's16']
    """
    if not (data := data[: len(data) // (12 * channels) * 12 * channels]):
        return None
    if not (suspect := stated == "f32"):
        alike, loud = _likeness(decoded(data, SUBTYPES[stated], channels))
        suspect = bool(((alike < _ROUGH) & (loud > _LOUD)).any())
    for name, kind in _FORMS.items():
        other = name != stated and not (stated == "f32" and name.startswith("s32"))
        if other and (suspect or (name == "s16" and stated.endswith("32"))):
            plain = np.frombuffer(data, kind).reshape(-1, channels) if kind else None
            alike, _ = _likeness(decoded(data, "PCM_24", channels) if plain is None else plain)
            if len(alike) and alike.min() > _SMOOTH:  # Without sound no format is smoother than another
                return name
    return None


def _likeness(samples: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Return correlation of neighbouring samples and standard deviation of each non-constant channel."""
    about = samples.astype(np.float64) - samples.mean(axis=0)
    power = (about**2).sum(axis=0)
    live, along = power > 0.0, (about[1:] * about[:-1]).sum(axis=0)
    return along[live] / power[live], np.sqrt(power[live] / max(len(about), 1))


class _Form(NamedTuple):
    """Layout of the chunks of a file format."""

    first: int  # Position of the first chunk in bytes
    header: struct.Struct  # Name and size
    counted: int  # Bytes of the header that are included in the size
    padded: int  # Chunks start at multiples of this


_RIFF, _W64 = _Form(12, struct.Struct("<4sI"), 0, 2), _Form(40, struct.Struct("<4s12xQ"), 24, 8)


class PlainSamples:
    """The samples in the chunks of a file, with the interface of `soundfile.SoundFile` for `AudioSource`.

    Attributes
    ----------
    declared_bytes, n_bytes, there_bytes : int
        Bytes of samples by the header, by the chunks, and from the first sample to the end of the file.
    look : bytes
        Bytes of the first samples.
    needed : bool
        Whether libsndfile reads the samples wrongly (24 bits in four bytes as three) or not at all (BW64).
    """

    def __init__(self, file: BinaryIO, form: _Form, first: int, declared: int, about: bytes) -> None:
        self._file, self.close, self._first, self.declared_bytes = file, file.close, first, declared
        self.there_bytes = os.fstat(file.fileno()).st_size - first
        self.n_bytes = _held_bytes(file, form, first, declared, self.there_bytes)
        tag, self.channels, self.samplerate, self._frame_bytes, bits = struct.unpack("<HHI4xHH", about[:16])
        whole = 1 <= self.channels <= MAX_CHANNELS and self._frame_bytes % self.channels == 0
        each = self._frame_bytes // self.channels if whole and 1 <= self.samplerate <= MAX_RATE_HZ else 0
        tag = int.from_bytes(about[24:26], "little") if tag == 0xFFFE else tag
        self.subtype = {1: _WHOLE, 3: _FLOATS}.get(tag, {}).get(each)
        self.seek(0)
        self.look = file.read(LOOK_BYTES)
        # Arecord stores 24 bits in the lower three of four bytes, all other programs in the upper three.
        if (tag, each, bits) == (1, 4, 24) and four_byte_form(self.look) == "s24_32":
            self.subtype = PADDED_24
        file.seek(0)
        right = self.n_bytes == declared and bits == 8 * each and file.read(4) != b"BW64"
        self.needed = self.subtype is not None and not right
        self.frames = self.n_bytes // max(self._frame_bytes, 1)

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""
        return self._file.closed

    def seek(self, frame: int) -> None:
        """Go to a sample."""
        self._file.seek(self._first + frame * self._frame_bytes)

    def read(self, frames: int, **_: object) -> Float32Array:
        """Return the next `frames` samples of all channels."""
        return decoded(self._file.read(frames * self._frame_bytes), str(self.subtype), self.channels)


def plain_samples(path: Path) -> PlainSamples | None:
    """Open a RIFF, RF64, BW64 or W64 file by its chunks; return None for other files."""
    with ExitStack() as opened:
        file = opened.enter_context(path.open("rb"))
        magic, about, wide = file.read(16), b"", _UNKNOWN_SIZE
        is_riff = magic[:4] in (b"RIFF", b"RF64", b"BW64") and magic[8:12] == b"WAVE"
        form = _RIFF if is_riff else _W64
        for name, size, at in _chunks(file, form) if is_riff or magic == _W64_RIFF else ():
            if name == b"fmt ":
                about = file.read(min(size, 40))
            elif name == b"ds64" and len(sizes := file.read(16)) == 16:
                wide = struct.unpack("<8xQ", sizes)[0]
            elif name == b"data" and len(about) >= 16:
                opened.pop_all()
                declared = wide if size == _UNKNOWN_SIZE else size
                return PlainSamples(file, form, at, declared, about)
    return None


def _chunks(file: BinaryIO, form: _Form, at: int | None = None) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, size and first byte of each chunk, and move the file there; the last may be truncated."""
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
    """Return the number of bytes of samples: the declared one unless the file contradicts it."""
    if declared > there:
        far = min(declared % _OPEN_SIZE, -declared % _OPEN_SIZE)
        return there if far <= _NEAR_BYTES < declared else declared
    # The size has overflowed if chunks follow at a multiple of 4 GiB after it.
    ends = range(declared, there + 1, 1 << 32)
    return next((end for end in ends if _only_chunks(file, form, at + end, at + there)), there)


def _only_chunks(file: BinaryIO, form: _Form, begin: int, end: int) -> bool:
    """Return whether only whole chunks follow; some writers do not pad the chunk before them."""
    for start in {begin, begin + -begin % form.padded}:
        last = start
        for name, size, at in _chunks(file, form, start):
            if not all(32 <= letter < 127 for letter in name):
                break
            last = at + size
        if abs(end - last) < form.padded:
            return True
    return False
