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
from worldstate.belief.track import Track, hidden_share, merged
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement

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


def acoustic_update(memory: Memory, measurement: Measurement, weight: float) -> None:
    """Update the entities with the bearing and the approach rate of a measurement.

    R is divided by `weight`: consecutive windows overlap, and full weight for each would count the same
    samples up to ten times.
    """
    # A measured position tells more than a bearing that may be that of a wall.
    tracks = [track for track in memory.tracks if track.moving and track.place is None]
    bearing, approach = measurement.bearing, measurement.approach
    silent = isinstance(bearing, NotUsable) and isinstance(approach, NotUsable)
    if weight <= 0.0 or silent or not tracks:
        return
    sides = memory.sides
    visible = sides.hypotheses[1]
    # P(this entity is the source of this window's sound)
    sounding = [visible * one.existence if one.seen else sides.existence(one.side) for one in tracks]
    motion = MotionBelief.stacked([track.motion for track in tracks])
    if not isinstance(bearing, NotUsable):
        paths = [_path(bearing.std_rad, hidden_share(track, sides)) for track in tracks]
        own = [
            association_probability(track, bearing.azimuth_rad, std, path * chance)
            for track, (std, path), chance in zip(tracks, paths, sounding, strict=True)
        ]
        stds = np.array([std for std, _ in paths]) / math.sqrt(weight)
        motion = update(motion, AZIMUTH, bearing.azimuth_rad, stds, np.array(own))
    if not isinstance(approach, NotUsable):
        std = approach.std_hz / math.sqrt(weight)
        motion = update(motion, RADIAL_RATE, -approach.inverse_tta_hz, std, np.array(sounding))
    for track, moved, chance in zip(tracks, motion.each(), sounding, strict=True):
        track.motion, track.updated_ns = moved, measurement.stamp_ns
        track.sources = merged(track.sources, measurement.source)
        track.approach_heard |= chance > 0.5 and not isinstance(approach, NotUsable)


def association_probability(
    track: Track, azimuth_rad: float, std_rad: float, own_path_probability: float
) -> float:
    r"""Return the probability that a peak belongs to this entity's own path.

    .. math:: w = \frac{p\, N(z; \theta, P_\theta + R)}{p\, N(z; \theta, P_\theta + R) + (1 - p)/\pi}
    """
    if not 0.0 < own_path_probability < 1.0:
        return own_path_probability
    own = log_azimuth_likelihood(track.motion, azimuth_rad, std_rad) + math.log(own_path_probability)
    other = _LOG_CLUTTER_DENSITY + math.log1p(-own_path_probability)
    # exp overflows above 709.
    return 1.0 / (1.0 + math.exp(min(other - own, 700.0)))


def _path(std_rad: float, share: float) -> tuple[float, float]:
    r"""Return standard deviation and prior path probability of a peak, hidden or in line of sight.

    The deviation that comes with a peak holds that it may be another one, which association weighs itself:

    .. math:: \sigma^2 = \sigma_0^2 + p\, \frac{\pi^2}{12}

    with the deviation :math:`\sigma_0` of peaks that are the entity's, and p the chance that this one is not.
    """
    if share >= 0.5:
        return _HIDDEN_STD, _HIDDEN_PATH
    own_rad = min(std_rad, _IN_VIEW_STD)
    astray = (std_rad**2 - own_rad**2) / _ANYWHERE_RAD2
    return own_rad, min(max(1.0 - astray, 0.0), _IN_VIEW_PATH)
