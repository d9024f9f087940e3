"""Arrays in npz files: no pickled objects, bounded size, atomic writing."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from worldstate.ground.errors import InputFileError, InvalidArgumentError

from .atomic import atomic_path

Result = TypeVar("Result")


def save_npz(path: str | Path, values: Mapping[str, Any]) -> None:
    """Write arrays by name."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **values)


def load_npz(
    path: str | Path, what: str, max_bytes: int, read: Callable[[dict[str, np.ndarray]], Result]
) -> Result:
    """Return what `read` makes of the arrays of a file.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_npz(Path(folder) / "a.npz", {"x": np.arange(3)})
    ...     load_npz(Path(folder) / "a.npz", "numbers", 1 << 10, lambda values: values["x"].sum())
    np.int64(3)
    """
    try:
        if Path(path).stat().st_size > max_bytes:
            raise InputFileError(path, f"expected {what} of at most {max_bytes >> 20} MiB")
        with np.load(path, allow_pickle=False) as file:
            return read({name: file[name] for name in file.files})
    except InputFileError:
        raise
    except OSError as error:
        raise InputFileError(path, f"expected {what} as npz ({error.strerror or error})") from error
    except InvalidArgumentError as error:
        raise InputFileError(path, f"expected {what} ({error})") from error
    except Exception as error:  # zipfile, zlib and numpy each have errors of their own for damaged bytes
        raise InputFileError(path, f"expected {what} as npz, they do not read: {error}") from error
