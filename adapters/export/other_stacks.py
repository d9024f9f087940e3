"""Entities in the formats of other stacks: Autoware's objects, OSI's SensorData, tracks of ODAS and MOT.

A position is measured, or assumed in the crossing lane if only the azimuth is known.
"""

import json
import logging
import math
import socket
import struct
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from worldstate.adapters.files.file_io import FileOpener, GrowingFile, line_writer
from worldstate.ground import FloatArray, InvalidArgumentError, seconds
from worldstate.ground.checks import host_and_port
from worldstate.ground.extras import check_extra, optional
from worldstate.ground.threads import BoundedChannel, WorkThread
from worldstate.state import Entity, WorldState
from worldstate.state.sensor import Ego

# Real vehicles of OVAD pass some 9 m ahead of the ego; another junction has another distance.
CROSSING_M = 9.0
# Relative standard deviation of that distance, assumed: 6 to 12 m for two of three junctions.
_CROSSING_SHARE = 0.3
# At larger azimuths the lane would be hundreds of metres away, so the place is on a circle about the ego.
_WIDEST_RAD = math.radians(80.0)
PATH_STEP_S, PATH_STEPS = 0.5, 6


@dataclass(frozen=True, slots=True, eq=False)
class LaneObject:
    """A moving entity with a position and a velocity, which other stacks require."""

    entity: Entity
    position_m: FloatArray  # x, y in the frame of the state
    velocity_mps: FloatArray  # x, y over ground; zero if unknown
    covariance: FloatArray  # of the position, m^2, shape (2, 2)
    measured: bool  # Whether a sensor measured the position; otherwise the lane is assumed
    confidence: float  # Probability that it exists and follows its path

    @property
    def yaw_rad(self) -> float:
        """Direction of its motion."""
        return math.atan2(self.velocity_mps[1], self.velocity_mps[0])

    def path_m(self) -> FloatArray:
        """Return its positions now and every 0.5 s until 3 s from now, shape (7, 2)."""
        after_s = PATH_STEP_S * np.arange(PATH_STEPS + 1)[:, None]
        return np.asarray(self.position_m + after_s * self.velocity_mps)


def lane_objects(state: WorldState, crossing_m: float = CROSSING_M) -> Iterator[LaneObject]:
    r"""Yield every moving entity with a position.

    An entity with an azimuth only is placed in a lane across the road ahead,

    .. math:: p = d\,(1, \tan\theta), \qquad
        \Sigma = \sigma_\theta^2\, \partial_\theta p\, \partial_\theta p^T + \sigma_d^2\, p p^T / d^2

    and a hidden one moves towards the axis of the ego at the pace of its occluder, on each possible side.
    """
    paces = {occluder.direction: occluder.pace_hz for occluder in state.context.occluders}
    coming = {cue.direction: (cue.within or {}).get("3") for cue in state.cues if cue.direction}
    moving = (part for one in state.entities if one.moving for part in one.on_each_side())
    for entity in moving:
        within = coming.get(entity.direction or "") if entity.status == "hidden" else None
        # The cue gives P(exists) multiplied by P(comes into view | exists).
        confidence = min(entity.existence_probability, 1.0 if within is None else within)
        if entity.position_m is None:
            pace_hz = paces.get(entity.direction or "", 0.0)
            yield _assumed(entity, crossing_m, pace_hz, confidence, _twist(state))
        else:
            yield _measured(entity, entity.position_m, confidence)


def _measured(entity: Entity, position_m: tuple[float, float, float], confidence: float) -> LaneObject:
    velocity = np.array((entity.velocity_mps or (0.0, 0.0, 0.0))[:2])
    known = np.array(entity.covariance)[:2, :2] if entity.covariance is not None else np.zeros((2, 2))
    return LaneObject(entity, np.array(position_m[:2]), velocity, known, True, confidence)


def _twist(state: WorldState) -> tuple[float, float]:
    """Return speed and yaw rate of the ego vehicle."""
    if state.ego is None:
        return state.context.ego_speed_mps or 0.0, 0.0
    return state.ego.speed_mps, state.ego.yaw_rate_rad_s


