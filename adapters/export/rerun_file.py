"""Recordings for the Rerun viewer: the scene that Foxglove draws, and the snapshots as text."""

import base64
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.errors import MissingExtraError
from worldstate.ground.serialisation import decode, decode_json
from worldstate.ground.typing import FloatArray

from .log_message import IMAGE_TOPIC, SCENE_TOPIC, SNAPSHOT_TOPIC, SRP_TOPIC, LogMessage, LogSink
from .scene_messages import CompressedImage, Rgba, SceneItem, SceneUpdate, Xyz

TIMELINE = "stream"


@contextmanager
def rerun_file(path: Path) -> Iterator[LogSink]:
    """Lend a function that writes messages to a Rerun recording, which takes its name when the block ends."""
    rr = _rerun()
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


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError("rerun-sdk", "rerun") from error
    return rerun


_WRITERS: dict[str, Callable[[ModuleType, Any, LogMessage], None]] = {
    SNAPSHOT_TOPIC: _snapshot,
    IMAGE_TOPIC: _image,
    SCENE_TOPIC: _scene,
    SRP_TOPIC: _scene,
}
