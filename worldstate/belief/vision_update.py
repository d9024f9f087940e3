"""Update the entities with a look of the co-evidence channel: detections, missed detections, hand-overs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from worldstate.abduction.co_evidence import Absent, CoEvidence, Unqueried
from worldstate.ground.typing import FloatArray
from worldstate.measurement.measurement import Measurement, Sighting

from .association import associated
from .existence import after_empty_look, after_sighting
from .explanation import ExplanationBelief
from .kinematics.cartesian import update_bearing
from .kinematics.motion import MotionBelief, update_azimuth
from .kinematics.polar import LOG_RANGE, RADIAL_RATE
from .settings import FilterSettings
from .site_geometry import SiteGeometry
from .track import Track, entity_id, follow_places, merged, relabelled

# Of (theta_dot rad/s, rho 1/s) at the first sighting: a car at 50 km/h passing at 15 m has .9 rad/s, two
# deviations. A parked one has none, but zero would make the covariance singular.
_NEW_RATE_STD = (0.5, 0.5)
_PARKED_RATE_STD = (1e-3, 1e-3)
# All that tells two sightings apart: one that moves and one parked at the same place are two.
_BY_ALL = attrgetter("azimuth_rad", "label", "score", "std_rad", "width_rad", "moving")
# A detection by a channel said to miss everything would carry no information; its miss rate is capped here.
_MOST_MISSES = 0.99


@dataclass(frozen=True, slots=True)
class VisionUpdate:
    """Result of a look."""

    tracks: tuple[Track, ...]
    explanation: ExplanationBelief
    handed_over: tuple[int, ...]  # Sides of hand-overs
    emerged: tuple[int, ...]  # Sides past whose edge somebody came into view, heard before or not
    born: int  # Entities born in view so far


def log_co_evidence(answer: CoEvidence, directions: int) -> FloatArray:
    """Return log p(V | hidden_1 .. hidden_K, visible, none), shape (K + 2,), nats."""
    hidden, visible, none = answer.log_likelihoods().tolist()
    return np.array([*[hidden] * directions, visible, none])


def vision_update(
    tracks: tuple[Track, ...],
    explanation: ExplanationBelief,
    measurement: Measurement,
    weight: float,
    born: int,
    site: SiteGeometry,
) -> VisionUpdate:
    """Return tracks and explanations after one look; `born` counts the entities born in view so far."""
    # Sorted, so that the state does not depend on the order in which a detector lists its boxes.
    sightings = tuple(sorted(measurement.sightings, key=_BY_ALL))
    found = associated(tracks, sightings, site)
    turned, after = _turned(tracks, sightings, found, site), []
    for i, track in enumerate(tracks):
        if i not in found:
            after.append(_not_sighted(track, _searched(track, measurement), weight, site))
        elif track.seen:
            after.append(_sighted(turned[i], sightings[found[i]], measurement, site))
        else:
            after.append(_handed_over(turned[i], sightings[found[i]], measurement, site))
    handed_over = tuple(tracks[i].side for i in found if not tracks[i].seen)
    for side in handed_over:
        explanation = explanation.emerge(side, site.settings.handover_residual)
    unheard = [sighting for j, sighting in enumerate(sightings) if j not in found.values()]
    fresh = [_born(sighting, measurement, born + n, site) for n, sighting in enumerate(unheard)]
    emerged = emerged_sides(handed_over, fresh, site)
    return VisionUpdate((*after, *fresh), explanation, handed_over, emerged, born + len(fresh))


def emerged_sides(
    handed_over: tuple[int, ...], fresh: Sequence[Track], site: SiteGeometry
) -> tuple[int, ...]:
    """Return the sides past whose edge somebody has just come: hidden before, or first seen there."""
    near = (
        track.side
        for track in fresh
        if track.seen and track.moving
        if site.sides[track.side].distance_rad(track.motion.azimuth_rad) <= 2.0 * site.settings.edge_std_rad
    )
    return tuple(sorted({*handed_over, *near}))


def surviving(tracks: tuple[Track, ...], settings: FilterSettings) -> tuple[Track, ...]:
    """Return the tracks without seen entities of too little existence or too uncertain azimuth."""
    return tuple(
        track
        for track in tracks
        if not track.seen
        or (
            track.existence >= settings.delete_existence
            and track.motion.azimuth_std_rad <= settings.lost_std_rad
        )
    )


def _rates(answer: CoEvidence, settings: FilterSettings) -> tuple[float, float]:
    """Return the miss and clutter rate of a look."""
    if isinstance(answer, Unqueried):
        # Sightings outside the sector asked about: found without a stated miss rate.
        return 0.0, settings.clutter_rate
    return min(answer.miss_rate, _MOST_MISSES), answer.clutter_rate or settings.clutter_rate


def _found(track: Track, measurement: Measurement, settings: FilterSettings, **changes: Any) -> Track:
    """Return an associated track with existence, sources and time stamps updated, and more changes."""
    miss, clutter = _rates(measurement.co_evidence, settings)
    return replace(
        track,
        existence=after_sighting(track.existence, miss, clutter),
        sources=merged(track.sources, "vision"),
        updated_ns=measurement.stamp_ns,
        last_seen_ns=measurement.stamp_ns,
        answer="visible",
        miss_rate=None if isinstance(measurement.co_evidence, Unqueried) else miss,
        **changes,
    )


def _sighted(track: Track, sighting: Sighting, measurement: Measurement, site: SiteGeometry) -> Track:
    labels = relabelled(track.labels, ((sighting.label, sighting.score),))
    return _found(track, measurement, site.settings, labels=labels, moving=sighting.moving)


def _handed_over(track: Track, sighting: Sighting, measurement: Measurement, site: SiteGeometry) -> Track:
    """Return a hidden entity after its hand-over: same id, azimuth and side of the sighting."""
    seen = replace(
        track,
        seen=True,
        side=site.nearest_side(sighting.azimuth_rad),
        existence=max(track.existence, site.settings.sighting_existence),
        labels=((sighting.label, sighting.score),),
    )
    return _found(seen, measurement, site.settings)


def _turned(
    tracks: Sequence[Track], sightings: Sequence[Sighting], found: Mapping[int, int], site: SiteGeometry
) -> dict[int, Track]:
    """Return the found tracks, by their index, with their motion after the bearings of their sightings."""
    turned, usual, placed = {}, [], {}
    for i, j in found.items():
        track, sighting = tracks[i], sightings[j]
        if track.place is not None:
            place = update_bearing(track.place, sighting.azimuth_rad, sighting.std_rad)
            placed[i] = replace(track, place=place)
        elif track.seen and sighting.moving == track.moving:
            usual.append(i)
        else:
            turned[i] = replace(track, motion=_motion_at(sighting, track.motion))
    turned |= zip(placed, follow_places(list(placed.values()), site), strict=True)
    if usual:
        motion = MotionBelief.stacked([tracks[i].motion for i in usual])
        azimuth_rad = np.array([sightings[found[i]].azimuth_rad for i in usual])
        std_rad = np.array([sightings[found[i]].std_rad for i in usual])
        after = update_azimuth(motion, azimuth_rad, std_rad, weight=1.0)
        turned |= {i: replace(tracks[i], motion=one) for i, one in zip(usual, after.each(), strict=True)}
    return turned


def _searched(track: Track, measurement: Measurement) -> CoEvidence:
    """Return the answer that speaks of a track: of the sector of a sound, or of all that the sensor sees.

    Of whoever is in view the look itself: by the miss rate of a sector half outside the image, vehicles that
    have gone stay for up to two seconds.
    """
    if measurement.look is None or (not track.seen and track.place is None):
        return measurement.co_evidence
    return measurement.look.answer


def _not_sighted(track: Track, answer: CoEvidence, weight: float, site: SiteGeometry) -> Track:
    if not track.seen and track.place is None:
        searched = isinstance(answer, Absent)
        miss = answer.miss_rate if isinstance(answer, Absent) else None
        return replace(track, answer="absent" if searched else "unqueried", miss_rate=miss)
    # Absent speaks of one sector; what stands outside the field of view was not looked for.
    if isinstance(answer, Unqueried) or not site.in_view(track.motion.azimuth_rad):
        return replace(track, answer="unqueried", miss_rate=None)
    # Who may still be behind the corner is missed there for certain.
    hidden = 0.0 if track.seen else track.behind
    miss = hidden + (1.0 - hidden) * answer.miss_rate**weight
    existence = after_empty_look(track.existence, miss)
    return replace(track, existence=existence, answer="absent", miss_rate=answer.miss_rate)


def _born(sighting: Sighting, measurement: Measurement, number: int, site: SiteGeometry) -> Track:
    unseen = Track(
        id=entity_id(site.settings.stream, "visible", number),
        side=site.nearest_side(sighting.azimuth_rad),
        seen=True,
        existence=site.settings.sighting_existence,
        motion=_motion_at(sighting, None),
        labels=((sighting.label, sighting.score),),
        moving=sighting.moving,
        sources=("vision",),
        created_ns=measurement.stamp_ns,
        updated_ns=measurement.stamp_ns,
    )
    return _found(unseen, measurement, site.settings)


def _motion_at(sighting: Sighting, before: MotionBelief | None) -> MotionBelief:
    """Return the motion belief at a sighting, with approach rate and range of an earlier belief."""
    rate_std, radial_std = _NEW_RATE_STD if sighting.moving else _PARKED_RATE_STD
    mean, std = [sighting.azimuth_rad, 0.0, 0.0, 3.2], [sighting.std_rad, rate_std, radial_std, 0.6]
    if before is not None and sighting.moving:
        mean[2:] = before.mean[RADIAL_RATE:].tolist()
        std[2:] = np.sqrt(np.diag(before.covariance)[RADIAL_RATE : LOG_RANGE + 1]).tolist()
    return MotionBelief.around((mean[0], mean[1], mean[2], mean[3]), (std[0], std[1], std[2], std[3]))
