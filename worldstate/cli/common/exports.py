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
from typing import TYPE_CHECKING

from worldstate import adapters
from worldstate.ground import in_range
from worldstate.ground.errors import InvalidArgumentError

from .inputs import describe

if TYPE_CHECKING:
    from worldstate.adapters.export.log_messages import LogMessage, LogSink
    from worldstate.adapters.files.file_io import FileOpener
    from worldstate.state import WorldState

    Stack = AbstractContextManager[Callable[[WorldState], object]]

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

    viewers: "list[LogSink]" = field(default_factory=list)  # Take messages
    stacks: "list[Callable[[WorldState], object]]" = field(default_factory=list)  # Take states

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
            if name in _VIEWERS:
                exports.viewers.append(opened.enter_context(_viewer(name, target, live, arguments)))
            else:
                exports.stacks.append(opened.enter_context(_stack(name, target, crossing_m, live, arguments)))
        yield exports


def most_bytes(arguments: argparse.Namespace) -> int | None:
    """Return the largest size of a log by --rotate-mib, None without it."""
    most_mib: int | None = getattr(arguments, "rotate_mib", None)
    return None if most_mib is None else int(in_range("--rotate-mib", most_mib, 1, 1 << 30)) << 20


def _viewer(
    name: str, target: str, live: bool, arguments: argparse.Namespace
) -> "AbstractContextManager[LogSink]":
    from worldstate.adapters.export.log_messages import mcap_file, rerun_file

    if name == "foxglove":
        return _websocket(target, not live, arguments.origin)
    return rerun_file(Path(target)) if name == "rerun" else mcap_file(Path(target), _opener(live, arguments))


def _opener(live: bool, arguments: argparse.Namespace) -> "FileOpener":
    from worldstate.adapters.files.file_io import GrowingFile, whole_file

    return partial(GrowingFile, most_bytes=most_bytes(arguments)) if live else whole_file


@contextmanager
def _websocket(port: str, paced: bool, origins: list[str]) -> "Iterator[LogSink]":
    from worldstate.adapters.export.foxglove_server import live_server

    if not port.isdecimal():
        raise InvalidArgumentError(f"--export foxglove: expected a port, got {port}")
    with live_server(int(port), paced=paced, origins=origins) as (send, found):
        print(f"Foxglove: open connection ws://127.0.0.1:{found}", file=sys.stderr)
        yield send


def _stack(name: str, target: str, crossing_m: float, live: bool, arguments: argparse.Namespace) -> "Stack":
    from worldstate.adapters.export import other_stacks
    from worldstate.adapters.own_parts import ExporterPart, load_part, own_exporter
    from worldstate.adapters.ros.bag_writer import state_bag

    opener, comes = _opener(live, arguments), live and arguments.odometry is not None
    own: dict[str, ExporterPart] = {
        "osi": lambda path: other_stacks.osi_trace(Path(path), crossing_m, opener),
        "autoware": lambda path: other_stacks.autoware_lines(Path(path), crossing_m, opener, comes=comes),
        "mot": lambda path: other_stacks.mot_lines(Path(path), opener),
        "odas": partial(other_stacks.odas_socket, live=live),
        "rosbag": lambda path: state_bag(Path(path), crossing_m),
        "rosbag-sqlite3": lambda path: state_bag(Path(path), crossing_m, "sqlite3"),
    }
    if name in own:
        opened: Stack = own[name](target)
        return _expendable(target, opened) if live and name.startswith("rosbag") else opened
    return own_exporter(name, load_part("worldstate.exporters", name, "--export", EXPORTERS), target)


@contextmanager
def _expendable(target: str, stack: "Stack") -> "Iterator[Callable[[WorldState], object]]":
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
