"""Text files, read within a bound."""

from pathlib import Path

from worldstate.ground.errors import InputFileError


def read_text(path: str | Path, what: str, max_bytes: int) -> str:
    """Return what a file in UTF-8 of at most so many bytes holds."""
    try:
        return read_bytes(path, what, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputFileError(path, f"expected {what} in UTF-8") from error


def read_bytes(path: str | Path, what: str, max_bytes: int) -> bytes:
    """Return what a file of at most so many bytes holds."""
    try:
        with Path(path).open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise InputFileError(path, f"expected {what} ({error.strerror})") from error
    if len(data) > max_bytes:
        raise InputFileError(path, f"expected {what} of at most {max_bytes >> 20} MiB")
    return data
