"""Open a bag of ROS 2, find a topic in it, and read its messages."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from worldstate.ground.errors import InputFileError, WorldstateError

from .message_types import typestore

METADATA_NAME, STORAGE_SUFFIXES = "metadata.yaml", (".mcap", ".db3")
# Half a second of a thousand microphones; an image of detections is far below it.
MAX_MESSAGE_BYTES = 64 << 20


def is_bag(path: Path) -> bool:
    """Whether a path names a bag: its folder, or one of its storage files.

    Examples
    --------
    >>> is_bag(Path("drive.mcap")), is_bag(Path("street.wav"))
    (True, False)
    """
    return path.suffix in STORAGE_SUFFIXES or (path / METADATA_NAME).is_file()


@dataclass(frozen=True, slots=True)
class BagReader:
    """An open bag."""

    path: Path
    reader: Any  # rosbags' own

    def count(self, topic: str) -> int:
        """Return how many messages a topic holds, as the bag says."""
        return sum(int(one.msgcount) for one in self.reader.connections if one.topic == topic)

    def topic(self, option: str, given: str | None, *kinds: str) -> str | None:
        """Return the topic that holds messages of one of these types; None where there is none.

        Raises
        ------
        InputFileError
            If the topic that was given is not there, or several would do and none was given.
        """
        found = {one.topic: one.msgtype for one in self.reader.connections}
        fit = sorted(topic for topic, kind in found.items() if kind in kinds)
        if given is not None and given not in fit:
            problem = f"expected {_either(kinds)} on {given} ({option}), got {self._told()}"
            raise InputFileError(self.path, problem)
        if given is None and len(fit) > 1:
            problem = f"expected {option} with one of {', '.join(fit)}, which all hold {_either(kinds)}"
            raise InputFileError(self.path, problem)
        return given or next(iter(fit), None)

    def needed_topic(self, option: str, given: str | None, *kinds: str) -> str:
        """Return the topic; refuse a bag without one."""
        topic = self.topic(option, given, *kinds)
        if topic is None:
            raise InputFileError(self.path, f"expected a topic of {_either(kinds)}, got {self._told()}")
        return topic

    def kind_of(self, topic: str) -> str:
        """Return the type of a topic's messages."""
        return next(str(one.msgtype) for one in self.reader.connections if one.topic == topic)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield the messages of a topic, each with the time at which it was recorded, ns."""
        chosen = [one for one in self.reader.connections if one.topic == topic]
        with refused_as_bag(self.path):
            for connection, recorded_ns, data in self.reader.messages(chosen):
                if len(data) > MAX_MESSAGE_BYTES:
                    problem = f"expected messages of at most {MAX_MESSAGE_BYTES} bytes on {topic}"
                    raise InputFileError(self.path, f"{problem}, got one of {len(data)}")
                yield recorded_ns, self.reader.deserialize(data, connection.msgtype)

    def _told(self) -> str:
        found = sorted(f"{one.topic} ({one.msgtype})" for one in self.reader.connections)
        return ", ".join(found) or "no topic at all"


@contextmanager
def open_bag(path: Path) -> Iterator[BagReader]:
    """Lend a bag.

    Raises
    ------
    InputFileError
        If there is none, or it is damaged.
    MissingExtraError
        Without rosbags.
    """
    store = typestore()
    from rosbags.highlevel import AnyReader

    with refused_as_bag(path):
        # Bags of before ROS 2 Iron hold no definitions; then those that ship here count.
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    try:
        yield BagReader(path, reader)
    finally:
        reader.close()


@contextmanager
def refused_as_bag(path: Path) -> Iterator[None]:
    """Turn whatever is wrong with a bag into one error that names it."""
    try:
        yield
    except WorldstateError:
        raise
    # A damaged bag fails in SQLite, YAML, struct, zstd or numpy, each with errors of its own; a length
    # that was spoiled asks for more memory than there is.
    except Exception as error:
        said = str(error) or type(error).__name__
        if "rofile" in said:  # An MCAP file of another program, such as `run --export mcap=FILE`
            said += "; `worldstate log replay` reads files of snapshots"
        raise InputFileError(path, f"expected a bag of ROS 2 that can be read ({said:.200})") from error


def _either(kinds: tuple[str, ...]) -> str:
    return " or ".join(kinds)
