"""From settings to motion: when and where every vehicle and the ego are."""

from functools import partial

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.typing import FloatArray

from .junction import Site
from .kinds import vehicle_kind
from .occluders import hidden_by
from .route import along, turn_in
from .settings import SimulationSettings, VehicleSettings
from .vehicle import Trajectory, drive, follow

SEARCH_STEP_M = 0.1
TURN_WITHIN_S = 5.0  # braking for a turn begins and line of sight is reached within this long


def trajectories(settings: SimulationSettings, time_s: FloatArray) -> list[Trajectory]:
    """Motion of every vehicle at evenly spaced times, the first that of the approach; empty without any."""
    return [_trajectory(settings, vehicle, time_s) for vehicle in settings.traffic]


def _trajectory(settings: SimulationSettings, vehicle: VehicleSettings, time_s: FloatArray) -> Trajectory:
    lane, entry_y = _entry(settings, vehicle)

    passing = partial(
        drive,
        entry_y_m=entry_y,
        lane_x_m=lane,
        speed_mps=vehicle.speed_mps,
        braking_mps2=vehicle.braking_mps2,
        kind=vehicle_kind(vehicle.kind),
    )
    if vehicle.route_m:
        way = along(vehicle.route_m, _first_sight(settings.site, vehicle))
        return follow(passing(time_s, entry_s=vehicle.entry_s), entry_y, way)
    if vehicle.manoeuvre == "turn":
        turn = turn_in(lane, entry_y)
        # Slowing down for the turn costs time before line of sight: set off that much earlier.
        near = vehicle.entry_s + np.arange(-TURN_WITHIN_S, TURN_WITHIN_S, time_s[1] - time_s[0])
        slowed = follow(passing(near, entry_s=vehicle.entry_s), entry_y, *turn)
        late = float(np.interp(0.0, slowed.driven_m, near)) - vehicle.entry_s
        return follow(passing(time_s, entry_s=vehicle.entry_s - late), entry_y, *turn)
    return passing(time_s, entry_s=vehicle.entry_s)


def _entry(settings: SimulationSettings, vehicle: VehicleSettings) -> tuple[float, float]:
    """Return the lane, and where in it the camera sees the vehicle when it comes into sight."""
    near, far = settings.site.lanes_m
    lane = near if vehicle.approach == "left" else far
    eye_x, eye_y, _ = PinholeCamera().position_m
    ego_x = float(settings.ego.x_m(np.array([vehicle.entry_s]))[0])
    right, left = settings.site.sight_m(lane, (ego_x + eye_x, eye_y))
    return lane, left if vehicle.approach == "left" else right


def _first_sight(site: Site, vehicle: VehicleSettings) -> float:
    """Return the distance along a route at which it leaves the last body that hides it."""
    route = along(vehicle.route_m)
    length = float(np.hypot(*np.diff(np.array(vehicle.route_m), axis=0).T).sum())
    driven = np.arange(0.0, length, SEARCH_STEP_M)
    eye_x, eye_y, _ = PinholeCamera().position_m
    hidden = np.flatnonzero(hidden_by(site.occluders, *route.at(driven), (eye_x, eye_y)))
    return float(driven[hidden[-1]]) + SEARCH_STEP_M if len(hidden) else 0.0
