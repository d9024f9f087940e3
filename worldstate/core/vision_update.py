"""Update the entities with a look of the co-evidence channel: detections, missed detections, hand-overs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.belief.association import associated
from worldstate.belief.kinematics.cartesian import update_bearing
from worldstate.belief.kinematics.motion import (
    AZIMUTH,
    AZIMUTH_RATE,
    LOG_RANGE,
    RADIAL_RATE,
    MotionBelief,
    update,
)
from worldstate.belief.site_geometry import CLUTTER_RATE, SiteGeometry
from worldstate.belief.track import (
    Track,
    after_empty_look,
    after_sighting,
    born,
    follow_places,
    merged,
    relabelled,
)
from worldstate.ground import FloatArray, seconds
from worldstate.measurement import CameraLook, Look, Measurement, Sector, Sighting

from .birth_death import after_look
from .memory import NEWS_HOLDS_NS, Memory

# Of (theta_dot rad/s, rho 1/s) at the first sighting: a car at 50 km/h passing at 15 m has .9 rad/s, two
# deviations. A parked one has none, but zero would make the covariance singular.
_NEW_RATE_STD = (0.5, 0.5)
_PARKED_RATE_STD = (1e-3, 1e-3)
# All that tells two sightings apart: one that moves and one parked at the same place are two.
_BY_ALL = attrgetter("azimuth_rad", "label", "score", "std_rad", "width_rad", "moving")
# A detection by a channel said to miss everything would carry no information; its miss rate is capped here.
_MOST_MISSES = 0.99
# Of an object before its first sighting is counted: indifferent, that one decides.
_FIRST_EXISTENCE = 0.5
# A crowded street shows some forty; at 600 a step took .3 s.
MOST_BOXES = 64
_OUTSIDE = Unqueried("outside the field of view")


def counting_boxes(measurement: Measurement) -> tuple[Measurement, int]:
    """Return a measurement with the boxes of each image that count, and the number of the others."""
    left_out = sum(max(len(one.sightings) - MOST_BOXES, 0) for one in measurement.looks)
    if not left_out:
        return measurement, 0
    further = tuple(replace(one, sightings=_counting(one.sightings)) for one in measurement.further)
    return replace(measurement, sightings=_counting(measurement.sightings), further=further), left_out


def _counting(sightings: tuple[Sighting, ...]) -> tuple[Sighting, ...]:
    """Return the moving ones and those of the highest score, however a detector lists them."""
    return tuple(sorted(sightings, key=lambda one: (not one.moving, -one.score, _BY_ALL(one)))[:MOST_BOXES])


def log_co_evidence(answer: CoEvidence, directions: int) -> FloatArray:
    """Return log p(V | hidden_1 .. hidden_K, visible, none), shape (K + 2,), nats."""
    hidden, visible, none = answer.log_likelihoods().tolist()
    return np.array([*[hidden] * directions, visible, none])


def vision_update(
    memory: Memory, measurement: Measurement, seen: CameraLook, weight: float, site: SiteGeometry
) -> Memory:
    """Return the memory after one look: detections, missed detections and hand-overs."""
    # Sorted, so that the state does not depend on the order in which a detector lists its boxes.
    sightings, view = tuple(sorted(seen.sightings, key=_BY_ALL)), site.view(seen.look)
    whose, stamp_ns = associated(memory.tracks, sightings, view, site), measurement.stamp_ns
    numbers = range(memory.sighted, memory.sighted + len(whose.new))
    fresh = [born("visible", number, _FIRST_EXISTENCE, stamp_ns, site) for number in numbers]
    tracks, chances = (*memory.tracks, *fresh), (*whose.chances, *[1.0] * len(fresh))
    found = whose.found | dict(enumerate(whose.new, start=len(memory.tracks)))
    turned, rates = _turned(tracks, sightings, found, site), _rates(measurement.co_evidence)
    after, others = list[Track](), _other_views(memory, seen.look)
    for i, (track, chance) in enumerate(zip(tracks, chances, strict=True)):
        answer = _searched(track, measurement, seen.look, view)
        existence = _existence(track, chance, answer, weight, rates)
        if i in found:
            if not track.seen:
                existence = after_sighting(max(track.existence, _FIRST_EXISTENCE), *rates)
            after.append(_found(turned[i], sightings[found[i]], existence, measurement, site))
        elif answer is _OUTSIDE and any(one.touches(track.motion.azimuth_rad) for one in others):
            # Where only other cameras have looked, their answer holds.
            after.append(track)
        else:
            left = _has_left(track, answer, stamp_ns, site)
            after.append(_not_sighted(track, existence, _OUTSIDE if left else answer))
    memory = replace(memory, sighted=memory.sighted + len(fresh))
    return after_look(memory, after, whose, stamp_ns, site)


def _other_views(memory: Memory, look: Look) -> list[Sector]:
    """Return where cameras with a sector of their own looked in the last second."""
    if look.sector_rad is None:
        return []
    recent = (one for one in memory.looks if memory.stamp_ns - one.stamp_ns <= NEWS_HOLDS_NS)
    return [Sector.between(*one.sector_rad) for one in recent if one.sector_rad is not None]


def _rates(answer: CoEvidence) -> tuple[float, float]:
    """Return the miss and clutter rate of a look."""
    if isinstance(answer, Unqueried):
        # Sightings outside the sector asked about: found without a stated miss rate.
        return 0.0, CLUTTER_RATE
    return min(answer.miss_rate, _MOST_MISSES), answer.clutter_rate or CLUTTER_RATE


def _found(
    track: Track, sighting: Sighting, existence: float, measurement: Measurement, site: SiteGeometry
) -> Track:
    """Return a track after a sighting of its own; one that was not seen before takes its side and class."""
    miss, _ = _rates(measurement.co_evidence)
    seen_as = ((sighting.label, sighting.score),)
    return replace(
        track,
        side=track.side if track.seen else site.nearest_side(sighting.azimuth_rad),
        seen=True,
        existence=existence,
        labels=relabelled(track.labels, seen_as) if track.seen else seen_as,
        moving=sighting.moving,
        sources=merged(track.sources, "vision"),
        updated_ns=measurement.stamp_ns,
        last_seen_ns=measurement.stamp_ns,
        answer="visible",
        miss_rate=None if isinstance(measurement.co_evidence, Unqueried) else miss,
        width_rad=sighting.width_rad,
    )


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
        after = update(motion, AZIMUTH, azimuth_rad, std_rad, weight=1.0)
        turned |= {i: replace(tracks[i], motion=one) for i, one in zip(usual, after.each(), strict=True)}
    return turned


def _searched(track: Track, measurement: Measurement, look: Look, view: Sector) -> CoEvidence:
    """Return the answer that speaks of a track: of the sector of a sound, or of all that the sensor sees.

    Of an entity in view the look itself: by the miss rate of a sector half outside the image, vehicles that
    have gone stay for up to two seconds.
    """
    if not track.detected:
        return measurement.co_evidence
    # What stands outside the field of view was not looked for.
    if not view.touches(track.motion.azimuth_rad):
        return _OUTSIDE
    return look.answer


def _has_left(track: Track, answer: CoEvidence, stamp_ns: int, site: SiteGeometry) -> bool:
    r"""Tell whether the likelier reason of a miss is that its leading end has passed the edge ahead of it.

    .. math:: p \ge (1 - p)\, \beta^{\min(t / T, 1)}

    with the chance p of that, the time t since its last box and the interval T of looks. Boxes end as soon as
    a vehicle is partly hidden: stated in view until its existence has fallen, it would be for half a second.
    """
    if not (track.seen and track.moving) or isinstance(answer, Unqueried):
        return False
    way = math.copysign(1.0, track.motion.mean[AZIMUTH_RATE])
    end_rad = track.motion.azimuth_rad + 0.5 * way * track.width_rad
    past = site.past_edge(end_rad, track.motion.azimuth_std_rad, way)
    unseen_s = seconds(stamp_ns - (track.last_seen_ns or 0))
    missed = math.pow(answer.miss_rate, min(unseen_s / site.settings.look_interval_s, 1.0))
    return past >= (1.0 - past) * missed


def _existence(
    track: Track, chance: float, answer: CoEvidence, weight: float, rates: tuple[float, float]
) -> float:
    r"""Return the existence after a look, with the chance p that one of its sightings is of the track.

    .. math:: r \leftarrow p\, r_+ + (1 - p)\, r_-
    """
    missed = track.existence
    if not track.detected:
        return missed
    if not isinstance(answer, Unqueried):
        # An entity that may still be behind the corner is missed there for certain.
        hidden = 0.0 if track.seen else track.behind
        missed = after_empty_look(missed, hidden + (1.0 - hidden) * answer.miss_rate**weight)
    return missed + chance * (after_sighting(track.existence, *rates) - missed)


def _not_sighted(track: Track, existence: float, answer: CoEvidence) -> Track:
    # Present speaks of any entity in view.
    if isinstance(answer, Absent) or (track.detected and isinstance(answer, Present)):
        return replace(track, existence=existence, answer="absent", miss_rate=answer.miss_rate)
    return replace(track, existence=existence, answer="unqueried", miss_rate=None)


def _motion_at(sighting: Sighting, before: MotionBelief) -> MotionBelief:
    """Return the motion belief at a sighting, with approach rate and range of an earlier belief."""
    rate_std, radial_std = _NEW_RATE_STD if sighting.moving else _PARKED_RATE_STD
    mean, std = [sighting.azimuth_rad, 0.0, 0.0, 3.2], [sighting.std_rad, rate_std, radial_std, 0.6]
    if sighting.moving:
        mean[2:] = before.mean[RADIAL_RATE:].tolist()
        std[2:] = np.sqrt(np.diag(before.covariance)[RADIAL_RATE : LOG_RANGE + 1]).tolist()
    return MotionBelief.around((mean[0], mean[1], mean[2], mean[3]), (std[0], std[1], std[2], std[3]))
