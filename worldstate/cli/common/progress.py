"""Progress on standard error: a bar in a terminal, a line every 30 seconds elsewhere."""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from worldstate import adapters, frontend, operations
from worldstate.ground.extras import has_extra

from .output import printable, say

if TYPE_CHECKING:
    from worldstate.adapters.audio.sound_file import Audio

Item = TypeVar("Item")
EVERY_S = 30.0


class Bar:
    """Handle of one running progress bar."""

    def __init__(self, total: float | None) -> None:
        self.total, self.stage = total, ""
        self.done = 0.0
        self.shown: Callable[[float], object] = lambda amount: None

    def advance(self, amount: float = 1.0) -> None:
        """Move the bar on by `amount` of its total."""
        self.done += amount
        self.shown(amount)

    def go_on(self, stage: str, amount: float) -> None:
        """Set the name of the next stage, and advance the bar by the amount of the last stage."""
        self.stage = f": {stage}"
        self.advance(amount)


@contextmanager
def progress_bar(description: str, total: float | None, *, quiet: bool = False) -> Iterator[Bar]:
    """Show the progress of a block on standard error; with `quiet` show nothing.

    Without a terminal, or without the package rich, it is a line every 30 seconds.

    Examples
    --------
    >>> with progress_bar("working", 3, quiet=True) as bar:
    ...     bar.advance()
    """
    bar = Bar(total)
    if quiet:
        yield bar
        return
    with _drawn(description, bar) if can_draw() else _told(description, bar):
        yield bar


def can_draw() -> bool:
    """Return whether standard error is a terminal and rich is installed."""
    return sys.stderr.isatty() and has_extra("rich")


@contextmanager
def _drawn(description: str, bar: Bar) -> Iterator[None]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    told = TextColumn("{task.description}", markup=False)
    columns = told, BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(printable(description), total=bar.total)
        bar.shown = lambda amount: progress.update(
            task, advance=amount, description=printable(description + bar.stage)
        )
        yield


@contextmanager
def _told(description: str, bar: Bar) -> Iterator[None]:
    # A thread, because minutes may pass between two advances.
    ended, begun_s = threading.Event(), time.monotonic()

    def tell() -> None:
        while not ended.wait(EVERY_S):
            gone_s = time.monotonic() - begun_s
            share = f"{100.0 * bar.done / bar.total:.0f} %" if bar.total else f"{bar.done:g} done"
            left_s = gone_s * (bar.total / bar.done - 1.0) if bar.total and bar.done else None
            left = "" if left_s is None else f", some {left_s:.0f} s left"
            say(f"{description}{bar.stage}: {share} after {gone_s:.0f} s{left}")

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()


@contextmanager
def sound_bar(audio: "Audio") -> Iterator[Bar]:
    """Show a bar in seconds of an open recording; the length of a pipe is unknown."""
    known = audio.duration_s > 1.0
    with progress_bar(f"listening to {audio.path.name}", audio.duration_s if known else None) as bar:
        yield bar


def track(items: Iterable[Item], description: str, total: float | None = None) -> Iterator[Item]:
    """Yield the items and advance a progress bar by each."""
    with progress_bar(description, total) as bar:
        for item in items:
            yield item
            bar.advance()


def listen_with_progress(
    source: "adapters.Source",
    *,
    states_path: Path | None,
    on_hop: "Callable[[adapters.Step], None]" = lambda step: None,
) -> "operations.RecordingReport":
    """Run a recording to its end with a progress bar in seconds of sound."""
    from worldstate.adapters.audio.sound_file import RawPcm, open_sound

    hops = None
    if not isinstance(source.sound, RawPcm):
        with open_sound(source.sound, channels=source.array.channels, strict=False) as audio:
            hops = 10.0 * audio.duration_s
    with progress_bar(f"listening to {source.audio_path.name}", hops) as bar:

        def follow(step: "adapters.Step") -> None:
            on_hop(step)
            bar.advance()

        return operations.run_recording(source, states_path=states_path, on_hop=follow)


def read_streams(
    inputs: Iterable[Path], array: "frontend.MicrophoneArray | None", model: Path | None
) -> "list[operations.HopTable]":
    """Return the hop streams of data sets, recordings, sound files and files of --save-streams."""
    from worldstate.operations.calibration.cueing_calibration import find_inputs, read_input

    found = [item for path in inputs for item in find_inputs(path)]
    read = track(found, "listening", len(found))
    return [stream for path in read for stream in read_input(path, array=array, model=model)]
