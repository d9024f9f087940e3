r"""Azimuth of a hidden vehicle, from the time until it comes into view.

It drives along the crossing street towards the edge of its occluder. With the street at distance d, the edge
at azimuth a and speed v, its azimuth t seconds before line of sight is

.. math:: \tan\theta(t) = \tan a + \frac{v}{d}\, t

Sound contains no distance in metres, but it contains the time to visible. Mean and variance are taken over
the distribution of this time.

A hidden road user with position p and velocity w over ground comes into view when it passes the line from
the ego vehicle, which drives along e(t), past the corner c of its occluder:

.. math:: S_t = (c - e_t) \times (p + w t - e_t) \le 0

Position and velocity are normal, and so is :math:`S_t` at each time. For an ego vehicle at rest, it is the
distance :math:`n \cdot (p + w t)` behind the line, times that of the corner, and the time to visible is the
ratio :math:`T = -(n \cdot p) / (n \cdot w)`. If the distance of a corner is unknown, its line is assumed to
keep its place on the ground.
"""

import math
from collections.abc import Sequence

import numpy as np

from worldstate.abduction.sequence.sequence_model import COMING_S, TAIL
from worldstate.belief.kinematics.cartesian import CartesianBelief, arc
from worldstate.belief.kinematics.motion import AZIMUTH, AZIMUTH_RATE, RADIAL_RATE, MotionBelief
from worldstate.ground import TINY, FloatArray, wrap_angle

from .site_geometry import USUAL_EDGE_STD, SideGeometry, SiteGeometry
from .track import Tracks

_MIDDLE_S = 0.5 * (np.array(COMING_S) + np.array((0.0, *COMING_S[:-1])))
# Beyond this azimuth the street ahead ends or bends.
_FARTHEST_RAD = math.radians(80.0)
_STEPS = 51  # Times at which the line of sight is evaluated; times between are interpolated


def hidden_bearing(coming: FloatArray, side: SideGeometry) -> tuple[float, float]:
    """Return mean and deviation of the azimuth, radians, given the distribution of the time to visible.

    Shapes: coming (9,), for the groups of `COMING_S`.

    Examples
    --------
    >>> near, far = np.zeros((2, 9))
    >>> near[0] = far[5] = 1.0
    >>> side = SideGeometry("left", 0.56, 0.96, 0.35)
    >>> [round(math.degrees(value)) for value in (*hidden_bearing(near, side), *hidden_bearing(far, side))]
    [37, 7, 63, 7]
    """
    along_rad = wrap_angle(side.edge_azimuth_rad + side.yaw_rad)
    sign, edge_rad = math.copysign(1.0, along_rad), abs(along_rad)
    slope = math.tan(min(edge_rad, _FARTHEST_RAD)) + side.pace_hz * _MIDDLE_S
    azimuth = np.minimum(np.arctan(slope), _FARTHEST_RAD)
    weight = (coming + TINY) / np.add.reduce(coming + TINY)
    mean = float(weight @ azimuth)
    # The usual deviation of an edge, 5 degrees, also covers errors of the time to visible: the edges of five
    # junctions deviate by only 2.6 degrees. A known edge does not remove these errors, so half of the usual
    # variance is kept. This share has the highest likelihood on exam seed 1 with learned edges; without it,
    # squared errors are 1.42 times the variance.
    edge = 0.5 * (side.edge_std_rad**2 + max(side.edge_std_rad, USUAL_EDGE_STD) ** 2)
    variance = edge + side.street.extent_rad**2 + float(weight @ (azimuth - mean) ** 2)
    return wrap_angle(sign * mean - side.yaw_rad), math.sqrt(variance)


def hidden_motion(coming: FloatArray, share: float, side: SideGeometry, before: MotionBelief) -> MotionBelief:
    r"""Return the motion of a vehicle that is hidden with probability `share`, and otherwise in view.

    A vehicle past the edge continues at the same speed,

    .. math:: \dot\theta = -\frac{v}{d} \cos^2\theta, \qquad \frac{\dot r}{r} = \dot\theta \tan\theta

    and is near the edge. A hidden one keeps its measured approach rate.
    """
    hidden_rad, hidden_std = hidden_bearing(coming, side)
    in_view_rad = side.edge_azimuth_rad
    azimuth_rad = share * hidden_rad + (1.0 - share) * in_view_rad
    # Mean and variance of the mixture.
    apart = share * (1.0 - share) * (hidden_rad - in_view_rad) ** 2
    variance = share * hidden_std**2 + (1.0 - share) * side.street.past_std_rad**2 + apart
    along_rad = wrap_angle(side.edge_azimuth_rad + side.yaw_rad)
    rate = -math.copysign(side.pace_hz * math.cos(azimuth_rad + side.yaw_rad) ** 2, along_rad)
    mean, covariance = before.mean.copy(), before.covariance.copy()
    mean[[AZIMUTH, AZIMUTH_RATE]] = azimuth_rad, rate
    rate_variance = (side.street.turn_share * rate) ** 2
    spreads = [(AZIMUTH, variance), (AZIMUTH_RATE, rate_variance)]
    if not share:
        mean[RADIAL_RATE] = rate * math.tan(azimuth_rad + side.yaw_rad)
        spreads.append((RADIAL_RATE, rate_variance))
    # These components follow from the sequence alone and replace earlier beliefs about them.
    for axis, spread in spreads:
        covariance[axis], covariance[:, axis] = 0.0, 0.0
        covariance[axis, axis] = spread
    return MotionBelief(mean, covariance)


