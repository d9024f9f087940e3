r"""Tracks of sound from bearings alone, for an array without a model.

Existence e and azimuth of a track follow the integrated probabilistic data association filter. A bearing z
belongs to its likeliest track i if it is likelier there than in a random direction; otherwise a new track
begins:

.. math:: \frac{e}{1 - e} \leftarrow \frac{e}{1 - e} \big(1 - p + 2\pi\, p\, N(z; \theta_i, P_i + R)\big)^w,

with the chance p that an active source is the loudest one, and the new share w of its sound. For other tracks
N is 0. In silence a track fades.

References
----------
D. Musicki, R. Evans and S. Stankovic, "Integrated probabilistic data association", IEEE Transactions on
Automatic Control 39, 1994.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from worldstate.ground.serialisation import Probability
from worldstate.ground.values import NotUsable
from worldstate.measurement import Measurement

from .kinematics.motion import AZIMUTH, MotionBelief, log_azimuth_likelihood, predict, update
from .street_model import StreetModel

MOST_SOUNDS = 8
# One talker in a room: 79 to 100 % of the usable bearings are within 15 degrees of the talker; two talkers:
# 23 to 56 % for each (five microphones on a ring of 4.5 cm, six simulated rooms of 0.25 to 0.6 s).
_LOUDEST = 0.5
# Duration of the sound behind a bearing; overlapping bearings repeat one another.
_BEARING_S = 0.2
# Existence after one bearing, and its limit; without a limit a track would outlive its sound for long.
_FIRST, _MOST = 0.2, 0.99
# A car that passes 5 m away at 10 m/s turns by up to 2 rad/s.
_RATE_STD_RAD_S, _NEAR_M = 1.0, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class SoundTrack:
    """A source of sound as one array receives it: azimuth, existence and times."""

    source: str
    motion: MotionBelief
    existence: Probability
    created_ns: int
    updated_ns: int


def faded(tracks: Iterable[SoundTrack], step_s: float, street: StreetModel) -> tuple[SoundTrack, ...]:
    """Return tracks at a later time without a bearing."""
    kept = math.exp(-step_s / street.unseen_s)
    return tuple(
        replace(one, existence=kept * one.existence, motion=predict(one.motion, step_s, street.acceleration))
        for one in tracks
        if kept * one.existence >= street.death
    )


def followed(
    tracks: Sequence[SoundTrack], measurement: Measurement, new_s: float, street: StreetModel
) -> tuple[SoundTrack, ...]:
    """Return tracks after the bearing of a measurement with `new_s` seconds of new sound."""
    bearing, source, weight = measurement.bearing, measurement.source, min(new_s / _BEARING_S, 1.0)
    if isinstance(bearing, NotUsable) or bearing.at_edge or weight <= 0.0:
        return tuple(tracks)
    # A larger deviation means that another peak may be right; `_LOUDEST` already includes this chance.
    azimuth_rad, std_rad = bearing.azimuth_rad, min(bearing.std_rad, street.seen_std_rad)
    after = [one if one.source != source else _weighed(one, weight, 0.0) for one in tracks]
    ratios = [
        math.tau * math.exp(log_azimuth_likelihood(one.motion, azimuth_rad, std_rad)) * (one.source == source)
        for one in tracks
    ]
    nearest = max(range(len(tracks)), key=ratios.__getitem__, default=0)
    if ratios and ratios[nearest] > 1.0:
        found = _weighed(tracks[nearest], weight, ratios[nearest])
        motion = update(found.motion, AZIMUTH, azimuth_rad, std_rad / math.sqrt(weight))
        after[nearest] = replace(found, motion=motion, updated_ns=measurement.stamp_ns)
    else:
        stds = std_rad, _RATE_STD_RAD_S, street.closing_hz, street.range_spread
        motion = MotionBelief.around((azimuth_rad, 0.0, 0.0, math.log(_NEAR_M)), stds)
        after.append(SoundTrack(source, motion, _FIRST, measurement.stamp_ns, measurement.stamp_ns))
    likely = (one for one in after if one.existence >= street.death)
    return tuple(sorted(likely, key=lambda one: (-one.existence, one.source, one.created_ns))[:MOST_SOUNDS])


def _weighed(track: SoundTrack, weight: float, ratio: float) -> SoundTrack:
    """Return a track after a bearing, given the bearing's likelihood ratio to a random direction."""
    odds = track.existence / (1.0 - track.existence) * (1.0 - _LOUDEST + _LOUDEST * ratio) ** weight
    return replace(track, existence=min(odds / (1.0 + odds), _MOST))
