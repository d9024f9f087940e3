"""A document as files: the page, the same as Markdown, every picture and all numbers."""

import tempfile
from pathlib import Path

from worldstate.adapters.files.atomic import check_target, deferred_signals
from worldstate.ground.errors import InputFileError
from worldstate.operations.figure_style import figure_file

from .document import Document
from .pages import html_page, markdown_page
from .table import Figure

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
