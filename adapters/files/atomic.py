"""Atomic file writing: a temporary name, then a rename.

A reader never meets half a file, and a run that fails leaves nothing behind. A link is followed: what it
points to is replaced, and the link stays. Devices, pipes and folders are never replaced.
"""

import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from worldstate.ground.errors import InputFileError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Lend a temporary sibling of `path`; it takes the name on success and disappears on error."""
    # The sibling keeps the suffix, because writers such as `numpy.savez` and `soundfile` look at it.
    target = check_target(path)
    temporary = target.with_name(f".{target.stem[:100]}-{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        yield temporary
        if target.exists():
            shutil.copymode(target, temporary)
        temporary.replace(target)
    finally:
        try:
            _remove(temporary)
        except BaseException:  # a second Ctrl-C; the first one is on its way up already
            _remove(temporary)
            raise


def check_target(path: str | Path) -> Path:
    """Return where output to `path` would go, links followed; refuse what is neither free nor a plain file.

    Examples
    --------
    >>> check_target("/dev/null")
    Traceback (most recent call last):
    worldstate.ground.errors.InputFileError: /dev/null: expected a file to write to, found a device or pipe
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise InputFileError(path, f"expected an existing folder {target.parent} to write into")
    if target.is_dir():
        raise InputFileError(path, "expected a file name to write to, found a folder")
    if os.path.lexists(target) and not target.is_file():
        raise InputFileError(path, "expected a file to write to, found a device or pipe")
    there = target if target.exists() else target.parent
    if not (os.access(there, os.W_OK) and os.access(target.parent, os.W_OK | os.X_OK)):
        raise InputFileError(path, "expected a place to write to, permission denied")
    return target


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 with plain newlines, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


@contextmanager
def line_writer(path: str | Path) -> Iterator[Callable[[str], None]]:
    """Lend a function that writes lines of UTF-8 to a file, which takes its name at the end."""
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        yield lambda line: print(line, file=file)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
