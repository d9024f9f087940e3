"""The table type of all studies: printed, written as JSON and CSV, and inserted into pages.

A study returns its findings as `Table` values, and its pictures as `Figure` values. A command prints
``table.lines()`` and includes ``json_values(findings)`` in its JSON report. A `Document`
combines tables and figures in `report.md`, a Markdown page with its figures and numbers as files; all files
are written, or none.
"""

import csv
import io
import math
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from worldstate.adapters.files.file_io import check_target
from worldstate.ground.errors import InputFileError
from worldstate.ground.parallel import deferred_signals
from worldstate.operations.figure_style import figure_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

MISSING = "\u2013"
_PARTS = ("value", "low", "high", "note", "paper", "paper_low", "paper_high")


@dataclass(frozen=True, slots=True)
class Value:
    """A number with its interval and the paper's value; NaN if there is none.

    Examples
    --------
    >>> Value(0.881, 0.79, 0.98, paper=Value(0.88)).text
    '0.88 [0.79, 0.98]'
    >>> Value(float("nan"), note="states no bearing").text
    'states no bearing'
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    digits: int = 2
    note: str = ""  # Printed after the value, or instead of it
    paper: "Value | None" = None

    @property
    def number(self) -> str:
        """The rounded value; if there is none, its note or a dash."""
        return self._rounded(self.value) if math.isfinite(self.value) else self.note or MISSING

    @property
    def interval(self) -> str:
        """The interval, empty if there is none."""
        if not all(map(math.isfinite, (self.value, self.low, self.high))):
            return ""
        return f"[{self._rounded(self.low)}, {self._rounded(self.high)}]"

    @property
    def text(self) -> str:
        """Value, interval and note in one line."""
        note = f"({self.note})" if self.note and math.isfinite(self.value) else ""
        return " ".join(filter(None, (self.number, self.interval, note)))

    def _rounded(self, value: float) -> str:
        # A rounded -0.001 would print as -0.00; adding zero removes the sign.
        return f"{round(value, self.digits) + 0.0:.{self.digits}f}"


# A float without an interval is printed with three decimals, an unknown one (None, NaN) as a dash.
Cell: TypeAlias = Value | str | float | None


def cell_text(cell: Cell) -> str:
    """Return a cell as a line of text.

    Examples
    --------
    >>> cell_text(0.5), cell_text(3), cell_text(Value(0.5, digits=1)), cell_text(None) == MISSING
    ('0.500', '3', '0.5', True)
    """
    if cell is None:
        return MISSING
    if isinstance(cell, float):
        return Value(cell, digits=3).text
    return cell.text if isinstance(cell, Value) else str(cell)


@dataclass(frozen=True, slots=True)
class Table:
    """Named columns with their units, and rows of cells; `name` is also that of the CSV file.

    Examples
    --------
    >>> table = Table("leads", "Leads", ("method", "lead (s)"), (("ours", Value(1.7, 1.3, 2.1)),))
    >>> for line in table.lines():
    ...     print(line)
    Leads
    method        lead (s)
    ours    1.70 [1.30, 2.10]
    >>> json_values(table)["rows"]
    [['ours', [1.7, 1.3, 2.1]]]
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[Cell, ...]]
    caption: str = ""

    def lines(self) -> list[str]:
        """Return the title and the aligned columns for a terminal; the caption is used only on pages."""
        texts = [list(self.columns), *([cell_text(cell) for cell in row] for row in self.rows)]
        widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
        return [self.title, *(_aligned(row, widths) for row in texts)]


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture with its numbers; `draw` receives an empty matplotlib figure."""

    name: str
    title: str
    caption: str
    draw: "Callable[[Canvas], None]"
    columns: tuple[str, ...]
    rows: Sequence[Sequence[Cell]]
    size_in: tuple[float, float] = (4.4, 3.7)


Block: TypeAlias = Table | Figure


def csv_text(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """Return rows as CSV; a column of values becomes one column for each part that occurs.

    Examples
    --------
    >>> print(csv_text(("method", "lead (s)"), (("ours", Value(1.7, 1.3, paper=Value(1.69))),)))
    method,lead (s) value,lead (s) low,lead (s) paper
    ours,1.7,1.3,1.69
    <BLANKLINE>
    """
    split = [part for i, title in enumerate(columns) for part in _split(title, [row[i] for row in rows])]
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(zip(*split, strict=True))
    return buffer.getvalue()


def figure_lines(columns: Mapping[str, Mapping[str, float | None]], form: str = ".3g") -> list[str]:
    """Return figures for a terminal, one per row; whole numbers in full, a dash for unknown values.

    Examples
    --------
    >>> for line in figure_lines({"ours": {"n": 12, "lead_s": 1.7}, "theirs": {"n": 12, "lead_s": None}}):
    ...     print(line.replace(MISSING, "-"))
    figure  ours  theirs
    n         12      12
    lead_s   1.7       -
    >>> figure_lines({})
    []
    """
    if not columns:
        return []
    rows = [
        (name, *(_figure_text(one[name], form) for one in columns.values()))
        for name in next(iter(columns.values()))
    ]
    return Table("figures", "", ("figure", *columns), rows).lines()[1:]


def _figure_text(value: float | None, form: str) -> str:
    return MISSING if value is None else format(value, "d" if isinstance(value, int) else form)


def json_values(value: Any) -> Any:
    """Return findings as JSON-compatible values: nested dataclasses, tuples and arrays, null for NaN.

    Examples
    --------
    >>> json_values({"lead": Value(1.5), "beta": np.array([0.5, np.nan]), "out": Path("a")})
    {'lead': 1.5, 'beta': [0.5, None], 'out': 'a'}
    """
    if isinstance(value, Value):
        known = all(map(math.isfinite, (value.low, value.high)))
        return json_values([value.value, value.low, value.high] if known else value.value)
    if isinstance(value, np.ndarray | np.generic):
        return json_values(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): json_values(one) for key, one in value.items()}
    if is_dataclass(value):
        return {one.name: json_values(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, list | tuple):
        return [json_values(one) for one in value]
    return str(value) if isinstance(value, Path) else value


def _aligned(row: Sequence[str], widths: Sequence[int]) -> str:
    """Return a line with the first column left-aligned and the numbers right-aligned."""
    numbers = (cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))
    return "  ".join([row[0].ljust(widths[0]), *numbers]).rstrip()


def _split(title: str, cells: Sequence[Cell]) -> Iterable[list[float | str]]:
    """Return the CSV columns for a column of cells, each with its head."""
    if not any(isinstance(cell, Value) for cell in cells):
        return [[title, *map(_written, cells)]]
    rows = [[_written(part) for part in _parts(cell)] for cell in cells]
    # The first part is kept even if all rows lack it: the column was measured but has no values.
    kept = [i for i in range(len(_PARTS)) if i == 0 or any(row[i] != "" for row in rows)]
    return [[f"{title} {_PARTS[i]}", *(row[i] for row in rows)] for i in kept]


def _parts(cell: Cell) -> tuple[Cell, ...]:
    if not isinstance(cell, Value):
        return (cell, *[None] * (len(_PARTS) - 1))
    paper = cell.paper or Value(math.nan)
    # The note of an unknown value replaces it, as in the report.
    value, note = (cell.note, "") if math.isnan(cell.value) else (cell.value, cell.note)
    return value, cell.low, cell.high, note, paper.value, paper.low, paper.high


def _written(cell: Cell) -> float | str:
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return ""
    # The CSV writer does not quote a lone carriage return, but readers end the row there.
    return " ".join(cell.split()) if isinstance(cell, str) else cell  # type: ignore[return-value]


@dataclass(frozen=True, slots=True)
class Section:
    """A heading with paragraphs, tables and figures."""

    title: str
    text: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = ()


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report; the facts (versions, seeds, settings) are at its end."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    facts: tuple[tuple[str, str], ...] = ()

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Every table and figure, in reading order."""
        return tuple(block for section in self.sections for block in section.blocks)