def _of_axes(position_m: FloatArray, twist: tuple[float, float]) -> FloatArray:
    """Return the velocity over ground of a position that is fixed in the axes of the moving ego vehicle."""
    (x, y), (speed_mps, yaw_rate_rad_s) = position_m.tolist(), twist
    return np.array([speed_mps - yaw_rate_rad_s * y, yaw_rate_rad_s * x])


def _assumed(
    entity: Entity, crossing_m: float, pace_hz: float, confidence: float, twist: tuple[float, float]
) -> LaneObject:
    azimuth_rad = entity.azimuth_rad
    along = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])
    across = np.array([-along[1], along[0]])
    slope = max(along[0], math.cos(_WIDEST_RAD))
    position = crossing_m / slope * along
    # On the circle only the azimuth changes; in the lane the range changes with it.
    turned = crossing_m / slope * across if slope > along[0] else np.array([0.0, crossing_m / slope**2])
    spread = _CROSSING_SHARE * position
    covariance = entity.azimuth_std_rad**2 * np.outer(turned, turned) + np.outer(spread, spread)
    if entity.status == "hidden":
        velocity = np.array([0.0, -math.copysign(pace_hz * crossing_m, azimuth_rad)])
    else:
        velocity = (entity.azimuth_rate_rad_s or 0.0) * turned + _of_axes(position, twist)
        if not turned[0]:
            # The lane is fixed: driving towards it changes the azimuth of a standing vehicle in it.
            velocity = np.array([0.0, velocity[1] - velocity[0] * along[1] / along[0]])
    return LaneObject(entity, position, velocity, covariance, False, confidence)


def _in_map(one: LaneObject, ego: Ego) -> LaneObject:
    """Return an object in the map, with the covariance of the ego pose added."""
    cos, sin = math.cos(ego.yaw_rad), math.sin(ego.yaw_rad)
    turn = np.array([[cos, -sin], [sin, cos]])
    x, y = offset = turn @ one.position_m
    by_pose = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
    covariance = turn @ one.covariance @ turn.T + by_pose @ np.array(ego.covariance) @ by_pose.T
    position, velocity = np.array(ego.position_m) + offset, turn @ one.velocity_mps
    return replace(one, position_m=position, velocity_mps=velocity, covariance=covariance)


# Numbers of autoware_perception_msgs/ObjectClassification, which has no tram.
LABELS = {"unknown": 0, "car": 1, "van": 1, "truck": 2, "bus": 3, "motorcycle": 5, "bicycle": 6, "person": 7}
# Usual length, width and height, metres.
SIZES_M = {
    2: (8.0, 2.5, 3.2),
    3: (12.0, 2.5, 3.2),
    5: (2.2, 0.8, 1.4),
    6: (1.8, 0.6, 1.6),
    7: (0.5, 0.5, 1.8),
}
CAR_M = (4.5, 1.8, 1.5)
# Variance of required values without a measurement, as in Autoware's trackers.
_UNKNOWN_VARIANCE = 1e4


def autoware_objects(state: WorldState, crossing_m: float = CROSSING_M) -> dict[str, Any]:
    """Return the message in the frame `map`; hidden entities are in the occluded lane, see `lane_objects`.

    Raises
    ------
    InvalidArgumentError
        If no odometry has given the pose of the ego vehicle in the map.

    Examples
    --------
    >>> ego = Ego((2.0, 0.0), 0.0, ((0.0,) * 3,) * 3, 5.0, 0.0, localised=True)
    >>> autoware_objects(WorldState(1_500_000_000, 0, ego=ego))
    {'header': {'stamp': {'sec': 1, 'nanosec': 500000000}, 'frame_id': 'map'}, 'objects': []}
    """
    if (ego := state.ego) is None or not ego.localised:
        got = "none" if ego is None else "a speed without a pose"
        expected = "expected odometry with x_m, y_m and yaw_rad"
        raise InvalidArgumentError(f"Autoware's objects stand in the map: {expected}, got {got}")
    stamp = dict(zip(("sec", "nanosec"), divmod(state.stamp_ns, 1_000_000_000), strict=True))
    objects = [_object(_in_map(one, ego)) for one in lane_objects(state, crossing_m)]
    return {"header": {"stamp": stamp, "frame_id": "map"}, "objects": objects}


