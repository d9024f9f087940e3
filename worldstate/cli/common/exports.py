"""--export: viewers, logs and other stacks that receive the states of a command, hop by hop."""

import argparse
import itertools
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldstate import adapters
from worldstate.ground import in_range
from worldstate.ground.errors import InvalidArgumentError

from .inputs import describe

if TYPE_CHECKING:
    from worldstate.adapters.export.log_messages import LogMessage, LogSink
    from worldstate.state import WorldState

_LOG = logging.getLogger(__name__)
FOXGLOVE_PORT = 8765
# Exporters of the library, each with its optional module.
EXPORTERS = {
    "mcap": "mcap", "foxglove": "foxglove", "rerun": "rerun", "osi": "osi3", "autoware": None, "odas": None,
    "mot": None, "rosbag": "rosbags", "rosbag-sqlite3": "rosbags",
}  # fmt: skip
_EXTRAS = {"figure": "matplotlib", "camera_device": "cv2", "view": "rich", "web": "websockets"}
_FILES = "mcap", "rerun", "osi", "autoware", "mot"
# These exporters take messages on topics; the others take states.
_VIEWERS = "mcap", "rerun", "foxglove"


def add_output_options(parser: argparse.ArgumentParser, *, pages: bool = True) -> "argparse._ArgumentGroup":
    """Declare --out, --export and --origin; return their group.

    --export NAME=TARGET sends the states to another program, and may be repeated:
      mcap=FILE            snapshots and scene for Foxglove
      foxglove[=PORT]      the same on a websocket, in real time (8765)
      rerun=FILE           the same for the Rerun viewer
      osi=FILE             a trace of ASAM OSI SensorData; for NAME.mcap in MCAP, under OSI's file name
      autoware=FILE        Autoware's PredictedObjects, one per line
      mot=FILE             positions as MOTChallenge text of 2015, without vehicles that have none
      odas=HOST:PORT       tracks in the form of ODAS; ODAS Studio uses port 9000
      rosbag=FOLDER        advisories, objects and markers for ROS 2; rosbag-sqlite3=FOLDER uses SQLite
      NAME=TARGET          an exporter of an installed package
    """
    describe(parser, add_output_options)
    group = parser.add_argument_group("output")
    group.add_argument("--out", type=Path, metavar="JSONL", help="write one snapshot per line")
    text = "send states to a viewer, a log or another stack; may be repeated"
    group.add_argument("--export", action="append", default=[], metavar="NAME=TARGET", help=text)
    if pages:
        text = "allow web pages of this origin, such as https://app.foxglove.dev; may be repeated"
        group.add_argument("--origin", action="append", metavar="URL", help=text)
    parser.set_defaults(origin=[])
    return group


def exported_files(arguments: argparse.Namespace) -> dict[str, Path]:
    """Return the files of --export by option."""
    files = [(name, target) for name, target in _asked(arguments) if name in _FILES]
    return {f"export {name} ({n})": Path(target) for n, (name, target) in enumerate(files, start=1)}


def needed_extras(arguments: argparse.Namespace) -> list[str]:
    """Return the optional modules that the options for output need."""
    given = vars(arguments)
    found = [module for option, module in _EXTRAS.items() if given.get(option) not in (None, False)]
    found += [module for name, _ in _asked(arguments) if (module := EXPORTERS.get(name)) is not None]
    return found


def _asked(arguments: argparse.Namespace) -> list[tuple[str, str]]:
    if not arguments.export:
        return []
    from worldstate.adapters.own_parts import part_and_target

    usual = [f"foxglove={FOXGLOVE_PORT}" if text == "foxglove" else text for text in arguments.export]
    return [part_and_target("--export", text) for text in usual]


@dataclass(frozen=True, slots=True)
class Exports:
    """The open targets of --export."""

    viewers: "list[Callable[[LogMessage], object]]" = field(default_factory=list)
    stacks: "list[Callable[[WorldState], object]]" = field(default_factory=list)

    def message(self, message: "LogMessage") -> None:
        """Pass a message on to every viewer."""
        for viewer in self.viewers:
            viewer(message)

    def state(self, state: "WorldState") -> None:
        """Pass a state on."""
        from worldstate.adapters.export.log_messages import state_messages

        for message in state_messages(state) if self.viewers else ():
            self.message(message)
        for stack in self.stacks:
            stack(state)


