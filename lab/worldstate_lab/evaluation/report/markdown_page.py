"""A report as Markdown, with tables that any viewer knows and pictures as files."""

import re
from collections.abc import Sequence

from .document import Block, Cell, Document, ReportTable, Section


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
    for section in document.sections:
        parts += _section(section, 2, files)
    parts += ["## Versions and settings", _rows(("", ""), document.facts)]
    return "\n\n".join(parts) + "\n"


def _section(section: Section, level: int, files: str) -> list[str]:
    parts = [f"{'#' * level} {_escaped(section.title)}", *map(_escaped, section.text)]
    for block in section.blocks:
        parts += _block(block, files)
    for one in section.subsections:
        parts += _section(one, level + 1, files)
    return parts


def _block(block: Block, files: str) -> list[str]:
    title, numbers = _escaped(block.title), f"[CSV]({files}/{block.name}.csv)"
    caption = f"{_escaped(block.caption)} {numbers}".strip()
    if isinstance(block, ReportTable):
        return [f"**{title}**", _rows(block.columns, block.rows), caption]
    return [f"![{title}]({files}/{block.name}.png)", f"**{title}.** {caption}"]


def _rows(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    lines = [columns, ["---"] * len(columns), *([_cell(cell) for cell in row] for row in rows)]
    lines[0] = [_escaped(column) for column in columns]
    return "\n".join(f"|{'|'.join(_padded(cell) for cell in line)}|" for line in lines)


def _padded(cell: str) -> str:
    return cell if cell == "---" else f" {cell} "


def _cell(cell: Cell) -> str:
    if isinstance(cell, str):
        return _escaped(cell)
    paper = f", paper {cell.paper.text}" if cell.paper else ""
    return _escaped(cell.text + paper)


def _escaped(text: str) -> str:
    """Text in which nothing is markup; a line break would end a row of a table."""
    one_line = " ".join(text.split())
    return re.sub(r"([\\`*_|~])|\[(?=[^\]]*\]\()", lambda m: "\\" + m.group(0), one_line).replace("<", "&lt;")
