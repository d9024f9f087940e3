"""Viewers, logs and other stacks that a command sends world-states to, hop by hop."""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from .bag_options import add_storage_option

if TYPE_CHECKING:
    from worldstate.adapters.export.log_message import LogMessage, LogSink
    from worldstate.adapters.listen import Source, Step
    from worldstate.state import WorldState

FOXGLOVE_PORT = 8765
# The options that name files to write.
LOG_FILES = ("mcap", "rerun", "osi", "autoware")


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Declare --mcap, --rerun, --live, --osi, --autoware, --odas, --ros-bag, --export and --crossing."""
    add = parser.add_argument_group("viewers, logs and other stacks").add_argument
    add("--mcap", type=Path, metavar="FILE", help="write snapshots and scene for Foxglove")
    add("--rerun", type=Path, metavar="FILE", help="write the same for the Rerun viewer (extra `rerun`)")
    live = "serve the same on a Foxglove websocket, in real time (default port: 8765)"
    add("--live", type=int, nargs="?", const=FOXGLOVE_PORT, metavar="PORT", help=live)
    add("--osi", type=Path, metavar="FILE", help="write a trace of ASAM OSI SensorData")
    add("--autoware", type=Path, metavar="JSONL", help="write Autoware's PredictedObjects, one a line")
    add("--odas", metavar="HOST:PORT", help="send tracks as ODAS does; ODAS Studio listens at port 9000")
    add("--ros-bag", type=Path, metavar="FOLDER", help="write advisories, objects and markers for ROS 2")
    add_storage_option(parser)
    other = "pass states to an exporter that an installed package brings; may be given several times"
    add("--export", action="append", default=[], metavar="NAME=TARGET", help=other)
    crossing = "metres ahead of the lane where others than viewers find who is only heard (default: 9)"
    add("--crossing", type=float, default=9.0, metavar="M", help=crossing)


@dataclass(frozen=True, slots=True)
class StateLogs:
    """Everything that states are passed on to."""

    viewers: "list[LogSink]" = field(default_factory=list)  # These take messages
    stacks: "list[Callable[[WorldState], object]]" = field(default_factory=list)  # These take states

    def message(self, message: "LogMessage") -> None:
        """Pass a message on to every viewer."""
        for viewer in self.viewers:
            viewer(message)

    def state(self, state: "WorldState") -> None:
        """Pass a state on."""
        from worldstate.adapters.export.log_message import state_messages

        for message in state_messages(state) if self.viewers else ():
            self.message(message)
        for stack in self.stacks:
            stack(state)


@contextmanager
def open_logs(arguments: argparse.Namespace, *, paced: bool = True) -> Iterator[StateLogs]:
    """Open every log that was asked for; `paced` plays what comes too soon at the speed of its stamps."""
    with ExitStack() as opened:
        logs = StateLogs()
        _open_stacks(arguments, logs, opened)
        if arguments.mcap is not None:
            from worldstate.adapters.export.mcap_file import mcap_file

            logs.viewers.append(opened.enter_context(mcap_file(arguments.mcap)))
        if arguments.rerun is not None:
            from worldstate.adapters.export.rerun_file import rerun_file

            logs.viewers.append(opened.enter_context(rerun_file(arguments.rerun)))
        if arguments.live is not None:
            from worldstate.adapters.export.live_server import live_server

            send, port = opened.enter_context(live_server(arguments.live, paced=paced))
            print(f"Foxglove: open connection ws://127.0.0.1:{port}", file=sys.stderr)
            logs.viewers.append(send)
        yield logs


def _open_stacks(arguments: argparse.Namespace, logs: StateLogs, opened: ExitStack) -> None:
    from worldstate.ground.checks import in_range

    crossing_m = in_range("--crossing", arguments.crossing, 1.0, 100.0)
    if arguments.osi is not None:
        from worldstate.adapters.export.osi import osi_trace

        logs.stacks.append(opened.enter_context(osi_trace(arguments.osi, crossing_m)))
    if arguments.autoware is not None:
        from worldstate.adapters.export.autoware import autoware_objects
        from worldstate.adapters.state_log import states_writer

        write = opened.enter_context(states_writer(arguments.autoware))
        logs.stacks.append(
            lambda state: write(json.dumps(autoware_objects(state, crossing_m), allow_nan=False))
        )
    if arguments.ros_bag is not None:
        from worldstate.adapters.ros.state_bag import state_bag

        bag = state_bag(arguments.ros_bag, crossing_m, arguments.ros_storage)
        logs.stacks.append(opened.enter_context(bag))
    if arguments.odas is not None:
        from worldstate.adapters.export.odas import odas_socket

        logs.stacks.append(opened.enter_context(odas_socket(arguments.odas)))
    for text in arguments.export:
        from worldstate.adapters.own_parts import ExporterPart, load_part, part_and_target

        name, target = part_and_target("--export", text)
        export: ExporterPart = load_part("worldstate.exporters", name, "--export")
        logs.stacks.append(opened.enter_context(export(target)))


@contextmanager
def log_hops(
    arguments: argparse.Namespace, source: "Source", *, paced: bool = True
) -> "Iterator[Callable[[Step], None]]":
    """Lend a function that logs a hop of a recording: state, power over azimuth, and the camera's image."""
    with open_logs(arguments, paced=paced) as logs:
        if not logs.viewers:
            yield lambda step: logs.state(step.state)
            return
        from worldstate.adapters.export.log_message import camera_images, srp_message

        image_before = camera_images(source.audio_path.parent, source.start_ns)

        def log_hop(step: "Step") -> None:
            for message in image_before(step.state.stamp_ns):
                logs.message(message)
            logs.state(step.state)
            logs.message(srp_message(step.state, step.frame.azimuths_rad, step.frame.srp))

        yield log_hop
