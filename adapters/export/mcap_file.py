"""MCAP files of world-states, for Foxglove and whatever else reads MCAP."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.errors import InputFileError, MissingExtraError

from .log_message import SNAPSHOT_TOPIC, LogMessage, LogSink


@contextmanager
def mcap_file(path: Path) -> Iterator[LogSink]:
    """Lend a function that writes messages to an MCAP file, which takes its name when the block ends."""
    _mcap()
    from mcap.writer import Writer

    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels: dict[str, int] = {}

        def write(message: LogMessage) -> None:
            if message.topic not in channels:
                schema = writer.register_schema(message.schema_name, "jsonschema", message.schema)
                channels[message.topic] = writer.register_channel(message.topic, "json", schema)
            writer.add_message(channels[message.topic], message.stamp_ns, message.data, message.stamp_ns)

        yield write
        writer.finish()


def read_snapshot_lines(path: Path) -> Iterator[str]:
    """Yield the snapshots of an MCAP file as the text that was written, in the order of their writing."""
    mcap = _mcap()
    from mcap.reader import make_reader

    with path.open("rb") as file:
        try:
            # By time of writing and not by stamp: a late measurement may have moved a stamp back.
            for _, _, message in make_reader(file).iter_messages([SNAPSHOT_TOPIC], log_time_order=False):
                yield message.data.decode()
        except (mcap.exceptions.McapError, UnicodeDecodeError) as error:
            raise InputFileError(path, f"expected an MCAP file of snapshots ({error})") from error


def _mcap() -> Any:
    try:
        import mcap.exceptions
    except ImportError as error:
        raise MissingExtraError("mcap", "mcap") from error
    return mcap
