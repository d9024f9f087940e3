"""A report of sections as one HTML page, as Markdown, and as files: all or nothing."""

import re
import tempfile
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from worldstate.adapters.files.atomic import check_target, deferred_signals
from worldstate.ground.errors import InputFileError
from worldstate.operations.figure_style import figure_file

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


# A wider figure gets a row of its own, and on a phone a box in which it scrolls.
WIDE_IN = 6.0
_FACTS = Section("Versions and settings")
_STYLE = """
body { margin: 0 auto; max-width: 72rem; padding: 1.5rem 1rem; font: 16px/1.55 system-ui, sans-serif;
  background: #fff; color: #1a1a1a; overflow-wrap: break-word; }
h2 { margin-top: 2.6rem; padding-top: .6rem; border-top: 1px solid #d0d0d0; }
p, figcaption { max-width: 46rem; }
.lead { font-weight: 600; border-left: 4px solid #D55E00; padding: .3rem .8rem; }
.box { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem; text-align: left; vertical-align: top; border-bottom: 1px solid #e3e3e3; }
td.value { white-space: nowrap; }
td span { display: block; color: #666; white-space: normal; min-width: 6rem; }
td span.paper { color: #0a5a94; }
figure { margin: 1rem 0; }
figure.narrow { display: inline-block; width: min(100%, 33rem); vertical-align: top; }
img { width: 100%; }
.wide img { min-width: 44rem; }
"""


def html_page(document: Document, pictures: Mapping[str, bytes], files: str) -> str:
    """Return the page; `pictures` holds the PNG of each figure by name, `files` the folder of the numbers.

    Examples
    --------
    >>> page = html_page(Document("<Streets>", "Simulated.", (Section("Results"),)), {}, "numbers")
    >>> "<h1>&lt;Streets&gt;</h1>" in page, '<h2 id="results">Results</h2>' in page, "<script" in page
    (True, True, False)
    """
    names = [section.title for section in document.sections]
    contents = "".join(f'<li><a href="#{_anchor(name)}">{escape(name)}</a></li>' for name in names)
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        f"<title>{escape(document.title)}</title>",
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body>",
        f'<h1>{escape(document.title)}</h1>\n<p class="lead">{escape(document.lead)}</p>',
        f"<nav><ol>{contents}</ol></nav>",
        *(part for level, one in document.walk() for part in _html_section(level, one, pictures, files)),
        *_html_section(2, _FACTS, pictures, files),
        f"{_html_rows(('', ''), document.facts)}</body></html>\n",
    ]
    return "\n".join(parts)


def _html_section(level: int, section: Section, pictures: Mapping[str, bytes], files: str) -> Iterator[str]:
    yield f'<h{level} id="{_anchor(section.title)}">{escape(section.title)}</h{level}>'
    yield from (f"<p>{escape(one)}</p>" for one in section.text)
    for block in section.blocks:
        shape, body = "wide", _html_body(block, pictures)
        if isinstance(block, Figure) and block.size_in[0] <= WIDE_IN:
            shape = "narrow"
        yield (
            f'<figure class="{shape}"><b>{escape(block.title)}</b>{body}<figcaption>{escape(block.caption)} '
            f'<a href="{escape(files)}/{escape(block.name)}.csv">CSV</a></figcaption></figure>'
        )


def _html_body(block: Block, pictures: Mapping[str, bytes]) -> str:
    if not isinstance(block, Figure):
        return _html_rows(block.columns, block.rows)
    data = b64encode(pictures[block.name]).decode("ascii")
    return f'<div class="box"><img alt="{escape(block.title)}" src="data:image/png;base64,{data}"></div>'


def _html_rows(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "\n".join(f"<tr>{''.join(map(_html_cell, row))}</tr>" for row in rows)
    return f'<div class="box"><table><tr>{head}</tr>\n{body}\n</table></div>'


def _html_cell(cell: Cell) -> str:
    if not isinstance(cell, Value):
        return f"<td>{escape(cell_text(cell))}</td>"
    beside = [cell.interval, cell.note if cell.number != cell.note else ""]
    parts = "".join(f"<span>{escape(part)}</span>" for part in beside if part)
    paper = f'<span class="paper">paper {escape(cell.paper.text)}</span>' if cell.paper else ""
    return f'<td class="value">{escape(cell.number)}{parts}{paper}</td>'


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


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
    parts += [f"## {_FACTS.title}", _markdown_rows(("", ""), document.facts)]
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


PAGE, MARKDOWN, FILES = "report.html", "report.md", "report_files"


def write_document(document: Document, folder: Path) -> None:
    """Write `report.html`, `report.md` and `report_files/` into an existing folder, all or nothing.

    Raises
    ------
    InputFileError
        If one of the names is taken by something else, or the folder is missing or not writable.
    """
    for name in (PAGE, MARKDOWN):
        check_target(folder / name)
    if (folder / FILES).exists() and not (folder / FILES).is_dir():
        raise InputFileError(folder / FILES, "expected a folder of an earlier report, or nothing")
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as temporary:
        new = Path(temporary)
        _write_all(document, new)
        # Pages of one run beside pictures of another would be worse than none: no signal between the moves.
        with deferred_signals():
            if (folder / FILES).exists():
                (folder / FILES).rename(new / "before")
            for name in (FILES, MARKDOWN, PAGE):
                (new / name).replace(folder / name)


def _write_all(document: Document, folder: Path) -> None:
    files, pictures = folder / FILES, {}
    files.mkdir()
    for block in document.blocks:
        _write(files / f"{block.name}.csv", block.csv())
        if isinstance(block, Figure):
            picture = files / f"{block.name}.png"
            with figure_file(picture, *block.size_in) as canvas:
                block.draw(canvas)
            pictures[block.name] = picture.read_bytes()
    _write(folder / PAGE, html_page(document, pictures, FILES))
    _write(folder / MARKDOWN, markdown_page(document, FILES))


def _write(path: Path, text: str) -> None:
    # A file name that is no UTF-8 comes in with surrogates, which cannot be written.
    path.write_text(text, encoding="utf-8", errors="replace")
