"""Which sighting belongs to which entity."""

import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from worldstate.measurement import Sighting
from worldstate.values import wrap_angle

from .settings import FilterSettings
from .side import Side
from .track import Track

_NEVER = 1e6
_CHANGED_MIND = 20.0


def match_visible(
    tracks: tuple[Track, ...], sightings: tuple[Sighting, ...], settings: FilterSettings
) -> dict[int, int]:
    """Return {track index: sighting index} by global nearest neighbour in azimuth, within the gate.

    The cost is the squared Mahalanobis distance, plus a penalty where one is parked and the other moves, lest
    a vehicle that drives past a parked one changes places with it. Only tracks that vision has take part.
    """
    candidates = [i for i, track in enumerate(tracks) if track.seen]
    if not candidates or not sightings:
        return {}
    cost = np.array([[_distance(tracks[i], s, settings) for s in sightings] for i in candidates])
    rows, columns = linear_sum_assignment(cost)
    return {
        candidates[row]: int(column)
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
        if cost[row, column] < _NEVER
    }


def match_hidden(
    tracks: tuple[Track, ...],
    sightings: tuple[tuple[int, Sighting], ...],
    sides: tuple[Side, ...],
    settings: FilterSettings,
) -> dict[int, int]:
    """Return {track index: sighting index}: hidden entities that came into view.

    A vehicle comes into view near the edge of what hid it. Each new moving sighting goes to the hidden entity
    that is likeliest by its existence and the distance to that edge, best pair first.
    """
    pairs = sorted(
        (-_emergence(track, sighting, sides, settings), i, j)
        for i, track in enumerate(tracks)
        for j, sighting in sightings
        if _may_emerge(track, sighting, sides, settings)
    )
    found: dict[int, int] = {}
    for _, i, j in pairs:
        if i not in found and j not in found.values():
            found[i] = j
    return found


def _distance(track: Track, sighting: Sighting, settings: FilterSettings) -> float:
    residual = wrap_angle(sighting.azimuth_rad - track.motion.azimuth_rad)
    variance = track.motion.azimuth_std_rad**2 + sighting.std_rad**2
    outside = abs(residual) > settings.gate_rad or residual**2 > settings.gate_sigma**2 * variance
    if outside:
        return _NEVER
    return residual**2 / variance + (0.0 if sighting.moving == track.moving else _CHANGED_MIND)


def _may_emerge(
    track: Track, sighting: Sighting, sides: tuple[Side, ...], settings: FilterSettings
) -> bool:
    near = sides[track.side].distance_rad(sighting.azimuth_rad) <= settings.handover_gate_rad
    return not track.seen and sighting.moving and near


def _emergence(
    track: Track, sighting: Sighting, sides: tuple[Side, ...], settings: FilterSettings
) -> float:
    spread = settings.handover_gate_rad / 2.0
    distance = sides[track.side].distance_rad(sighting.azimuth_rad)
    return math.log(max(track.existence, 1e-12)) - 0.5 * (distance / spread) ** 2
