"""Write bags of ROS 2: a folder with metadata.yaml and one storage file."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeAlias

from worldstate.adapters.files.atomic import atomic_path, check_target
from worldstate.ground.errors import InputFileError

from .message_types import message, typestore

Storage = Literal["mcap", "sqlite3"]
# Takes topic, type, stamp in ns and the values of the message's fields.
WriteMessage: TypeAlias = Callable[[str, str, int, Mapping[str, Any]], None]
# Of the bag's metadata: the last that ROS 2 Humble to Jazzy read.
_VERSION: Literal[8] = 8


def check_bag_target(path: Path) -> Path:
    """Return where a bag would be written; refuse a name that is taken.

    Examples
    --------
    >>> check_bag_target(Path("/dev"))
    Traceback (most recent call last):
    worldstate.ground.errors.InputFileError: /dev: expected a name that is free, a bag is a new folder
    """
    if path.exists():
        raise InputFileError(path, "expected a name that is free, a bag is a new folder")
    return check_target(path)


@contextmanager
def bag_writer(path: Path, storage: Storage = "mcap") -> Iterator[WriteMessage]:
    """Lend a function that writes messages to a new bag, which takes its name when the block ends.

    Raises
    ------
    InputFileError
        If the name is taken or its folder is not there.
    MissingExtraError
        Without rosbags.
    """
    store, target = typestore(), check_bag_target(path)
    from rosbags.rosbag2 import StoragePlugin, Writer

    with atomic_path(target) as temporary:
        temporary.mkdir()
        # A storage file is named after its folder: it is written into one of the final name, then moved up.
        inner = temporary / target.name
        with Writer(inner, version=_VERSION, storage_plugin=StoragePlugin[storage.upper()]) as bag:
            connections: dict[str, Any] = {}

            def write(topic: str, kind: str, stamp_ns: int, values: Mapping[str, Any]) -> None:
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, kind, typestore=store)
                bag.write(connections[topic], stamp_ns, store.serialize_cdr(message(kind, values), kind))

            yield write
        for file in inner.iterdir():
            file.rename(temporary / file.name)
        inner.rmdir()
