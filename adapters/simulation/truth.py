"""What only a simulation knows."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldstate.adapters.camera import PinholeCamera

from .detector import FRAME_RATE_HZ, line_of_sight
from .settings import SimulationSettings
from .vehicle import Trajectory

SCHEMA = "worldstate.simulation.truth"
SCHEMA_VERSION = "1.0.0"


def describe(
    settings: SimulationSettings,
    frames_s: NDArray[np.float64],
    seen: Trajectory | None,
    camera: PinholeCamera,
) -> dict[str, Any]:
    """Return settings and, per camera frame, where the vehicle is, ready for JSON.

    Keys of a frame: `position_m` (front bumper, x ahead and y left of the array), `speed_mps`, `azimuth_rad`
    (of the front axle, left positive), `range_m`, `line_of_sight`, `time_to_visible_s` (negative afterwards).
    Without a vehicle there are no frames and `entry_s` is null.
    """
    return {
        "schema": SCHEMA,
        "version": SCHEMA_VERSION,
        "settings": asdict(settings),
        "frame_rate_hz": FRAME_RATE_HZ,
        "entry_s": None if seen is None else settings.entry_s,
        "frames": [] if seen is None else _frames(settings, frames_s, seen, camera),
    }


def _frames(
    settings: SimulationSettings, frames_s: NDArray[np.float64], seen: Trajectory, camera: PinholeCamera
) -> list[dict[str, Any]]:
    columns = {
        "time_s": frames_s,
        "speed_mps": seen.speed_mps,
        "azimuth_rad": np.arctan2(seen.axle_y_m(), seen.lane_x_m),
        "range_m": np.hypot(seen.axle_y_m(), seen.lane_x_m),
        "time_to_visible_s": settings.entry_s - frames_s,
    }
    sight = line_of_sight(seen, settings.site, camera)
    return [
        {name: round(float(values[i]), 6) for name, values in columns.items()}
        | {"position_m": [round(seen.lane_x_m, 6), round(float(seen.front_y_m[i]), 6)]}
        | {"line_of_sight": bool(sight[i])}
        for i in range(len(frames_s))
    ]
