"""JSON-lines files of snapshots, as `worldstate run --out` writes them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.serialisation import MOST_CHARACTERS, decode_json
from worldstate.ground.values import nanoseconds, seconds
from worldstate.state import WorldState

from .atomic import atomic_path
from .text_file import refused_as_file

# A hop: the last decision of a recording ends up to so long before it does.
_SLACK_NS = nanoseconds(0.1)


def read_state_near(path: str | Path, stamp_ns: int) -> WorldState:
    """Return the snapshot of a file that is nearest to a time, which must not lie outside the file's."""
    with refused_as_file(path):
        # Only the one that is asked for is read whole: an hour has 36,000.
        first_ns = last_ns = nearest = None
        for at_ns, value in _records(path):
            first_ns, last_ns = at_ns if first_ns is None else first_ns, at_ns
            if nearest is None or abs(at_ns - stamp_ns) < abs(nearest[0] - stamp_ns):
                nearest = at_ns, value
            elif at_ns > stamp_ns >= first_ns:
                break
        if nearest is None or first_ns is None or last_ns is None:
            raise InputFileError(path, "expected snapshots, got none: `worldstate run --out` writes them")
        if not first_ns - _SLACK_NS <= stamp_ns <= last_ns + _SLACK_NS:
            raise InputFileError(
                path,
                f"expected a time from {seconds(first_ns):.1f} to {seconds(last_ns):.1f} s, in which it has "
                f"snapshots, got {seconds(stamp_ns):.1f} s",
            )
        return WorldState.from_dict(nearest[1])


@contextmanager
def states_writer(path: Path | None) -> Iterator[Callable[[str], None]]:
    """Lend a function that writes a snapshot's line; without a path one that writes nothing."""
    if path is None:
        yield lambda line: None
        return
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        yield lambda line: print(line, file=file)


def state_lines(path: str | Path) -> Iterator[str]:
    """Yield every line of the file, without its end."""
    with Path(path).open("rb") as file:
        for number, line in enumerate(iter(partial(file.readline, MOST_CHARACTERS), b""), start=1):
            try:
                yield line.decode().rstrip("\n")
            except UnicodeDecodeError as error:
                raise InvalidArgumentError(f"line {number}: expected UTF-8") from error


def _records(path: str | Path) -> Iterator[tuple[int, object]]:
    """Yield stamp and content of every line."""
    for number, line in enumerate(state_lines(path), start=1):
        value = decode_json(line, f"line {number}")
        stamp_ns = value.get("stamp_ns") if isinstance(value, dict) else None
        # What has no stamp is refused by the reader of snapshots, which says what is missing.
        yield stamp_ns if isinstance(stamp_ns, int) else WorldState.from_dict(value).stamp_ns, value