def markdown_page(document: Document, files: str) -> str:
    """Return the text; pictures and numbers are in the folder `files` beside it.

    Examples
    --------
    >>> print(markdown_page(Document("Streets", "Simulated.", (Section("Results", ("Two.",)),)), "f"))
    # Streets
    <BLANKLINE>
    **Simulated.**
    <BLANKLINE>
    ## Results
    <BLANKLINE>
    Two.
    <BLANKLINE>
    ## Versions and settings
    <BLANKLINE>
    |  |  |
    |---|---|
    <BLANKLINE>
    """
    parts = [f"# {_escaped(document.title)}", f"**{_escaped(document.lead)}**"]
    for section in document.sections:
        parts += [f"## {_escaped(section.title)}", *map(_escaped, section.text)]
        parts += [part for block in section.blocks for part in _markdown_block(block, files)]
    parts += ["## Versions and settings", _markdown_rows(("", ""), document.facts)]
    return "\n\n".join(parts) + "\n"


def _markdown_block(block: Block, files: str) -> list[str]:
    title, numbers = _escaped(block.title), f"[CSV]({files}/{block.name}.csv)"
    caption = f"{_escaped(block.caption)} {numbers}".strip()
    if isinstance(block, Figure):
        return [f"![{title}]({files}/{block.name}.png)", f"**{title}.** {caption}"]
    return [f"**{title}**", _markdown_rows(block.columns, block.rows), caption]


