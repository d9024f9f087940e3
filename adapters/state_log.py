"""Snapshots of a log: JSON lines of `run --out`, MCAP, a bag of ROS 2, or hops of `hear`."""

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
# The last hop of a recording ends at most one hop before its end.
_SLACK_NS = nanoseconds(0.1)
# An MCAP file begins with its magic number and the header, whose first field is the profile.
_HEADER_BYTES, _ROS_PROFILE = 64, b"\x04\x00\x00\x00ros2"
PARQUET = ".parquet"  # Suffix of the tables of `hear`
BATCH_ROWS = 4096  # About 20 MB, because a row of hops has about 5 kB
_PACKED = b"\x1f\x8b"
_EMPTY = "expected snapshots, got none: `worldstate run --out` writes them"


def read(log: Path | str) -> list[WorldState]:
    """Return the world-states of a log.

    Parameters
    ----------
    log : path
        JSON lines of `worldstate run --out`, MCAP or ROS 2 bag of `--export`, or hops of `hear` as Parquet.

    Raises
    ------
    InputFileError
        If the file is missing or holds no snapshot.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, "states.jsonl").write_text(WorldState(100_000_000, 1).to_json())
    ...     read(f"{folder}/states.jsonl")[0].stamp_ns
    100000000
    """
    return [state for _, state in read_log(Path(log))]


def read_log(path: Path) -> Iterator[tuple[str, WorldState]]:
    """Yield every snapshot with its line of JSON; refuse a log without snapshots.

    Snapshots of schema 3.x are upgraded, and so are their lines.
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
    """Yield each image or block of sound with its time stamp, ns; only MCAP of `--export` contains them."""
    kinds: dict[str, type[CompressedImage] | type[RawAudio]]
    kinds = {IMAGE_TOPIC: CompressedImage, SOUND_TOPIC: RawAudio}
    with refused_as_file(path):
        for stamp_ns, topic, text in read_messages(path, *kinds) if is_own_mcap(path) else ():
            yield stamp_ns, decode(kinds[topic], decode_json(text, topic), topic)


def upgraded_messages(path: Path) -> Iterator[LogMessage]:
    """Yield every message of an MCAP file of `--export` in the form of this version, in order."""
    # Messages that follow from a snapshot are made again; spatial power, images and sound are kept.
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
    """Yield the snapshots of a Parquet file of `worldstate hear --hops`."""
    arrow, parquet = optional("pyarrow"), optional("pyarrow.parquet")
    try:
        with parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(BATCH_ROWS, columns=["snapshot"]):
                yield from map(str, batch.column("snapshot").to_pylist())
    except (OSError, KeyError, arrow.ArrowException) as error:
        raise InputFileError(path, f"expected a table of hops with snapshots ({error})") from error


def is_own_mcap(path: Path) -> bool:
    """Return whether a log is an MCAP file of `--export mcap`, and not a bag of ROS 2."""
    if not path.is_file():
        return False
    with plain_file(path, "snapshots") as file:
        head = file.read(_HEADER_BYTES)
    # The name of a rotated file may end with a number.
    return (path.suffix.lower() == ".mcap" or head.startswith(MCAP_MAGIC)) and _ROS_PROFILE not in head


def read_state_near(path: Path, stamp_ns: int, *, anywhere: bool = False) -> WorldState:
    """Return the snapshot nearest to a time, which must be within the log unless `anywhere`."""
    with refused_as_file(path):
        # Only the returned snapshot is decoded: an hour has 36,000.
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
            raise InputFileError(path, f"expected a time from {span}, the span of its snapshots, {got}")
        return WorldState.from_dict(nearest[1])


def _json_lines(path: Path) -> Iterator[str]:
    """Yield every line of the file without its end; skip blank, cut and damaged lines."""
    left_out = 0
    with plain_file(path, "snapshots") as file:
        for number, line in enumerate(iter(partial(file.readline, MOST_CHARACTERS), b""), start=1):
            # The first line may be cut if only the end of a log was copied, and the last one while a run
            # writes the log.
            inner = number > 1 and line.endswith((b"}\n", b"}\r\n")) and line.startswith(b"{")
            # The decoder refuses a complete line that is too long or has no valid text; its error gives the
            # line number.
            if inner or len(line) == MOST_CHARACTERS or not _is_cut(line):
                yield line.decode("utf-8-sig", "replace").strip()
            elif number == 1 and line.startswith(_PACKED):
                raise InvalidArgumentError("line 1: expected UTF-8, unpacked as by gunzip")
            else:
                left_out += bool(line.strip())
    if left_out:
        _LOG.warning("%s: %d cut or damaged lines are left out", path, left_out)


def _is_cut(line: bytes) -> bool:
    try:
        decode_json(line.decode("utf-8-sig"), "")
    except (UnicodeDecodeError, InvalidArgumentError):
        return True
    return False


def _records(path: Path) -> Iterator[tuple[int, object]]:
    """Yield time stamp and content of every snapshot."""
    for number, line in enumerate(_lines(path), start=1):
        value = decode_json(line, f"line {number}")
        stamp_ns = value.get("stamp_ns") if isinstance(value, dict) else None
        # Without a time stamp, the reader of snapshots raises an error that names the missing key.
        yield stamp_ns if isinstance(stamp_ns, int) else WorldState.from_dict(value).stamp_ns, value