def is_localised(state: WorldState) -> bool:
    """Return whether the pose of the ego vehicle in the map is known."""
    return state.ego is not None and state.ego.localised


@contextmanager
def autoware_lines(
    path: Path, crossing_m: float, opener: FileOpener, *, comes: bool
) -> Iterator[Callable[[WorldState], None]]:
    """Yield a function that writes the messages of states, one per line.

    The first state must have a pose, unless `comes` is true: the odometry of a live run gives the pose later.
    """
    started = comes
    with line_writer(path, opener) as write:

        def write_state(state: WorldState) -> None:
            nonlocal started
            # After a clock fault the pose is unknown for a while; this must not end a run.
            if not started or is_localised(state):
                write(json.dumps(autoware_objects(state, crossing_m), allow_nan=False))
            started = True

        yield write_state


def likeliest_label(one: LaneObject) -> int:
    """Return Autoware's number of the likeliest known class, or 0."""
    known = [said for said in one.entity.classification or () if LABELS.get(said.label, 0)]
    return LABELS[max(known, key=lambda said: said.probability).label] if known else 0


def _object(one: LaneObject) -> dict[str, Any]:
    speed = float(np.hypot(*one.velocity_mps))
    length, width, height = SIZES_M.get(likeliest_label(one), CAR_M)
    kinds = [{"label": LABELS.get(kind, 0), "probability": share} for kind, share in _kinds(one.entity)]
    poses = [_pose(point, 0.5 * height, one.yaw_rad) for point in one.path_m()]
    still = {"linear": _xyz(0.0, 0.0), "angular": _xyz(0.0, 0.0)}
    twist = still | {"linear": _xyz(speed, 0.0)}  # in the axes of the object
    unknown = _covariance(np.diag([_UNKNOWN_VARIANCE] * 2))
    step = {"sec": int(PATH_STEP_S), "nanosec": int(PATH_STEP_S % 1.0 * 1e9)}
    return {
        "object_id": {"uuid": list(uuid.UUID(one.entity.id).bytes)},
        "existence_probability": one.entity.existence_probability,
        # Planners use the first one, and fail without one.
        "classification": kinds,
        "kinematics": {
            "initial_pose_with_covariance": {"pose": poses[0], "covariance": _covariance(one.covariance)},
            "initial_twist_with_covariance": {"twist": twist, "covariance": unknown},
            "initial_acceleration_with_covariance": {"accel": still, "covariance": unknown},
            "predicted_paths": [{"path": poses, "time_step": step, "confidence": one.confidence}],
        },
        # Type 0 is a bounding box.
        "shape": {"type": 0, "footprint": {"points": []}, "dimensions": _xyz(length, width, height)},
    }


def _kinds(entity: Entity) -> list[tuple[str, float]]:
    """Return the classes with their probabilities, the likeliest first; the remainder to one is unknown."""
    told = [(said.label, said.probability) for said in entity.classification or ()]
    left = 1.0 - sum(probability for _, probability in told)
    return sorted(told + [("unknown", left)] * (left > 1e-6), key=lambda kind: -kind[1])


def _pose(position_m: FloatArray, z_m: float, yaw_rad: float) -> dict[str, Any]:
    turned = _xyz(0.0, 0.0, math.sin(0.5 * yaw_rad)) | {"w": math.cos(0.5 * yaw_rad)}
    x, y = position_m.tolist()
    return {"position": _xyz(x, y, z_m), "orientation": turned}


