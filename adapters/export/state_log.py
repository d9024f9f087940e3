"""Snapshots of a log, whichever form it has: JSON lines, or MCAP."""

from collections.abc import Iterator
from pathlib import Path

from worldstate.adapters.files.json_file import refused_as_file
from worldstate.adapters.files.states_file import state_lines
from worldstate.ground.errors import InputFileError
from worldstate.state import WorldState

from .mcap_file import read_snapshot_lines


def read_log(path: Path) -> Iterator[tuple[str, WorldState]]:
    """Yield every snapshot, beside the line of JSON that was written; refuse a log without any."""
    empty = True
    with refused_as_file(path):
        for line in read_snapshot_lines(path) if path.suffix.lower() == ".mcap" else state_lines(path):
            yield line, WorldState.from_json(line)
            empty = False
    if empty:
        raise InputFileError(path, "expected snapshots, got none: `worldstate run --out` writes them")
