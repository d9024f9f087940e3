"""What a look of the co-evidence channel does: sightings, empty looks, hand-over from hidden to visible."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from worldstate.abduction.co_evidence import Absent, CoEvidence, Unqueried
from worldstate.measurement import Measurement, Sighting

from .association import match_hidden, match_visible
from .existence import after_empty_look, after_sighting
from .explanation import ExplanationBelief
from .motion import MotionBelief, update_azimuth
from .polar import LOG_RANGE, RADIAL_RATE
from .settings import FilterSettings
from .side import Side, nearest_side
from .track import Track, entity_id, merged, relabelled

_NEW_RATE_STD = (0.5, 0.5)
_PARKED_RATE_STD = (1e-3, 1e-3)


@dataclass(frozen=True, slots=True)
class Seen:
    """Outcome of a look: the tracks, the explanations, and on which sides a hand-over took place."""

    tracks: tuple[Track, ...]
    explanation: ExplanationBelief
    handed_over: tuple[int, ...]
    born: int


def log_co_evidence(answer: CoEvidence, directions: int, weight: float) -> NDArray[np.float64]:
    """Return w log p(V | hidden_1 .. hidden_K, visible, none), shape (K + 2,), nats.

    Examples
    --------
    >>> log_co_evidence(Absent(miss_rate=0.04), 2, weight=0.5).round(2)
    array([ 0.  ,  0.  , -1.61,  0.  ])
    """
    if weight <= 0.0:
        return np.zeros(directions + 2)
    hidden, visible, none = (weight * answer.log_likelihoods()).tolist()
    return np.array([*[hidden] * directions, visible, none])


def look(
    tracks: tuple[Track, ...],
    explanation: ExplanationBelief,
    measurement: Measurement,
    sides: tuple[Side, ...],
    view_half_angle_rad: float,
    weight: float,
    born: int,
    settings: FilterSettings,
) -> Seen:
    """Return the world after one look; `born` counts the entities that vision brought in so far."""
    sightings = tuple(sorted(measurement.sightings, key=lambda s: (s.azimuth_rad, s.label, s.score)))
    known = match_visible(tracks, sightings, settings)
    new = tuple((j, s) for j, s in enumerate(sightings) if j not in known.values())
    emerging = match_hidden(tracks, new, sides, settings)
    after = []
    for i, track in enumerate(tracks):
        if i in known:
            after.append(_sighted(track, sightings[known[i]], measurement, settings))
        elif i in emerging:
            after.append(_handed_over(track, sightings[emerging[i]], measurement, sides, settings))
        else:
            after.append(_not_sighted(track, measurement.co_evidence, view_half_angle_rad, weight))
    handed_over = tuple(tracks[i].side for i in emerging)
    for side in handed_over:
        explanation = explanation.emerge(side, settings.handover_residual)
    fresh = [s for j, s in new if j not in emerging.values()]
    after += [_born(s, measurement, sides, born + n, settings) for n, s in enumerate(fresh)]
    return Seen(tuple(after), explanation, handed_over, born + len(fresh))


def surviving(tracks: tuple[Track, ...], settings: FilterSettings) -> tuple[Track, ...]:
    """Return the tracks without the visible ones that no longer exist or are lost."""
    return tuple(
        track
        for track in tracks
        if not track.seen
        or (
            track.existence >= settings.delete_existence
            and track.motion.azimuth_std_rad <= settings.lost_std_rad
        )
    )


def _in_view(track: Track, view_half_angle_rad: float) -> bool:
    return abs(track.motion.azimuth_rad) <= view_half_angle_rad


def _rates(answer: CoEvidence, settings: FilterSettings) -> tuple[float, float]:
    """Return miss and clutter rate of a look; a channel that was not asked has neither."""
    if isinstance(answer, Unqueried):
        return 0.0, settings.clutter_rate
    return answer.miss_rate, answer.clutter_rate or settings.clutter_rate


def _sighted(track: Track, sighting: Sighting, measurement: Measurement, settings: FilterSettings) -> Track:
    motion = track.motion
    if sighting.moving != track.moving:
        motion = _motion_at(sighting, motion)
    else:
        motion = update_azimuth(motion, sighting.azimuth_rad, sighting.std_rad, weight=1.0)
    miss, clutter = _rates(measurement.co_evidence, settings)
    return replace(
        track,
        existence=after_sighting(track.existence, min(miss, 0.99), clutter),
        motion=motion,
        labels=relabelled(track.labels, sighting),
        moving=sighting.moving,
        sources=merged(track.sources, "vision"),
        updated_ns=measurement.stamp_ns,
        last_seen_ns=measurement.stamp_ns,
        answer="visible",
        miss_rate=None if isinstance(measurement.co_evidence, Unqueried) else miss,
    )


def _handed_over(
    track: Track,
    sighting: Sighting,
    measurement: Measurement,
    sides: tuple[Side, ...],
    settings: FilterSettings,
) -> Track:
    """Return the hidden entity as vision now has it: same id, azimuth and side from the sighting."""
    seen = replace(
        track,
        seen=True,
        side=nearest_side(sides, sighting.azimuth_rad),
        existence=max(track.existence, settings.sighting_existence),
        motion=_motion_at(sighting, track.motion),
    )
    labels = ((sighting.label, sighting.score),)
    return replace(_sighted(seen, sighting, measurement, settings), labels=labels)


def _not_sighted(
    track: Track, answer: CoEvidence, view_half_angle_rad: float, weight: float
) -> Track:
    if isinstance(answer, Unqueried) or not (track.seen and _in_view(track, view_half_angle_rad)):
        searched = isinstance(answer, Absent) and not track.seen
        miss = answer.miss_rate if isinstance(answer, Absent) and searched else None
        return replace(track, answer="absent" if searched else "unqueried", miss_rate=miss)
    existence = after_empty_look(track.existence, answer.miss_rate**weight)
    return replace(track, existence=existence, answer="absent", miss_rate=answer.miss_rate)


def _born(
    sighting: Sighting,
    measurement: Measurement,
    sides: tuple[Side, ...],
    number: int,
    settings: FilterSettings,
) -> Track:
    unseen = Track(
        id=entity_id(settings.stream, "visible", number),
        side=nearest_side(sides, sighting.azimuth_rad),
        seen=True,
        existence=settings.sighting_existence,
        motion=_motion_at(sighting, None),
        labels=((sighting.label, sighting.score),),
        moving=sighting.moving,
        sources=("vision",),
        created_ns=measurement.stamp_ns,
        updated_ns=measurement.stamp_ns,
    )
    return replace(_sighted(unseen, sighting, measurement, settings), labels=unseen.labels)


def _motion_at(sighting: Sighting, before: MotionBelief | None) -> MotionBelief:
    """Return a motion that starts at a sighting, with approach rate and range of a belief before it."""
    rate_std, radial_std = _NEW_RATE_STD if sighting.moving else _PARKED_RATE_STD
    mean, std = [sighting.azimuth_rad, 0.0, 0.0, 3.2], [sighting.std_rad, rate_std, radial_std, 0.6]
    if before is not None and sighting.moving:
        mean[2:] = before.mean[RADIAL_RATE:].tolist()
        std[2:] = np.sqrt(np.diag(before.covariance)[RADIAL_RATE : LOG_RANGE + 1]).tolist()
    return MotionBelief.around((mean[0], mean[1], mean[2], mean[3]), (std[0], std[1], std[2], std[3]))
