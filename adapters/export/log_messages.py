"""Messages of a hop for viewers and logs, and the writers of MCAP files and Rerun recordings."""

import base64
import json
import logging
import math
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, TypeAlias

import numpy as np

from worldstate.adapters.audio.sound_file import SoundInput, open_sound
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.adapters.files.file_io import FileOpener, GrowingFile, atomic_path, plain_file, whole_file
from worldstate.ground import FloatArray, InputFileError, nanoseconds
from worldstate.ground.errors import MissingExtraError
from worldstate.ground.extras import check_extra, optional
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import Float32Array
from worldstate.state.world_state import WorldState, snapshot_schema

from . import scene

SNAPSHOT_TOPIC, SCENE_TOPIC = "/worldstate/snapshot", "/worldstate/scene"
SRP_TOPIC, IMAGE_TOPIC = "/worldstate/srp", "/camera/image"
SOUND_TOPIC, FRAME_TOPIC = "/microphones/sound", "/tf"
# OVAD's images, 1936 pixels wide, are shown in a third of a screen. At half the width each takes 77 kB in a
# log instead of 245 kB.
_WIDEST_PX, _QUALITY = 1000, 80
Told: TypeAlias = (
    WorldState | scene.SceneUpdate | scene.CompressedImage | scene.RawAudio | scene.FrameTransform
)


@dataclass(frozen=True, slots=True)
class LogMessage:
    """One message, in JSON, for viewers and logs."""

    topic: str
    stamp_ns: int
    value: Told

    @property
    def data(self) -> bytes:
        """The JSON text; for a snapshot that of `WorldState.to_json`."""
        if isinstance(self.value, WorldState):
            return self.value.to_json().encode()
        written = encode(self.value)
        return json.dumps(written, allow_nan=False, check_circular=False, separators=(",", ":")).encode()

    @property
    def schema_name(self) -> str:
        """Name of the type of the value; drawings have the names of Foxglove's types."""
        own = isinstance(self.value, WorldState)
        return "worldstate.Snapshot" if own else f"foxglove.{type(self.value).__name__}"

    @property
    def schema(self) -> bytes:
        """JSON Schema of the message."""
        if isinstance(self.value, WorldState):
            return json.dumps(snapshot_schema()).encode()
        shipped = files("worldstate") / "data" / f"{self.schema_name}.schema.json"
        return json.dumps(json.loads(shipped.read_text("utf-8"))).encode()


LogSink: TypeAlias = Callable[[LogMessage], None]


def state_messages(state: WorldState) -> Iterator[LogMessage]:
    """Yield the snapshot (JSON of `WorldState.to_json`), its scene, and with odometry its frame in the map.

    Examples
    --------
    >>> [(message.topic, message.schema_name) for message in state_messages(WorldState(0, 0))]
    [('/worldstate/snapshot', 'worldstate.Snapshot'), ('/worldstate/scene', 'foxglove.SceneUpdate')]
    """
    yield LogMessage(SNAPSHOT_TOPIC, state.stamp_ns, state)
    yield LogMessage(SCENE_TOPIC, state.stamp_ns, scene.scene_update(state))
    if state.ego is not None:
        stamp, half_rad = scene.SceneTime.of_ns(state.stamp_ns), 0.5 * state.ego.yaw_rad
        turned = scene.Rotation(z=math.sin(half_rad), w=math.cos(half_rad))
        frame = scene.FrameTransform(stamp, "map", state.frame_id, scene.Xyz(*state.ego.position_m), turned)
        yield LogMessage(FRAME_TOPIC, state.stamp_ns, frame)


def srp_message(state: WorldState, azimuths_rad: FloatArray, srp: FloatArray) -> LogMessage:
    """Return the power of the sound over azimuth as a line about the array."""
    return LogMessage(SRP_TOPIC, state.stamp_ns, scene.srp_scene(state, azimuths_rad, srp))


