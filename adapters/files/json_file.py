"""JSON files of one dataclass: read within a bound, every refusal beginning with the file's name."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError
from worldstate.ground.serialisation import decode_json

MAX_BYTES = 16 << 20


def read_json(path: str | Path, what: str) -> object:
    """Return what a JSON file of at most 16 MiB holds, decoded strictly."""
    with refused_as_file(path):
        try:
            with Path(path).open("rb") as file:
                data = file.read(MAX_BYTES + 1)
            text = data.decode("utf-8")
        except OSError as error:
            raise InputFileError(path, f"expected {what} ({error.strerror})") from error
        except UnicodeDecodeError as error:
            raise InputFileError(path, f"expected {what} in UTF-8") from error
        if len(data) > MAX_BYTES:
            raise InputFileError(path, f"expected {what} of at most {MAX_BYTES >> 20} MiB")
        return decode_json(text, what)


@contextmanager
def refused_as_file(path: object) -> Iterator[None]:
    """Turn refusals inside into those of a file, which begin with its name."""
    try:
        yield
    except SchemaVersionError as error:
        raise SchemaVersionError(path, error.problem) from error
    except InvalidArgumentError as error:
        raise InputFileError(path, str(error)) from error
