"""Progress on standard error for anything that takes more than two seconds."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from worldstate.adapters.audio.sound_file import Audio

Item = TypeVar("Item")


class Bar:
    """Handle of one running progress bar."""

    def __init__(self, progress: Progress, task: int) -> None:
        self._progress = progress
        self._task = task

    def advance(self, amount: float = 1.0) -> None:
        """Move the bar on by `amount` of its total."""
        self._progress.advance(self._task, amount)  # type: ignore[arg-type]


@contextmanager
def progress_bar(description: str, total: float | None, *, quiet: bool = False) -> Iterator[Bar]:
    """Show a bar on standard error while the block runs; nothing where `quiet` or not a terminal.

    Examples
    --------
    >>> with progress_bar("working", 3, quiet=True) as bar:
    ...     bar.advance()
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=quiet) as progress:
        yield Bar(progress, progress.add_task(description, total=total))


@contextmanager
def sound_bar(audio: "Audio") -> Iterator[Bar]:
    """Show a bar that counts the seconds of an open recording; of a pipe nobody knows how many there are."""
    known = audio.duration_s > 1.0
    with progress_bar(f"listening to {audio.path.name}", audio.duration_s if known else None) as bar:
        yield bar


def track(items: Iterable[Item], description: str, total: float | None = None) -> Iterator[Item]:
    """Yield the items, a step of a progress bar for each."""
    with progress_bar(description, total) as bar:
        for item in items:
            yield item
            bar.advance()
