"""Association of sightings with entities, in view and at the edge of an occluder, all at once."""

import math

import numpy as np

from worldstate.ground.values import wrap_angle
from worldstate.measurement.measurement import Sighting

from .settings import FilterSettings
from .site_geometry import SiteGeometry
from .track import Track

# Of a pair outside the gate; below any sum of scores within it.
_FORBIDDEN = -1e6
# Of pairing a parked with a moving object, nats: below the gate's 4 deviations, so that any free partner is
# preferred, and finite, so that a parked car that drives off keeps its id.
_PARKED_MISMATCH = -10.0
_FOUND = 0.95  # Of the looks at an entity in view
_LEAST = 1e-300  # Keeps logarithms finite


def associated(
    tracks: tuple[Track, ...], sightings: tuple[Sighting, ...], site: SiteGeometry
) -> dict[int, int]:
    r"""Return {track index: sighting index} of the likeliest assignment; what is left over is new.

    Every sighting is one of an entity in view, a hidden one that comes past an edge, or a vehicle that nobody
    has heard; their scores, nats, are

    .. math:: \log \frac{r N(z; \theta, S)}{1 - r p_D}, \qquad
              \log r\, [(1 - c)\, N(z; a_k, \sigma^2) + c \max_j N(z; a_j, \sigma^2)], \qquad
              \log \frac{u}{V}

    with existence r, the edge a of a hidden one's side, which the signature may have confused with
    probability c, and u vehicles that were not heard anywhere in the view V. Entities in view and hidden ones
    compete: an entity that has left the view would else take the first sighting of the next one.
    """
    if not tracks or not sightings:
        return {}
    unheard = math.log(site.settings.unheard_probability / (2.0 * site.view_half_angle_rad))
    scores = np.full((len(sightings), len(tracks) + len(sightings)), _FORBIDDEN)
    for j, sighting in enumerate(sightings):
        scores[j, : len(tracks)] = [_score(track, sighting, unheard, site) for track in tracks]
        scores[j, len(tracks) + j] = unheard
    # Imported where it is needed: scipy.optimize takes longer than all else that the core imports.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-scores)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {column: row for row, column in pairs if column < len(tracks) and scores[row, column] > _FORBIDDEN}


def _score(track: Track, sighting: Sighting, unheard: float, site: SiteGeometry) -> float:
    if not track.seen:
        return _emergence(track, sighting, site) if sighting.moving else _FORBIDDEN
    residual = wrap_angle(sighting.azimuth_rad - track.motion.azimuth_rad)
    variance = track.motion.azimuth_std_rad**2 + sighting.std_rad**2
    settings = site.settings
    if abs(residual) > settings.gate_rad or residual**2 > settings.gate_sigma**2 * variance:
        return _FORBIDDEN
    density = -0.5 * (residual**2 / variance + math.log(2.0 * math.pi * variance))
    expected = math.log(max(track.existence, _LEAST)) - math.log1p(-track.existence * _FOUND)
    mismatch = 0.0 if sighting.moving == track.moving else _PARKED_MISMATCH
    # Within its gate an entity in view takes a sighting before that counts as a new vehicle; a maximum of the
    # two would be a tie of all poor pairs, which the order of sightings would settle.
    return float(np.logaddexp(density + expected + mismatch, unheard))


def _emergence(track: Track, sighting: Sighting, site: SiteGeometry) -> float:
    settings = site.settings
    near = [_edge_density(side.distance_rad(sighting.azimuth_rad), settings) for side in site.sides]
    own = near.pop(track.side)
    heard = (1.0 - settings.side_confusion) * own + settings.side_confusion * max(near, default=own)
    return math.log(max(track.existence * heard, _LEAST))


def _edge_density(distance_rad: float, settings: FilterSettings) -> float:
    """Return the density of first sightings at a distance from the edge that they come past, 1/rad."""
    deviations = distance_rad / settings.edge_std_rad
    return math.exp(-0.5 * deviations**2) / (settings.edge_std_rad * math.sqrt(2.0 * math.pi))
