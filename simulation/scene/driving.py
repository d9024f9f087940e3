"""Motion from settings: the position of every vehicle, and when the camera of the ego sees it."""

from dataclasses import replace

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.typing import BoolArray, FloatArray

from .junction import Site
from .kinds import vehicle_kind
from .occluders import hidden_by
from .settings import SimulationSettings, VehicleSettings
from .vehicle import Trajectory, along, drive

CAMERA = PinholeCamera.ovad()  # The camera of every simulated ego
# Azimuths of the right and the left edge of its image, seen from the camera.
RIGHT_EDGE_RAD, LEFT_EDGE_RAD = CAMERA.off_axis(CAMERA.azimuth([CAMERA.width_px, 0.0])) + CAMERA.yaw_rad


def camera_sees(site: Site, x_m: FloatArray, y_m: FloatArray, ego_x_m: float | FloatArray = 0.0) -> BoolArray:
    """Return when the camera sees a moving point, shape (T,).

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import site
    >>> x, y = np.array([8.0, 8.0, 2.0, -8.0]), np.array([3.0, 8.0, 2.5, 0.0])
    >>> camera_sees(site("SA1"), x, y)
    array([ True, False, False, False])
    """
    eye = (ego_x_m + CAMERA.position_m[0], CAMERA.position_m[1])
    direction = np.arctan2(y_m - eye[1], x_m - eye[0])
    pictured = (direction > RIGHT_EDGE_RAD) & (direction < LEFT_EDGE_RAD)
    right, left = site.sights_m(x_m, eye)
    # In the open, and on this side of the corners, no corner hides the point.
    past_corners = site.is_open | (x_m <= site.corner_ahead_m) | ((y_m > right) & (y_m < left))
    return np.asarray(pictured & past_corners & ~hidden_by(site.occluders, x_m, y_m, eye))


SEARCH_STEP_M = 0.1


def trajectories(settings: SimulationSettings, time_s: FloatArray) -> list[Trajectory]:
    """Return the motion of every vehicle at evenly spaced times; the vehicle of the approach comes first."""
    return [_trajectory(settings, vehicle, time_s) for vehicle in settings.traffic]


def _trajectory(settings: SimulationSettings, vehicle: VehicleSettings, time_s: FloatArray) -> Trajectory:
    lane = settings.site.lanes_m[0 if vehicle.approach == "left" else 1]
    ego_x = float(settings.ego.x_m(np.array([vehicle.entry_s]))[0])
    entry_y = entry_y_m(settings.site, lane, vehicle.approach, ego_x)
    passing = drive(
        time_s,
        entry_s=vehicle.entry_s,
        entry_y_m=entry_y,
        lane_x_m=lane,
        speed_mps=vehicle.speed_mps,
        braking_mps2=vehicle.braking_mps2,
        kind=vehicle_kind(vehicle.kind),
    )
    if not vehicle.route_m:
        return passing
    route = along(vehicle.route_m, _first_sight(settings.site, vehicle)[0])
    driven = (passing.front_y_m - entry_y) * passing.heading
    return replace(passing, front_y_m=route.at(driven)[1], route=route, driven_m=driven)


def entry_y_m(site: Site, lane_m: float, approach: str, ego_x_m: float = 0.0) -> float:
    """Return the y in its lane at which the camera first sees a vehicle from the left or the right."""
    eye_x, eye_y, _ = CAMERA.position_m
    right, left = site.sight_m(lane_m, (ego_x_m + eye_x, eye_y))
    ahead = lane_m - ego_x_m - eye_x
    right_edge, left_edge = (eye_y + ahead * np.tan(edge) for edge in (RIGHT_EDGE_RAD, LEFT_EDGE_RAD))
    return float(min(left, left_edge) if approach == "left" else max(right, right_edge))


def comes_into_view_s(settings: SimulationSettings, vehicle: VehicleSettings) -> float | None:
    """Return when the camera first sees a vehicle: 0 if it is in view from the start, None if never."""
    if not vehicle.route_m:
        return vehicle.entry_s
    _, found = _first_sight(settings.site, vehicle)
    return {"hidden at first": vehicle.entry_s, "in view at first": 0.0, "never": None}[found]


def _first_sight(site: Site, vehicle: VehicleSettings) -> tuple[float, str]:
    """Return the distance along a route at which the vehicle comes into view, and whether it does.

    For a vehicle that is in view from the start, or never, it is the distance nearest to the ego.
    """
    route = along(vehicle.route_m)
    length = float(np.hypot(*np.diff(np.array(vehicle.route_m), axis=0).T).sum())
    driven = np.arange(0.0, length, SEARCH_STEP_M)
    x, y = route.at(driven)
    seen = camera_sees(site, x, y)
    if seen.any() and not seen[0]:
        return float(driven[_longest_begins(seen)]), "hidden at first"
    return float(driven[np.hypot(x, y).argmin()]), "in view at first" if seen.any() else "never"


def _longest_begins(seen: BoolArray) -> int:
    """Return the start of the longest run of True.

    Examples
    --------
    >>> _longest_begins(np.array([False, True, False, True, True]))
    3
    """
    # A short glimpse before a body hides the vehicle again is too early for a driver to react to.
    edges = np.flatnonzero(np.diff(np.r_[0, seen.astype(int), 0]))
    begins, ends = edges[::2], edges[1::2]
    return int(begins[(ends - begins).argmax()])
