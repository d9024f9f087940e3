"""Arrays in npz files: no pickled objects, bounded size, atomic writing."""

import math
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from worldstate.ground.errors import InputFileError, InvalidArgumentError

from .file_io import atomic_path

Result = TypeVar("Result")

# The end of a zip file: a record of 22 bytes, then a comment of at most 65,535.
_END, _END_BYTES, _LONGEST_COMMENT = b"PK\5\6", 22, 65_535
_MAX_DIRECTORY_BYTES = 1 << 16


def save_npz(path: str | Path, values: Mapping[str, Any]) -> None:
    """Write arrays by name."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **values)


def load_npz(
    path: str | Path, what: str, max_bytes: int, read: Callable[[dict[str, np.ndarray]], Result]
) -> Result:
    """Return what `read` makes of the arrays of a file, which take at most `max_bytes` when decoded.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_npz(Path(folder) / "a.npz", {"x": np.arange(3)})
    ...     load_npz(Path(folder) / "a.npz", "numbers", 1 << 10, lambda values: values["x"].sum())
    np.int64(3)
    """
    try:
        with Path(path).open("rb") as file:
            if _decoded_bytes(file) > max_bytes:
                raise InputFileError(path, f"expected {what} of at most {max_bytes >> 20} MiB")
            with np.load(file, allow_pickle=False) as arrays:
                return read({name: arrays[name] for name in arrays.files})
    except InputFileError:
        raise
    except OSError as error:
        raise InputFileError(path, f"expected {what} as npz ({error.strerror or error})") from error
    except InvalidArgumentError as error:
        raise InputFileError(path, f"expected {what} ({error})") from error
    except Exception as error:  # zipfile, zlib and numpy each have errors of their own for damaged bytes
        raise InputFileError(path, f"expected {what} as npz, they do not read: {error}") from error


def _decoded_bytes(file: BinaryIO) -> int:
    """Return how much memory the arrays take, as numbers of 64 bits at least, from their headers alone."""
    _check_directory(file)
    total = 0
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            with archive.open(name) as member:
                # The header of a later version may be 4 GiB long.
                if np.lib.format.read_magic(member) != (1, 0):
                    raise InvalidArgumentError(f"{name}: expected an array in version 1.0 of its format")
                shape, _, dtype = np.lib.format.read_array_header_1_0(member)
                total += math.prod(shape) * max(dtype.itemsize, 8)
    file.seek(0)
    return total


def _check_directory(file: BinaryIO) -> None:
    """Refuse a zip file whose list of members would itself fill the memory."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - _END_BYTES - _LONGEST_COMMENT, 0))
    tail = file.read()
    at = tail.rfind(_END)
    extended = tail[max(at - 20, 0) : at].startswith(b"PK\6\7")
    if at < 0 or extended or int.from_bytes(tail[at + 12 : at + 16], "little") > _MAX_DIRECTORY_BYTES:
        raise InvalidArgumentError("expected a zip file with a short list of members")
