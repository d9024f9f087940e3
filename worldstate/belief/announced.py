r"""Hidden entities with a place: when they come into view, and what that says of each side.

With the edge of the occluder at azimuth a, the normal :math:`n = (-\sin a, \cos a)` of its line of sight and
the velocity w relative to the ego vehicle, an entity at p comes into view after

.. math:: t = -\frac{n \cdot p}{n \cdot w}
"""

import math
from collections.abc import Iterable

import numpy as np

from worldstate.abduction.sequence.sequence_model import COMING_S
from worldstate.belief.kinematics.cartesian import CartesianBelief

from .site_geometry import SideGeometry, SiteGeometry
from .track import Track

# Slower towards the line of sight than so many standard deviations, and it may never cross it.
_LEAST_DEVIATIONS = 2.0
# m/s: of a velocity that nobody measured, which says nothing against coming.
_UNKNOWN_SPEED_STD = 3.0


def time_to_visible(
    place: CartesianBelief, side: SideGeometry, ego_speed_mps: float
) -> tuple[float, float] | None:
    """Return mean and standard deviation of the time until an entity passes an edge, s; None if it may not.

    Examples
    --------
    >>> coming = CartesianBelief(np.array([10.0, 20.0, 0.0, -8.0]), np.diag([0.2, 0.2, 0.1, 0.1]))
    >>> [round(value, 1) for value in time_to_visible(coming, SideGeometry("left", 0.56, 0.96, 0.35), 0.0)]
    [1.7, 0.2]
    """
    edge_rad = side.edge_azimuth_rad
    along = np.array([math.cos(edge_rad), math.sin(edge_rad)])
    normal = np.array([-along[1], along[0]])
    position, velocity = place.mean[:2], place.mean[2:] - np.array([ego_speed_mps, 0.0])
    rate = float(normal @ velocity)
    if abs(rate) <= _LEAST_DEVIATIONS * math.sqrt(normal @ place.covariance[2:, 2:] @ normal):
        return None
    time_s = -float(normal @ position) / rate
    crossing_m = float(along @ (position + time_s * velocity))
    if time_s <= 0.0 or crossing_m <= 0.0:
        return None
    slope = np.concatenate([normal, time_s * normal])
    variance = float(slope @ place.covariance @ slope) + (crossing_m * side.edge_std_rad) ** 2
    return time_s, math.sqrt(variance) / abs(rate)


def announced(tracks: Iterable[Track], site: SiteGeometry) -> tuple[float, ...]:
    """Return for each side the probability that a hidden entity with a place comes into view, shape (K,)."""
    chances = [0.0] * len(site.sides)
    for track in tracks:
        if not track.seen and track.place is not None and _comes(track, track.place, site):
            chances[track.side] = max(chances[track.side], track.existence * track.behind)
    return tuple(chances)


def _comes(track: Track, place: CartesianBelief, site: SiteGeometry) -> bool:
    """Tell whether an entity may come into view within the times that a sequence model speaks of."""
    if place.velocity_std_mps > _UNKNOWN_SPEED_STD:
        return True
    expected = time_to_visible(place, site.sides[track.side], site.ego_speed_mps)
    return track.moving and expected is not None and expected[0] <= COMING_S[-1]
