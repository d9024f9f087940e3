"""Viewers and logs that a command sends world-states to, hop by hop."""

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worldstate.adapters.export.log_message import LogMessage, LogSink
    from worldstate.adapters.listen import Source, Step

FOXGLOVE_PORT = 8765


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Declare --mcap and --live."""
    add = parser.add_argument_group("viewers and logs").add_argument
    add("--mcap", type=Path, metavar="FILE", help="write snapshots and scene for Foxglove")
    live = "serve the same on a Foxglove websocket, in real time (default port: 8765)"
    add("--live", type=int, nargs="?", const=FOXGLOVE_PORT, metavar="PORT", help=live)


@contextmanager
def open_logs(arguments: argparse.Namespace) -> "Iterator[Callable[[LogMessage], None]]":
    """Lend a function that passes a message to every log that was asked for."""
    with ExitStack() as stack:
        sinks: list[LogSink] = []
        if arguments.mcap is not None:
            from worldstate.adapters.export.mcap_file import mcap_file

            sinks.append(stack.enter_context(mcap_file(arguments.mcap)))
        if arguments.live is not None:
            from worldstate.adapters.export.live_server import live_server

            send, port = stack.enter_context(live_server(arguments.live))
            print(f"Foxglove: open connection ws://127.0.0.1:{port}", file=sys.stderr)
            sinks.append(send)

        def pass_on(message: "LogMessage") -> None:
            for sink in sinks:
                sink(message)

        yield pass_on


@contextmanager
def log_hops(arguments: argparse.Namespace, source: "Source") -> "Iterator[Callable[[Step], None]]":
    """Lend a function that logs a hop of a recording: state, power over azimuth, and the camera's image."""
    if arguments.mcap is None and arguments.live is None:
        yield lambda step: None
        return
    from worldstate.adapters.export.camera_images import camera_images
    from worldstate.adapters.export.log_message import srp_message, state_messages

    with open_logs(arguments) as log:
        image_before = camera_images(source.audio_path.parent, source.start_ns)

        def log_hop(step: "Step") -> None:
            for message in (*image_before(step.state.stamp_ns), *state_messages(step.state)):
                log(message)
            log(srp_message(step.state, step.frame.azimuths_rad, step.frame.srp))

        yield log_hop
