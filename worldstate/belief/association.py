"""Which sighting belongs to which entity."""

import math

import numpy as np

from worldstate.ground.values import wrap_angle
from worldstate.measurement.measurement import Sighting

from .settings import FilterSettings
from .site_geometry import SiteGeometry
from .track import Track

_NEVER = 1e6
_CHANGED_MIND = 20.0


def match_visible(
    tracks: tuple[Track, ...], sightings: tuple[Sighting, ...], settings: FilterSettings
) -> dict[int, int]:
    """Return {track index: sighting index} by global nearest neighbour in azimuth, within the gate."""
    # The cost is the squared Mahalanobis distance, plus a penalty where one is parked and the other moves,
    # lest a vehicle that drives past a parked one changes places with it. Only tracks that vision has take
    # part.
    candidates = [i for i, track in enumerate(tracks) if track.seen]
    if not candidates or not sightings:
        return {}
    cost = np.array([[_distance(tracks[i], s, settings) for s in sightings] for i in candidates])
    # Imported where it is needed: scipy.optimize takes longer than all else that the core imports.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(cost)
    return {
        candidates[row]: int(column)
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
        if cost[row, column] < _NEVER
    }


def match_hidden(
    tracks: tuple[Track, ...], sightings: tuple[tuple[int, Sighting], ...], scene: SiteGeometry
) -> dict[int, int]:
    """Return {track index: sighting index}: hidden entities that came into view."""
    # A vehicle comes into view near the edge of what hid it. Of a new moving sighting there are two accounts:
    # it is a hidden entity, whose side may have been heard wrongly, or it is a vehicle that nobody heard. The
    # likelier one holds, best pair first.
    pairs = sorted(
        (-score, i, j)
        for i, track in enumerate(tracks)
        for j, sighting in sightings
        if not track.seen and sighting.moving
        if (score := _emergence(track, sighting, scene)) > 0.0
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


def _emergence(track: Track, sighting: Sighting, scene: SiteGeometry) -> float:
    """Return the log odds of "this entity" against "nobody heard it"; -inf out of reach of any edge."""
    settings = scene.settings
    distances = [side.distance_rad(sighting.azimuth_rad) for side in scene.sides]
    if min(distances) > settings.handover_gate_rad:
        return -math.inf
    near = [math.exp(-2.0 * (distance / settings.handover_gate_rad) ** 2) for distance in distances]
    own = near.pop(track.side)
    heard = (1.0 - settings.side_confusion) * own + settings.side_confusion * max(near, default=own)
    unheard = settings.unheard_probability * max([own, *near])
    return math.log(max(track.existence, 1e-12) * heard / unheard)
