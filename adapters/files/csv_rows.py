"""Rows of a CSV file: selected columns with their line numbers."""

import csv
import io
import math
from collections.abc import Collection, Iterator
from pathlib import Path

from worldstate.ground.errors import InputFileError

from .text_file import read_text

MAX_BYTES = 16 << 20
MAX_ROWS = 200_000
MAX_COLUMNS = 10_000
MAX_CELL = 1000


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
