"""Association of sightings with entities, in view and at the edge of an occluder."""

import math

import numpy as np

from worldstate.ground.values import wrap_angle
from worldstate.measurement.measurement import Sighting

from .settings import FilterSettings
from .site_geometry import SiteGeometry
from .track import Track

# Cost of a pair outside the gate; larger than any sum of costs within it.
_FORBIDDEN = 1e6
# Cost of pairing a parked with a moving object: above gate_sigma**2 = 16, so that any free partner is
# preferred, and finite, so that a parked car that drives off keeps its id.
_PARKED_MISMATCH = 20.0
_LEAST = 1e-300  # Keeps logarithms finite


def match_visible(
    tracks: tuple[Track, ...], sightings: tuple[Sighting, ...], settings: FilterSettings
) -> dict[int, int]:
    """Return {track index: sighting index} by global nearest neighbour in azimuth, within the gate."""
    # The cost is the squared Mahalanobis distance, plus a penalty where one is parked and the other moves:
    # without it a vehicle that drives past a parked one swapped ids with it. Only entities already seen take
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
        if cost[row, column] < _FORBIDDEN
    }


def match_hidden(
    tracks: tuple[Track, ...], sightings: tuple[tuple[int, Sighting], ...], site: SiteGeometry
) -> dict[int, int]:
    """Return {track index: sighting index} of the hidden entities that came into view."""
    # A vehicle comes into view near the edge of its occluder. A new moving sighting is either a hidden
    # entity, whose side may be wrong, or a vehicle that was not heard; the likelier hypothesis is taken, best
    # pair first.
    pairs = sorted(
        (-score, i, j)
        for i, track in enumerate(tracks)
        for j, sighting in sightings
        if not track.seen and sighting.moving
        if (score := _emergence(track, sighting, site)) > 0.0
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
        return _FORBIDDEN
    return residual**2 / variance + (0.0 if sighting.moving == track.moving else _PARKED_MISMATCH)


def _emergence(track: Track, sighting: Sighting, site: SiteGeometry) -> float:
    r"""Return the log odds of this hidden entity against a vehicle that was not heard.

    .. math:: \frac{r\, [(1 - c)\, N(z; a_k, \sigma^2) + c \max_j N(z; a_j, \sigma^2)]}{u / V}

    with existence r, the edges a of its own side k and of the others, of which the signature may have meant
    one with probability c, and vehicles that were not heard, u of them, anywhere in the view V.
    """
    settings = site.settings
    near = [_edge_density(side.distance_rad(sighting.azimuth_rad), settings) for side in site.sides]
    own = near.pop(track.side)
    heard = (1.0 - settings.side_confusion) * own + settings.side_confusion * max(near, default=own)
    unheard = settings.unheard_probability / (2.0 * site.view_half_angle_rad)
    return math.log(max(track.existence * heard, _LEAST)) - math.log(unheard)


def _edge_density(distance_rad: float, settings: FilterSettings) -> float:
    """Return the density of first sightings at a distance from the edge that they come past, 1/rad."""
    deviations = distance_rad / settings.edge_std_rad
    return math.exp(-0.5 * deviations**2) / (settings.edge_std_rad * math.sqrt(2.0 * math.pi))
