"""JSON files of one dataclass: read within a bound, every refusal beginning with the file's name."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError
from worldstate.ground.serialisation import decode, decode_json

from .text_file import read_text

T = TypeVar("T")

MAX_BYTES = 16 << 20


def read_json(path: str | Path, what: str, max_bytes: int = MAX_BYTES) -> object:
    """Return what a JSON file holds, decoded strictly."""
    with refused_as_file(path):
        return decode_json(read_text(path, what, max_bytes), what)


def read_record(kind: type[T], path: str | Path, what: str) -> T:
    """Return the value of type `kind` that a JSON file holds."""
    with refused_as_file(path):
        return decode(kind, read_json(path, f"a {what} file"), what)


@contextmanager
def refused_as_file(path: object) -> Iterator[None]:
    """Turn refusals inside into those of a file, which begin with its name."""
    try:
        yield
    except SchemaVersionError as error:
        raise SchemaVersionError(path, error.problem) from error
    except InvalidArgumentError as error:
        raise InputFileError(path, str(error)) from error
