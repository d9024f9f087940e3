"""Atomic file writing: a temporary name, then a rename.

A reader never meets half a file, and a run that fails leaves nothing behind.
"""

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from worldstate.ground.errors import InputFileError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Lend a temporary sibling of `path`; it takes the name on success and disappears on error.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with atomic_path(Path(folder) / "states.jsonl") as temporary:
    ...         _ = temporary.write_text("{}")
    ...     [p.name for p in Path(folder).iterdir()]
    ['states.jsonl']
    """
    # The sibling keeps the suffix, because writers such as ``numpy.savez`` and ``soundfile`` look at it. It
    # may be made a file or a folder; a folder can only take a name that is free or an empty folder.
    target = Path(path)
    if not target.parent.is_dir():
        raise InputFileError(target, f"expected an existing folder {target.parent} to write into")
    temporary = target.with_name(f".{target.stem}-{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        yield temporary
        _take_name(temporary, target)
    finally:
        _remove(temporary)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 with plain newlines, whole or not at all.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_text(Path(folder) / "note.txt", "hidden")
    ...     (Path(folder) / "note.txt").read_text()
    'hidden'
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def _take_name(temporary: Path, target: Path) -> None:
    if target.is_dir() and not temporary.is_dir():
        raise InputFileError(target, "expected a file name to write to, found a folder")
    temporary.replace(target)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
