"""Rows of a CSV file: selected columns with their line numbers."""

import csv
import io
from collections.abc import Collection
from pathlib import Path

from worldstate.ground.errors import InputFileError

MAX_BYTES = 16 << 20


def read_rows(path: Path, columns: Collection[str]) -> list[tuple[int, dict[str, str]]]:
    r"""Read the wanted columns of a CSV file with a header.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "list.csv").write_text("ID,Note\n1_00_0002,wet\n")
    ...     read_rows(Path(folder) / "list.csv", ["ID"])
    [(2, {'ID': '1_00_0002'})]
    """
    reader = csv.DictReader(io.StringIO(_text(path), newline=""))
    try:
        header = reader.fieldnames or ()
        missing = [column for column in columns if column not in header]
        if missing:
            problem = f"expected columns {', '.join(columns)}, missing {', '.join(missing)}"
            raise InputFileError(path, problem)
        return [(reader.line_num, {c: (row[c] or "").strip() for c in columns}) for row in reader]
    except csv.Error as error:
        raise InputFileError(path, f"line {reader.line_num}: expected CSV: {error}") from error


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputFileError(path, f"expected a CSV file ({error.strerror})") from error
    if len(data) > MAX_BYTES:
        raise InputFileError(path, f"expected a CSV file of at most {MAX_BYTES} bytes")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputFileError(path, "expected a CSV file in UTF-8") from error
