"""Snapshots of a log, whichever form it has: JSON lines, MCAP, or a bag of ROS 2."""

from collections.abc import Iterator
from pathlib import Path

from worldstate.adapters.export.mcap_file import read_snapshot_lines
from worldstate.adapters.files.states_file import state_lines
from worldstate.adapters.files.text_file import refused_as_file
from worldstate.adapters.ros.bag_reader import is_bag
from worldstate.adapters.ros.state_bag import bag_snapshot_lines
from worldstate.ground.errors import InputFileError
from worldstate.state import WorldState

# An MCAP file begins with its magic number, then the header, of which the profile comes first.
_HEADER_BYTES, _ROS_PROFILE = 64, b"\x04\x00\x00\x00ros2"


def read_log(path: Path) -> Iterator[tuple[str, WorldState]]:
    """Yield every snapshot, beside the line of JSON that was written; refuse a log without any."""
    empty = True
    with refused_as_file(path):
        for line in _lines(path):
            yield line, WorldState.from_json(line)
            empty = False
    if empty:
        raise InputFileError(path, "expected snapshots, got none: `worldstate run --out` writes them")


def _lines(path: Path) -> Iterator[str]:
    if path.suffix.lower() == ".mcap" and path.is_file() and not _is_of_ros(path):
        return read_snapshot_lines(path)
    return bag_snapshot_lines(path) if is_bag(path) else state_lines(path)


def _is_of_ros(path: Path) -> bool:
    with path.open("rb") as file:
        return _ROS_PROFILE in file.read(_HEADER_BYTES)
