"""Message types of ROS 2: those of rosbags, and the definitions that ship with this package."""

from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from worldstate.ground.extras import optional

AUDIO, ARRAY = "worldstate_msgs/msg/MultiChannelAudio", "worldstate_msgs/msg/MicrophoneArray"
ADVISORIES = "worldstate_msgs/msg/RiskAdvisories"
STAMPED_PCM, PCM = "audio_common_msgs/msg/AudioDataStamped", "audio_common_msgs/msg/AudioData"
PCM_INFO = "audio_common_msgs/msg/AudioInfo"
AUDIO_FRAME, RAW_AUDIO = "audio_utils_msgs/msg/AudioFrame", "foxglove_msgs/msg/RawAudio"
DETECTIONS, ODOMETRY = "vision_msgs/msg/Detection2DArray", "nav_msgs/msg/Odometry"
OBJECTS = "autoware_perception_msgs/msg/PredictedObjects"
MARKERS, TEXT = "visualization_msgs/msg/MarkerArray", "std_msgs/msg/String"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_OURS = ("MultiChannelAudio", "MicrophoneArray", "RiskAdvisory", "RiskAdvisories")
_OTHERS = "audio_common_msgs", "audio_utils_msgs", "autoware_perception_msgs", "foxglove_msgs", "vision_msgs"
# Separator of the definitions in one file, as in bags.
_SEPARATOR = "=" * 80 + "\nMSG: "
_SPECIAL = {"string": "", "wstring": "", "bool": False}


@cache
def typestore() -> Any:
    """Return rosbags' store of the types of ROS 2 Humble, with further types added.

    Raises
    ------
    MissingExtraError
        If rosbags is not installed.
    """
    typesys = optional("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in _definitions():
        store.register(typesys.get_types_from_msg(text, name))
    return store


def message(name: str, values: Mapping[str, Any]) -> Any:
    """Return a message of a type; missing fields are zero or empty, and others raise KeyError."""
    store = typestore()
    kinds = dict(store.fielddefs[name][1])
    if unknown := values.keys() - kinds:
        raise KeyError(f"{name} has no {', '.join(unknown)}")
    # Only rosbags has this field, in empty messages; ROS does not.
    kinds.pop("structure_needs_at_least_one_member", None)
    fields = {field: _value(kind, values.get(field)) for field, kind in kinds.items()}
    return store.types[name](**fields)


def header(stamp_ns: int, frame_id: str = "base_link") -> dict[str, Any]:
    """Return the values of a message header.

    Examples
    --------
    >>> header(1_500_000_000)
    {'stamp': {'sec': 1, 'nanosec': 500000000}, 'frame_id': 'base_link'}
    """
    return {"stamp": time_of(stamp_ns), "frame_id": frame_id}


def time_of(stamp_ns: int) -> dict[str, int]:
    """Return the values of a ROS time or duration."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}


def stamp_of(header: Any) -> int:
    """Return the stamp of a message header, ns."""
    return instant_of(header.stamp)


def instant_of(time: Any) -> int:
    """Return a ROS time in ns."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def _definitions() -> Iterator[tuple[str, str]]:
    folder = files("worldstate") / "data"
    for name in _OURS:
        yield f"worldstate_msgs/msg/{name}", (folder / f"{name}.msg").read_text("utf-8")
    for package in _OTHERS:
        for part in (folder / f"{package}.msg").read_text("utf-8").split(_SEPARATOR)[1:]:
            name, _, text = part.partition("\n")
            yield f"{package}/msg/{name.rpartition('/')[2]}", text


def _value(kind: tuple[Any, Any], value: Any) -> Any:
    """Convert a value to the form of its field: message, number, text, or a list of these."""
    node, about = kind
    if node.name == "NAME":
        return message(about, value or {})
    if node.name == "BASE":
        return _SPECIAL.get(about[0], 0) if value is None else value
    of_one, length = about
    length = length if node.name == "ARRAY" else 0
    if of_one[0].name == "BASE" and of_one[1][0] not in _SPECIAL:
        return np.asarray(np.zeros(length) if value is None else value, dtype=of_one[1][0])
    return [_value(of_one, one) for one in ([None] * length if value is None else value)]
