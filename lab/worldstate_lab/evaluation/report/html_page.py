"""A report as one HTML page: style and pictures inside, no script, nothing from the network."""

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping
from html import escape
from itertools import groupby

from .document import Block, Cell, Document, ReportFigure, ReportTable, Section, Value

# Wider figures get a row of their own, and on a phone a box in which they scroll.
WIDE_IN = 6.0
_STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 72rem; padding: 1.5rem 1rem 4rem; background: #fff; color: #1a1a1a;
  font: 16px/1.55 system-ui, "Segoe UI", Roboto, "Liberation Sans", sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .6rem; }
h2 { font-size: 1.3rem; margin: 2.6rem 0 .6rem; padding-top: .6rem; border-top: 1px solid #d0d0d0; }
h3 { font-size: 1.08rem; margin: 1.8rem 0 .4rem; }
p { max-width: 46rem; margin: .5rem 0; }
.lead { font-weight: 600; border-left: 4px solid #D55E00; padding: .3rem .8rem; background: #fdf4ee; }
nav ol { padding-left: 1.4rem; columns: 18rem; margin: .6rem 0; }
a { color: #0a5a94; }
.table { margin: 1.4rem 0; }
.table h4, figcaption b { font-size: 1rem; margin: 0 0 .35rem; font-weight: 600; }
.box { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem; text-align: left; vertical-align: top; border-bottom: 1px solid #e3e3e3; }
tbody td:first-child, thead th:first-child { position: sticky; left: 0; background: #fff; }
thead th { border-bottom: 2px solid #555; vertical-align: bottom; }
td.text { min-width: 9rem; max-width: 26rem; }
td.value { white-space: nowrap; }
td.note { min-width: 6rem; color: #666; }
td span { display: block; color: #666; font-size: .92em; }
td span.paper { color: #0a5a94; }
td span.note { white-space: normal; min-width: 6rem; }
.caption, figcaption { color: #444; font-size: .88rem; max-width: 46rem; }
.figures { display: grid; gap: 1.4rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); }
figure { margin: 1rem 0; }
.figures figure { max-width: 33rem; }
img { display: block; width: 100%; height: auto; }
.wide img { min-width: 44rem; }
@media print { body { max-width: none; } .box { overflow: visible; } }
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
    page = _Page(pictures, files)
    facts = "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in document.facts)
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        f"<title>{escape(document.title)}</title>",
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{escape(document.title)}</h1>",
        f'<p class="lead">{escape(document.lead)}</p>',
        f"<nav><ol>{contents}</ol></nav>",
        *(page.section(one, 2) for one in document.sections),
        f'<h2 id="facts">Versions and settings</h2><div class="box"><table>{facts}</table></div>',
        "</body></html>\n",
    ]
    return "\n".join(parts)


class _Page:
    """The parts of a page, with what they share: pictures, and the folder of the numbers."""

    def __init__(self, pictures: Mapping[str, bytes], files: str) -> None:
        self.pictures, self.files = pictures, files

    def section(self, section: Section, level: int) -> str:
        anchor = f' id="{_anchor(section.title)}"' if level == 2 else ""
        return "\n".join(
            [
                f"<h{level}{anchor}>{escape(section.title)}</h{level}>",
                *(f"<p>{escape(one)}</p>" for one in section.text),
                *self._blocks(section.blocks),
                *(self.section(one, level + 1) for one in section.subsections),
            ]
        )

    def _blocks(self, blocks: Iterable[Block]) -> Iterable[str]:
        for beside, some in groupby(blocks, key=_stands_beside):
            parts = "\n".join(
                self._figure(one) if isinstance(one, ReportFigure) else self._table(one) for one in some
            )
            yield f'<div class="figures">\n{parts}\n</div>' if beside else parts

    def _table(self, table: ReportTable) -> str:
        head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
        rows = "\n".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in table.rows)
        return (
            f'<div class="table"><h4>{escape(table.title)}</h4><div class="box"><table>'
            f"<thead><tr>{head}</tr></thead><tbody>\n{rows}\n</tbody></table></div>"
            f'<p class="caption">{escape(table.caption)} {self._numbers(table.name)}</p></div>'
        )

    def _figure(self, figure: ReportFigure) -> str:
        data = b64encode(self.pictures[figure.name]).decode("ascii")
        shape = "wide" if figure.size_in[0] > WIDE_IN else "narrow"
        image = f'<img alt="{escape(figure.title)}" src="data:image/png;base64,{data}">'
        caption = f"<b>{escape(figure.title)}.</b> {escape(figure.caption)} {self._numbers(figure.name)}"
        box = f'<div class="box">{image}</div>'
        return f'<figure class="{shape}">{box}<figcaption>{caption}</figcaption></figure>'

    def _numbers(self, name: str) -> str:
        return f'<a href="{escape(self.files)}/{escape(name)}.csv">CSV</a>'


def _stands_beside(block: Block) -> bool:
    return isinstance(block, ReportFigure) and block.size_in[0] <= WIDE_IN


def _cell(cell: Cell) -> str:
    if isinstance(cell, str):
        return f'<td class="text">{escape(cell)}</td>'
    # A number never breaks, a reason for its absence may.
    kind = "value" if cell.number != cell.note else "note"
    note = f'<span class="note">{escape(cell.note)}</span>' if cell.note and kind == "value" else ""
    interval = f"<span>{escape(cell.interval)}</span>" if cell.interval else ""
    return f'<td class="{kind}">{escape(cell.number)}{interval}{note}{_paper(cell.paper)}</td>'


def _paper(value: Value | None) -> str:
    return "" if value is None else f'<span class="paper">paper {escape(value.text)}</span>'


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
