"""A report of sections as a page of Markdown with its figures and numbers as files: all or nothing."""

import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from worldstate.adapters.files.file_io import check_target
from worldstate.ground.errors import InputFileError
from worldstate.operations.figure_style import figure_file
from worldstate.simulation.parallel import deferred_signals

from .table import Block, Cell, Figure, Value, cell_text


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, its paragraphs, then tables and figures, then the sections below it."""

    title: str
    text: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = ()
    subsections: "tuple[Section, ...]" = ()

    def walk(self, level: int) -> "Iterator[tuple[int, Section]]":
        """Yield this section and those below it in the order of reading, each with its level."""
        yield level, self
        for one in self.subsections:
            yield from one.walk(level + 1)


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report; the facts (versions, seeds, settings) stand at its end."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    facts: tuple[tuple[str, str], ...] = ()

    def walk(self) -> Iterator[tuple[int, Section]]:
        """Yield every section in the order of reading, with the level of its heading."""
        for section in self.sections:
            yield from section.walk(2)

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Every table and figure, in the order of reading."""
        return tuple(block for _, section in self.walk() for block in section.blocks)


def markdown_page(document: Document, files: str) -> str:
    """Return the text; pictures and numbers lie in the folder `files` beside it.

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
    for level, section in document.walk():
        parts += [f"{'#' * level} {_escaped(section.title)}", *map(_escaped, section.text)]
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
    """Return text in which nothing is markup; a line break would end a row of a table."""
    one_line = " ".join(text.split())
    return re.sub(r"([\\`*_|~])|\[(?=[^\]]*\]\()", lambda m: "\\" + m.group(0), one_line).replace("<", "&lt;")


PAGE, FILES = "report.md", "report_files"


def write_document(document: Document, folder: Path) -> None:
    """Write `report.md` and `report_files/` into an existing folder, all or nothing.

    Raises
    ------
    InputFileError
        If one of the names is taken by something else, or the folder is missing or not writable.
    """
    check_target(folder / PAGE)
    if (folder / FILES).exists() and not (folder / FILES).is_dir():
        raise InputFileError(folder / FILES, "expected a folder of an earlier report, or nothing")
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as temporary:
        new = Path(temporary)
        _write_all(document, new)
        # A page of one run beside pictures of another would be worse than none: no signal between the moves.
        with deferred_signals():
            if (folder / FILES).exists():
                (folder / FILES).rename(new / "before")
            for name in (FILES, PAGE):
                (new / name).replace(folder / name)


def _write_all(document: Document, folder: Path) -> None:
    files = folder / FILES
    files.mkdir()
    for block in document.blocks:
        _write(files / f"{block.name}.csv", block.csv())
        if isinstance(block, Figure):
            with figure_file(files / f"{block.name}.png", *block.size_in) as canvas:
                block.draw(canvas)
    _write(folder / PAGE, markdown_page(document, FILES))


def _write(path: Path, text: str) -> None:
    # A file name that is no UTF-8 comes in with surrogates, which cannot be written.
    path.write_text(text, encoding="utf-8", errors="replace")
