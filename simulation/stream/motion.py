"""Motion along a route under speed limits: drivers who brake, stand, and go on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.kinds import VehicleKind
from worldstate.simulation.scene.route import Route
from worldstate.simulation.scene.vehicle import Trajectory

STEP_M = 0.05
ACCELERATION_MPS2, BRAKING_MPS2 = 1.5, 2.0  # comfortable values of drivers in towns


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """A highest speed at one point of a route, and how long the vehicle stands there."""

    at_m: float
    speed_mps: float = 0.0
    stands_s: float = 0.0
    braking_mps2: float = BRAKING_MPS2


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Where a vehicle is on a clock of its own, which begins at 0."""

    route: Route
    time_s: FloatArray  # shape (N,): Not decreasing
    driven_m: FloatArray  # shape (N,): Distance of the front along the route
    speed_mps: FloatArray  # shape (N,)
    kind: VehicleKind
    heading: int  # Of the lane, as in `Trajectory`

    @property
    def duration_s(self) -> float:
        """When it ends."""
        return float(self.time_s[-1])

    def reaches_s(self, driven_m: float) -> float:
        """When the front has driven so far; where it stands there, when it goes on."""
        return float(self.time_s[max(int(np.searchsorted(self.driven_m, driven_m, side="right")) - 1, 0)])

    def trajectory(self, time_s: FloatArray, heard: Route | None = None) -> Trajectory:
        """Return position and speed at some times, on the route or where its sound comes from."""
        route = heard or self.route
        driven = np.interp(time_s, self.time_s, self.driven_m)
        x, y = route.at(driven)
        speed = np.interp(time_s, self.time_s, self.speed_mps)
        lane = float(x[0]) if len(x) else 0.0
        return Trajectory(time_s, y, speed, lane, self.heading, self.kind, route, driven)


def drive_along(
    route: Route,
    span_m: tuple[float, float],
    cruise_mps: float,
    limits: Sequence[SpeedLimit],
    kind: VehicleKind,
    heading: int,
) -> Motion:
    r"""Drive from one distance to another as fast as the limits allow.

    .. math:: v(s) = \min\Big(v_0, \sqrt{v_i^2 + 2 b_i (s_i - s)}\ (s < s_i),
              \sqrt{v_i^2 + 2 a (s - s_i)}\ (s > s_i)\Big)
    """
    stops = sorted((one for one in limits if one.stands_s > 0.0), key=lambda one: one.at_m)
    edges = [span_m[0], *(one.at_m for one in stops), span_m[1]]
    # A stop is in the grid twice: between both nothing is driven and time goes by.
    pieces = [_grid(low, high) for low, high in pairwise(edges)]
    driven = np.concatenate(pieces)
    speed = np.full_like(driven, cruise_mps)
    for one in limits:
        before = one.at_m - driven
        room = np.where(before > 0.0, 2.0 * one.braking_mps2 * before, -2.0 * ACCELERATION_MPS2 * before)
        speed = np.minimum(speed, np.sqrt(one.speed_mps**2 + room))
    # At constant acceleration a step takes its length over the mean of both speeds, exactly.
    step, twice = np.diff(driven), speed[1:] + speed[:-1]
    took = 2.0 * step / np.maximum(twice, 1e-6)
    took[np.cumsum([len(piece) for piece in pieces[:-1]], dtype=int) - 1] = [one.stands_s for one in stops]
    return Motion(route, np.r_[0.0, np.cumsum(took)], driven, speed, kind, heading)


def _grid(low_m: float, high_m: float) -> FloatArray:
    return np.linspace(low_m, high_m, max(round((high_m - low_m) / STEP_M), 1) + 1)


def confined(route: Route, near_m: float, far_m: float) -> Route:
    """Return the route with its way ahead kept between two limits.

    What turned into another street is heard from that street's mouth.
    """
    driven = np.arange(route.driven_m[0], route.driven_m[-1], 0.5)
    x, y = route.at(driven)
    return replace(route, driven_m=driven, points_m=np.column_stack([np.clip(x, near_m, far_m), y]))
