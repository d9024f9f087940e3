"""Text files, read within a bound."""

from pathlib import Path

from worldstate.ground.errors import InputFileError


def read_text(path: str | Path, what: str, max_bytes: int) -> str:
    """Return what a file in UTF-8 of at most so many bytes holds."""
    try:
        with Path(path).open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise InputFileError(path, f"expected {what} ({error.strerror})") from error
    if len(data) > max_bytes:
        raise InputFileError(path, f"expected {what} of at most {max_bytes >> 20} MiB")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputFileError(path, f"expected {what} in UTF-8") from error
