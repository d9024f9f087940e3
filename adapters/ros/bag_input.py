"""Reader of ROS 2 bags: topics, sound, array, detections and speed of the ego."""

import io
import logging
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

from worldstate.adapters.audio import sound_file
from worldstate.adapters.audio.plain_samples import LOOK_BYTES, MAX_CHANNELS, Encoding
from worldstate.adapters.camera.detections import MAX_FRAMES, DetectionFrame, DetectionLog, frame_of
from worldstate.adapters.datasets.ovad import AUDIO_NAME
from worldstate.adapters.export.log_messages import MCAP_MAGIC, MCAP_MENDED, check_chunks
from worldstate.adapters.files.array_file import named_arrays
from worldstate.adapters.files.file_io import MAX_BYTES, in_order, plain_file, read_text, refused_as_file
from worldstate.adapters.files.odometry_file import OdometryLog
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground import InputFileError, WorldstateError, seconds
from worldstate.ground.extras import optional
from worldstate.ground.typing import Float32Array, FloatArray, IntArray
from worldstate.measurement.odometry import Odometry

from . import message_types as types
from .message_types import instant_of, stamp_of, typestore
from .sample_clock import begins_again, contradiction, lost_before

# Commands that may repair a file of each storage.
_MENDED = {".mcap": MCAP_MENDED, ".db3": "`sqlite3 IN .recover | sqlite3 OUT`"}
METADATA_NAME, STORAGE_SUFFIXES = "metadata.yaml", tuple(_MENDED)
# Half a second of 1,000 microphones; the detections of an image are far smaller.
MAX_MESSAGE_BYTES = 64 << 20


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: its folder, or one of its storage files.

    Examples
    --------
    >>> is_bag(Path("drive.mcap")), is_bag(Path("street.wav"))
    (True, False)
    """
    if path.suffix in STORAGE_SUFFIXES or (path / METADATA_NAME).is_file():
        return True
    return path.is_dir() and not (path / AUDIO_NAME).exists() and _storage_of(path) != [path]


def _storage_of(path: Path) -> list[Path]:
    """Return the paths to open for a bag: its folder or file, or the files of a folder without metadata."""
    files = [] if (path / METADATA_NAME).is_file() else [path.glob(f"*{kind}") for kind in STORAGE_SUFFIXES]
    return sorted(one for found in files for one in found) or [path]


@dataclass(frozen=True, slots=True)
class BagReader:
    """An open bag."""

    path: Path
    reader: Any  # The reader of rosbags

    def has(self, topic: str, kind: str) -> bool:
        """Return whether there are messages of a type on a topic, from the bag's metadata."""
        every = self.reader.connections
        return any(one.topic == topic and one.msgtype == kind and one.msgcount for one in every)

    def topic(self, option: str, given: str | None, *kinds: str) -> str | None:
        """Return the topic with messages of one of these types; None if there is none.

        Raises
        ------
        InputFileError
            If the given topic is missing, or none was given and several fit.
        """
        found = {one.topic: one.msgtype for one in self.reader.connections}
        fit = sorted(topic for topic, kind in found.items() if kind in kinds)
        if given is not None and given not in fit:
            problem = f"expected {' or '.join(kinds)} on {given} ({option}), got {self.told()}"
            raise InputFileError(self.path, problem)
        if given is None and len(fit) > 1:
            problem = f"expected {option} with one of {', '.join(fit)}, which all hold {' or '.join(kinds)}"
            raise InputFileError(self.path, problem)
        return given or next(iter(fit), None)

    def kind_of(self, topic: str) -> str:
        """Return the type of a topic's messages."""
        return next(str(one.msgtype) for one in self.reader.connections if one.topic == topic)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield the messages of a topic, each with its time of recording, ns."""
        chosen = [one for one in self.reader.connections if one.topic == topic]
        with refused_as_bag(self.path):
            for connection, recorded_ns, data in self.reader.messages(chosen):
                if len(data) > MAX_MESSAGE_BYTES:
                    problem = f"expected messages of at most {MAX_MESSAGE_BYTES} bytes on {topic}"
                    raise InputFileError(self.path, f"{problem}, got one of {len(data)}")
                yield recorded_ns, self.reader.deserialize(data, connection.msgtype)

    def told(self) -> str:
        """Return the topics and their types, for error messages."""
        found = sorted(f"{one.topic} ({one.msgtype})" for one in self.reader.connections)
        return ", ".join(found) or "no topic at all"


@contextmanager
def open_bag(path: Path) -> Iterator[BagReader]:
    """Open a bag for the duration of the context.

    Raises
    ------
    InputFileError
        If there is no bag, or it is damaged.
    MissingExtraError
        If rosbags is not installed.
    """
    store = typestore()
    from rosbags.highlevel import AnyReader

    with refused_as_bag(path):
        for file in (one for one in (path.iterdir() if path.is_dir() else [path]) if not one.is_dir()):
            with plain_file(file, "a file of a bag") as opened:
                named = file.suffix == ".mcap" or opened.read(len(MCAP_MAGIC)) == MCAP_MAGIC
            if named:
                check_chunks(file)
        if (metadata := path / METADATA_NAME).is_file():
            _check_packing(metadata, metadata.stat().st_mtime_ns)
        # Bags from before ROS 2 Iron have no definitions; the definitions that ship here are used for them.
        reader = AnyReader(_storage_of(path), default_typestore=store)
        reader.open()
    try:
        yield BagReader(path, reader)
    finally:
        reader.close()


@lru_cache(maxsize=8)  # a run opens a bag several times, and the reader parses the file each time
def _check_packing(metadata: Path, modified_ns: int) -> None:
    """Refuse a bag with compressed files or messages, because its reader decodes them without a limit."""
    about = optional("ruamel.yaml").YAML(typ="safe").load(read_text(metadata, "metadata", MAX_BYTES))
    mode = about["rosbag2_bagfile_information"].get("compression_mode") or "none"
    if mode.lower() != "none":
        problem = f"expected a bag compressed by chunks of MCAP or not at all, got compression by {mode:.20}"
        raise InputFileError(metadata.parent, f"{problem}: `ros2 bag convert` writes one")


@contextmanager
def refused_as_bag(path: Path) -> Iterator[None]:
    """Convert any failure on a bag to one error with its name."""
    try:
        yield
    except WorldstateError:
        raise
    # A damaged bag may raise errors of SQLite, YAML, struct, zstd or numpy; a corrupt length may exhaust the
    # memory.
    except Exception as error:
        said = " ".join(str(error).split()) or type(error).__name__
        if "rofile" in said:  # An MCAP file of another program, such as `run --export mcap=FILE`
            said += "; `worldstate log replay` reads files of snapshots"
        kind = ".db3" if path.suffix == ".db3" or any(path.glob("*.db3")) else ".mcap"
        way_on = f"{_MENDED[kind]} may save a truncated file, `ros2 bag reindex` a folder"
        problem = f"expected a readable bag of ROS 2 ({said:.200}); {way_on}"
        raise InputFileError(path, problem) from error


_LOG = logging.getLogger(__name__)
T = TypeVar("T")

AUDIO_KINDS = types.AUDIO, types.STAMPED_PCM, types.PCM, types.AUDIO_FRAME, types.RAW_AUDIO
# Formats by message type; compressed formats are refused, because they lose the phase between microphones.
_ENCODED: tuple[Encoding, ...] = get_args(Encoding)
_FRAMES = "signed_16", "signed_24", "signed_padded_24", "signed_32", "float"
ENCODINGS: dict[str, dict[str, Encoding]] = {
    types.PCM_INFO: dict(zip(("S16LE", "S24LE", "S24_32LE", "S32LE", "F32LE"), _ENCODED, strict=True)),
    types.AUDIO_FRAME: dict(zip(_FRAMES, _ENCODED, strict=True)),
    types.RAW_AUDIO: {"pcm-s16": "s16"},
    types.AUDIO: {"": "f32"},
}
# Longest loss that is filled with silence, which the front-end detects as a dropout, seconds.
LONGEST_GAP_S = 2.0
STATIC_TOPIC = "/tf_static"
# Tolerance of a quaternion's length, as in tf2.
_LENGTH_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class AudioPacket:
    """The bytes of one message, which may start and end within a sample."""

    stamp_ns: int  # Time of the first sample
    recorded_ns: int
    pcm: sound_file.RawPcm
    data: bytes

    @property
    def length_ns(self) -> float:
        """Length of the samples, ns."""
        return len(self.data) * 1e9 / (self.pcm.frame_bytes * self.pcm.sample_rate_hz)


@dataclass(frozen=True, slots=True)
class BagSound(sound_file.SoundStream):
    """A sound topic of a bag. Its clock counts the samples, starting at the stamp of the first one."""

    path: Path
    topic: str
    sample_rate_hz: int
    channels: int
    start_ns: int
    stated: sound_file.RawPcm | None = None  # Format of the bytes, if given
    frames: int = 0  # Including silence for losses
    lost_ns: Mapping[int, float] = field(default_factory=dict)  # Losses by number of the message after them
    again: tuple[tuple[int, int], ...] = ()  # Recording times at which stamps start again, and their offset

    @property
    def name(self) -> str:
        """Path of the bag, for error messages."""
        return str(self.path)

    def open(self) -> "BagAudio":
        """Open the sound at its start."""
        return BagAudio(self)

    def time_ns(self, stamp_ns: int, recorded_ns: int) -> int:
        """Convert the stamp of another message to this clock; without a stamp, use its time of recording."""
        last = bisect_right(self.again, (recorded_ns, np.inf))
        return stamp_ns + self.again[last - 1][1] if last and stamp_ns else stamp_ns or recorded_ns


class BagAudio(sound_file.Audio):
    """Sound of a bag that is being read; losses are filled with silence."""

    def __init__(self, sound: BagSound) -> None:
        self._sound, self.path, self.frames = sound, sound.path, sound.frames
        self.sample_rate_hz, self.channels = sound.sample_rate_hz, sound.channels
        first = next(self.blocks(self.sample_rate_hz), np.empty((0, self.channels), np.float32))
        self.silent_channels = sound_file.constant_channels(first)

    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the recording from its start in blocks of `frames` samples; the last one may be shorter."""
        held = np.empty((0, self.channels), np.float32)
        for part in self._parts():
            held = np.concatenate([held, part])
            yield from (held[start : start + frames] for start in range(0, len(held) - frames + 1, frames))
            held = held[len(held) // frames * frames :]
        if len(held):
            yield held

    def close(self) -> None:
        """Do nothing: the bag is only open while blocks are read."""

    def _parts(self) -> Iterator[Float32Array]:
        """Yield the samples of each message, after silence for the loss before it."""
        held, done, sound = b"", 0, self._sound
        with open_bag(self.path) as bag:
            for number, packet in enumerate(audio_packets(bag, sound.topic, sound.stated)):
                if lost_ns := sound.lost_ns.get(number, 0.0):
                    self._tell_lost(1e-9 * lost_ns, done / self.sample_rate_hz)
                whole = packet.pcm.frame_bytes
                data = held + bytes(_lost_bytes(packet, lost_ns, bool(held))) + packet.data
                samples = packet.pcm.to_samples(data[: len(data) // whole * whole])
                sound_file.check_finite(self.path, samples, done)
                held, done = data[len(data) // whole * whole :], done + len(samples)
                yield samples

    def _tell_lost(self, lost_s: float, at_s: float) -> None:
        """Warn of a loss; refuse a long one."""
        if lost_s > LONGEST_GAP_S:
            expected = f"expected messages on {self._sound.topic} at most {LONGEST_GAP_S:g} s apart"
            got = f"at {at_s:.3f} s the next is {lost_s:.3f} s off: cut the bag there (`ros2 bag convert`)"
            raise InputFileError(self.path, f"{expected}; {got}")
        _LOG.warning("%s: %.3f s of %s are missing at %.3f s", self.path, lost_s, self._sound.topic, at_s)


def _lost_bytes(packet: AudioPacket, lost_ns: float, within: bool) -> int:
    """Return the size of a loss in bytes: whole samples, or whole messages if messages split samples."""
    whole = packet.pcm.frame_bytes
    each = len(packet.data) if within or len(packet.data) % whole else whole
    return round(lost_ns * 1e-9 * packet.pcm.sample_rate_hz * whole / each) * each


def audio_packets(
    bag: BagReader, topic: str, stated: sound_file.RawPcm | None = None
) -> Iterator[AudioPacket]:
    """Yield the packet of each message of a topic; refuse changes of format and a topic without messages."""
    kind, first = bag.kind_of(topic), None
    if kind == types.AUDIO and stated is not None:
        problem = f"expected no format beside the topic: messages of {kind} contain theirs"
        raise InputFileError(bag.path, problem)
    if stated is None and kind in (types.STAMPED_PCM, types.PCM):
        stated = _pcm_info(bag, topic)
    for recorded_ns, message in bag.messages(topic):
        packet = _packet(stated or _described(bag, topic, kind, message), message, recorded_ns)
        first = first or packet
        got = packet.pcm.sample_rate_hz, packet.pcm.channels
        if got != (wanted := (first.pcm.sample_rate_hz, first.pcm.channels)):
            told = "expected {} Hz and {} channels as in the first message of {}, got {} and {}"
            raise InputFileError(bag.path, told.format(*wanted, topic, *got))
        if packet.data:
            yield packet
    if first is None:
        raise InputFileError(bag.path, f"expected samples on {topic}, but it has no message")


def _pcm_info(bag: BagReader, topic: str) -> sound_file.RawPcm:
    """Return the format of audio_common's bytes from its AudioInfo message."""
    where = bag.topic("the topic of AudioInfo", None, types.PCM_INFO)
    said = None if where is None else next(bag.messages(where), None)
    if said is None:
        wanted = f"{types.PCM_INFO} beside {topic}, or --topic audio={topic}:RATE:CHANNELS:FORMAT"
        raise InputFileError(bag.path, f"expected {wanted}")
    info = said[1]
    if info.coding_format.lower() not in ("wave", "raw", ""):
        problem = f"{where}: expected uncompressed samples (format:=wave), got {info.coding_format!r:.20}"
        raise InputFileError(bag.path, problem)
    return _described(bag, str(where), types.PCM_INFO, info)


# Fields with format, rate and channels of the bytes in each message type; float planes have one format.
_STATED = {
    types.PCM_INFO: ("sample_format", "sample_rate", "channels"),
    types.AUDIO_FRAME: ("format", "sampling_frequency", "channel_count"),
    types.RAW_AUDIO: ("format", "sample_rate", "number_of_channels"),
    types.AUDIO: ("", "sample_rate", "channels"),
}


def _described(bag: BagReader, topic: str, kind: str, message: Any) -> sound_file.RawPcm:
    """Return the format of bytes from a message that contains it."""
    sample_format, rate_hz, channels = (getattr(message, name, "") for name in _STATED[kind])
    if (encoding := ENCODINGS[kind].get(sample_format)) is None:
        problem = f"{topic}: expected one of {', '.join(ENCODINGS[kind])}, got {sample_format!r:.20}"
        raise InputFileError(bag.path, problem)
    with refused_as_file(bag.path):
        return sound_file.RawPcm(io.BytesIO(), int(rate_hz), int(channels), encoding, str(bag.path))


def _packet(pcm: sound_file.RawPcm, message: Any, recorded_ns: int) -> AudioPacket:
    """Return the bytes of a message with the time of their first sample."""
    head = getattr(message, "header", message)
    at = getattr(head, "stamp", getattr(head, "timestamp", None))
    stamp_ns = 0 if at is None else instant_of(at)
    packet = AudioPacket(stamp_ns, recorded_ns, pcm, _bytes_of(pcm, message))
    # The stamp of AudioFrame is the time of its last sample, and so is the recording time of messages without
    # stamp.
    if stamp_ns and not hasattr(message, "frame_sample_count"):
        return packet
    return replace(packet, stamp_ns=max((stamp_ns or recorded_ns) - round(packet.length_ns), 0))


def _bytes_of(pcm: sound_file.RawPcm, message: Any) -> bytes:
    """Return samples as bytes with interleaved channels."""
    data, layout = getattr(message, "audio", message).data, getattr(message, "layout", "interleaved")
    if hasattr(message, "layout") and len(data) % pcm.channels:
        problem = f"expected samples of {pcm.channels} channels, got {len(data)} numbers"
        raise InputFileError(pcm.name, problem)
    if layout not in ("interleaved", "planar"):
        raise InputFileError(pcm.name, f"layout: expected interleaved or planar, got {layout!r:.40}")
    frames = getattr(message, "frame_sample_count", None)
    if frames is not None and len(data) != frames * pcm.frame_bytes:
        counted = f"expected whole samples of {pcm.channels} channels, {frames} as frame_sample_count says"
        raise InputFileError(pcm.name, f"{counted}, got {len(data)} bytes")
    return bytes(data.reshape(pcm.channels, -1).T.tobytes() if layout == "planar" else data.tobytes())


def read_sound(
    path: Path, topic: str | None = None, stated: sound_file.RawPcm | None = None
) -> tuple[BagSound, MicrophoneArray | None]:
    """Return the sound of a bag and its array, if it contains one."""
    with open_bag(path) as bag, refused_as_file(path):
        return sound_of_bag(bag, topic, stated), _array(bag)


def read_beside(
    sound: BagSound, *, detections: str | None = None, odometry: str | None = None
) -> tuple[DetectionLog | None, OdometryLog | None]:
    """Return detections and odometry of a bag, from the given topics or the only ones of their types.

    Raises
    ------
    InputFileError
        If the bag is damaged, several topics fit, or a message contains impossible values.
    """
    with open_bag(sound.path) as bag, refused_as_file(sound.path):
        seen = bag.topic("--topic detections=", detections, types.DETECTIONS)
        driven = bag.topic("--topic odometry=", odometry, types.ODOMETRY)
        boxes = None if seen is None else _detections(bag, seen, sound)
        return boxes, None if driven is None else _ego(bag, driven, sound)


def needed_array(sound: BagSound, array: MicrophoneArray | None) -> MicrophoneArray:
    """Return the array in `base_link`; refuse a bag without microphone positions.

    A named board has its own axes. If static transforms connect `base_link` with the frame of the sound, they
    are applied to it.
    """
    if array is None:
        raise InputFileError(sound.path, f"expected --array, or a message of {types.ARRAY} in the bag")
    if array.name not in named_arrays():
        return array
    with open_bag(sound.path) as bag, refused_as_file(sound.path):
        positions_m = _in_base_link(bag, sound, array.positions_m)
        if positions_m is None:
            return array
        placed = replace(array, positions_m=positions_m)
    x, y, z = positions_m.mean(axis=0).tolist()
    told = "%s: %s is turned and moved by %s, its middle at (%.3g, %.3g, %.3g) m"
    _LOG.warning(told, sound.path, array.name, STATIC_TOPIC, x, y, z)
    return placed


def _in_base_link(bag: BagReader, sound: BagSound, points_m: FloatArray) -> FloatArray | None:
    """Return points of the sound's frame in `base_link`; None if no static transforms connect the two."""
    _, first = next(bag.messages(sound.topic))
    frame = _frame_name(first.header.frame_id) if hasattr(first, "header") else ""
    transforms, passed = _static_transforms(bag), set[str]()
    while frame != "base_link" and frame in transforms:
        if frame in passed:
            problem = f"{STATIC_TOPIC}: expected no loop, got one of {len(passed)} frames"
            raise InputFileError(bag.path, problem)
        passed.add(frame)
        frame, said = transforms[frame]
        points_m = _in_parent(bag.path, said, points_m)
    return points_m if passed and frame == "base_link" else None


def _static_transforms(bag: BagReader) -> dict[str, tuple[str, Any]]:
    """Return the parent of every frame and the last transform to it."""
    found: dict[str, tuple[str, Any]] = {}
    if not bag.has(STATIC_TOPIC, types.TRANSFORMS):
        return found
    for _, message in _few(bag, STATIC_TOPIC):
        for one in message.transforms:
            child, parent = _frame_name(one.child_frame_id), _frame_name(one.header.frame_id)
            before, _ = found.get(child, (parent, None))
            if before != parent:
                problem = f"{STATIC_TOPIC}: expected one parent of {child}, got {before} and {parent}"
                raise InputFileError(bag.path, problem)
            found[child] = parent, one.transform
    return found


def _frame_name(text: str) -> str:
    return text.removeprefix("/")  # used by ROS 1


def _in_parent(path: Path, transform: Any, points_m: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    turn, by = transform.rotation, transform.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) <= _LENGTH_TOLERANCE:
        raise InputFileError(path, f"{STATIC_TOPIC}: expected a quaternion of length 1, got {length:.3g}")
    turned = points_m @ Rotation.from_quat(quaternion).as_matrix().T
    return np.asarray(turned + np.array([by.x, by.y, by.z]))


def sound_of_bag(bag: BagReader, topic: str | None, stated: sound_file.RawPcm | None = None) -> BagSound:
    """Return the sound of a bag with the stamps of all its messages; refuse a bag without sound."""
    heard = bag.topic("--topic audio=", topic, *AUDIO_KINDS)
    if heard is None:
        raise InputFileError(bag.path, f"expected a topic of {' or '.join(AUDIO_KINDS)}, got {bag.told()}")
    if _storage_of(bag.path) != [bag.path]:
        _LOG.warning("%s: %s is missing, `ros2 bag reindex` writes it", bag.path, METADATA_NAME)
    stamps, recorded, lengths, data = list[int](), list[int](), list[float](), b""
    for packet in audio_packets(bag, heard, stated):
        stamps.append(packet.stamp_ns)
        recorded.append(packet.recorded_ns)
        lengths.append(packet.length_ns)
        data += packet.data if len(data) < LOOK_BYTES else b""
    if not stamps:
        raise InputFileError(bag.path, f"expected samples on {heard}, but its messages are empty")
    pcm = packet.pcm
    pcm.check_encoding(data)
    sound = BagSound(bag.path, heard, pcm.sample_rate_hz, pcm.channels, stamps[0], stated)
    return _on_samples(sound, np.array(stamps), np.array(recorded), np.array(lengths))


def _on_samples(
    sound: BagSound, stamps_ns: IntArray, recorded_ns: IntArray, lengths_ns: FloatArray
) -> BagSound:
    """Return the sound with the losses and repetitions that its stamps show."""
    again = begins_again(stamps_ns, lengths_ns)
    added_ns = np.zeros(len(stamps_ns), dtype=np.int64)
    for k, more_ns in again:
        added_ns[k:] = more_ns
        told = "%s: stamps of %s begin again at %.3f s (a bag in a loop?) and are continued"
        _LOG.warning(told, sound.path, sound.topic, seconds(int(lengths_ns[:k].sum())))
    stamps_ns = stamps_ns + added_ns
    lost_ns, early_ns = lost_before(stamps_ns, lengths_ns)
    if told := contradiction(stamps_ns, lengths_ns, lost_ns):
        problem = f"{sound.topic}: {told}: another rate (--topic), or a bag that was played in a loop"
        raise InputFileError(sound.path, f"{problem} whose passes the recorder mixed: record one pass")
    return replace(
        sound,
        start_ns=sound.start_ns - round(early_ns),
        frames=round(float(lengths_ns.sum() + lost_ns.sum()) * 1e-9 * sound.sample_rate_hz),
        lost_ns={int(k): float(lost_ns[k]) for k in np.flatnonzero(lost_ns)},
        again=tuple((int(recorded_ns[k]), more_ns) for k, more_ns in again),
    )


def _array(bag: BagReader) -> MicrophoneArray | None:
    topic = bag.topic("one topic of an array, or --array,", None, types.ARRAY)
    said = None if topic is None else next(bag.messages(topic), None)
    if said is None:
        return None
    places = said[1].positions
    if len(places) > MAX_CHANNELS:
        raise InputFileError(bag.path, f"{topic}: expected at most {MAX_CHANNELS} microphones")
    positions_m = np.array([[one.x, one.y, one.z] for one in places], dtype=np.float64).reshape(-1, 3)
    return MicrophoneArray(positions_m, str(said[1].name or topic))


def _detections(bag: BagReader, topic: str, sound: BagSound) -> DetectionLog:
    stamps, frames = _timed(bag, topic, sound, lambda message: detection_frame(message.detections))
    return DetectionLog(tuple(frames), np.array(stamps, dtype=np.int64), f"{bag.path} {topic}")


def _timed(
    bag: BagReader, topic: str, sound: BagSound, read: Callable[[Any], T], most: int = MAX_FRAMES
) -> tuple[list[int], list[T]]:
    """Return increasing times on the clock of the sound, and the contents of the messages.

    If more than three in four stamps repeat an earlier one, for example because a node always sends its start
    time, they are ignored. The time of recording then replaces them, as for messages without a stamp.
    """
    told = [(stamp_of(one.header), recorded_ns, read(one)) for recorded_ns, one in _few(bag, topic, most)]
    stamped = [stamp_ns for stamp_ns, *_ in told if stamp_ns]
    if stands := 4 * len({*stamped}) < len(stamped):  # transports hardly ever repeat a message so often
        _LOG.warning("%s: stamps of %s do not advance, so the times of recording are used", bag.path, topic)
    times = [sound.time_ns(0 if stands else stamp_ns, recorded_ns) for stamp_ns, recorded_ns, _ in told]
    order = in_order(times, f"{bag.path} {topic}")
    return [times[i] for i in order], [told[i][2] for i in order]


def detection_frame(found: Any) -> DetectionFrame:
    """Return the boxes of an image, with the same checks as for a file."""
    best = [_best(one.results) for one in found]
    told = {"scores": [score for _, score in best], "classes_str": [label for label, _ in best]}
    return frame_of(told | {"boxes": [_box(one.bbox) for one in found]}, "detections")


def _box(box: Any) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom; the centre contains a point since ROS 2 Humble, x and y before."""
    centre = getattr(box.center, "position", box.center)
    half = 0.5 * box.size_x, 0.5 * box.size_y
    return centre.x - half[0], centre.y - half[1], centre.x + half[0], centre.y + half[1]


def _best(results: Any) -> tuple[str, float]:
    """Return class and score of the best hypothesis, or "unknown" and 0 for a box without one."""
    said = [getattr(one, "hypothesis", one) for one in results]
    best = max(said, key=lambda one: one.score, default=None)
    if best is None:
        return "unknown", 0.0
    # The field was called id before ROS 2 Galactic.
    return str(getattr(best, "class_id", getattr(best, "id", "unknown"))), float(best.score)


def _ego(bag: BagReader, topic: str, sound: BagSound) -> OdometryLog:
    # The pose is not used, because the odometry frame is not the map of the context's corners.
    def moved(message: Any) -> tuple[float, float]:
        return message.twist.twist.linear.x, message.twist.twist.angular.z

    times, told = _timed(bag, topic, sound, moved, 100 * MAX_FRAMES)
    return OdometryLog(tuple(Odometry(topic, ns, *one) for ns, one in zip(times, told, strict=True)))


def _few(bag: BagReader, topic: str, most: int = MAX_FRAMES) -> Iterator[tuple[int, Any]]:
    for number, message in enumerate(bag.messages(topic)):
        if number >= most:
            raise InputFileError(bag.path, f"expected at most {most} messages on {topic}")
        yield message
