r"""Where a hidden vehicle is, by the time that remains until it comes into view.

It drives along the crossing street towards the edge of its occluder. With the street at distance d, the edge
at azimuth a and speed v, it stands t seconds before line of sight at

.. math:: \tan\theta(t) = \tan a + \frac{v}{d}\, t

Metres are not in the sound, but the time to visible is; the mean is taken over its distribution and over
what is not known of v / d. Of the variance a fifth is the place's: what is heard is how far behind the edge
a vehicle is, and most of what is not known of the time is at which pace it comes.

A hidden vehicle with a place comes into view when it passes its edge. With the edge of the occluder at
azimuth a, the normal :math:`n = (-\sin a, \cos a)` of its line of sight and the velocity w relative to the
ego vehicle, an entity at p comes into view after

.. math:: t = -\frac{n \cdot p}{n \cdot w}
"""

import math

import numpy as np

from worldstate.abduction.sequence.sequence_model import COMING_S
from worldstate.belief.kinematics.cartesian import CartesianBelief
from worldstate.belief.kinematics.motion import AZIMUTH, AZIMUTH_RATE, MotionBelief
from worldstate.ground import FloatArray, wrap_angle

from .site_geometry import SideGeometry, SiteGeometry
from .track import Tracks

# What is not known of v / d: within a factor of 1.2 (three points of a lognormal distribution with the
# weights of Gauss and Hermite).
_SPREAD = 0.2
_PACES = np.exp(_SPREAD * math.sqrt(3.0) * np.array([-1.0, 0.0, 1.0]))
_PACE_WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6.0
# Of the variance of the time: exam seed 1, sequence alone, three seconds before T0: errors of 6.6 degrees
# where all of it states 9.4. A vehicle's length and lane leave the rest, however well its edge is known.
_PLACE_SHARE, _EXTENT_STD, _USUAL_EDGE_STD = 0.2, math.radians(4.2), math.radians(5.0)
# v t / d in the middle of every group where v / d is 1/s, shape (groups, paces).
_PASSED = (0.5 * (np.array(COMING_S) + np.array((0.0, *COMING_S[:-1]))))[:, None] * _PACES
# Beyond, the street ahead ends or bends.
_FARTHEST_RAD = math.radians(80.0)
_SMALLEST = 1e-12
# Of the azimuth rate, relative: drivers brake and turn.
_RATE_SPREAD = 0.5
_IN_VIEW_STD = math.radians(20.0)


def hidden_bearing(coming: FloatArray, side: SideGeometry) -> tuple[float, float]:
    """Return mean and deviation of the azimuth, radians, of a vehicle that comes with these probabilities.

    Shapes: coming (9,), of the groups of `COMING_S`.

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
    slope = math.tan(min(edge_rad, _FARTHEST_RAD)) + side.pace_hz * _PASSED
    azimuth = np.minimum(np.arctan(slope), _FARTHEST_RAD)
    weight = coming[:, None] * _PACE_WEIGHTS + _SMALLEST
    weight = weight / weight.sum()
    mean = float((weight * azimuth).sum())
    # The five degrees of the usual edge hold more than the edge, from which five junctions deviate by 2.6:
    # errors of the time, which a known edge does not end. Half of their variance stays: likeliest on exam
    # seed 1 with learned edges; without it squared errors are 1.42 of the variance.
    edge = 0.5 * (side.edge_std_rad**2 + max(side.edge_std_rad, _USUAL_EDGE_STD) ** 2)
    variance = _PLACE_SHARE * float((weight * (azimuth - mean) ** 2).sum()) + (edge + _EXTENT_STD**2)
    return wrap_angle(sign * mean - side.yaw_rad), math.sqrt(variance)


def hidden_motion(coming: FloatArray, share: float, side: SideGeometry, before: MotionBelief) -> MotionBelief:
    r"""Return the motion of a vehicle that comes with these probabilities or, but for `share`, is in view.

    A vehicle past the edge goes on as it came,

    .. math:: \dot\theta = -\frac{v}{d} \cos^2\theta

    and stands half-way between edge and axis, give or take; what was heard of its approach rate is kept.
    """
    hidden_rad, hidden_std = hidden_bearing(coming, side)
    in_view_rad = 0.5 * (side.edge_azimuth_rad - side.yaw_rad)
    azimuth_rad = share * hidden_rad + (1.0 - share) * in_view_rad
    # Mean and variance of the two together.
    apart = share * (1.0 - share) * (hidden_rad - in_view_rad) ** 2
    variance = share * hidden_std**2 + (1.0 - share) * _IN_VIEW_STD**2 + apart
    along_rad = wrap_angle(side.edge_azimuth_rad + side.yaw_rad)
    rate = -math.copysign(side.pace_hz * math.cos(azimuth_rad + side.yaw_rad) ** 2, along_rad)
    mean, covariance = before.mean.copy(), before.covariance.copy()
    mean[[AZIMUTH, AZIMUTH_RATE]] = azimuth_rad, rate
    # Both are read anew from the sequence, whatever else was believed of them.
    for axis, spread in ((AZIMUTH, variance), (AZIMUTH_RATE, (_RATE_SPREAD * rate) ** 2)):
        covariance[axis], covariance[:, axis] = 0.0, 0.0
        covariance[axis, axis] = spread
    return MotionBelief(mean, covariance)


# Slower towards the line of sight than so many standard deviations, and it may never cross it.
_LEAST_DEVIATIONS = 2.0
# m/s: of a velocity that was not measured, which says nothing against coming.
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


def announced(tracks: Tracks, site: SiteGeometry) -> tuple[float, ...]:
    """Return for each side the probability that a hidden entity with a place comes into view, shape (K,)."""
    chances = [0.0] * len(site.sides)
    for i in np.flatnonzero(tracks.placed & ~tracks.seen).tolist():
        if _comes(tracks, i, site):
            side, chance = int(tracks.side[i]), float(tracks.existence[i] * tracks.behind[i])
            chances[side] = max(chances[side], chance)
    return tuple(chances)


def _comes(tracks: Tracks, row: int, site: SiteGeometry) -> bool:
    """Tell whether an entity may come into view within the times that a sequence model speaks of."""
    place = CartesianBelief(tracks.place_mean[row], tracks.place_covariance[row])
    if place.velocity_std_mps > _UNKNOWN_SPEED_STD:
        return True
    expected = time_to_visible(place, site.sides[tracks.side[row]], site.ego_speed_mps)
    return bool(tracks.moving[row]) and expected is not None and expected[0] <= COMING_S[-1]