def _xyz(x: float, y: float, z: float = 0.0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _covariance(of_xy: FloatArray) -> list[float]:
    """Return the 6 x 6 covariance of x, y, z and three angles by rows; unknown variances are large."""
    whole = _UNKNOWN_VARIANCE * np.eye(6)
    whole[:2, :2] = of_xy
    return list(map(float, whole.ravel()))


# Numbers of osi3.MovingObject.VehicleClassification by those of Autoware; a person has another type.
_VEHICLES = {1: "TYPE_CAR", 2: "TYPE_HEAVY_TRUCK", 3: "TYPE_BUS", 5: "TYPE_MOTORBIKE", 6: "TYPE_BICYCLE"}
_PERSON = 7
# Assumed deviation of the height of the middle: a van is 0.5 m higher than a car, and roads have a camber.
_Z_STD_M = 0.3


def osi_sensor_data(state: WorldState, crossing_m: float = CROSSING_M) -> Any:
    """Return the snapshot as an `osi3` message: hidden entities are predicted, others measured.

    Examples
    --------
    >>> osi_sensor_data(WorldState(1_500_000_000, 7)).moving_object_header.cycle_counter
    7
    """
    data = optional("osi3.osi_sensordata_pb2").SensorData()
    data.version.CopyFrom(_osi_version())
    header = data.moving_object_header
    for stamp in (data.timestamp, data.last_measurement_time, header.measurement_time):
        stamp.seconds, stamp.nanos = divmod(state.stamp_ns, 1_000_000_000)
    data.sensor_id.value = 1
    # The state is in the axes of the vehicle, so the virtual sensor is at their origin.
    _set(data.mounting_position.position, x=0.0, y=0.0, z=0.0)
    _set(data.mounting_position.orientation, yaw=0.0, pitch=0.0, roll=0.0)
    header.cycle_counter = state.seq
    impaired = any(sensor.condition != "working" for sensor in state.sensors)
    available = "AVAILABLE_REDUCED" if impaired else "AVAILABLE"
    header.data_qualifier = getattr(header, f"DATA_QUALIFIER_{available}")
    for one in lane_objects(state, crossing_m):
        _fill(data.moving_object.add(), one, one.velocity_mps - _of_axes(one.position_m, _twist(state)))
    return data


def _set(part: Any, **values: float) -> None:
    """Set all values of a part, because a vector of OSI has three values or is absent."""
    for name, value in values.items():
        setattr(part, name, value)


@contextmanager
def osi_trace(path: Path, crossing_m: float, opener: FileOpener) -> Iterator[Callable[[WorldState], None]]:
    """Yield a function that writes states to a trace, which is multi-channel if its name ends in .mcap.

    The name of a multi-channel trace is extended at the end to OSI's convention, which includes the number of
    states.
    """
    check_extra("osi3")
    many, states = path.suffix.lower() == ".mcap", count()
    opened = _osi_mcap if many else _osi_lengths
    with opener(path) as file, opened(file) as write:
        yield lambda state: write(osi_sensor_data(state, crossing_m), next(states))
    with suppress(FileNotFoundError):  # a trace that grows may have been removed, which is logged
        if many:
            path.rename(path.with_name(_osi_name(path.name, next(states))))


@contextmanager
def _osi_lengths(file: BinaryIO | GrowingFile) -> Iterator[Callable[[Any, int], None]]:
    """Yield a function that writes the length of a message, little endian, and then the message."""

    def write(data: Any, number: int) -> None:
        message = data.SerializeToString()
        file.write(struct.pack("<I", len(message)) + message)

    yield write


@contextmanager
def _osi_mcap(file: BinaryIO | GrowingFile) -> Iterator[Callable[[Any, int], None]]:
    """Yield a function that writes a message to OSI's multi-channel trace."""
    osi, protobuf = _osi_versions()
    writer = optional("mcap.writer").Writer(file, chunk_size=1 << 12)  # a second of states
    writer.start()
    about = {"osi_version": osi, "protobuf_version": protobuf}
    bounds = {f"{bound}_{name}": version for bound in ("min", "max") for name, version in about.items()}
    writer.add_metadata("net.asam.osi.trace", {"version": osi} | bounds)
    kind = optional("osi3.osi_sensordata_pb2").SensorData
    schema = optional("mcap_protobuf.schema").register_schema(writer, kind)
    told = {f"net.asam.osi.trace.channel.{name}": version for name, version in about.items()}
    channel = writer.register_channel("SensorData", "protobuf", schema, told)

    def write(data: Any, number: int) -> None:
        stamp_ns = data.timestamp.seconds * 1_000_000_000 + data.timestamp.nanos
        writer.add_message(channel, stamp_ns, data.SerializeToString(), stamp_ns, number)

    yield write
    writer.finish()


def _osi_version() -> Any:
    described = optional("osi3.osi_version_pb2")
    return described.DESCRIPTOR.GetOptions().Extensions[described.current_interface_version]


def _osi_versions() -> tuple[str, str]:
    """Return the versions of OSI and of protobuf."""
    version = _osi_version()
    osi = f"{version.version_major}.{version.version_minor}.{version.version_patch}"
    return osi, str(optional("google.protobuf").__version__)


def _osi_name(name: str, states: int) -> str:
    """Return a trace's name by OSI's convention: time, type, versions without dots, messages, own name."""
    written = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    osi, protobuf = (version.replace(".", "") for version in _osi_versions())
    return f"{written}_sd_{osi}_{protobuf}_{states}_{name}"


def _fill(moving: Any, one: LaneObject, relative_mps: FloatArray) -> None:
    entity = one.entity
    header = moving.header
    # OSI's ids have 64 bits, of which the highest marks an unset value.
    header.tracking_id.value = uuid.UUID(entity.id).int & (1 << 63) - 1
    header.existence_probability = entity.existence_probability
    header.age = seconds(entity.updated_ns - entity.created_ns)
    found = "MEASURED" if one.measured and entity.status != "hidden" else "PREDICTED"
    header.measurement_state = getattr(header, f"MEASUREMENT_STATE_{found}")
    (x, y), (vx, vy) = one.position_m.tolist(), relative_mps.tolist()
    x_std, y_std = (one.covariance.diagonal() ** 0.5).tolist()
    length, width, height = SIZES_M.get(likeliest_label(one), CAR_M)
    base = moving.base
    _set(base.position, x=x, y=y, z=0.5 * height)  # the middle of the box
    _set(base.velocity, x=vx, y=vy, z=0.0)
    _set(base.orientation, yaw=one.yaw_rad, pitch=0.0, roll=0.0)
    _set(moving.base_rmse.position, x=x_std, y=y_std, z=_Z_STD_M)
    _set(base.dimension, length=length, width=width, height=height)
    moving.movement_state = moving.MOVEMENT_STATE_MOVING
    kinds = optional("osi3.osi_object_pb2").MovingObject
    for label, probability in _kinds(entity):
        number, candidate = LABELS.get(label, 0), moving.candidate.add()
        candidate.probability = probability
        known = kinds.TYPE_VEHICLE if number else kinds.TYPE_UNKNOWN
        candidate.type = kinds.TYPE_PEDESTRIAN if number == _PERSON else known
        if number in _VEHICLES:
            candidate.vehicle_classification.type = getattr(kinds.VehicleClassification, _VEHICLES[number])


class _Numbers:
    """Numbers of the present entities in order of appearance; those of a whole run would fill the memory."""

    def __init__(self) -> None:
        self._there: dict[str, int] = {}
        self._next = count(1)

    def of(self, state: WorldState) -> dict[str, int]:
        """Return the number of every entity of a state by its id; no number is used twice."""
        self._there = {one.id: self._there.get(one.id) or next(self._next) for one in state.entities}
        return self._there


@contextmanager
def mot_lines(path: Path, opener: FileOpener) -> Iterator[Callable[[WorldState], None]]:
    """Yield a function that writes states as text of MOTChallenge 2015, tracks in space.

    A line is ``frame, id, -1, -1, -1, -1, conf, x, y, z``: the number of the state from 1, the number of the
    entity, its existence probability, and its position in metres in the frame of the state. A snapshot has no
    boxes of images, and a moving entity without a known distance has no line.
    """
    numbers, frames = _Numbers(), count(1)
    with line_writer(path, opener) as write:

        def write_state(state: WorldState) -> None:
            frame, known = next(frames), numbers.of(state)
            for one in state.entities:
                if one.moving and one.position_m is not None:
                    place = ",".join(f"{value:.3f}" for value in one.position_m)
                    write(f"{frame},{known[one.id]},-1,-1,-1,-1,{one.existence_probability:.6f},{place}")

        yield write_state


# ODAS always sends the same number of tracks; empty ones have the id 0.
_TRACKS = 4
# ODAS Studio splits the stream at "}", newline, "{". It restores the lost brace only if neither of the two
# characters before the last one is a brace. Therefore the layout is ODAS's own, with "]" on a separate line.
_ODAS_MESSAGE = '{{\n    "timeStamp": {stamp},\n    "src": [\n        {sources}\n    ]\n}}\n'


class OdasTracks:
    """Snapshots in ODAS's JSON of tracked sources; entities are numbered in order of appearance.

    Examples
    --------
    >>> json.loads(OdasTracks().message(WorldState(0, 12)))["timeStamp"]
    12
    """

    def __init__(self) -> None:
        self._numbers = _Numbers()

    def message(self, state: WorldState) -> str:
        """Return one message: the likeliest moving entities as directions, their existence as activity."""
        numbers = self._numbers.of(state)
        moving = [one for one in state.entities if one.moving]
        likeliest = sorted(moving, key=lambda one: -one.existence_probability)[:_TRACKS]
        tracks = [_odas_track(one, numbers[one.id]) for one in likeliest]
        empty = {"id": 0, "tag": "", "x": 0.0, "y": 0.0, "z": 0.0, "activity": 0.0}
        sources = map(json.dumps, tracks + [empty] * (_TRACKS - len(tracks)))
        return _ODAS_MESSAGE.format(stamp=state.seq, sources=",\n        ".join(sources))


def _odas_track(entity: Entity, number: int) -> dict[str, object]:
    x, y = round(math.cos(entity.azimuth_rad), 3), round(math.sin(entity.azimuth_rad), 3)
    activity = round(entity.existence_probability, 3)
    return {"id": number, "tag": "dynamic", "x": x, "y": y, "z": 0.0, "activity": activity}


@contextmanager
def odas_socket(address: str, *, live: bool = False) -> Iterator[Callable[[WorldState], None]]:
    """Connect to HOST:PORT, as ODAS does, and yield a function that sends the message of a state.

    The function waits for a slow receiver, and a receiver that disconnects is an error. In a `live` run a
    `LiveSender` drops messages instead.
    """
    tracks, target = OdasTracks(), host_and_port("--export odas", address, 1)
    try:
        connection = socket.create_connection(target, TAKEN_S)
    except (OSError, TypeError, UnicodeError) as error:
        # The message has no file name, so the command cannot add one.
        raise InvalidArgumentError(f"--export odas: expected a listener at {address} ({error})") from error
    if live:
        with LiveSender(target, connection) as sender:
            yield lambda state: sender.put(tracks.message(state).encode())
    else:
        with connection:
            yield lambda state: connection.sendall(tracks.message(state).encode())


_LOG = logging.getLogger(__name__)
# A receiver that reads nothing for this time is disconnected; a new connection is tried at this interval.
TAKEN_S, AGAIN_S = 10.0, 1.0
# Two seconds of hops: older states are useless.
MOST_WAITING = 20


class LiveSender(WorkThread):
    """Send messages in a separate thread, so that no receiver can delay or end a run.

    At the end it waits up to one second until the queued messages are sent.

    Parameters
    ----------
    target : (str, int)
        Host and port of the receiver, for a new connection after it has disconnected.
    connection : socket
        The open connection to it.
    """

    def __init__(self, target: tuple[str, int], connection: socket.socket) -> None:
        self._target, self._connection = target, connection
        self._waiting, self._failed = BoundedChannel[bytes](MOST_WAITING), 0
        super().__init__(self._end, AGAIN_S)

    @property
    def dropped(self) -> int:
        """Number of dropped messages."""
        return self._waiting.dropped + self._failed

    def put(self, message: bytes) -> None:
        """Queue a message; if the queue is full, it replaces the oldest one."""
        self._waiting.put(message)

    def __exit__(self, *_: object) -> None:
        self._waiting.close()
        super().__exit__()

    def _end(self) -> None:
        self._connection.close()
        if self.dropped:
            _LOG.warning("%s:%d did not take %d messages", *self._target, self.dropped)

    def _work(self) -> None:
        while (message := self._waiting.take()) is not None:
            try:
                self._connection.sendall(message)
            except OSError:  # the receiver has disconnected, or has received only part of a message
                self._failed += 1
                self._connection.close()
                if self._stopped.wait(AGAIN_S):
                    return
                with suppress(OSError):
                    self._connection = socket.create_connection(self._target, TAKEN_S)
