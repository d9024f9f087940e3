"""Writers of ROS 2 bags: a recording as a vehicle would store it, and world-states."""

import heapq
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, TypeAlias

from worldstate.adapters.audio.sound_file import Audio, SoundInput, open_audio, open_sound
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ, TRUTH_NAME, Recording
from worldstate.adapters.export.other_stacks import CROSSING_M, autoware_objects, is_localised
from worldstate.adapters.export.scene import SceneItem, SceneLine, SceneTriangles, scene_update
from worldstate.adapters.files.file_io import atomic_path, check_target, read_json
from worldstate.adapters.files.odometry_file import OdometryLog
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground import InputFileError, nanoseconds
from worldstate.ground.serialisation import encode
from worldstate.measurement.odometry import Odometry
from worldstate.state import RiskCue, WorldState

from . import message_types as types
from .bag_input import STATIC_TOPIC, open_bag
from .message_types import header, message, time_of, typestore

Storage = Literal["mcap", "sqlite3"]
# Arguments: topic, type, stamp in ns and the values of the message's fields.
WriteMessage: TypeAlias = Callable[[str, str, int, Mapping[str, Any]], None]
# Version of the bag's metadata: the last one that ROS 2 Humble to Jazzy can read.
_VERSION: Literal[8] = 8
AUDIO_TOPIC, ARRAY_TOPIC = "/microphones/audio", "/microphones/array"
DETECTIONS_TOPIC, ODOMETRY_TOPIC = "/camera/detections", "/odometry"
MICROPHONES_FRAME, CAMERA_FRAME = "microphones", "camera"
# Typical rate of audio drivers.
_BLOCKS_PER_SECOND = 10

# Stamp from the start of the recording, topic, type, values.
_Event = tuple[int, str, str, dict[str, Any]]


def check_bag_target(path: Path) -> Path:
    """Return the target of a bag; refuse a name that is in use.

    Examples
    --------
    >>> check_bag_target(Path("/dev"))
    Traceback (most recent call last):
    worldstate.ground.errors.InputFileError: /dev: expected a new name, because a bag is a new folder
    """
    if path.exists():
        raise InputFileError(path, "expected a new name, because a bag is a new folder")
    return check_target(path)


@contextmanager
def bag_writer(path: Path, storage: Storage = "mcap") -> Iterator[WriteMessage]:
    """Yield a function that writes messages to a new bag, which gets its name when the block ends.

    Raises
    ------
    InputFileError
        If the name is in use or its folder is missing.
    MissingExtraError
        If rosbags is not installed.
    """
    store, target = typestore(), check_bag_target(path)
    from rosbags.rosbag2 import StoragePlugin, Writer

    with atomic_path(target) as temporary:
        temporary.mkdir()
        # A storage file has the name of its folder, so it is written into a folder of the final name and
        # moved up.
        inner = temporary / target.name
        with Writer(inner, version=_VERSION, storage_plugin=StoragePlugin[storage.upper()]) as bag:
            connections: dict[str, Any] = {}

            def write(topic: str, kind: str, stamp_ns: int, values: Mapping[str, Any]) -> None:
                if topic not in connections:
                    kept = [_kept_for_late()] if topic == STATIC_TOPIC else []
                    connections[topic] = bag.add_connection(
                        topic, kind, typestore=store, offered_qos_profiles=kept
                    )
                bag.write(connections[topic], stamp_ns, store.serialize_cdr(message(kind, values), kind))

            yield write
        for file in inner.iterdir():
            file.rename(temporary / file.name)
        inner.rmdir()


