"""Update the entities with an acoustic bearing and approach rate, by probabilistic data association."""

import math

import numpy as np

from worldstate.belief.kinematics.motion import (
    AZIMUTH,
    RADIAL_RATE,
    MotionBelief,
    log_azimuth_likelihood,
    update,
)
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import merged
from worldstate.ground import TINY, FloatArray, NotUsable
from worldstate.measurement.measurement import Bearing, Measurement

from .birth_death import HIDDEN
from .memory import Memory

# Density of peaks of other sources: uniform over the half-plane ahead, because images in walls and other
# sources were found at all azimuths.
_LOG_CLUTTER_DENSITY = -math.log(math.pi)
_ANYWHERE_RAD2 = math.pi**2 / 12.0


def acoustic_update(memory: Memory, measurement: Measurement, weight: float, site: SiteGeometry) -> None:
    """Update the entities with the bearing and the approach rate of a measurement.

    R is divided by `weight`: windows overlap, and full weight would use the same samples up to ten times.
    """
    tracks, bearing, approach, street = memory.tracks, measurement.bearing, measurement.approach, site.street
    # A measured position is more accurate than a bearing, which may point to a reflecting wall.
    rows = (tracks.moving & ~tracks.placed).nonzero()[0]
    silent = isinstance(bearing, NotUsable) and isinstance(approach, NotUsable)
    if weight <= 0.0 or silent or not len(rows):
        return
    # `sounding` is P(an entity is the source of this window's sound).
    visible = memory.belief.joint.explanations[1]
    sounding = np.where(tracks.seen[rows], visible, 1.0) * tracks.existence[rows]
    motion = MotionBelief(tracks.mean[rows], tracks.covariance[rows])
    if not isinstance(bearing, NotUsable):
        hidden = tracks.behind[rows] >= HIDDEN
        heard_hidden = (street.heard_std_rad,), (street.heard_path,)
        std_rad, path = np.where(hidden, heard_hidden, _path_in_view(bearing, site))
        azimuth_rad, ago_s = bearing.azimuth_rad, street.bearing_s
        own = association_probability(motion, azimuth_rad, std_rad, path * sounding, ago_s)
        motion = update(motion, AZIMUTH, azimuth_rad, std_rad / math.sqrt(weight), own, ago_s)
    if not isinstance(approach, NotUsable):
        std_hz = approach.std_hz / math.sqrt(weight)
        motion = update(motion, RADIAL_RATE, -approach.inverse_tta_hz, std_hz, sounding)
        tracks.approach_heard[rows] |= sounding > 0.5
    tracks.mean[rows], tracks.covariance[rows] = motion.mean, motion.covariance
    tracks.updated_ns[rows] = measurement.stamp_ns
    for i in rows.tolist():
        tracks.sources[i] = merged(tracks.sources[i], measurement.source)


def association_probability(
    motion: MotionBelief,
    azimuth_rad: float,
    std_rad: FloatArray,
    own_path_probability: FloatArray,
    ago_s: float = 0.0,
) -> FloatArray:
    r"""Return the probability that a peak belongs to each entity's own path.

    .. math:: w = \frac{p\, N(z; \theta, P_\theta + R)}{p\, N(z; \theta, P_\theta + R) + (1 - p)/\pi}
    """
    p = np.minimum(np.maximum(own_path_probability, TINY), 1.0)
    own = log_azimuth_likelihood(motion, azimuth_rad, std_rad, ago_s) + np.log(p)
    other = _LOG_CLUTTER_DENSITY + np.log1p(-np.minimum(p, 1.0 - TINY))
    weight = np.exp(-np.logaddexp(0.0, other - own))
    certain = (own_path_probability <= 0.0) | (own_path_probability >= 1.0)
    return np.where(certain, own_path_probability, weight)


def _path_in_view(bearing: Bearing, site: SiteGeometry) -> tuple[tuple[float], tuple[float]]:
    r"""Return the deviation of a peak of an entity in line of sight, and the prior of its own path.

    The deviation of a measured peak includes the chance p that the peak belongs to another source:

    .. math:: \sigma^2 = \sigma_0^2 + p\, \frac{\pi^2}{12}

    Association treats p separately, so only the entity's own deviation :math:`\sigma_0` is returned. A peak
    past an edge is an image or belongs to a hidden vehicle.
    """
    street, azimuth_rad = site.street, np.array([bearing.azimuth_rad])
    own_rad = min(bearing.std_rad, street.seen_std_rad)
    astray = (bearing.std_rad**2 - own_rad**2) / _ANYWHERE_RAD2
    sight = site.line_of_sight(azimuth_rad, np.array([own_rad]), np.array([street.range_m]))
    return (own_rad,), (min(max(1.0 - astray, 0.0), street.seen_path) * float(sight[0]),)
