"""JSON files of one dataclass: read within a bound, every refusal beginning with the file's name."""

from pathlib import Path
from typing import TypeVar

from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError
from worldstate.ground.serialisation import decode, decode_json

T = TypeVar("T")

MAX_BYTES = 16 << 20


def read_json(path: str | Path, what: str) -> object:
    """Return what a JSON file of at most 16 MiB holds, decoded strictly."""
    try:
        with Path(path).open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise InputFileError(path, f"expected {what} of at most {MAX_BYTES >> 20} MiB")
        return decode_json(data.decode("utf-8"), what)
    except OSError as error:
        raise InputFileError(path, f"expected {what} ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputFileError(path, f"expected {what} in UTF-8") from error
    except InvalidArgumentError as error:
        raise InputFileError(path, str(error)) from error


def decode_file(cls: type[T], data: object, path: object, what: str) -> T:
    """Return the dataclass that a file's decoded JSON holds, refusals as those of the file.

    Raises
    ------
    InputFileError
        If something is missing, of the wrong type or out of range.
    SchemaVersionError
        If it is of another schema or another major version.
    """
    try:
        return decode(cls, data, what)
    except SchemaVersionError as error:
        raise SchemaVersionError(path, error.problem) from error
    except InvalidArgumentError as error:
        raise InputFileError(path, str(error)) from error
