"""Predicted objects as Autoware's `PredictedObjects` message spells them, as JSON."""

import math
import uuid
from typing import Any

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.state import WorldState

from .lane_objects import CROSSING_M, PATH_STEP_S, LaneObject, lane_objects

# Of autoware_perception_msgs/ObjectClassification; a tram is none of them.
LABELS = {"unknown": 0, "car": 1, "van": 1, "truck": 2, "bus": 3, "motorcycle": 5, "bicycle": 6, "person": 7}
# Length, width and height of a usual one, metres.
SIZES_M = {
    2: (8.0, 2.5, 3.2),
    3: (12.0, 2.5, 3.2),
    5: (2.2, 0.8, 1.4),
    6: (1.8, 0.6, 1.6),
    7: (0.5, 0.5, 1.8),
}
CAR_M = (4.5, 1.8, 1.5)
# Of what the message asks for and nobody measured: "unknown" as Autoware's trackers state it.
_UNKNOWN_VARIANCE = 1e4


def autoware_objects(state: WorldState, crossing_m: float = CROSSING_M) -> dict[str, Any]:
    """Return the message; hidden entities stand in the occluded lane, see `lane_objects`.

    Examples
    --------
    >>> autoware_objects(WorldState(1_500_000_000, 0))
    {'header': {'stamp': {'sec': 1, 'nanosec': 500000000}, 'frame_id': 'base_link'}, 'objects': []}
    """
    sec, nanosec = divmod(state.stamp_ns, 1_000_000_000)
    header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": state.frame_id}
    return {"header": header, "objects": [_object(one) for one in lane_objects(state, crossing_m)]}


def likeliest_label(one: LaneObject) -> int:
    """Return Autoware's number of the likeliest known class, 0 where none is known."""
    known = [said for said in one.entity.classification if LABELS.get(said.label, 0)]
    return LABELS[max(known, key=lambda said: said.probability).label] if known else 0


def _object(one: LaneObject) -> dict[str, Any]:
    speed = float(np.hypot(*one.velocity_mps))
    pose = {"pose": _pose(one.position_m, one.yaw_rad), "covariance": _covariance(one.covariance)}
    twist = {"linear": _xyz(speed, 0.0), "angular": _xyz(0.0, 0.0)}  # in the axes of the object
    still = {"linear": _xyz(0.0, 0.0), "angular": _xyz(0.0, 0.0)}
    unknown = _covariance(np.diag([_UNKNOWN_VARIANCE] * 2))
    path = {
        "path": [_pose(point, one.yaw_rad) for point in one.path_m()],
        "time_step": {"sec": int(PATH_STEP_S), "nanosec": int(PATH_STEP_S % 1.0 * 1e9)},
        "confidence": one.confidence,
    }
    length, width, height = SIZES_M.get(likeliest_label(one), CAR_M)
    return {
        "object_id": {"uuid": list(uuid.UUID(one.entity.id).bytes)},
        "existence_probability": one.entity.existence_probability,
        "classification": [
            {"label": LABELS.get(said.label, 0), "probability": said.probability}
            for said in one.entity.classification
        ],
        "kinematics": {
            "initial_pose_with_covariance": pose,
            "initial_twist_with_covariance": {"twist": twist, "covariance": unknown},
            "initial_acceleration_with_covariance": {"accel": still, "covariance": unknown},
            "predicted_paths": [path],
        },
        "shape": {
            "type": 0,  # a bounding box
            "footprint": {"points": []},
            "dimensions": {"x": length, "y": width, "z": height},
        },
    }


def _pose(position_m: FloatArray, yaw_rad: float) -> dict[str, Any]:
    half = 0.5 * yaw_rad
    turned = {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)}
    return {"position": _xyz(*position_m.tolist()), "orientation": turned}


def _xyz(x: float, y: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": 0.0}


def _covariance(of_xy: FloatArray) -> list[float]:
    """Return the 6 x 6 of x, y, z and three angles, row by row; what is not known has a large variance."""
    whole = _UNKNOWN_VARIANCE * np.eye(6)
    whole[:2, :2] = of_xy
    return [float(value) for value in whole.ravel()]
