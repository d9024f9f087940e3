"""Update by detections: the looks that count, and the entities that they find, miss or announce."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.belief.association import LEAST_EXISTENCE, MOST_EXISTENCE, Association, associated, leaving
from worldstate.belief.detection import Detection, Scan, camera_scan, fused, position_scan
from worldstate.belief.hidden_bearing import announced
from worldstate.belief.kinematics.cartesian import (
    CartesianBelief,
    at_position,
    update_bearing,
    update_position,
)
from worldstate.belief.kinematics.motion import AZIMUTH, LOG_RANGE, RADIAL_RATE, MotionBelief, update
from worldstate.belief.settings import FilterSettings
from worldstate.belief.site_geometry import SiteGeometry, normal_share
from worldstate.belief.track import (
    Track,
    TrackArrays,
    after_empty_look,
    after_sighting,
    born,
    follow_places,
    merged,
    relabelled,
)
from worldstate.ground import FloatArray, nanoseconds, seconds, wrap_angle
from worldstate.measurement import CameraLook, Measurement, PositionScan, Sector

from .birth_death import REOCCLUSION_NS, after_look
from .cues import NO_LOOK, claimed_nats, update_rule
from .fixed_lag import LAG_NS
from .memory import FORGOTTEN_NS, NEWS_HOLDS_NS, CountedLook, Memory, SourceRule
from .sequence_memory import SequenceMemory, alerted
from .site_model import FilterModel

# Of (theta_dot rad/s, rho 1/s) at the first box: a car at 50 km/h passing at 15 m has .9 rad/s, two
# deviations. A parked one has none, but zero would make the covariance singular.
_NEW_RATE_STD = (0.5, 0.5)
_PARKED_RATE_STD = (1e-3, 1e-3)
_ROUNDING = 1e-12  # Odds of certainty have no quotient
_Found = Mapping[int, Detection]  # By the index of the track


def new_looks(
    memory: Memory, measurement: Measurement, start_ns: int, settings: FilterSettings
) -> tuple[Measurement, list[tuple[CameraLook, float]]]:
    r"""Note the looks of a measurement; return it, and the new ones, weighed.

    .. math:: \kappa = \min(dt / T, 1), \quad T = look interval

    by the time since the last look of the sensor. A look belongs to the sensor that looked. Carried by a
    second source, or delivered again, it says nothing new; the source that carried it first keeps its answer,
    since each of its windows is weighed anew.
    """
    new = []
    for one in measurement.looks:
        look, last = one.look, memory.looks.get(one.look.sensor)
        # One stray stamp must not hide the looks after it, nor an image of long ago be new for ever.
        in_time = -FORGOTTEN_NS < look.stamp_ns - measurement.stamp_ns <= LAG_NS
        if in_time and (last is None or look.stamp_ns > last.stamp_ns):
            since_s = seconds(look.stamp_ns - (start_ns if last is None else last.stamp_ns))
            new.append((one, min(max(since_s, 0.0) / settings.look_interval_s, 1.0)))
            memory.looks[look.sensor] = CountedLook(
                look.stamp_ns, measurement.source, look.answer, look.sector_rad
            )
        elif not in_time or (last is not None and last.source != measurement.source):
            when = "was counted before" if in_time else "is of another time"
            said = Unqueried(f"this look of {look.sensor} {when}")
            measurement = replace(measurement, co_evidence=said)
    return measurement, new


def update_looks(
    memory: Memory, measurement: Measurement, looks: Sequence[tuple[CameraLook, float]], model: FilterModel
) -> None:
    """Update the memory with the new looks of a measurement, all cameras at once."""
    if looks:
        scans = [camera_scan(seen, model.site.view(seen.look), weight) for seen, weight in looks]
        detection_update(memory, scans, measurement.co_evidence, measurement.stamp_ns, model.site)


def update_positions(memory: Memory, scan: PositionScan, model: FilterModel) -> None:
    """Update the memory with the positions of a radar or a radio: entities, and announced hidden ones."""
    settings, last = model.site.settings, memory.looks.get(scan.source)
    elapsed_s = math.inf if last is None else seconds(scan.stamp_ns - last.stamp_ns)
    weight = min(elapsed_s / settings.look_interval_s, 1.0)
    detection_update(memory, [position_scan(scan, weight)], None, scan.stamp_ns, model.site)
    memory.looks[scan.source] = _scan_look(scan)
    if isinstance(memory.belief, SequenceMemory):
        memory.belief = alerted(memory.belief, model.context)
    chances = announced(memory.tracks, model.site)
    if not any(chances):
        # An entity that has come into view, or is gone, ends the rule of the source that announced it.
        memory.rules.pop(scan.source, None)
    elif scan.searched is None:
        said = SignatureEvidence(model.context.directions, tuple(map(claimed_nats, chances)), 0.0, 0.0)
        sides = tuple(k for k, chance in enumerate(chances) if chance > 0.5)
        rule = SourceRule(scan.stamp_ns, announced=sides)
        update_rule(memory, scan.source, rule, said, NO_LOOK, model)


def _scan_look(scan: PositionScan) -> CountedLook:
    """Return a scan as a look at its sector, or at none where it is of messages."""
    searched = scan.searched
    if searched is None:
        return CountedLook(scan.stamp_ns, scan.source)
    miss, half_rad = 1.0 - searched.detection_probability, searched.sector.half_width_rad
    answer = (Present if scan.positions else Absent)(miss, searched.clutter_rate)
    ends_rad = (searched.sector.centre_rad - half_rad, searched.sector.centre_rad + half_rad)
    return CountedLook(scan.stamp_ns, scan.source, answer, ends_rad)


def detection_update(
    memory: Memory, scans: Sequence[Scan], asked: CoEvidence | None, stamp_ns: int, site: SiteGeometry
) -> None:
    """Update the memory with all looks of an instant, whose order carries no meaning.

    `asked` is what cameras answer of the sector of a sound; None of positions.
    """
    known, (detections, by_look) = memory.tracks, fused(scans)
    arrays = TrackArrays.of(known)
    whose = associated(known, arrays, detections, site)
    fresh = _born(memory, [detections[j] for j in whose.new], scans[0], stamp_ns, site)
    memory.tracks = tracks = (*known, *fresh)
    if fresh:
        arrays = TrackArrays.of(tracks)
    rows = whose.found | dict(enumerate(whose.new, start=len(known)))
    found = {i: detections[j] for i, j in rows.items()}
    if scans[0].sector is None:
        existence = [_told(one, found.get(i), scans[0]) for i, one in enumerate(tracks)]
    else:
        existence = _existence(arrays, found, _hits(arrays, rows, whose, by_look), scans)
    chances = whose.chances + [1.0] * len(fresh)
    _move(tracks, arrays.motion, found)
    for i, one in found.items():
        _see(tracks[i], one, chances[i], scans, stamp_ns, site)
    if len(found) < len(tracks):
        views, past = _other_views(memory, scans), leaving(arrays, site).tolist()
        for i in set(range(len(tracks))).difference(found):
            _miss(tracks[i], past[i], scans, asked, views, stamp_ns, site)
    for track, chance in zip(tracks, existence, strict=True):
        track.existence = chance
    if scans[0].sector is None:
        for i in found:
            _announce(tracks[i], site)
    follow_places(tracks, site)
    emerged = {i: chances[i] for i in whose.found if not arrays.seen[i] and tracks[i].seen}
    after_look(memory, emerged, fresh, stamp_ns, site)


def _born(
    memory: Memory, new: Sequence[Detection], scan: Scan, stamp_ns: int, site: SiteGeometry
) -> list[Track]:
    """Return new entities before their detections count; hidden where messages say so."""
    fresh = list[Track]()
    for one in new:
        side = site.hiding_side(one.azimuth_rad) if one.found is None else None
        existence = min(one.existence, MOST_EXISTENCE)
        if side is None:
            track = born("visible", memory.counts.sighted, existence, stamp_ns, site)
            track.side = site.nearest_side(one.azimuth_rad)
            memory.counts.sighted += 1
        else:
            track = born(site.sides[side].label, memory.history[side].births, existence, stamp_ns, site)
            track.side, track.came_from = side, 1.0
            memory.history[side].births += 1
        track.sources = (scan.source,)
        fresh.append(track)
    return fresh


def _hits(
    arrays: TrackArrays, rows: Mapping[int, int], whose: Association, by_look: FloatArray
) -> FloatArray:
    """Return P(a look has detected a track), certain of a first detection, shape (tracks, looks)."""
    hits = np.zeros((len(arrays.seen), by_look.shape[1]))
    hits[: whose.pairs.shape[1]] = np.minimum(whose.pairs.T @ by_look, 1.0)
    for i in np.flatnonzero(~arrays.seen).tolist():
        if i in rows:
            hits[i] = by_look[rows[i]]
    return hits


def _existence(arrays: TrackArrays, found: _Found, hits: FloatArray, scans: Sequence[Scan]) -> list[float]:
    r"""Return the existence after every look s of an instant, each with the chance c that it has detected it.

    .. math:: r_s = c_s\, r_+ + (1 - c_s)\, \frac{r (1 - p_s)}{1 - r p_s}, \qquad
              p_s = p_D\, P_{range}\, (1 - P_{hidden}), \qquad
              \frac{r'}{1 - r'} = \frac{r}{1 - r} \prod_s \frac{r_s}{1 - r_s} \frac{1 - r}{r}
    """
    seen, counts, before = arrays.seen, arrays.detected.copy(), arrays.existence.copy()
    for i in (i for i in np.flatnonzero(~seen).tolist() if i in found):
        counts[i], before[i] = True, max(before[i], found[i].existence)
    r = np.minimum(np.maximum(before, _ROUNDING), 1.0 - _ROUNDING)
    in_sight = np.where(seen, 1.0, 1.0 - arrays.behind)
    odds = ratio = _odds(r)
    for hit, scan in zip(hits.T, scans, strict=True):
        detected = _searched(arrays.motion, scan) * in_sight * (1.0 - (scan.miss_rate or 0.0) ** scan.weight)
        missed = after_empty_look(r, 1.0 - detected)
        missed = np.where(seen, missed, np.maximum(missed, LEAST_EXISTENCE))
        now = missed + hit * (after_sighting(r, scan.miss_rate or 0.0, scan.clutter_rate) - missed)
        ratio = ratio * _odds(now) / odds
    existence: list[float] = np.where(counts, ratio / (1.0 + ratio), before).tolist()
    return existence


def _odds(probabilities: FloatArray) -> FloatArray:
    bounded = np.minimum(np.maximum(probabilities, _ROUNDING), 1.0 - _ROUNDING)
    return np.asarray(bounded / (1.0 - bounded))


def _searched(motion: MotionBelief, scan: Scan) -> FloatArray:
    """Return P(a look covers it) of every track, by the range of the sensor in its sector."""
    if scan.sector is None or scan.miss_rate is None:
        return np.zeros(len(motion.mean))
    from_centre_rad = np.abs(wrap_angle(motion.mean[:, AZIMUTH] - scan.sector.centre_rad))
    covers = from_centre_rad <= scan.sector.half_width_rad
    if math.isinf(scan.range_m):
        return covers.astype(float)
    stds = np.sqrt(motion.covariance[:, LOG_RANGE, LOG_RANGE])
    deviations = (math.log(scan.range_m) - motion.mean[:, LOG_RANGE]) / stds
    return np.where(covers, [normal_share(one) for one in deviations.tolist()], 0.0)


def _told(track: Track, told: Detection | None, scan: Scan) -> float:
    """Return the existence after messages."""
    # A sender that lies in one message lies in the next: what a source repeats counts once.
    if told is None or scan.source in track.sources:
        return track.existence
    odds = told.existence / (1.0 - told.existence)
    before = min(track.existence, MOST_EXISTENCE)
    return min(before * odds / (before * odds + 1.0 - before), MOST_EXISTENCE)


def _move(tracks: Sequence[Track], motion: MotionBelief, found: _Found) -> None:
    """Update the motion or the place of the found tracks with what was measured of them."""
    usual = list[int]()
    for i, one in found.items():
        track = tracks[i]
        if one.position is not None or track.place is not None:
            track.place = _placed(track, one)
        elif track.seen and one.moving == track.moving:
            usual.append(i)
        else:
            track.motion = _motion_at(one, track.motion)
    if usual:
        azimuth_rad, std_rad = np.array([(found[i].azimuth_rad, found[i].std_rad) for i in usual]).T
        before = MotionBelief(motion.mean[usual], motion.covariance[usual])
        after = update(before, AZIMUTH, azimuth_rad, std_rad).each()
        for i, moved in zip(usual, after, strict=True):
            tracks[i].motion = moved


def _placed(track: Track, found: Detection) -> CartesianBelief:
    position, place = found.position, track.place
    if position is None:
        assert place is not None
        return update_bearing(place, found.azimuth_rad, found.std_rad)
    if place is not None:
        return update_position(place, position)
    place = at_position(position)
    if not track.seen:
        return place
    return update_bearing(place, track.motion.azimuth_rad, track.motion.azimuth_std_rad)


def _motion_at(box: Detection, before: MotionBelief) -> MotionBelief:
    """Return the motion belief at a box, with approach rate and range of an earlier belief."""
    rate_std, radial_std = _NEW_RATE_STD if box.moving else _PARKED_RATE_STD
    mean, std = [box.azimuth_rad, 0.0, 0.0, 3.2], [box.std_rad, rate_std, radial_std, 0.6]
    if box.moving:
        mean[2:] = before.mean[RADIAL_RATE:].tolist()
        std[2:] = np.sqrt(np.diag(before.covariance)[RADIAL_RATE : LOG_RANGE + 1]).tolist()
    return MotionBelief.around((mean[0], mean[1], mean[2], mean[3]), (std[0], std[1], std[2], std[3]))


def _see(
    track: Track, found: Detection, chance: float, scans: Sequence[Scan], stamp_ns: int, site: SiteGeometry
) -> None:
    """Update a track with its detection; one not in view before takes its side and class there."""
    track.updated_ns, track.sources = stamp_ns, merged(track.sources, scans[0].source)
    if found.classes:
        track.labels = relabelled(track.labels, found.classes) if track.seen else found.classes
    if found.moving is not None:
        track.moving = found.moving
    if found.width_rad is None:
        track.approach_heard = True  # By the velocity of its position
    else:
        track.width_rad = found.width_rad
    if found.found is None:
        return
    if not track.seen:
        track.seen, track.side = True, site.nearest_side(found.azimuth_rad)
        track.came_from *= chance
    track.last_seen_ns, track.answer = stamp_ns, "visible"
    track.miss_rate = _miss_rate(scans, found.azimuth_rad)


def _miss_rate(scans: Sequence[Scan], azimuth_rad: float) -> float | None:
    """Return P(all looks miss what is in view there), None where none has searched."""
    rates = [one.miss_rate or 0.0 for one in scans if one.searches(azimuth_rad)]
    return math.prod(rates) if rates else None


def _announce(track: Track, site: SiteGeometry) -> None:
    """Put a track that a message has placed on the side whose occluder hides it there, if one does."""
    assert track.place is not None
    x, y = track.place.mean[:2].tolist()
    side = site.hiding_side(math.atan2(y, x))
    if side is not None and (not track.seen or track.unseen_ns(track.updated_ns) > REOCCLUSION_NS):
        track.side, track.seen, track.came_from = side, False, 1.0


def _miss(
    track: Track,
    past: float,
    scans: Sequence[Scan],
    asked: CoEvidence | None,
    views: Sequence[Sector],
    stamp_ns: int,
    site: SiteGeometry,
) -> None:
    """Update the last answer about a track that none of the looks of an instant has found."""
    if track.detected:
        miss_rate = _miss_rate(scans, track.motion.azimuth_rad)
        # Where only other cameras have looked, or a radar elsewhere, the last answer holds.
        holds = asked is None or any(one.touches(track.motion.azimuth_rad) for one in views)
        if miss_rate is not None and asked is not None and _has_left(track, past, miss_rate, stamp_ns, site):
            miss_rate, holds = None, False
    else:
        # What is only heard was asked of in the sector of its sound.
        miss_rate, holds = asked.miss_rate if isinstance(asked, Absent) else None, asked is None
    if miss_rate is not None:
        track.answer, track.miss_rate = "absent", miss_rate
    elif not holds:
        track.answer, track.miss_rate = "unqueried", None


def _other_views(memory: Memory, scans: Sequence[Scan]) -> list[Sector]:
    """Return where cameras with a sector of their own looked in the last second."""
    if not any(one.names_sector for one in scans):
        return []
    recent = (one for one in memory.looks.values() if memory.stamp_ns - one.stamp_ns <= NEWS_HOLDS_NS)
    asked = (one for one in recent if not isinstance(one.answer, Unqueried))
    return [Sector.between(*one.sector_rad) for one in asked if one.sector_rad is not None]


def _has_left(track: Track, past: float, miss_rate: float, stamp_ns: int, site: SiteGeometry) -> bool:
    r"""Tell whether the likelier reason of a miss is that its leading end has passed the edge ahead of it.

    .. math:: p \ge (1 - p)\, \beta^{\min(t / T, 1)}

    with the chance p of that, the time t since its last box and the interval T of looks. Boxes end as soon as
    a vehicle is partly hidden: stated in view until its existence has fallen, it would be for half a second.
    """
    unseen = track.unseen_ns(stamp_ns) / nanoseconds(site.settings.look_interval_s)
    missed = math.pow(miss_rate, min(unseen, 1.0))
    return 0.0 < past >= (1.0 - past) * missed
