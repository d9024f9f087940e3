"""World-states on a websocket that Foxglove opens, in real time."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from worldstate.ground.errors import InvalidArgumentError, MissingExtraError
from worldstate.ground.values import seconds

from .log_message import LogMessage, LogSink


@contextmanager
def live_server(port: int, *, paced: bool = True) -> Iterator[tuple[LogSink, int]]:
    """Lend a function that sends messages to whoever is connected, and the port; 0 takes a free one.

    What comes sooner than its stamp says is held back, so that a recording plays at the speed of its sound;
    not so where `paced` is False: microphones that run set the pace themselves.
    """
    try:
        import foxglove
    except ImportError as error:
        raise MissingExtraError("foxglove-sdk", "foxglove") from error

    # A context of its own: the global one keeps its channels for all servers of the process.
    context = foxglove.Context()
    try:
        server = foxglove.start_server(name="worldstate", port=port, context=context)
    except (RuntimeError, OverflowError) as error:
        raise InvalidArgumentError(
            f"--export foxglove: expected a free port, got {port} ({error})"
        ) from error
    channels: dict[str, foxglove.Channel] = {}
    begun_s: float | None = None

    def send(message: LogMessage) -> None:
        nonlocal begun_s
        stamp_s = seconds(message.stamp_ns)
        begun_s = time.monotonic() - stamp_s if begun_s is None else begun_s
        if paced:
            time.sleep(max(begun_s + stamp_s - time.monotonic(), 0.0))
        if message.topic not in channels:
            schema = foxglove.Schema(name=message.schema_name, encoding="jsonschema", data=message.schema)
            channels[message.topic] = foxglove.Channel(
                message.topic, schema=schema, message_encoding="json", context=context
            )
        channels[message.topic].log(message.data, log_time=message.stamp_ns)

    try:
        yield send, server.port
    finally:
        server.stop()