def motion_in_view(
    coming: FloatArray, shares: Sequence[float], site: SiteGeometry, before: MotionBelief
) -> MotionBelief:
    """Return the motion of a vehicle that has come into view, given P(it came from a side) for each side.

    The mean is that of the likeliest side. The covariance includes the other sides, so that bearings can move
    the mean towards them. Shapes: coming (K, 9), shares (K,).
    """
    pairs = zip(coming, site.sides, strict=True)
    every = MotionBelief.stacked([hidden_motion(one, 0.0, side, before) for one, side in pairs])
    weights = np.array(shares)
    mean = every.mean[weights.argmax()]
    apart = every.mean - mean
    covariance = np.tensordot(weights, every.covariance + apart[:, :, None] * apart[:, None, :], 1)
    return MotionBelief(mean.copy(), covariance)


def time_to_visible(
    place: CartesianBelief, side: SideGeometry, site: SiteGeometry, within_s: float = COMING_S[-1]
) -> tuple[FloatArray, tuple[float, float, float] | None]:
    r"""Return P(an entity comes into view in time | hidden), and low, best and high time to visible, s.

    .. math:: P(T \le t \mid \text{hidden}) = P(S_t \le 0 \mid S_0 > 0)

    The best time is that of the mean position and velocity; nine of ten entities that come in time do so
    between low and high. The times are None if fewer than nine of ten come in time, or for several positions
    at once.

    Examples
    --------
    >>> from worldstate.belief.street_model import FilterSettings
    >>> coming = CartesianBelief(np.array([10.0, 20.0, 0.0, -8.0]), np.diag([0.2, 0.2, 0.1, 0.1]))
    >>> left = SideGeometry("left", 0.56, 0.96, 0.35)
    >>> chance, times_s = time_to_visible(coming, left, SiteGeometry((left,), 0.6, FilterSettings()))
    >>> round(float(chance), 3), [round(value, 1) for value in times_s]
    (1.0, [1.4, 1.7, 2.0])
    """
    # Imported here: few streets have announced road users.
    from scipy.special import ndtr, ndtri

    along = np.array([math.cos(side.edge_azimuth_rad), math.sin(side.edge_azimuth_rad)])
    range_m, speed_mps = (side.corner_m, site.ego_speed_mps) if side.corner_m else (1.0, 0.0)
    # After the ego vehicle has passed a corner, the corner hides nothing.
    abeam_s = range_m * math.cos(side.edge_azimuth_rad) / (speed_mps or TINY)
    times_s = np.linspace(0.0, min(within_s, abeam_s) if abeam_s > 0.0 else within_s, _STEPS)
    ego, _ = arc(speed_mps, site.ego_yaw_rate_rad_s, times_s)
    ray = range_m * along - ego
    off = place.mean[..., None, :2] + times_s[:, None] * place.mean[..., None, 2:] - ego
    normal = side.outwards * np.stack([-ray[:, 1], ray[:, 0]], axis=1)
    slope = np.hstack([normal, times_s[:, None] * normal])
    mean, edge = (normal * off).sum(axis=-1), range_m * side.edge_std_rad * (off @ along)
    spread = slope @ place.covariance
    std = np.sqrt((spread * slope).sum(axis=-1) + edge**2)
    shared = (spread[..., 1:, :] * slope[:-1]).sum(axis=-1) + edge[..., 1:] * edge[..., :-1]
    past, correlation = -mean / std, shared / (std[..., 1:] * std[..., :-1])
    # Step by step: an entity that has also passed the ego vehicle is behind the line again.
    passes = _both_below(-past[..., :-1], past[..., 1:], -correlation).sum(axis=-1)
    chance = np.clip(passes / np.maximum(ndtr(-past[..., 0]), TINY), 0.0, 1.0)
    if chance.ndim or chance < 1.0 - 2.0 * TAIL:
        return chance, None
    past = np.maximum.accumulate(past)
    low, high = ndtri(np.interp([TAIL, 1.0 - TAIL], [0.0, 1.0], ndtr(past[[0, -1]]))).tolist()
    low_s, best_s, high_s = np.interp([low, 0.0, high], past, times_s).tolist()
    return chance, (low_s, best_s, high_s)


def _both_below(h: FloatArray, k: FloatArray, correlation: FloatArray) -> FloatArray:
    """Return P(two correlated standard normal numbers are below h and k), by Owen's T."""
    from scipy.special import ndtr, owens_t

    h, k = (np.where(one, one, TINY) for one in (h, k))
    rest = np.sqrt(np.maximum(1.0 - correlation**2, TINY))
    tails = owens_t(h, (k / h - correlation) / rest) + owens_t(k, (h / k - correlation) / rest)
    return np.asarray(0.5 * (ndtr(h) + ndtr(k)) - tails - 0.5 * (h * k < 0.0))


def announced(tracks: Tracks, site: SiteGeometry) -> tuple[float, ...]:
    """Return P(a hidden entity with a position comes into view) for each side, shape (K,)."""
    hidden, chances = tracks.placed & ~tracks.seen & tracks.moving, [0.0] * len(site.sides)
    for k in set(tracks.side[hidden].tolist()):
        rows = (hidden & (tracks.side == k)).nonzero()[0]
        places = CartesianBelief(tracks.place_mean[rows], tracks.place_covariance[rows])
        comes, _ = time_to_visible(places, site.sides[k], site)
        chances[k] = float((tracks.existence[rows] * tracks.behind[rows] * comes).max())
    return tuple(chances)