def camera_images(recording: Path, start_ns: int = 0) -> Callable[[int], Iterator[LogMessage]]:
    """Return a function that yields the last image before a stamp if it is new; stamps must increase."""
    path = recording / VIDEO_NAME
    if not path.is_file():
        return lambda stamp_ns: iter(())
    cv2, video = optional("cv2"), open_video(path)
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


@contextmanager
def recorded_sound(
    sound: SoundInput, start_ns: int = 0, channels: Sequence[int] = ()
) -> Iterator[Callable[[int], Iterator[LogMessage]]]:
    """Yield a function that returns the sound of one microphone of a file up to increasing stamps."""
    if not isinstance(sound, Path | tuple):
        yield lambda stamp_ns: iter(())
        return
    with open_sound(sound, channels=channels, strict=False) as audio:
        rate_hz, taken = audio.sample_rate_hz, 0
        blocks = audio.blocks(rate_hz // 10)
        # Silent channels are numbered from 1.
        heard = next(i for i in range(audio.channels) if i + 1 not in audio.silent_channels)

        def sound_until(stamp_ns: int) -> Iterator[LogMessage]:
            nonlocal taken
            while (begins_ns := start_ns + nanoseconds(taken / rate_hz)) < stamp_ns:
                block = next(blocks, None)
                if block is None:
                    return
                taken += len(block)
                yield sound_message(begins_ns, block[:, heard], rate_hz)

        yield sound_until


def sound_message(stamp_ns: int, samples: Float32Array, rate_hz: int) -> LogMessage:
    """Return a block of sound, full scale 1, that begins at the stamp."""
    whole = np.clip(np.rint(32768.0 * samples), -32768, 32767).astype("<i2")
    text = base64.b64encode(whole.tobytes()).decode("ascii")
    return LogMessage(SOUND_TOPIC, stamp_ns, scene.RawAudio(scene.SceneTime.of_ns(stamp_ns), text, rate_hz))


def image_message(stamp_ns: int, jpeg: bytes) -> LogMessage:
    """Return an image of the camera."""
    text = base64.b64encode(jpeg).decode("ascii")
    image = scene.CompressedImage(scene.SceneTime.of_ns(stamp_ns), "camera", text)
    return LogMessage(IMAGE_TOPIC, stamp_ns, image)


@contextmanager
def rerun_file(path: Path) -> Iterator[LogSink]:
    """Yield a function that writes messages to a Rerun recording, which is named at the end of the block."""
    rr = optional("rerun")
    with atomic_path(path) as temporary:
        recording = rr.RecordingStream("worldstate")
        recording.save(temporary)
        recording.log("/", rr.ViewCoordinates.FLU, static=True)

        def write(message: LogMessage) -> None:
            recording.set_time("stream", duration=1e-9 * message.stamp_ns)
            for place, drawn in _drawn(rr, message.topic, message.value):
                recording.log(place, drawn)

        try:
            yield write
        finally:
            recording.disconnect()


def _drawn(rr: ModuleType, topic: str, value: Told) -> Iterator[tuple[str, object]]:
    """Yield the drawings of a message with their paths; drawings of earlier scenes are removed."""
    if isinstance(value, WorldState):
        yield topic, rr.TextDocument(value.to_json(), media_type="application/json")
    elif isinstance(value, scene.CompressedImage):
        yield topic, rr.EncodedImage(contents=base64.b64decode(value.data), media_type="image/jpeg")
    elif isinstance(value, scene.SceneUpdate):
        yield topic, rr.Clear(recursive=True)
        for item in value.entities:
            place = f"{topic}/{item.id.replace(' ', '/')}"
            yield from ((f"{place}/{part}", shape) for part, shape in _shapes(rr, item))
            if item.metadata:
                yield place, rr.AnyValues(**{pair.key: pair.value for pair in item.metadata})


def _shapes(rr: ModuleType, item: scene.SceneItem) -> Iterator[tuple[str, object]]:
    for number, one in enumerate(item.triangles):
        corners, color = _points(one.points), _color(one.color)
        triangles = np.arange(len(corners)).reshape(-1, 3)
        yield (
            f"sector{number}",
            rr.Mesh3D(vertex_positions=corners, triangle_indices=triangles, albedo_factor=color),
        )
    if item.lines:
        strips, radii = zip(*((_points(one.points), 0.5 * one.thickness) for one in item.lines), strict=True)
        yield "lines", rr.LineStrips3D(strips, radii=radii, colors=_colors(item.lines))
    for arrow in item.arrows:
        ahead = (arrow.shaft_length + arrow.head_length, 0.0, 0.0)
        yield "arrow", rr.Arrows3D(vectors=[ahead], colors=[_color(arrow.color)])
    if item.cubes:
        centers = _points(one.pose.position for one in item.cubes)
        sizes = _points(one.size for one in item.cubes)
        yield "boxes", rr.Boxes3D(centers=centers, sizes=sizes, colors=_colors(item.cubes))
    if item.texts:
        places, labels = _points(one.pose.position for one in item.texts), [one.text for one in item.texts]
        colors = _colors(item.texts)
        yield "text", rr.Points3D(places, labels=labels, colors=colors, radii=0.1, show_labels=True)


def _points(points: Iterable[scene.Xyz]) -> FloatArray:
    return np.array([(one.x, one.y, one.z) for one in points], dtype=np.float64).reshape(-1, 3)


def _color(color: scene.Rgba) -> list[int]:
    return [round(255 * part) for part in (color.r, color.g, color.b, color.a)]


def _colors(shapes: Iterable[scene.SceneLine | scene.SceneSolid | scene.SceneText]) -> list[list[int]]:
    return [_color(one.color) for one in shapes]


@contextmanager
def mcap_file(path: Path, opener: FileOpener = whole_file) -> Iterator[LogSink]:
    """Yield a function that writes messages to an MCAP file.

    The file gets its name at the end of the block. A `GrowingFile` has its name from the start, and a killed
    run loses half a second of it. After a write error the file ends with its last complete chunk, as its
    index contains byte offsets.
    """
    check_extra("mcap")
    with opener(path) as file:
        messages = _McapMessages(file)

        def write(message: LogMessage) -> None:
            nonlocal messages
            # A new file begins with a snapshot, because the scene of a state follows its snapshot.
            if isinstance(file, GrowingFile) and file.full and message.topic == SNAPSHOT_TOPIC:
                messages.finish()
                file.begin()
                messages = _McapMessages(file)
            messages.write(message)

        try:
            yield write
        finally:
            messages.finish()


# Only complete chunks of an unfinished file are read: a killed run loses at most this time of its stream.
_CHUNK_NS = nanoseconds(0.5)
_CHUNK_BYTES = 1 << 20


class _ChunkLimit:
    """Size limit of a chunk, which the writer checks after every message; 0 after `_CHUNK_NS`."""

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._elapsed = False

    def take(self, stamp_ns: int) -> None:
        first_ns = stamp_ns if self._first_ns is None else self._first_ns
        self._elapsed = stamp_ns - first_ns >= _CHUNK_NS
        self._first_ns = stamp_ns if self._elapsed else min(first_ns, stamp_ns)

    def __lt__(self, size: int) -> bool:
        return self._elapsed or size > _CHUNK_BYTES


class _McapMessages:
    """Messages of an MCAP file."""

    def __init__(self, file: BinaryIO | GrowingFile) -> None:
        self._limit, self._channels = _ChunkLimit(), dict[str, int]()
        self._writer = optional("mcap.writer").Writer(file, chunk_size=self._limit)
        self._writer.start()

    def write(self, message: LogMessage) -> None:
        if message.topic not in self._channels:
            schema = self._writer.register_schema(message.schema_name, "jsonschema", message.schema)
            self._channels[message.topic] = self._writer.register_channel(message.topic, "json", schema)
        self._limit.take(message.stamp_ns)
        channel = self._channels[message.topic]
        self._writer.add_message(channel, message.stamp_ns, message.data, message.stamp_ns)

    def finish(self) -> None:
        self._writer.finish()


_LOG = logging.getLogger(__name__)
MCAP_MENDED = "`mcap recover IN -o OUT`"
# Half a second of states with images takes a hundredth of it.
_LARGEST_RECORD = 1 << 28


def read_messages(path: Path, *topics: str) -> Iterator[tuple[int, str, str]]:
    """Yield stamp, topic and text of the messages of an MCAP file, in the order of writing.

    From a truncated file the messages of complete chunks are read.
    """
    reader, cut_short = optional("mcap.reader").NonSeekingReader, optional("mcap.exceptions").EndOfFile
    check_chunks(path)
    with plain_file(path, "an MCAP file") as file:
        found = False
        try:
            # The order is that of writing and not of the stamps, because a late measurement may have moved a
            # stamp back.
            messages = reader(file, validate_crcs=True, record_size_limit=_LARGEST_RECORD)
            for _, channel, message in messages.iter_messages(log_time_order=False):
                found = True
                if channel.topic in topics:
                    yield message.log_time, channel.topic, message.data.decode()
        except GeneratorExit:
            raise
        except Exception as error:  # zstandard, lz4 and struct raise different errors for damaged bytes
            cut = isinstance(error, (cut_short, struct.error)) and _is_cut(path)
            if not (found and cut):
                said = str(error) * (not cut) or "it ends before its first whole chunk"
                problem = f"expected an MCAP file of snapshots ({said:.200})"
                raise InputFileError(path, f"{problem}; {MCAP_MENDED} may save it") from error
            _LOG.warning("%s: it was cut, its whole chunks are read; %s may save more", path, MCAP_MENDED)


def _is_cut(path: Path) -> bool:
    """Return whether an MCAP file is truncated: it does not end with the magic number."""
    with path.open("rb") as file:
        magic = file.read(_MAGIC_BYTES)
        while len(head := file.read(_RECORD.size)) == _RECORD.size:
            file.seek(_RECORD.unpack(head)[1], os.SEEK_CUR)
        return head != magic


MCAP_MAGIC = b"\x89MCAP"
# MCAP: the magic number, the head of every record, and the head of a chunk up to its compression.
_MAGIC_BYTES, _RECORD, _CHUNK, _CHUNK_HEAD = 8, struct.Struct("<BQ"), 6, struct.Struct("<QQQII")
# Message: its channel and number, then its time.
_MESSAGE, _MESSAGE_HEAD = 5, struct.Struct("<6xQ")
# Index of a chunk: its first and last time and its offset; the last 16 bytes are its sizes.
_INDEX, _INDEX_HEAD, _INDEX_SIZES = 8, struct.Struct("<QQQ"), struct.Struct("<QQ")
# Readers of bags keep all chunks with overlapping times in memory, decoded.
_MOST_AT_ONCE = 1 << 29


def check_chunks(path: Path) -> None:
    """Refuse an MCAP file with a chunk that fills the memory, or with an index that contradicts its chunks.

    The readers of MCAP and of bags have no limit, and the stated size of a compressed frame may be wrong,
    missing, or followed by another frame. Therefore each chunk is decoded here first, up to its stated size.
    Bags are read by the index. It must list exactly these chunks, and its time ranges must contain all of
    their messages, since readers of bags omit messages outside of them.
    """
    about = path.stat()
    _check_chunks(path, about.st_size, about.st_mtime_ns)


@lru_cache(maxsize=8)  # a run opens a bag several times, and decoding takes seconds per gigabyte
def _check_chunks(path: Path, end: int, modified_ns: int) -> None:
    chunks, times = dict[int, tuple[tuple[int, int], tuple[int, ...]]](), list[tuple[int, int, int]]()
    with plain_file(path, "an MCAP file") as file:
        at = _MAGIC_BYTES
        while at + _RECORD.size <= end:
            file.seek(at)
            begin = at
            kind, length = _RECORD.unpack(file.read(_RECORD.size))
            at += _RECORD.size + length
            if kind == _INDEX and _INDEX_HEAD.size < length <= _LARGEST_RECORD and at <= end:
                index = file.read(length)
                (first, last, place), sizes = _INDEX_HEAD.unpack_from(index), _INDEX_SIZES.unpack(index[-16:])
                known, span = chunks.get(place, (None, ()))
                if known != sizes:
                    raise InputFileError(path, f"expected an index of its chunks, got none at byte {place}")
                if not first <= min(span, default=first) <= max(span, default=last) <= last:
                    problem = f"expected an index with the times of its messages, got {first} to {last} ns"
                    raise InputFileError(path, problem)
                times += [(first, 0, sizes[1]), (last, 1, -sizes[1])]
            # Readers refuse or omit truncated records before they decode them.
            if kind == _CHUNK and length >= _CHUNK_HEAD.size and at <= end:
                head = file.read(_CHUNK_HEAD.size)
                claimed = int(_CHUNK_HEAD.unpack(head)[2])
                if (size := max(length, claimed)) > _LARGEST_RECORD:
                    limit = f"expected chunks of at most {_LARGEST_RECORD >> 20} MiB"
                    raise InputFileError(path, f"{limit}, got one of {size >> 20}")
                chunk = head + file.read(length - len(head))
                if len(decoded := _decoded(chunk, claimed)) > claimed:
                    raise InputFileError(path, f"expected {claimed} bytes in a chunk as it claims, got more")
                chunks[begin] = (_compressed_bytes(chunk), claimed), _message_span(path, decoded)
    if (most := max(accumulate(size for *_, size in sorted(times)), default=0)) > _MOST_AT_ONCE:
        limit = f"expected at most {_MOST_AT_ONCE >> 20} MiB in chunks of one time"
        raise InputFileError(path, f"{limit}, got {most >> 20}")


def _compressed_bytes(chunk: bytes) -> int:
    at = _CHUNK_HEAD.size + _CHUNK_HEAD.unpack_from(chunk)[4]
    return int.from_bytes(chunk[at : at + 8], "little")


def _decoded(chunk: bytes, claimed: int) -> bytes:
    """Return the content of a chunk, at most one byte more than the stated size; empty if it is damaged."""
    named = _CHUNK_HEAD.unpack_from(chunk)[4]
    name, rest = chunk[_CHUNK_HEAD.size :][:named], chunk[_CHUNK_HEAD.size + named :]
    data = rest[8:]
    if _compressed_bytes(chunk) > len(data):
        return bytes(claimed + 1)
    try:
        if name == b"zstd":
            decoder = optional("zstandard").ZstdDecompressor()
            return bytes(decoder.stream_reader(data, read_across_frames=True).read(claimed + 1))
        if name == b"lz4":
            return bytes(optional("lz4.frame").LZ4FrameFile(BytesIO(data)).read(claimed + 1))
    except MissingExtraError:
        raise
    except Exception:  # a damaged frame, for which the reader raises its own error
        return b""
    return data[:claimed]


def _message_span(path: Path, decoded: bytes) -> tuple[int, ...]:
    """Return the first and the last time of the messages among records, or nothing without a message."""
    at, times = 0, list[int]()
    while at + _RECORD.size <= len(decoded):
        kind, length = _RECORD.unpack_from(decoded, at)
        if not kind:  # zeros compress well, and would be read as very many records
            raise InputFileError(path, "expected records in a chunk, got zeros")
        at += _RECORD.size + length
        if kind == _MESSAGE and length >= _MESSAGE_HEAD.size and at <= len(decoded):
            times += _MESSAGE_HEAD.unpack_from(decoded, at - length)
    return (min(times), max(times)) if times else ()
