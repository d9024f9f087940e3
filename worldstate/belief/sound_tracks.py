r"""Tracks of sound: where something sounds, by bearings alone, as of an array without a model.

Existence e and azimuth of a track are those of the integrated probabilistic data association filter. A
bearing z counts for the track i that it is likeliest of, if it is likelier than any direction; else a track
begins:

.. math:: \frac{e}{1 - e} \leftarrow \frac{e}{1 - e} \big(1 - p + 2\pi\, p\, N(z; \theta_i, P_i + R)\big)^w,

with the chance p that a source which sounds is the loudest one, and the share w of its sound that is new.
For the others N is 0. In silence a track fades.

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
# Of one talker in a room, 0.79 to 1.0 of the usable bearings lie within 15 degrees of it, of each of two 0.23
# to 0.56 (five microphones on a ring of 4.5 cm, six simulated rooms of 0.25 to 0.6 s).
_LOUDEST = 0.5
# Sound that a bearing is read from; those that overlap say the same thing again.
_BEARING_S = 0.2
# Of a track with one bearing; and the largest, beyond which a track would outlive its sound for long.
_FIRST, _MOST = 0.2, 0.99
# A car that passes 5 m away at 10 m/s turns by up to 2 rad/s.
_RATE_STD_RAD_S, _NEAR_M = 1.0, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class SoundTrack:
    """Something that one source hears: its azimuth, whether it is there, and since when."""

    source: str
    motion: MotionBelief
    existence: Probability
    created_ns: int
    updated_ns: int


def faded(tracks: Iterable[SoundTrack], step_s: float, street: StreetModel) -> tuple[SoundTrack, ...]:
    """Return tracks at a later time, with nothing heard."""
    kept = math.exp(-step_s / street.unseen_s)
    return tuple(
        replace(one, existence=kept * one.existence, motion=predict(one.motion, step_s, street.acceleration))
        for one in tracks
        if kept * one.existence >= street.death
    )


def followed(
    tracks: Sequence[SoundTrack], measurement: Measurement, new_s: float, street: StreetModel
) -> tuple[SoundTrack, ...]:
    """Return tracks after the bearing of a measurement, of whose sound so much is new."""
    bearing, source, weight = measurement.bearing, measurement.source, min(new_s / _BEARING_S, 1.0)
    if isinstance(bearing, NotUsable) or bearing.at_edge or weight <= 0.0:
        return tuple(tracks)
    # A wider one says that another peak may be the right one, which the chance of the loudest holds.
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
    """Return a track after a bearing that is so many times likelier of it than of any direction."""
    odds = track.existence / (1.0 - track.existence) * (1.0 - _LOUDEST + _LOUDEST * ratio) ** weight
    return replace(track, existence=min(odds / (1.0 + odds), _MOST))
