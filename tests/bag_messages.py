"""Messages of ROS 2 as topic, type, time of recording and values, and bags of them."""

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from worldstate.adapters.audio.sound_file import RawPcm, open_sound
from worldstate.adapters.ros.bag_input import read_beside, read_sound
from worldstate.adapters.ros.bag_writer import bag_writer
from worldstate.adapters.ros.message_types import AUDIO, DETECTIONS, ODOMETRY, header

Message = tuple[str, str, int, dict[str, object]]
RATE_HZ, CHANNELS = 8000, 4


def bag_of(path: Path, messages: Iterable[Message], storage: str = "mcap") -> Path:
    with bag_writer(path, storage) as write:
        for one in messages:
            write(*one)
    return path


def read_bag(path: Path) -> SimpleNamespace:
    sound, array = read_sound(path)
    detections, ego = read_beside(sound)
    return SimpleNamespace(sound=sound, array=array, detections=detections, ego=ego)


def heard(path: Path, channels: int | None = CHANNELS, stated: RawPcm | None = None) -> np.ndarray:
    """Return the sound of a bag, (n, M) of full scale 1."""
    with open_sound(read_sound(path, None, stated)[0], channels) as audio:
        found = np.concatenate(list(audio.blocks()))
        assert audio.frames == len(found)
    return found


def sound_of(n_samples: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.5, 0.5, (n_samples, CHANNELS)).astype(np.float32)


def block(samples: np.ndarray, stamp_ns: int, **changed: object) -> Message:
    layout = {"sample_rate": RATE_HZ, "channels": samples.shape[1], "layout": "interleaved"}
    return "/mics", AUDIO, stamp_ns, {"header": header(stamp_ns), "data": samples.ravel()} | layout | changed


def blocks(samples: np.ndarray, *, lost: tuple[int, ...] = (), **changed: object) -> list[Message]:
    """Return sound in blocks of 0.1 s from 5 s on."""
    step = RATE_HZ // 10
    parts = enumerate(samples[start : start + step] for start in range(0, len(samples), step))
    return [block(part, (50 + k) * 10**8, **changed) for k, part in parts if k not in lost]


def info(recorded_ns: int = 0, **changed: object) -> Message:
    about = {"channels": CHANNELS, "sample_rate": RATE_HZ, "sample_format": "S16LE", "coding_format": "wave"}
    return "/info", "audio_common_msgs/msg/AudioInfo", recorded_ns, about | changed


def pcm(data: bytes, stamp_ns: int, recorded_ns: int) -> Message:
    values = {"header": header(max(stamp_ns, 0)), "audio": {"data": np.frombuffer(data, np.uint8)}}
    return "/audio", "audio_common_msgs/msg/AudioDataStamped", recorded_ns, values


def image(stamp_ns: int, recorded_ns: int, *boxes: dict[str, object]) -> Message:
    return "/boxes", DETECTIONS, recorded_ns, {"header": header(stamp_ns), "detections": [*boxes]}


def box(left: float, top: float, width: float, height: float, label: str, score: float) -> dict[str, object]:
    centre = {"position": {"x": left + width / 2, "y": top + height / 2}}
    size = {"center": centre, "size_x": width, "size_y": height}
    said = {"person": score / 2, label: score}
    return {"bbox": size, "results": [{"hypothesis": {"class_id": k, "score": v}} for k, v in said.items()]}


def moved(stamp_ns: int, recorded_ns: int, speed_mps: float) -> Message:
    twist = {"twist": {"linear": {"x": speed_mps}}}
    return "/odom", ODOMETRY, recorded_ns, {"header": header(stamp_ns), "twist": twist}