@contextmanager
def open_exports(
    arguments: argparse.Namespace, *, crossing_m: float = 9.0, live: bool = False
) -> Iterator[Exports]:
    """Open the targets of --export.

    A recording is sent at the speed of its time stamps, and its files get their names at the end. In a `live`
    run the sound sets the speed, and the files have their names from the start, except bags and Rerun files.
    """
    with ExitStack() as opened:
        exports = Exports()
        for name, target in _asked(arguments):
            taker = opened.enter_context(_target(name, target, crossing_m, live, arguments))
            (exports.viewers if name in _VIEWERS else exports.stacks).append(taker)
        yield exports


def most_bytes(arguments: argparse.Namespace) -> int | None:
    """Return the largest size of a log by --rotate-mib, None without it."""
    most_mib: int | None = getattr(arguments, "rotate_mib", None)
    return None if most_mib is None else int(in_range("--rotate-mib", most_mib, 1, 1 << 30)) << 20


@contextmanager
def _websocket(port: str, paced: bool, origins: list[str]) -> "Iterator[LogSink]":
    from worldstate.adapters.export.foxglove_server import live_server

    if not port.isdecimal():
        raise InvalidArgumentError(f"--export foxglove: expected a port, got {port}")
    with live_server(int(port), paced=paced, origins=origins) as (send, found):
        print(f"Foxglove: open connection ws://127.0.0.1:{found}", file=sys.stderr)
        yield send


def _target(
    name: str, target: str, crossing_m: float, live: bool, arguments: argparse.Namespace
) -> "AbstractContextManager[Callable[[Any], object]]":
    """Return the open function of one --export, for messages of a viewer or for states."""
    from worldstate.adapters.export import log_messages, other_stacks
    from worldstate.adapters.files.file_io import GrowingFile, whole_file
    from worldstate.adapters.own_parts import load_part, own_exporter
    from worldstate.adapters.ros.bag_writer import state_bag

    opener = partial(GrowingFile, most_bytes=most_bytes(arguments)) if live else whole_file
    path, comes = Path(target), live and arguments.odometry is not None
    own: dict[str, Callable[[], AbstractContextManager[Callable[[Any], object]]]] = {
        "mcap": lambda: log_messages.mcap_file(path, opener),
        "rerun": lambda: log_messages.rerun_file(path),
        "foxglove": lambda: _websocket(target, not live, arguments.origin),
        "osi": lambda: other_stacks.osi_trace(path, crossing_m, opener),
        "autoware": lambda: other_stacks.autoware_lines(path, crossing_m, opener, comes=comes),
        "mot": lambda: other_stacks.mot_lines(path, opener),
        "odas": lambda: other_stacks.odas_socket(target, live=live),
        "rosbag": lambda: state_bag(path, crossing_m),
        "rosbag-sqlite3": lambda: state_bag(path, crossing_m, "sqlite3"),
    }
    if name not in own:
        return own_exporter(name, load_part("worldstate.exporters", name, "--export", EXPORTERS), target)
    return _expendable(target, own[name]()) if live and name.startswith("rosbag") else own[name]()


@contextmanager
def _expendable(
    target: str, stack: "AbstractContextManager[Callable[[WorldState], object]]"
) -> "Iterator[Callable[[WorldState], object]]":
    """Yield the function of a bag; if the bag cannot be written, print a notice and continue the run."""
    failed = False

    def tried(write: Callable[[], object]) -> None:
        nonlocal failed
        try:
            write()
        except Exception as error:  # SQLite and MCAP raise their own errors
            if not failed:
                _LOG.warning("%s: cannot be written: %s", target, error)
            failed = True

    with ExitStack() as opened:
        export = opened.enter_context(stack)
        yield lambda state: None if failed else tried(partial(export, state))
        tried(opened.pop_all().close)


@contextmanager
def exported_hops(
    arguments: argparse.Namespace, source: "adapters.Source", *, live: bool = False
) -> "Iterator[Callable[[adapters.Step], None]]":
    """Yield a function that exports a hop: state, power over azimuth, image and sound."""
    with open_exports(arguments, crossing_m=source.crossing_m, live=live) as exports:
        if not exports.viewers:
            yield lambda step: exports.state(step.state)
            return
        from worldstate.adapters.export.log_messages import camera_images, recorded_sound, srp_message

        image_before = camera_images(source.audio_path.parent, source.start_ns)
        with recorded_sound(source.sound, source.start_ns, source.array.channels) as sound_until:

            def export_hop(step: "adapters.Step") -> None:
                stamp_ns = step.state.stamp_ns
                for message in itertools.chain(sound_until(stamp_ns), image_before(stamp_ns)):
                    exports.message(message)
                exports.state(step.state)
                exports.message(srp_message(step.state, step.frame.azimuths_rad, step.frame.srp))

            yield export_hop
