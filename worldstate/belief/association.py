"""Association of sightings with entities, in view and at the edge of an occluder, all at once."""

import math
from collections.abc import Sequence

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import wrap_angle
from worldstate.measurement.measurement import Sighting

from .settings import FilterSettings
from .site_geometry import SiteGeometry
from .track import Track

# Of a pair outside the gate; below any sum of scores within it.
FORBIDDEN = -1e6
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
    return assigned(_scores(tracks, sightings, unheard, site), unheard)


def assigned(scores: FloatArray, new: float) -> dict[int, int]:
    """Return {column: row} of the largest sum of scores, where every row may be somebody new instead.

    Examples
    --------
    >>> assigned(np.array([[3.0, 2.0], [2.5, FORBIDDEN]]), new=-1.0)
    {1: 0, 0: 1}
    """
    n, known = scores.shape
    if not n or not known:
        return {}
    every = np.full((n, known + n), FORBIDDEN)
    every[:, :known] = scores
    np.fill_diagonal(every[:, known:], new)
    # Imported where it is needed: scipy.optimize takes longer than all else that the core imports.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-every)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {column: row for row, column in pairs if column < known and every[row, column] > FORBIDDEN}


def _scores(
    tracks: tuple[Track, ...], sightings: tuple[Sighting, ...], unheard: float, site: SiteGeometry
) -> FloatArray:
    """Return the score of every sighting and track, shape (sightings, tracks)."""
    azimuth_rad = np.array([one.azimuth_rad for one in sightings])[:, None]
    std_rad = np.array([one.std_rad for one in sightings])[:, None]
    moving = np.array([one.moving for one in sightings])[:, None]
    known = np.array([track.seen or track.place is not None for track in tracks])
    in_view = _in_view(tracks, azimuth_rad, std_rad, moving, unheard, site.settings)
    return np.where(known, in_view, np.where(moving, _emergence(tracks, azimuth_rad, site), FORBIDDEN))


def _in_view(
    tracks: tuple[Track, ...],
    azimuth_rad: FloatArray,
    std_rad: FloatArray,
    moving: BoolArray,
    unheard: float,
    settings: FilterSettings,
) -> FloatArray:
    existence = np.array([track.existence for track in tracks])
    residual = wrap_angle(azimuth_rad - np.array([track.motion.azimuth_rad for track in tracks]))
    variance = np.array([track.motion.azimuth_std_rad for track in tracks]) ** 2 + std_rad**2
    density = -0.5 * (residual**2 / variance + np.log(2.0 * math.pi * variance))
    expected = np.log(np.maximum(existence, _LEAST)) - np.log1p(-existence * _FOUND)
    mismatch = np.where(moving == np.array([track.moving for track in tracks]), 0.0, _PARKED_MISMATCH)
    outside = (np.abs(residual) > settings.gate_rad) | (residual**2 > settings.gate_sigma**2 * variance)
    # Within its gate an entity in view takes a sighting before that counts as a new vehicle; a maximum of the
    # two would be a tie of all poor pairs, which the order of sightings would settle.
    return np.where(outside, FORBIDDEN, np.logaddexp(density + expected + mismatch, unheard))


def _emergence(tracks: tuple[Track, ...], azimuth_rad: FloatArray, site: SiteGeometry) -> FloatArray:
    existence = np.array([track.existence for track in tracks])
    own = emergence_density(tracks, azimuth_rad, site)
    return np.asarray(np.log(np.maximum(existence * own, _LEAST)))


def emergence_density(tracks: Sequence[Track], azimuth_rad: FloatArray, site: SiteGeometry) -> FloatArray:
    """Return the density of first sightings of hidden entities, 1/rad, shape (sightings, tracks)."""
    settings = site.settings
    edges_rad = np.array([side.edge_azimuth_rad for side in site.sides])
    deviations = wrap_angle(azimuth_rad - edges_rad) / settings.edge_std_rad
    # Of first sightings about the edge that they come past, 1/rad.
    near = np.exp(-0.5 * deviations**2) / (settings.edge_std_rad * math.sqrt(2.0 * math.pi))
    heard = np.empty_like(near)
    for side in range(len(edges_rad)):
        others = np.delete(near, side, axis=1).max(axis=1) if len(edges_rad) > 1 else near[:, side]
        confused = settings.side_confusion
        heard[:, side] = (1.0 - confused) * near[:, side] + confused * others
    return np.asarray(heard[:, [track.side for track in tracks]])
