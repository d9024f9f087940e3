"""What a bearing and an approach rate say of each entity, given that they may belong to something else."""

import math
from dataclasses import replace

from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement

from .explanation import ExplanationBelief
from .motion import log_azimuth_likelihood, update_approach, update_azimuth
from .settings import FilterSettings
from .track import Track, merged

# A peak that is not this entity's may stand anywhere in front of the array: images in walls, other sources.
_LOG_CLUTTER_DENSITY = -math.log(math.pi)


def acoustic_update(
    tracks: tuple[Track, ...],
    measurement: Measurement,
    explanation: ExplanationBelief,
    weight: float,
    settings: FilterSettings,
) -> tuple[Track, ...]:
    """Return the tracks after the acoustic bearing and approach rate."""
    # Each measurement is inflated by 1/`weight`, as its window overlaps the last one.
    if weight <= 0.0:
        return tracks
    return tuple(
        _heard(track, measurement, explanation, weight, settings) if track.moving else track
        for track in tracks
    )


def hidden_share(track: Track, explanation: ExplanationBelief) -> float:
    """P(hidden | exists) of a track: 0 once vision has it."""
    if track.seen:
        return 0.0
    hidden, emerged = explanation.hidden[track.side], explanation.emerged[track.side]
    return hidden / (hidden + emerged) if hidden + emerged > 0 else 1.0


def association_probability(
    track: Track, azimuth_rad: float, std_rad: float, own_path_probability: float
) -> float:
    r"""P(a peak is this entity's own path | where it stands).

    .. math:: w = \frac{p\, N(z; \theta, P_\theta + R)}{p\, N(z; \theta, P_\theta + R) + (1 - p)/\pi}
    """
    if not 0.0 < own_path_probability < 1.0:
        return own_path_probability
    own = log_azimuth_likelihood(track.motion, azimuth_rad, std_rad) + math.log(own_path_probability)
    other = _LOG_CLUTTER_DENSITY + math.log1p(-own_path_probability)
    return 1.0 / (1.0 + math.exp(min(other - own, 700.0)))


def _heard(
    track: Track,
    measurement: Measurement,
    explanation: ExplanationBelief,
    weight: float,
    settings: FilterSettings,
) -> Track:
    share = hidden_share(track, explanation)
    sounding = _sounding(track, explanation)
    motion, heard = track.motion, False
    if not isinstance(measurement.bearing, NotUsable):
        std, path = _path(measurement.bearing.std_rad, share, settings)
        azimuth = measurement.bearing.azimuth_rad
        own = association_probability(track, azimuth, std, path * sounding)
        motion = update_azimuth(motion, azimuth, std / math.sqrt(weight), own)
        heard = True
    approach_heard = track.approach_heard
    if not isinstance(measurement.approach, NotUsable):
        std = measurement.approach.std_hz / math.sqrt(weight)
        motion = update_approach(motion, measurement.approach.inverse_tta_hz, std, sounding)
        heard, approach_heard = True, approach_heard or sounding > 0.5
    if not heard:
        return track
    return replace(
        track,
        motion=motion,
        updated_ns=measurement.stamp_ns,
        sources=merged(track.sources, measurement.source),
        approach_heard=approach_heard,
    )


def _path(line_of_sight_std_rad: float, share: float, settings: FilterSettings) -> tuple[float, float]:
    """Return the standard deviation of a peak and P(it is the own path), hidden or in line of sight."""
    if share >= 0.5:
        return settings.hidden_bearing_std_rad, settings.hidden_path_probability
    return line_of_sight_std_rad, settings.line_of_sight_path_probability


def _sounding(track: Track, explanation: ExplanationBelief) -> float:
    """P(the sound of this window is this entity's)."""
    if track.seen:
        return explanation.visible * track.existence
    return explanation.hidden[track.side] + explanation.emerged[track.side]
