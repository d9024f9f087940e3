"""What a report is made of: values with intervals, tables, figures, sections; no markup, no files."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MISSING = "\u2013"


@dataclass(frozen=True, slots=True)
class Value:
    """A figure with its interval and the paper's beside it; NaN where there is none.

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
    note: str = ""  # Said after the value, or in its place
    paper: "Value | None" = None

    @property
    def number(self) -> str:
        """Value alone, rounded; its note, or a dash, where there is none."""
        return self._rounded(self.value) if math.isfinite(self.value) else self.note or MISSING

    @property
    def interval(self) -> str:
        """Interval alone, empty where there is none."""
        if not (math.isfinite(self.value) and math.isfinite(self.low) and math.isfinite(self.high)):
            return ""
        return f"[{self._rounded(self.low)}, {self._rounded(self.high)}]"

    @property
    def text(self) -> str:
        """Value, interval and note in one line."""
        note = f"({self.note})" if self.note and math.isfinite(self.value) else ""
        return " ".join(filter(None, (self.number, self.interval, note)))

    def _rounded(self, value: float) -> str:
        # A rounded -0.001 would print as -0.00; adding zero takes the sign away.
        return f"{round(value, self.digits) + 0.0:.{self.digits}f}"


Cell: TypeAlias = Value | str


@dataclass(frozen=True, slots=True)
class ReportTable:
    """Rows of cells; the name is that of its CSV file, the columns carry their units."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Curves:
    """Numbers behind a figure, as the rows of its CSV file."""

    columns: tuple[str, ...]
    rows: Sequence[Sequence[float | str]]


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """One picture; narrow ones (below 6 inches) stand side by side where there is room."""

    name: str
    title: str
    caption: str
    draw: "Callable[[Figure], None]"
    numbers: Curves
    size_in: tuple[float, float] = (4.4, 3.7)


Block: TypeAlias = ReportTable | ReportFigure


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, its paragraphs, then tables and figures, then the sections below it."""

    title: str
    text: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = ()
    subsections: "tuple[Section, ...]" = ()

    @property
    def all_blocks(self) -> tuple[Block, ...]:
        """Its own and those of the sections below it, in the order of reading."""
        return self.blocks + tuple(block for one in self.subsections for block in one.all_blocks)


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report; the facts (versions, seeds, settings) stand at its end."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    facts: tuple[tuple[str, str], ...] = ()

    @property
    def all_blocks(self) -> tuple[Block, ...]:
        """Every table and figure, in the order of reading."""
        return tuple(block for section in self.sections for block in section.all_blocks)
