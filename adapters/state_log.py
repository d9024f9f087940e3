"""Snapshots of a log in any form: JSON lines of `run --out`, MCAP, a bag of ROS 2, hops of `hear`."""

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from worldstate.adapters.export.log_messages import (
    IMAGE_TOPIC,
    MCAP_MAGIC,
    SNAPSHOT_TOPIC,
    SOUND_TOPIC,
    SRP_TOPIC,
    LogMessage,
    read_messages,
    state_messages,
)
from worldstate.adapters.export.scene import CompressedImage, RawAudio, SceneUpdate
from worldstate.adapters.files.file_io import plain_file, refused_as_file
from worldstate.adapters.ros.bag_input import is_bag
from worldstate.adapters.ros.bag_writer import bag_snapshot_lines
from worldstate.ground import InputFileError, InvalidArgumentError, nanoseconds, seconds
from worldstate.ground.extras import optional
from worldstate.ground.serialisation import MOST_CHARACTERS, decode, decode_json
from worldstate.state import WorldState
from worldstate.state.world_state import is_former

_LOG = logging.getLogger(__name__)
# A hop: the last decision of a recording ends up to so long before it does.
_SLACK_NS = nanoseconds(0.1)
# An MCAP file begins with its magic number, then the header, of which the profile comes first.
_HEADER_BYTES, _ROS_PROFILE = 64, b"\x04\x00\x00\x00ros2"
PARQUET = ".parquet"  # Of the tables of `hear`
BATCH_ROWS = 4096  # Of one of them; a row of hops has some 5 kB: 20 MB at a time
_PACKED = b"\x1f\x8b"
_EMPTY = "expected snapshots, got none: `worldstate run --out` writes them"


def read_log(path: Path) -> Iterator[tuple[str, WorldState]]:
    """Yield every snapshot, beside the line of JSON that was written; refuse a log without any.

    One of schema 3.x is upgraded, and so is its line.
    """
    empty = True
    with refused_as_file(path):
        for line in _lines(path):
            value = decode_json(line, "snapshot")
            state = WorldState.from_dict(value)
            yield state.to_json() if is_former(value) else line, state
            empty = False
    if empty:
        raise InputFileError(path, _EMPTY)


def read_media(path: Path) -> Iterator[tuple[int, CompressedImage | RawAudio]]:
    """Yield each image or block of sound of a log with its stamp, ns; only MCAP of `--export` holds any."""
    kinds: dict[str, type[CompressedImage] | type[RawAudio]]
    kinds = {IMAGE_TOPIC: CompressedImage, SOUND_TOPIC: RawAudio}
    with refused_as_file(path):
        for stamp_ns, topic, text in read_messages(path, *kinds) if is_own_mcap(path) else ():
            yield stamp_ns, decode(kinds[topic], decode_json(text, topic), topic)


def upgraded_messages(path: Path) -> Iterator[LogMessage]:
    """Yield every message of an MCAP file of `--export` as this version writes it, in its order."""
    # What follows from a snapshot is written anew; the power of the sound, images and sound are not.
    kinds = {SRP_TOPIC: SceneUpdate, IMAGE_TOPIC: CompressedImage, SOUND_TOPIC: RawAudio}
    with refused_as_file(path):
        for stamp_ns, topic, text in read_messages(path, SNAPSHOT_TOPIC, *kinds):
            if topic == SNAPSHOT_TOPIC:
                yield from state_messages(WorldState.from_json(text))
            else:
                yield LogMessage(topic, stamp_ns, decode(kinds[topic], decode_json(text, topic), topic))


def _lines(path: Path) -> Iterator[str]:
    if path.suffix == PARQUET:
        return _snapshots(path)
    if is_own_mcap(path):
        return (text for _, _, text in read_messages(path, SNAPSHOT_TOPIC))
    return bag_snapshot_lines(path) if is_bag(path) else _json_lines(path)


def _snapshots(path: Path) -> Iterator[str]:
    """Yield the snapshots of a Parquet file that `worldstate hear --hops` wrote."""
    arrow, parquet = optional("pyarrow"), optional("pyarrow.parquet")
    try:
        with parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(BATCH_ROWS, columns=["snapshot"]):
                yield from map(str, batch.column("snapshot").to_pylist())
    except (OSError, KeyError, arrow.ArrowException) as error:
        raise InputFileError(path, f"expected a table of hops with snapshots ({error})") from error


def is_own_mcap(path: Path) -> bool:
    """Return whether a log is an MCAP file that `--export mcap` writes, and not one of ROS 2."""
    if not path.is_file():
        return False
    with plain_file(path, "snapshots") as file:
        head = file.read(_HEADER_BYTES)
    # The name of a rotated one may end with a number.
    return (path.suffix.lower() == ".mcap" or head.startswith(MCAP_MAGIC)) and _ROS_PROFILE not in head


def read_state_near(path: Path, stamp_ns: int, *, anywhere: bool = False) -> WorldState:
    """Return the snapshot of a log that is nearest to a time, which lies within the log's or anywhere."""
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
            raise InputFileError(path, _EMPTY)
        if not (anywhere or first_ns - _SLACK_NS <= stamp_ns <= last_ns + _SLACK_NS):
            span = f"{seconds(first_ns):.1f} to {seconds(last_ns):.1f} s"
            got = f"got {seconds(stamp_ns):.1f} s"
            raise InputFileError(path, f"expected a time from {span}, in which it has snapshots, {got}")
        return WorldState.from_dict(nearest[1])


def _json_lines(path: Path) -> Iterator[str]:
    """Yield every line of the file, without its end; blank ones, and those cut or damaged, are left out."""
    left_out = 0
    with plain_file(path, "snapshots") as file:
        for number, line in enumerate(iter(partial(file.readline, MOST_CHARACTERS), b""), start=1):
            # What keeps the last bytes of a log begins within a line; a running one ends within one.
            inner = number > 1 and line.endswith((b"}\n", b"}\r\n")) and line.startswith(b"{")
            # Written with bytes that are no text, or so long, a whole line is refused by its number.
            if inner or len(line) == MOST_CHARACTERS or not _is_cut(line):
                yield line.decode("utf-8-sig", "replace").strip()
            elif number == 1 and line.startswith(_PACKED):
                raise InvalidArgumentError("line 1: expected UTF-8, unpacked as by gunzip")
            else:
                left_out += bool(line.strip())
    if left_out:
        _LOG.warning("%s: %d lines that are cut or damaged are left out", path, left_out)


def _is_cut(line: bytes) -> bool:
    try:
        decode_json(line.decode("utf-8-sig"), "")
    except (UnicodeDecodeError, InvalidArgumentError):
        return True
    return False


def _records(path: Path) -> Iterator[tuple[int, object]]:
    """Yield stamp and content of every snapshot."""
    for number, line in enumerate(_lines(path), start=1):
        value = decode_json(line, f"line {number}")
        stamp_ns = value.get("stamp_ns") if isinstance(value, dict) else None
        # What has no stamp is refused by the reader of snapshots, which says what is missing.
        yield stamp_ns if isinstance(stamp_ns, int) else WorldState.from_dict(value).stamp_ns, value
