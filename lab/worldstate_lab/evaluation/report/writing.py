"""A report as files: the page, the same as Markdown, every picture and all numbers."""

import tempfile
from pathlib import Path

from worldstate.adapters.files.atomic import check_target, deferred_signals
from worldstate.ground.errors import InputFileError
from worldstate.operations.figure_style import figure_file

from .csv_table import csv_text
from .document import Document, ReportFigure
from .html_page import html_page
from .markdown_page import markdown_page

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


def _write(path: Path, text: str) -> None:
    # A file name that is no UTF-8 comes in with surrogates, which cannot be written.
    path.write_text(text, encoding="utf-8", errors="replace")


def _write_all(document: Document, folder: Path) -> None:
    files = folder / FILES
    files.mkdir()
    pictures = {}
    for block in document.all_blocks:
        figure = block if isinstance(block, ReportFigure) else None
        numbers = block.numbers if isinstance(block, ReportFigure) else block
        _write(files / f"{block.name}.csv", csv_text(numbers))
        if figure:
            pictures[block.name] = _picture(figure, files / f"{block.name}.png")
    _write(folder / PAGE, html_page(document, pictures, FILES))
    _write(folder / MARKDOWN, markdown_page(document, FILES))


def _picture(figure: ReportFigure, path: Path) -> bytes:
    with figure_file(path, *figure.size_in) as canvas:
        figure.draw(canvas)
    return path.read_bytes()
