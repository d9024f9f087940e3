"""ASAM OSI `SensorData`, and traces of it."""

import struct
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.extras import check_extra, optional
from worldstate.ground.values import seconds
from worldstate.state import WorldState

from .autoware import CAR_M, LABELS, SIZES_M, likeliest_label
from .lane_objects import CROSSING_M, LaneObject, lane_objects

# Of osi3.MovingObject.VehicleClassification, by Autoware's numbers; a person has another type.
_VEHICLES = {1: "TYPE_CAR", 2: "TYPE_HEAVY_TRUCK", 3: "TYPE_BUS", 5: "TYPE_MOTORBIKE", 6: "TYPE_BICYCLE"}
_PERSON = 7


def osi_sensor_data(state: WorldState, crossing_m: float = CROSSING_M) -> Any:
    """Return the snapshot as an `osi3` message: hidden entities are predicted, others measured.

    Examples
    --------
    >>> osi_sensor_data(WorldState(1_500_000_000, 7)).moving_object_header.cycle_counter
    7
    """
    described, data = optional("osi3.osi_version_pb2"), optional("osi3.osi_sensordata_pb2").SensorData()
    version = described.DESCRIPTOR.GetOptions().Extensions[described.current_interface_version]
    data.version.CopyFrom(version)
    for stamp in (data.timestamp, data.last_measurement_time, data.moving_object_header.measurement_time):
        stamp.seconds, stamp.nanos = divmod(state.stamp_ns, 1_000_000_000)
    data.sensor_id.value = 1
    # The axes of the state are those of the vehicle: a virtual sensor at their origin.
    data.mounting_position.position.x = data.mounting_position.position.y = 0.0
    header = data.moving_object_header
    header.cycle_counter = state.seq
    impaired = any(sensor.condition != "working" for sensor in state.sensors)
    header.data_qualifier = (
        header.DATA_QUALIFIER_AVAILABLE_REDUCED if impaired else header.DATA_QUALIFIER_AVAILABLE
    )
    for one in lane_objects(state, crossing_m):
        _fill(data.moving_object.add(), one)
    return data


@contextmanager
def osi_trace(path: Path, crossing_m: float) -> Iterator[Callable[[WorldState], None]]:
    """Lend a function that writes states to a single-channel trace: length, little endian, and message."""
    check_extra("osi3")
    with atomic_path(path) as temporary, temporary.open("wb") as file:

        def write(state: WorldState) -> None:
            message = osi_sensor_data(state, crossing_m).SerializeToString()
            file.write(struct.pack("<I", len(message)) + message)

        yield write


def _fill(moving: Any, one: LaneObject) -> None:
    entity = one.entity
    header = moving.header
    # OSI counts in 64 bits, of which the highest marks a value that is not set.
    header.tracking_id.value = uuid.UUID(entity.id).int & (1 << 63) - 1
    header.existence_probability = entity.existence_probability
    header.age = seconds(entity.updated_ns - entity.created_ns)
    predicted = entity.status == "hidden" or not one.measured
    header.measurement_state = (
        header.MEASUREMENT_STATE_PREDICTED if predicted else header.MEASUREMENT_STATE_MEASURED
    )
    base, spread = moving.base, one.covariance.diagonal() ** 0.5
    base.position.x, base.position.y = one.position_m.tolist()
    base.velocity.x, base.velocity.y = one.velocity_mps.tolist()
    base.position.z = base.velocity.z = 0.0  # A vector has three values, or is not set
    base.orientation.yaw = one.yaw_rad
    moving.base_rmse.position.x, moving.base_rmse.position.y = spread.tolist()
    size = base.dimension
    size.length, size.width, size.height = SIZES_M.get(likeliest_label(one), CAR_M)
    moving.movement_state = moving.MOVEMENT_STATE_MOVING
    kinds = optional("osi3.osi_object_pb2").MovingObject
    for said in entity.classification:
        number, candidate = LABELS.get(said.label, 0), moving.candidate.add()
        candidate.probability = said.probability
        candidate.type = (
            kinds.TYPE_PEDESTRIAN
            if number == _PERSON
            else kinds.TYPE_VEHICLE
            if number
            else kinds.TYPE_UNKNOWN
        )
        if number in _VEHICLES:
            name = _VEHICLES[number]
            candidate.vehicle_classification.type = getattr(kinds.VehicleClassification, name)
