"""What a viewer or a log is given of a hop: messages on topics, each in JSON with its schema."""

import base64
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

from worldstate.adapters.camera.video import VIDEO_NAME, open_video, opencv
from worldstate.adapters.files.json_schema import json_schema
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import nanoseconds
from worldstate.state.world_state import WorldState, snapshot_schema

from .scene import scene_update, srp_scene
from .scene_messages import CompressedImage, SceneTime, SceneUpdate

SNAPSHOT_TOPIC, SCENE_TOPIC = "/worldstate/snapshot", "/worldstate/scene"
SRP_TOPIC, IMAGE_TOPIC = "/worldstate/srp", "/camera/image"
# OVAD's images, 1936 pixels wide, are shown in a third of a screen: halved they take 77 kB in a log, not 245.
_WIDEST_PX, _QUALITY = 1000, 80
# By the name that a viewer knows them by.
_SCENES: dict[str, type] = {
    "foxglove.SceneUpdate": SceneUpdate,
    "foxglove.CompressedImage": CompressedImage,
}


@dataclass(frozen=True, slots=True)
class LogMessage:
    """One message of JSON text."""

    topic: str
    schema_name: str
    stamp_ns: int
    data: bytes

    @property
    def schema(self) -> bytes:
        """JSON Schema of the message."""
        return _schema(self.schema_name)


LogSink: TypeAlias = Callable[[LogMessage], None]


def state_messages(state: WorldState) -> Iterator[LogMessage]:
    """Yield a snapshot as `WorldState.to_json` writes it, and the scene that it describes.

    Examples
    --------
    >>> [(message.topic, message.schema_name) for message in state_messages(WorldState(0, 0))]
    [('/worldstate/snapshot', 'worldstate.Snapshot'), ('/worldstate/scene', 'foxglove.SceneUpdate')]
    """
    yield LogMessage(SNAPSHOT_TOPIC, "worldstate.Snapshot", state.stamp_ns, state.to_json().encode())
    yield _scene(SCENE_TOPIC, state.stamp_ns, scene_update(state))


def srp_message(state: WorldState, azimuths_rad: FloatArray, srp: FloatArray) -> LogMessage:
    """Return the power of the sound over azimuth as a line about the array."""
    return _scene(SRP_TOPIC, state.stamp_ns, srp_scene(state, azimuths_rad, srp))


def camera_images(recording: Path, start_ns: int = 0) -> Callable[[int], Iterator[LogMessage]]:
    """Return what yields the last image before a stamp, asked in order of time, if it is a new one."""
    path = recording / VIDEO_NAME
    if not path.is_file():
        return lambda stamp_ns: iter(())
    cv2, video = opencv(), open_video(path)
    frames = enumerate(video.frames())
    ahead = next(frames, None)

    def image_before(stamp_ns: int) -> Iterator[LogMessage]:
        nonlocal ahead
        shown = None
        while ahead is not None and start_ns + nanoseconds(ahead[0] / video.frame_rate_hz) <= stamp_ns:
            shown, ahead = ahead, next(frames, None)
        if shown is not None:
            step = -(-video.width_px // _WIDEST_PX)
            size = video.width_px // step, video.height_px // step
            small = cv2.resize(shown[1], size, interpolation=cv2.INTER_AREA)
            _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            yield image_message(start_ns + nanoseconds(shown[0] / video.frame_rate_hz), jpeg.tobytes())

    return image_before


def image_message(stamp_ns: int, jpeg: bytes) -> LogMessage:
    """Return an image of the camera."""
    text = base64.b64encode(jpeg).decode("ascii")
    image = CompressedImage(SceneTime.of_ns(stamp_ns), "camera", text)
    return LogMessage(IMAGE_TOPIC, "foxglove.CompressedImage", stamp_ns, _json(encode(image)))


def _scene(topic: str, stamp_ns: int, scene: SceneUpdate) -> LogMessage:
    return LogMessage(topic, "foxglove.SceneUpdate", stamp_ns, _json(encode(scene)))


def _json(value: object) -> bytes:
    return json.dumps(value, allow_nan=False, check_circular=False, separators=(",", ":")).encode()


@cache
def _schema(name: str) -> bytes:
    own = json_schema(_SCENES[name]) if name in _SCENES else snapshot_schema()
    return json.dumps(own).encode()
