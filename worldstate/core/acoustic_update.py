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
from worldstate.belief.track import hidden_shares, merged
from worldstate.ground import FloatArray
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement

from .birth_death import HIDDEN
from .memory import Memory

# Density of peaks that are not this entity's: uniform over the half-plane ahead, since images in walls and
# other sources were found at all azimuths.
_LOG_CLUTTER_DENSITY = -math.log(math.pi)
# Peaks heard while hidden: P(of this side's direct or diffracted path), since in real hidden windows 21 % of
# them stand near the corner, and 14 degrees, since they spread from the edge to the vehicle itself.
_HIDDEN_PATH, _HIDDEN_STD = 0.25, 0.25
# Peaks of single vehicles in view at the five junctions with a name: .86 within 20 degrees where 15 to 20 are
# stated, and these off by 7, along the vehicle and about it. The others are images in walls, other sources.
_IN_VIEW_PATH, _IN_VIEW_STD = 0.8, 0.12
_ANYWHERE_RAD2 = math.pi**2 / 12.0
_LEAST_PATH, _MOST_PATH = 1e-300, 1.0 - 1e-15  # Keep logarithms finite


def acoustic_update(memory: Memory, measurement: Measurement, weight: float) -> None:
    """Update the entities with the bearing and the approach rate of a measurement.

    R is divided by `weight`: consecutive windows overlap, and full weight for each would count the same
    samples up to ten times.
    """
    tracks, sides, bearing, approach = memory.tracks, memory.sides, measurement.bearing, measurement.approach
    # A measured position tells more than a bearing that may be that of a wall.
    rows = np.flatnonzero(tracks.moving & ~tracks.placed)
    silent = isinstance(bearing, NotUsable) and isinstance(approach, NotUsable)
    if weight <= 0.0 or silent or not len(rows):
        return
    # P(this entity is the source of this window's sound)
    heard = np.array([sides.existence(k) for k in range(len(sides.hidden))])[tracks.side[rows]]
    sounding = np.where(tracks.seen[rows], sides.hypotheses[1] * tracks.existence[rows], heard)
    motion = MotionBelief(tracks.mean[rows], tracks.covariance[rows])
    if not isinstance(bearing, NotUsable):
        hidden = hidden_shares(tracks, sides)[rows] >= HIDDEN
        std_rad, path = np.where(hidden, ((_HIDDEN_STD,), (_HIDDEN_PATH,)), _path_in_view(bearing.std_rad))
        own = association_probability(motion, bearing.azimuth_rad, std_rad, path * sounding)
        motion = update(motion, AZIMUTH, bearing.azimuth_rad, std_rad / math.sqrt(weight), own)
    if not isinstance(approach, NotUsable):
        std_hz = approach.std_hz / math.sqrt(weight)
        motion = update(motion, RADIAL_RATE, -approach.inverse_tta_hz, std_hz, sounding)
        tracks.approach_heard[rows] |= sounding > 0.5
    tracks.mean[rows], tracks.covariance[rows] = motion.mean, motion.covariance
    tracks.updated_ns[rows] = measurement.stamp_ns
    for i in rows.tolist():
        tracks.sources[i] = merged(tracks.sources[i], measurement.source)


def association_probability(
    motion: MotionBelief, azimuth_rad: float, std_rad: FloatArray, own_path_probability: FloatArray
) -> FloatArray:
    r"""Return the probability that a peak belongs to each entity's own path.

    .. math:: w = \frac{p\, N(z; \theta, P_\theta + R)}{p\, N(z; \theta, P_\theta + R) + (1 - p)/\pi}
    """
    p = np.minimum(np.maximum(own_path_probability, _LEAST_PATH), 1.0)
    own = log_azimuth_likelihood(motion, azimuth_rad, std_rad) + np.log(p)
    other = _LOG_CLUTTER_DENSITY + np.log1p(-np.minimum(p, _MOST_PATH))
    # exp overflows above 709.
    weight = 1.0 / (1.0 + np.exp(np.minimum(other - own, 700.0)))
    certain = (own_path_probability <= 0.0) | (own_path_probability >= 1.0)
    return np.where(certain, own_path_probability, weight)


def _path_in_view(std_rad: float) -> tuple[tuple[float], tuple[float]]:
    r"""Return standard deviation and prior path probability of a peak of an entity in line of sight.

    The deviation that comes with a peak holds that it may be another one, which association weighs itself:

    .. math:: \sigma^2 = \sigma_0^2 + p\, \frac{\pi^2}{12}

    with the deviation :math:`\sigma_0` of peaks that are the entity's, and p the chance that this one is not.
    """
    own_rad = min(std_rad, _IN_VIEW_STD)
    astray = (std_rad**2 - own_rad**2) / _ANYWHERE_RAD2
    return (own_rad,), (min(max(1.0 - astray, 0.0), _IN_VIEW_PATH),)