def _kept_for_late() -> Any:
    """Return the quality of service of static transforms: they are also sent to late subscribers."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    ever = QosTime(9_223_372_036, 854_775_807)  # infinity in ROS 2
    sent = QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL
    return Qos(*sent, ever, ever, QosLiveliness.AUTOMATIC, ever, avoid_ros_namespace_conventions=False)


def write_bag(
    path: Path,
    sound: SoundInput,
    array: MicrophoneArray,
    detections: DetectionLog | None = None,
    ego: OdometryLog | None = None,
    *,
    camera: PinholeCamera | None = None,
    start_ns: int = 0,
    storage: Storage = "mcap",
) -> Iterator[float]:
    """Write a recording to a new bag; yield the duration of the sound written after each block, seconds.

    Stamps of detections and speeds are relative to the start of the recording; `start_ns` is added to all.
    """
    with open_sound(sound, array.n_microphones, strict=False) as audio, bag_writer(path, storage) as write:
        write(STATIC_TOPIC, types.TRANSFORMS, start_ns, {"transforms": _frames(array, camera, start_ns)})
        write(ARRAY_TOPIC, types.ARRAY, start_ns, _array(array, start_ns))
        rate_hz, taken = audio.sample_rate_hz, 0
        every = _seen(detections, start_ns), _driven(ego, start_ns), _heard(audio, start_ns)
        events = heapq.merge(*every, key=itemgetter(0))
        for stamp_ns, topic, kind, values in events:
            write(topic, kind, stamp_ns, values)
            if topic == AUDIO_TOPIC:
                taken += len(values["data"]) // audio.channels
                yield taken / rate_hz


def odometry_of(recording: Recording) -> OdometryLog | None:
    """Return the odometry of a recording: zero for a standing ego, simulated if available, else None."""
    with open_audio(recording.audio_path, strict=False) as audio:
        steps = int(audio.duration_s * FRAME_RATE_HZ) + 1
    standing = recording.moving_ego is False
    speeds = [0.0] * steps if standing else _simulated_speeds(recording.path / TRUTH_NAME)
    told = (Odometry("odometry", nanoseconds(i / FRAME_RATE_HZ), one) for i, one in enumerate(speeds))
    return OdometryLog(tuple(told)) if speeds else None


def _simulated_speeds(path: Path) -> list[float]:
    truth = read_json(path, "a truth file") if path.is_file() else None
    ego = truth.get("ego") if isinstance(truth, dict) else None
    speeds = ego.get("speed_mps") if isinstance(ego, dict) else None
    return speeds if isinstance(speeds, list) else []


def _frames(array: MicrophoneArray, camera: PinholeCamera | None, stamp_ns: int) -> list[dict[str, Any]]:
    """Return the poses of the sound's and the camera's frame in `base_link`; x of the camera is its axis."""
    from scipy.spatial.transform import Rotation

    placed = {MICROPHONES_FRAME: (array.positions_m.mean(axis=0).tolist(), (0.0, 0.0, 0.0))}
    if camera is not None:
        placed[CAMERA_FRAME] = camera.position_m, (camera.yaw_rad, -camera.pitch_rad, camera.roll_rad)
    found = []
    for frame, (at_m, turn) in placed.items():
        quaternion = Rotation.from_euler("ZYX", turn).as_quat()
        pose = {
            "translation": dict(zip("xyz", at_m, strict=True)),
            "rotation": dict(zip("xyzw", quaternion, strict=True)),
        }
        found.append({"header": header(stamp_ns), "child_frame_id": frame, "transform": pose})
    return found


def _array(array: MicrophoneArray, stamp_ns: int) -> dict[str, Any]:
    places = [{"x": x, "y": y, "z": z} for x, y, z in array.positions_m.tolist()]
    return {"header": header(stamp_ns), "name": array.name, "positions": places}


def _heard(audio: Audio, start_ns: int) -> Iterator[_Event]:
    about = {"sample_rate": audio.sample_rate_hz, "channels": audio.channels, "layout": "interleaved"}
    taken = 0
    for block in audio.blocks(max(audio.sample_rate_hz // _BLOCKS_PER_SECOND, 1)):
        stamp_ns = start_ns + round(taken * 1_000_000_000 / audio.sample_rate_hz)
        head = header(stamp_ns, MICROPHONES_FRAME)
        yield stamp_ns, AUDIO_TOPIC, types.AUDIO, about | {"header": head, "data": block.ravel()}
        taken += len(block)


def _seen(detections: DetectionLog | None, start_ns: int) -> Iterator[_Event]:
    if detections is None:
        return
    for stamp_ns, frame in zip(detections.stamps_ns.tolist(), detections.frames, strict=True):
        stamp_ns += start_ns
        head = header(stamp_ns, CAMERA_FRAME)
        boxes = [{"header": head} | one for one in _boxes(frame)]
        yield stamp_ns, DETECTIONS_TOPIC, types.DETECTIONS, {"header": head, "detections": boxes}


def _boxes(frame: DetectionFrame) -> Iterator[dict[str, Any]]:
    for box, score, label in zip(frame.boxes_px.tolist(), frame.scores.tolist(), frame.labels, strict=True):
        left, top, right, bottom = box
        centre = {"x": 0.5 * (left + right), "y": 0.5 * (top + bottom)}
        size = {"size_x": right - left, "size_y": bottom - top}
        said = {"hypothesis": {"class_id": label, "score": score}}
        yield {"bbox": {"center": {"position": centre}} | size, "results": [said]}


def _driven(ego: OdometryLog | None, start_ns: int) -> Iterator[_Event]:
    if ego is None:
        return
    for told in ego.told:
        stamp_ns = start_ns + told.stamp_ns
        twist = {"linear": {"x": told.speed_mps}, "angular": {"z": told.yaw_rate_rad_s}}
        frames = {"header": header(stamp_ns, "odom"), "child_frame_id": "base_link"}
        yield stamp_ns, ODOMETRY_TOPIC, types.ODOMETRY, frames | {"twist": {"twist": twist}}


# Topic to which Autoware's planners subscribe.
ADVISORIES_TOPIC, OBJECTS_TOPIC = "/worldstate/advisories", "/perception/object_recognition/objects"
MARKERS_TOPIC, SNAPSHOT_TOPIC = "/worldstate/markers", "/worldstate/snapshot"
# Constants of visualization_msgs/Marker.
ARROW, CUBE, LINE_STRIP, LABEL, TRIANGLE_LIST = 0, 1, 4, 9, 11
ADD, DELETE_ALL = 0, 3
_CAUSES = "hidden", "visible", "none"


@contextmanager
def state_bag(
    path: Path, crossing_m: float = CROSSING_M, storage: Storage = "mcap"
) -> Iterator[Callable[[WorldState], None]]:
    """Yield a function that writes states to a new bag."""
    with bag_writer(path, storage) as write:

        def write_state(state: WorldState) -> None:
            write(ADVISORIES_TOPIC, types.ADVISORIES, state.stamp_ns, risk_advisories(state))
            if is_localised(state):
                write(OBJECTS_TOPIC, types.OBJECTS, state.stamp_ns, autoware_objects(state, crossing_m))
            write(MARKERS_TOPIC, types.MARKERS, state.stamp_ns, scene_markers(state))
            write(SNAPSHOT_TOPIC, types.TEXT, state.stamp_ns, {"data": state.to_json()})

        yield write_state


def bag_snapshot_lines(path: Path) -> Iterator[str]:
    """Yield the snapshots of a bag as the JSON text that was written."""
    with open_bag(path) as bag:
        if bag.has(SNAPSHOT_TOPIC, types.TEXT):
            yield from (message.data for _, message in bag.messages(SNAPSHOT_TOPIC))


def risk_advisories(state: WorldState) -> dict[str, Any]:
    """Return the values of a RiskAdvisories message.

    Examples
    --------
    >>> risk_advisories(WorldState(0, 3))["seq"]
    3
    """
    return {
        "header": header(state.stamp_ns, state.frame_id),
        "seq": state.seq,
        "valid_until": time_of(state.valid_until_ns or 0),
        "calibrated": state.calibrated,
        "advisories": [_advisory(cue) for cue in state.cues],
    }


def _advisory(cue: RiskCue) -> dict[str, Any]:
    out, within, causes = cue.advisory, cue.within or {}, cue.hypotheses
    shares = {name: math.nan if causes is None else getattr(causes, name) for name in _CAUSES}
    return shares | {
        "direction": cue.direction or "",
        "usable": cue.usable,
        "why_not": list(cue.why_not),
        "azimuth": cue.azimuth_rad,
        "azimuth_std": cue.azimuth_std_rad,
        "risk": math.nan if cue.risk is None else cue.risk,
        "confidence": math.nan if cue.confidence is None else cue.confidence,
        "raised": out is not None,
        "since": time_of(0 if out is None else out.since_ns),
        "valid_until": time_of(0 if out is None else out.valid_until_ns),
        "alpha": [] if cue.alpha is None else [cue.alpha],
        "horizon": [float(horizon) for horizon in within],
        "within": list(within.values()),
        "time_to_visible": list(cue.time_to_visible_s or ()),
        "entity_id": cue.entity_id or "",
    }


def scene_markers(state: WorldState) -> dict[str, Any]:
    """Return the values of a MarkerArray that deletes earlier markers and draws the snapshot.

    Examples
    --------
    >>> [one["ns"] for one in scene_markers(WorldState(0, 0))["markers"]][:3]
    ['', 'ego', 'occluder corner_left']
    """
    head = header(state.stamp_ns, state.frame_id)
    markers: list[dict[str, Any]] = [{"header": head, "ns": "", "action": DELETE_ALL}]
    for item in scene_update(state).entities:
        lifetime = {"sec": item.lifetime.sec, "nanosec": item.lifetime.nsec}
        for number, shape in enumerate(_shapes(item)):
            named = {"header": head, "ns": item.id, "id": number, "action": ADD}
            markers.append(named | {"lifetime": lifetime, "frame_locked": item.frame_locked} | shape)
    return {"markers": markers}


def _shapes(item: SceneItem) -> Iterator[dict[str, Any]]:
    for arrow in item.arrows:
        length = arrow.shaft_length + arrow.head_length
        yield _shape(ARROW, arrow, (length, arrow.shaft_diameter, arrow.shaft_diameter))
    yield from (_shape(CUBE, cube, (cube.size.x, cube.size.y, cube.size.z)) for cube in item.cubes)
    yield from (_shape(LINE_STRIP, line, (line.thickness, 0.0, 0.0)) | _points(line) for line in item.lines)
    yield from (_shape(TRIANGLE_LIST, area, (1.0, 1.0, 1.0)) | _points(area) for area in item.triangles)
    yield from (_shape(LABEL, text, (0.0, 0.0, text.font_size)) | {"text": text.text} for text in item.texts)


def _points(drawn: SceneLine | SceneTriangles) -> dict[str, Any]:
    return {"points": [encode(one) for one in drawn.points]}


def _shape(kind: int, drawn: Any, scale: tuple[float, float, float]) -> dict[str, Any]:
    size = dict(zip("xyz", scale, strict=True))
    return {"type": kind, "pose": encode(drawn.pose), "scale": size, "color": encode(drawn.color)}
