"""Write bags of ROS 2, and a recording as the bag that a vehicle would have recorded."""

import heapq
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeAlias

from worldstate.adapters.audio.sound_file import SoundInput, open_audio, open_sound
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ, TRUTH_NAME, Recording
from worldstate.adapters.files.file_io import atomic_path, check_target, read_json
from worldstate.adapters.files.odometry_file import OdometryLog
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground import InputFileError, nanoseconds
from worldstate.measurement.odometry import Odometry

from .message_types import ARRAY, AUDIO, DETECTIONS, ODOMETRY, header, message, typestore

Storage = Literal["mcap", "sqlite3"]
# Takes topic, type, stamp in ns and the values of the message's fields.
WriteMessage: TypeAlias = Callable[[str, str, int, Mapping[str, Any]], None]
# Of the bag's metadata: the last that ROS 2 Humble to Jazzy read.
_VERSION: Literal[8] = 8
AUDIO_TOPIC, ARRAY_TOPIC = "/microphones/audio", "/microphones/array"
DETECTIONS_TOPIC, ODOMETRY_TOPIC = "/camera/detections", "/odometry"
# Of a second, as drivers deliver sound.
_BLOCKS_PER_SECOND = 10

# Stamp from the start of the recording, topic, type, values.
_Event = tuple[int, str, str, dict[str, Any]]


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


def write_bag(
    path: Path,
    sound: SoundInput,
    array: MicrophoneArray,
    detections: DetectionLog | None = None,
    ego: OdometryLog | None = None,
    *,
    start_ns: int = 0,
    storage: Storage = "mcap",
) -> Iterator[float]:
    """Write a recording to a new bag; yield how much of the sound is written after each block, seconds.

    The stamps of detections and speeds count from the start of the recording; `start_ns` is added to all.
    """
    with (
        open_sound(sound, array.n_microphones, strict=False) as audio,
        bag_writer(path, storage) as write,
    ):
        write(ARRAY_TOPIC, ARRAY, start_ns, _array(array, start_ns))
        rate_hz, taken = audio.sample_rate_hz, 0
        others = heapq.merge(_seen(detections, start_ns), _driven(ego, start_ns), key=lambda event: event[0])
        ahead = next(others, None)
        for block in audio.blocks(max(rate_hz // _BLOCKS_PER_SECOND, 1)):
            stamp_ns = start_ns + round(taken * 1_000_000_000 / rate_hz)
            while ahead is not None and ahead[0] <= stamp_ns:
                _write(write, ahead)
                ahead = next(others, None)
            about = {"sample_rate": rate_hz, "channels": audio.channels, "layout": "interleaved"}
            write(AUDIO_TOPIC, AUDIO, stamp_ns, about | {"header": header(stamp_ns), "data": block.ravel()})
            taken += len(block)
            yield taken / rate_hz
        for event in () if ahead is None else (ahead, *others):
            _write(write, event)


def odometry_of(recording: Recording) -> OdometryLog | None:
    """Return the odometry of a recording's ego: it stands, as simulated where that is known."""
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


def _write(write: WriteMessage, event: _Event) -> None:
    stamp_ns, topic, kind, values = event
    write(topic, kind, stamp_ns, values)


def _array(array: MicrophoneArray, stamp_ns: int) -> dict[str, Any]:
    places = [{"x": x, "y": y, "z": z} for x, y, z in array.positions_m.tolist()]
    return {"header": header(stamp_ns), "name": array.name, "positions": places}


def _seen(detections: DetectionLog | None, start_ns: int) -> Iterator[_Event]:
    if detections is None:
        return
    for stamp_ns, frame in zip(detections.stamps_ns.tolist(), detections.frames, strict=True):
        stamp_ns += start_ns
        head = header(stamp_ns, "camera")
        boxes = [{"header": head} | one for one in _boxes(frame)]
        yield stamp_ns, DETECTIONS_TOPIC, DETECTIONS, {"header": head, "detections": boxes}


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
        values = {
            "header": header(stamp_ns, "odom"),
            "child_frame_id": "base_link",
            "twist": {"twist": twist},
        }
        yield stamp_ns, ODOMETRY_TOPIC, ODOMETRY, values
