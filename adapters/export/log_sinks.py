"""Where the messages of a log go: MCAP files, Rerun recordings, and Foxglove on a websocket."""

import base64
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground import InputFileError, InvalidArgumentError, seconds
from worldstate.ground.extras import check_extra, optional
from worldstate.ground.serialisation import decode, decode_json
from worldstate.ground.typing import FloatArray

from .log_message import IMAGE_TOPIC, SCENE_TOPIC, SNAPSHOT_TOPIC, SRP_TOPIC, LogMessage, LogSink
from .scene_messages import CompressedImage, Rgba, SceneItem, SceneUpdate, Xyz

TIMELINE = "stream"


@contextmanager
def rerun_file(path: Path) -> Iterator[LogSink]:
    """Lend a function that writes messages to a Rerun recording, which takes its name when the block ends."""
    rr = optional("rerun")
    with atomic_path(path) as temporary:
        recording = rr.RecordingStream("worldstate")
        recording.save(temporary)
        recording.log("/", rr.ViewCoordinates.FLU, static=True)

        def write(message: LogMessage) -> None:
            recording.set_time(TIMELINE, duration=1e-9 * message.stamp_ns)
            _WRITERS[message.topic](rr, recording, message)

        try:
            yield write
        finally:
            recording.disconnect()


def _snapshot(rr: ModuleType, recording: Any, message: LogMessage) -> None:
    text = rr.TextDocument(message.data.decode(), media_type="application/json")
    recording.log(message.topic, text)


def _image(rr: ModuleType, recording: Any, message: LogMessage) -> None:
    image = decode(CompressedImage, decode_json(message.data.decode(), message.topic), message.topic)
    jpeg = base64.b64decode(image.data)
    recording.log(message.topic, rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))


def _scene(rr: ModuleType, recording: Any, message: LogMessage) -> None:
    """Draw what stands in the scene now; what an earlier one drew is removed, as the message says."""
    recording.log(message.topic, rr.Clear(recursive=True))
    scene = decode(SceneUpdate, decode_json(message.data.decode(), message.topic), message.topic)
    for item in scene.entities:
        place = f"{message.topic}/{item.id.replace(' ', '/')}"
        for part, shape in _shapes(rr, item):
            recording.log(f"{place}/{part}", shape)
        if item.metadata:
            recording.log(place, rr.AnyValues(**{pair.key: pair.value for pair in item.metadata}))


def _shapes(rr: ModuleType, item: SceneItem) -> Iterator[tuple[str, object]]:
    for number, one in enumerate(item.triangles):
        corners = _points(one.points)
        triangles = np.arange(len(corners)).reshape(-1, 3)
        color = _color(one.color)
        mesh = rr.Mesh3D(vertex_positions=corners, triangle_indices=triangles, albedo_factor=color)
        yield f"sector{number}", mesh
    if item.lines:
        strips, colors = (
            [_points(one.points) for one in item.lines],
            [_color(one.color) for one in item.lines],
        )
        radii = [0.5 * one.thickness for one in item.lines]
        yield "lines", rr.LineStrips3D(strips, radii=radii, colors=colors)
    for arrow in item.arrows:
        ahead = (arrow.shaft_length + arrow.head_length, 0.0, 0.0)
        yield "arrow", rr.Arrows3D(vectors=[ahead], colors=[_color(arrow.color)])
    if item.cubes:
        centers, sizes = (
            [_points((one.pose.position,))[0] for one in item.cubes],
            [one.size for one in item.cubes],
        )
        colors = [_color(one.color) for one in item.cubes]
        yield "boxes", rr.Boxes3D(centers=centers, sizes=_points(tuple(sizes)), colors=colors)
    if item.texts:
        places = _points(tuple(one.pose.position for one in item.texts))
        colors = [_color(one.color) for one in item.texts]
        labels = [one.text for one in item.texts]
        yield "text", rr.Points3D(places, labels=labels, colors=colors, radii=0.1, show_labels=True)


def _points(points: tuple[Xyz, ...]) -> FloatArray:
    return np.array([(one.x, one.y, one.z) for one in points], dtype=np.float64).reshape(-1, 3)


def _color(color: Rgba) -> tuple[int, int, int, int]:
    red, green, blue, opaque = (round(255 * part) for part in (color.r, color.g, color.b, color.a))
    return red, green, blue, opaque


_WRITERS: dict[str, Callable[[ModuleType, Any, LogMessage], None]] = {
    SNAPSHOT_TOPIC: _snapshot,
    IMAGE_TOPIC: _image,
    SCENE_TOPIC: _scene,
    SRP_TOPIC: _scene,
}


@contextmanager
def mcap_file(path: Path) -> Iterator[LogSink]:
    """Lend a function that writes messages to an MCAP file, which takes its name when the block ends."""
    check_extra("mcap")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = optional("mcap.writer").Writer(file)
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
    make_reader, damaged = optional("mcap.reader").make_reader, optional("mcap.exceptions").McapError
    with path.open("rb") as file:
        try:
            # By time of writing and not by stamp: a late measurement may have moved a stamp back.
            for _, _, message in make_reader(file).iter_messages([SNAPSHOT_TOPIC], log_time_order=False):
                yield message.data.decode()
        except (damaged, UnicodeDecodeError) as error:
            raise InputFileError(path, f"expected an MCAP file of snapshots ({error})") from error


@contextmanager
def live_server(port: int, *, paced: bool = True) -> Iterator[tuple[LogSink, int]]:
    """Lend a function that sends messages to connected viewers, and the port; 0 takes a free one.

    What comes sooner than its stamp says is held back, so that a recording plays at the speed of its sound;
    not so where `paced` is False: microphones that run set the pace themselves.
    """
    foxglove = optional("foxglove")
    # A context of its own: the global one keeps its channels for all servers of the process.
    context = foxglove.Context()
    try:
        server = foxglove.start_server(name="worldstate", port=port, context=context)
    except (RuntimeError, OverflowError) as error:
        raise InvalidArgumentError(
            f"--export foxglove: expected a free port, got {port} ({error})"
        ) from error
    channels: dict[str, Any] = {}
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