def _markdown_rows(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    texts = [columns, *([_markdown_cell(cell) for cell in row] for row in rows)]
    lines = ["".join(f"| {_escaped(cell)} " for cell in line) + "|" for line in texts]
    return "\n".join([lines[0], "|" + "---|" * len(columns), *lines[1:]])


def _markdown_cell(cell: Cell) -> str:
    paper = f", paper {cell.paper.text}" if isinstance(cell, Value) and cell.paper else ""
    return cell_text(cell) + paper


def _escaped(text: str) -> str:
    """Return text without active markup; a line break would end a row of a table."""
    one_line = " ".join(text.split())
    return re.sub(r"([\\`*_|~])|\[(?=[^\]]*\]\()", lambda m: "\\" + m.group(0), one_line).replace("<", "&lt;")


PAGE, FILES = "report.md", "report_files"


def write_document(document: Document, folder: Path) -> None:
    """Write `report.md` and `report_files/` into an existing folder, both or neither.

    Raises
    ------
    InputFileError
        If another file has one of the names, or the folder is missing or not writable.
    """
    check_target(folder / PAGE)
    if (folder / FILES).exists() and not (folder / FILES).is_dir():
        raise InputFileError(folder / FILES, "expected a folder of an earlier report, or none")
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as temporary:
        new = Path(temporary)
        _write_all(document, new)
        # A page of one run must not be combined with pictures of another: signals are deferred between the
        # moves.
        with deferred_signals():
            if (folder / FILES).exists():
                (folder / FILES).rename(new / "before")
            for name in (FILES, PAGE):
                (new / name).replace(folder / name)


def _write_all(document: Document, folder: Path) -> None:
    files = folder / FILES
    files.mkdir()
    for block in document.blocks:
        _write(files / f"{block.name}.csv", csv_text(block.columns, block.rows))
        if isinstance(block, Figure):
            with figure_file(files / f"{block.name}.png", *block.size_in) as canvas:
                block.draw(canvas)
    _write(folder / PAGE, markdown_page(document, FILES))


def _write(path: Path, text: str) -> None:
    # A file name that is not UTF-8 contains surrogates, which cannot be written.
    path.write_text(text, encoding="utf-8", errors="replace")
