"""Entities at places: as measured, or in the crossing lane where only their azimuth is known."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.state import Entity, WorldState

# Real vehicles of OVAD pass some 9 m ahead of the ego; another junction has another distance.
CROSSING_M = 9.0
# Relative standard deviation of that distance, assumed: 6 to 12 m for two of three junctions.
_CROSSING_SHARE = 0.3
# Beyond this the lane would be hundreds of metres away: the place is on a circle about the ego instead.
_WIDEST_RAD = math.radians(80.0)
PATH_STEP_S, PATH_STEPS = 0.5, 6


@dataclass(frozen=True, slots=True, eq=False)
class LaneObject:
    """A moving entity as other stacks have it: with a position and a velocity."""

    entity: Entity
    position_m: FloatArray  # x, y of the frame of the state
    velocity_mps: FloatArray  # x, y; zero where it is not known
    covariance: FloatArray  # shape (2, 2): of the position, m^2
    measured: bool  # Whether a sensor measured the position; else the lane is assumed
    confidence: float  # Probability that it goes along its path

    @property
    def yaw_rad(self) -> float:
        """Direction of its motion."""
        return math.atan2(self.velocity_mps[1], self.velocity_mps[0])

    def path_m(self) -> FloatArray:
        """Return where it is now and every half second until 3 s from now, shape (7, 2)."""
        after_s = PATH_STEP_S * np.arange(PATH_STEPS + 1)[:, None]
        path: FloatArray = self.position_m + after_s * self.velocity_mps
        return path


def lane_objects(state: WorldState, crossing_m: float = CROSSING_M) -> Iterator[LaneObject]:
    r"""Yield every moving entity at a place.

    One of which only the azimuth is known is put in a lane across the road ahead,

    .. math:: p = d\,(1, \tan\theta), \qquad
        \Sigma = \sigma_\theta^2\, \partial_\theta p\, \partial_\theta p^T + \sigma_d^2\, p p^T / d^2

    and a hidden one comes towards the axis of the ego at the pace of its occluder.
    """
    paces = {occluder.direction: occluder.pace_hz for occluder in state.context.occluders}
    coming = {cue.direction: (cue.within or {}).get("3") for cue in state.cues}
    for entity in (one for one in state.entities if one.moving):
        hidden, within = entity.status == "hidden", coming.get(entity.direction or "")
        # That somebody comes into view is said given all that was heard, so of one that exists it is more.
        given = within / max(entity.existence_probability, 1e-6) if hidden and within is not None else 1.0
        if entity.position_m is None:
            yield _assumed(entity, crossing_m, paces.get(entity.direction or "", 0.0), min(given, 1.0))
        else:
            yield _measured(entity, entity.position_m, min(given, 1.0))


def _measured(entity: Entity, position_m: tuple[float, float, float], confidence: float) -> LaneObject:
    velocity = np.array((entity.velocity_mps or (0.0, 0.0, 0.0))[:2])
    known = np.array(entity.covariance)[:2, :2] if entity.covariance is not None else np.zeros((2, 2))
    return LaneObject(entity, np.array(position_m[:2]), velocity, known, True, confidence)


def _assumed(entity: Entity, crossing_m: float, pace_hz: float, confidence: float) -> LaneObject:
    azimuth_rad = entity.azimuth_rad
    along = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])
    across = np.array([-along[1], along[0]])
    slope = max(along[0], math.cos(_WIDEST_RAD))
    position = crossing_m / slope * along
    # On the circle only the azimuth moves it; in the lane the range changes with it.
    turned = crossing_m / slope * across if slope > along[0] else np.array([0.0, crossing_m / slope**2])
    spread = _CROSSING_SHARE * position
    covariance = entity.azimuth_std_rad**2 * np.outer(turned, turned) + np.outer(spread, spread)
    if entity.status == "hidden":
        velocity = np.array([0.0, -math.copysign(pace_hz * crossing_m, azimuth_rad)])
    else:
        velocity = (entity.azimuth_rate_rad_s or 0.0) * turned
    return LaneObject(entity, position, velocity, covariance, False, confidence)
