"""Sample bytes that a RIFF, RF64 or W64 header announces: a shorter file is truncated.

libsndfile reads a file that was cut short as a shorter one, without a word: a recorder that ran out of disk
would go unnoticed. So the promise is read here.
"""

import os
import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

UNKNOWN_SIZE = 0xFFFFFFFF
MAX_CHUNKS = 10_000
W64_RIFF = bytes.fromhex("726966662e91cf11a5d628db04c10000")


class DataSize(NamedTuple):
    """Bytes of samples: promised by the header, and there in the file.

    Examples
    --------
    >>> DataSize(declared=1000, available=400).is_cut
    True
    """

    declared: int
    available: int

    @property
    def is_cut(self) -> bool:
        """Whether the header promises more than the file holds."""
        return self.declared > self.available


def data_size(path: Path) -> DataSize | None:
    """Read the size of the data chunk of a RIFF, RF64 or W64 file."""
    with path.open("rb") as file:
        magic = file.read(16)
        if magic[:4] in (b"RIFF", b"RF64") and magic[8:12] == b"WAVE":
            file.seek(12)
            return _riff_data(file)
        if magic == W64_RIFF:
            file.seek(40)
            return _w64_data(file)
    return None


def _remaining(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size - file.tell()


def _riff_data(file: BinaryIO) -> DataSize | None:
    wide_size: int | None = None
    for _ in range(MAX_CHUNKS):
        header = file.read(8)
        if len(header) < 8:
            return None
        name, size = struct.unpack("<4sI", header)
        if name == b"data":
            declared = wide_size if size == UNKNOWN_SIZE else size
            return None if declared is None else DataSize(declared, _remaining(file))
        if name == b"ds64":
            ds64 = file.read(16)
            wide_size = struct.unpack("<8xQ", ds64)[0] if len(ds64) == 16 else None
            file.seek(-len(ds64), os.SEEK_CUR)
        file.seek(size + size % 2, os.SEEK_CUR)
    return None


def _w64_data(file: BinaryIO) -> DataSize | None:
    for _ in range(MAX_CHUNKS):
        header = file.read(24)
        if len(header) < 24:
            return None
        name, size = struct.unpack("<4s12xQ", header)
        if name == b"data":
            return DataSize(size - 24, _remaining(file))
        if not 24 <= size <= _remaining(file) + 24:
            return None
        file.seek(size - 24 + -size % 8, os.SEEK_CUR)
    return None
