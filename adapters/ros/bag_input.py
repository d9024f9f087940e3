"""What a bag holds for a world-state: sound, array, detections and the speed of the ego."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.audio.open_sound import MAX_CHANNELS
from worldstate.adapters.camera.detections import (
    MAX_BOXES_A_FRAME,
    MAX_FRAMES,
    DetectionFrame,
    DetectionLog,
)
from worldstate.adapters.files.odometry_file import OdometryLog
from worldstate.adapters.files.text_file import refused_as_file
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.measurement.odometry import Odometry

from .bag_audio import AUDIO_KINDS, BagSound, first_stamp
from .bag_reader import BagReader, open_bag
from .message_types import ARRAY, DETECTIONS, ODOMETRY, stamp_of


@dataclass(frozen=True, slots=True)
class BagTopics:
    """Topics to read, each None for the only one of its type."""

    audio: str | None = None
    detections: str | None = None
    odometry: str | None = None


@dataclass(frozen=True, slots=True)
class BagInput:
    """All that a bag holds; None for what it does not."""

    sound: BagSound
    array: MicrophoneArray | None
    detections: DetectionLog | None
    ego: OdometryLog | None


def read_sound(path: Path, topic: str | None = None) -> tuple[BagSound, MicrophoneArray | None]:
    """Return the sound of a bag and its array, where it holds one."""
    with open_bag(path) as bag, refused_as_file(path):
        return sound_of_bag(bag, topic), _array(bag)


def read_bag(path: Path, topics: BagTopics | None = None) -> BagInput:
    """Read a bag but for its samples, which are read when they are listened to.

    Raises
    ------
    InputFileError
        If it is damaged, has no sound, several topics would do, or a message holds what cannot be.
    """
    chosen = topics or BagTopics()
    with open_bag(path) as bag, refused_as_file(path):
        sound = sound_of_bag(bag, chosen.audio)
        seen = bag.topic("--topic detections=", chosen.detections, DETECTIONS)
        driven = bag.topic("--topic odometry=", chosen.odometry, ODOMETRY)
        detections = None if seen is None else _detections(bag, seen)
        return BagInput(sound, _array(bag), detections, None if driven is None else _ego(bag, driven))


def needed_array(path: Path, array: MicrophoneArray | None) -> MicrophoneArray:
    """Return the array; refuse a bag of which nobody says where its microphones are."""
    if array is None:
        raise InputFileError(path, f"expected --array, or a message of {ARRAY} in the bag")
    return array


def sound_of_bag(bag: BagReader, topic: str | None) -> BagSound:
    """Return the sound of a bag; refuse one without."""
    heard = bag.needed_topic("--topic audio=", topic, *AUDIO_KINDS)
    return BagSound(bag.path, heard, first_stamp(bag, heard))


def _array(bag: BagReader) -> MicrophoneArray | None:
    topic = bag.topic("one topic of an array, or --array,", None, ARRAY)
    said = None if topic is None else next(bag.messages(topic), None)
    if said is None:
        return None
    places = said[1].positions
    if len(places) > MAX_CHANNELS:
        raise InputFileError(bag.path, f"{topic}: expected at most {MAX_CHANNELS} microphones")
    positions_m = np.array([[one.x, one.y, one.z] for one in places], dtype=np.float64).reshape(-1, 3)
    return MicrophoneArray(positions_m, str(said[1].name or topic))


def _detections(bag: BagReader, topic: str) -> DetectionLog:
    stamps, frames = [], []
    for recorded_ns, message in _few(bag, topic):
        # A detector that leaves the stamp out saw the image shortly before it was recorded.
        stamps.append(stamp_of(message.header) or recorded_ns)
        frames.append(_frame(message.detections))
    return DetectionLog(tuple(frames), np.array(stamps, dtype=np.int64), f"{bag.path} {topic}")


def _frame(found: Any) -> DetectionFrame:
    if len(found) > MAX_BOXES_A_FRAME:
        raise InvalidArgumentError(f"expected at most {MAX_BOXES_A_FRAME} boxes a frame, got {len(found)}")
    boxes = np.array([_box(one.bbox) for one in found], dtype=np.float64).reshape(-1, 4)
    best = [_best(one.results) for one in found]
    scores = np.array([score for _, score in best], dtype=np.float64)
    sound = np.isfinite(boxes).all() and (boxes[:, :2] <= boxes[:, 2:]).all()
    if not (sound and ((scores >= 0.0) & (scores <= 1.0)).all()):
        raise InvalidArgumentError("detections: expected finite boxes, sizes >= 0 and scores in [0, 1]")
    return DetectionFrame(boxes, scores, tuple(label for label, _ in best))


def _box(box: Any) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom; the centre has a point since ROS 2 Humble, x and y before."""
    centre = getattr(box.center, "position", box.center)
    half = 0.5 * box.size_x, 0.5 * box.size_y
    return centre.x - half[0], centre.y - half[1], centre.x + half[0], centre.y + half[1]


def _best(results: Any) -> tuple[str, float]:
    """Return class and score of the best hypothesis; of a box without one nothing is claimed."""
    said = [getattr(one, "hypothesis", one) for one in results]
    best = max(said, key=lambda one: one.score, default=None)
    if best is None:
        return "unknown", 0.0
    # It was called id before ROS 2 Galactic.
    return str(getattr(best, "class_id", getattr(best, "id", "unknown"))), float(best.score)


def _ego(bag: BagReader, topic: str) -> OdometryLog:
    told = (
        (stamp_of(said.header) or recorded_ns, said.twist.twist)
        for recorded_ns, said in _few(bag, topic, 100 * MAX_FRAMES)
    )
    # Not its pose: the frame of odometry is not the map in which the corners of a context stand.
    return OdometryLog(tuple(Odometry(topic, ns, twist.linear.x, twist.angular.z) for ns, twist in told))


def _few(bag: BagReader, topic: str, most: int = MAX_FRAMES) -> Iterator[tuple[int, Any]]:
    for number, message in enumerate(bag.messages(topic)):
        if number >= most:
            raise InputFileError(bag.path, f"expected at most {most} messages on {topic}")
        yield message
