"""Tables and curves as CSV, numbers to the last digit."""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from itertools import chain

from .document import Cell, Curves, ReportTable, Value

_PARTS = ("value", "low", "high", "note", "paper", "paper_low", "paper_high")


def csv_text(source: ReportTable | Curves) -> str:
    """Return a table with a column for each part of a value, or the curves as they are.

    Examples
    --------
    >>> table = ReportTable("t", "", ("method", "lead (s)"), (("ours", Value(1.7, 1.3, paper=Value(1.69))),))
    >>> print(csv_text(table))
    method,lead (s) value,lead (s) low,lead (s) paper
    ours,1.7,1.3,1.69
    <BLANKLINE>
    """
    rows = _split_values(source) if isinstance(source, ReportTable) else [source.columns, *source.rows]
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([_plain(cell) for cell in row] for row in rows)
    return buffer.getvalue()


def _split_values(table: ReportTable) -> Iterable[Sequence[float | str]]:
    """Head and rows; a part that no value of a column has gets no column."""
    columns = (_parts(title, [row[i] for row in table.rows]) for i, title in enumerate(table.columns))
    return zip(*chain.from_iterable(columns), strict=True)


def _parts(title: str, cells: Sequence[Cell]) -> list[list[float | str]]:
    if not any(isinstance(cell, Value) for cell in cells):
        return [[title, *map(str, cells)]]
    rows = [_numbers(cell) for cell in cells]
    known = [any(not _unknown(row[i]) for row in rows) for i in range(len(_PARTS))]
    # The first part stays even where no row knows it: a column that was measured and found empty.
    kept = [i for i in range(len(_PARTS)) if known[i] or i == 0]
    return [[f"{title} {_PARTS[i]}", *(row[i] for row in rows)] for i in kept]


def _numbers(cell: Cell) -> tuple[float | str, ...]:
    if not isinstance(cell, Value):
        return (cell, *[math.nan] * 6)
    paper = cell.paper or Value(math.nan)
    # What is not there says why, as in the report.
    value, note = (cell.note, "") if math.isnan(cell.value) else (cell.value, cell.note)
    return value, cell.low, cell.high, note, paper.value, paper.low, paper.high


def _unknown(value: float | str) -> bool:
    return value == "" or (isinstance(value, float) and math.isnan(value))


def _plain(value: float | str) -> float | str:
    # The writer does not quote a lone carriage return, and readers end the row there.
    return " ".join(value.split()) if isinstance(value, str) else "" if _unknown(value) else value
