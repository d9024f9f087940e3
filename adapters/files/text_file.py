"""Text files read within bounds: plain, JSON of one dataclass, rows of CSV."""

import csv
import io
import math
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError
from worldstate.ground.serialisation import decode, decode_json

T = TypeVar("T")

MAX_BYTES = 16 << 20
MAX_ROWS = 200_000
MAX_COLUMNS = 10_000
MAX_CELL = 1000


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


def read_json(path: str | Path, what: str, max_bytes: int = MAX_BYTES) -> object:
    """Return what a JSON file holds, decoded strictly."""
    with refused_as_file(path):
        return decode_json(read_text(path, what, max_bytes), what)


def read_record(kind: type[T], path: str | Path, what: str) -> T:
    """Return the value of type `kind` that a JSON file holds."""
    with refused_as_file(path):
        return decode(kind, read_json(path, f"a {what} file"), what)


@contextmanager
def refused_as_file(path: object, where: str = "") -> Iterator[None]:
    """Turn refusals inside into those of a file, which begin with its name and the place in it."""
    try:
        yield
    except SchemaVersionError as error:
        raise SchemaVersionError(path, error.problem) from error
    except InvalidArgumentError as error:
        raise InputFileError(path, f"{where}{error}") from error


def read_rows(
    path: Path, columns: Collection[str], optional: Collection[str] = ()
) -> Iterator[tuple[int, dict[str, str]]]:
    r"""Yield the wanted columns of a CSV file with a header, and the optional ones that it has, by line.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "list.csv").write_text("ID,Note\n1_00_0002,wet\n")
    ...     list(read_rows(Path(folder) / "list.csv", ["ID"]))
    [(2, {'ID': '1_00_0002'})]
    """
    reader = csv.reader(io.StringIO(read_text(path, "a CSV file", MAX_BYTES), newline=""))
    try:
        places = _places(path, next(reader, []), columns, optional)
        for number, cells in enumerate(filter(None, reader)):
            if number >= MAX_ROWS:
                raise InputFileError(path, f"expected at most {MAX_ROWS} lines")
            row = {name: cells[at].strip() if at < len(cells) else "" for name, at in places.items()}
            if max(map(len, row.values())) > MAX_CELL:
                problem = f"expected at most {MAX_CELL} characters between two commas"
                raise InputFileError(path, f"line {reader.line_num}: {problem}")
            yield reader.line_num, row
    except csv.Error as error:
        raise InputFileError(path, f"line {reader.line_num}: expected CSV: {error}") from error


def number(path: str | Path, line: int, row: dict[str, str], column: str) -> float:
    """Return the finite number in a column of a row that `read_rows` yielded."""
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        problem = f"line {line}: expected a finite number as {column}, got {row[column][:40]!r}"
        raise InputFileError(path, problem)
    return value


def _places(
    path: Path, header: list[str], columns: Collection[str], optional: Collection[str]
) -> dict[str, int]:
    """Return in which place of a line each column stands."""
    if len(header) > MAX_COLUMNS:
        raise InputFileError(path, f"expected at most {MAX_COLUMNS} columns, got {len(header)}")
    missing = [column for column in columns if column not in header]
    if missing:
        problem = f"expected columns {', '.join(columns)}, missing {', '.join(missing)}"
        raise InputFileError(path, problem)
    return {name: header.index(name) for name in (*columns, *optional) if name in header}
