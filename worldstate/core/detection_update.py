"""Update with detections: select new looks, then update the found, missed and announced entities."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.belief.association import associated
from worldstate.belief.detection import Detections, Scan, camera_scan, fused, miss_rates, position_scan
from worldstate.belief.kinematics.cartesian import (
    CartesianBelief,
    full_measurement,
    update_bearing,
    update_position,
)
from worldstate.belief.kinematics.motion import (
    AZIMUTH,
    LEAST_STD,
    LOG_RANGE,
    RADIAL_RATE,
    MotionBelief,
    update,
)
from worldstate.belief.site_geometry import SiteGeometry, normal_shares
from worldstate.belief.street_model import StreetModel
from worldstate.belief.track import (
    Track,
    Tracks,
    after_empty_look,
    born,
    follow_places,
    merged,
    occlude,
    occluded,
    relabelled,
)
from worldstate.ground import TINY, FloatArray, replaced, seconds, wrap_angle
from worldstate.ground.typing import IndexArray
from worldstate.measurement import CameraLook, Measurement, PositionScan, Sector

from .birth_death import HIDDEN, after_look, born_hidden
from .fixed_lag import LAG_NS
from .memory import FORGOTTEN_NS, NEWS_HOLDS_NS, CountedLook, Memory
from .site_model import FilterModel
from .street_belief import alerted

# Deviation of (theta_dot rad/s, rho 1/s) at the first box. A car at 50 km/h and a distance of 15 m has 0.9
# rad/s, which is two deviations; a parked car has no motion.
_NEW_RATE_STD, _PARKED_RATE_STD = 0.5, LEAST_STD


def new_looks(
    memory: Memory, measurement: Measurement, start_ns: int, street: StreetModel
) -> tuple[Measurement, list[tuple[CameraLook, float]]]:
    r"""Record the looks of a measurement; return the measurement, and the new looks with their weights.

    .. math:: \kappa = \min(dt / T, 1), \quad T = look interval

    with the time dt since the last look of the sensor. A look belongs to its sensor: repeated delivery, also
    by a second source, adds nothing. The first source to deliver it keeps the answer, because each of its
    windows has its own weight.
    """
    new = []
    for one in measurement.looks:
        look, last = one.look, memory.looks.get(one.look.sensor)
        # A stray future stamp must not block the looks after it, and a very old image must not stay new.
        in_time = -FORGOTTEN_NS < look.stamp_ns - measurement.stamp_ns <= LAG_NS
        if in_time and (last is None or look.stamp_ns > last.stamp_ns):
            since_s = seconds(look.stamp_ns - (start_ns if last is None else last.stamp_ns))
            new.append((one, min(max(since_s, 0.0) / street.look_s, 1.0)))
            said = look.answer, look.sector_rad, look.fault
            memory.looks[look.sensor] = CountedLook(look.stamp_ns, measurement.source, *said)
        elif not in_time or (last is not None and last.source != measurement.source):
            when = "was counted before" if in_time else "is of another time"
            unasked = Unqueried(f"this look of {look.sensor} {when}")
            measurement = replaced(measurement, co_evidence=unasked)
    return measurement, new


def update_looks(
    memory: Memory, measurement: Measurement, looks: Sequence[tuple[CameraLook, float]], model: FilterModel
) -> None:
    """Update the memory with the new looks of a measurement, all cameras together."""
    asked, tracks = measurement.co_evidence, memory.tracks
    unasked = [isinstance(seen.look.answer, Unqueried) and not seen.sightings for seen, _ in looks]
    if looks and all(unasked) and isinstance(asked, Unqueried) and True not in tracks.detected:
        # No sensor has looked, and no track could be found by a look: only the answer changes.
        tracks.answer[:], tracks.miss_rate[:] = "unqueried", math.nan
    elif looks:
        site = model.site
        scans = [camera_scan(seen, site.view(seen.look), weight, site.street) for seen, weight in looks]
        detection_update(memory, scans, asked, measurement.stamp_ns, site)


def update_positions(memory: Memory, scan: PositionScan, model: FilterModel) -> None:
    """Update the memory with the positions from a radar or from messages."""
    street, last, before = model.site.street, memory.looks.get(scan.source), memory.belief
    elapsed_s = math.inf if last is None else seconds(scan.stamp_ns - last.stamp_ns)
    scans = [position_scan(scan, min(elapsed_s / street.look_s, 1.0), street)]
    detection_update(memory, scans, None, scan.stamp_ns, model.site)
    memory.looks[scan.source] = _scan_look(scan)
    if memory.belief is not before:  # Time alone raises no alarm
        memory.belief = alerted(memory.belief, model.policy, street)


def _scan_look(scan: PositionScan) -> CountedLook:
    """Return a scan as a look at its sector; messages have no sector."""
    searched = scan.searched
    if searched is None:
        return CountedLook(scan.stamp_ns, scan.source)
    miss, half_rad = 1.0 - searched.detection_probability, searched.sector.half_width_rad
    answer = (Present if scan.positions else Absent)(miss, searched.clutter_rate)
    centre_rad = searched.sector.centre_rad if half_rad < math.pi else 0.0  # A full turn has no ends
    right_rad, left_rad = (math.remainder(centre_rad + way * half_rad, math.tau) for way in (-1.0, 1.0))
    return CountedLook(scan.stamp_ns, scan.source, answer, (right_rad, left_rad))


def detection_update(
    memory: Memory, scans: Sequence[Scan], asked: CoEvidence | None, stamp_ns: int, site: SiteGeometry
) -> None:
    """Update the memory with all looks of an instant; their order has no effect.

    `asked` is the cameras' answer for the sector of the sound; it is None for positions.
    """
    known, (detections, by_look) = memory.tracks, fused(scans)
    in_sight, n = detections.in_sight, len(known)
    if in_sight:
        detections = detections.seen_through(site)
    whose = associated(known, detections, site)
    if in_sight:
        # The likelier a detection belongs to a known entity, the less likely it is a new one.
        detections = replaced(detections, existence=detections.existence * whose.unclaimed)
    born = [_born(memory, detections, j, scans[0], stamp_ns, site) for j in whose.new]
    memory.tracks = tracks = known.joined(born)
    chances, detection = np.append(whose.chances, np.ones(len(whose.new))), np.full(len(tracks), -1)
    detection[list(whose.found)], detection[n:] = list(whose.found.values()), whose.new
    rows, missed, was_seen = (detection >= 0).nonzero()[0], (detection < 0).nonzero()[0], tracks.seen.copy()
    found = _Found(rows, detection[rows], chances[rows], detections)
    if in_sight:
        hits, existence = np.minimum(whose.pairs.T @ by_look, 1.0), tracks.existence.copy()
        existence[:n], detected = _existence(known, hits, scans, site.street)
        tracks.behind[:n] = _hidden(known, detected, chances[:n], bool(detections.positions), site.street)
        # The detection is either the sound-only entity or another vehicle.
        first = ((detection[:n] >= 0) & ~known.detected).nonzero()[0]
        another = (1.0 - chances[first]) * detections.existence[detection[first]]
        existence[first], tracks.behind[first] = chances[first] + another, 0.0
    else:
        existence = _told(tracks, found, scans[0].source, 1.0 - site.street.doubt)
    _move(tracks, found, site.street)
    _see(tracks, found, scans, stamp_ns, site)
    follow_places(tracks, site)
    if not in_sight:
        occlude(tracks, site)
    if len(missed):
        _miss(memory, missed, scans, asked)
    tracks.existence = existence
    _hide(tracks, site)
    emerged = {i: float(chances[i]) for i in whose.found if tracks.seen[i] and not was_seen[i]}
    after_look(memory, emerged, n, stamp_ns, site)


class _Found(NamedTuple):
    """Rows of the found entities, their detections, and the probability of each match."""

    rows: IndexArray
    by: IndexArray
    chances: FloatArray
    detections: Detections


def _born(
    memory: Memory, detections: Detections, by: int, scan: Scan, stamp_ns: int, site: SiteGeometry
) -> Track:
    """Return a new entity before its detection is applied; hidden if a message places it out of sight."""
    azimuth_rad = float(detections.azimuth_rad[by])
    side = None if detections.in_sight else site.hiding_side(detections.positions[by].position_m)
    existence = min(float(detections.existence[by]), 1.0 - site.street.doubt)
    if side is None:
        track = born("visible", memory.counts.sighted, existence, stamp_ns, site)
        memory.counts.sighted += 1
        return replaced(track, side=site.nearest_side(azimuth_rad), sources=(scan.source,), behind=0.0)
    return born_hidden(memory, side, existence, stamp_ns, scan.source, site)


def _existence(
    tracks: Tracks, hits: FloatArray, scans: Sequence[Scan], street: StreetModel
) -> tuple[FloatArray, FloatArray]:
    r"""Return the existence after all looks s of an instant, and P(a look detects it | in line of sight).

    With the chance c that a look has detected the entity,

    .. math:: r_s = c_s + (1 - c_s)\, \frac{r (1 - p_s)}{1 - r p_s}, \qquad
              p_s = p_D\, P_{range}\, (1 - P_{hidden}), \qquad
              \frac{r'}{1 - r'} = \frac{r}{1 - r} \prod_s \frac{r_s}{1 - r_s} \frac{1 - r}{r}

    A sound-only entity keeps its existence, which follows from the belief over the sides.
    """
    r = np.minimum(np.maximum(tracks.existence, TINY), 1.0 - TINY)
    detected = np.zeros(len(r))
    odds = ratio = r / (1.0 - r)
    for hit, scan in zip(hits.T, scans, strict=True):
        by_one = _searched(tracks, scan) * (1.0 - (scan.miss_rate or 0.0) ** scan.weight)
        detected = 1.0 - (1.0 - detected) * (1.0 - by_one)
        missed = after_empty_look(r, 1.0 - by_one * (1.0 - tracks.behind))
        missed = np.where(tracks.seen, missed, np.maximum(missed, street.doubt))
        now = np.minimum(np.maximum(hit + (1.0 - hit) * missed, TINY), 1.0 - TINY)
        ratio = ratio * (now / (1.0 - now)) / odds
    return np.where(tracks.detected, ratio / (1.0 + ratio), tracks.existence), detected


def _hidden(
    tracks: Tracks, detected: FloatArray, chances: FloatArray, by_radar: bool, street: StreetModel
) -> FloatArray:
    r"""Return P(hidden | exists) after the looks of an instant, with the chance c that they detected it.

    .. math:: P = c\, \frac{b q}{b q + 1 - b} + (1 - c)\, \frac{b}{b + (1 - b)(1 - p)}

    with the earlier P(hidden) b and p = P(detected | in line of sight). A hidden entity is detected q times
    as often: a radar also finds some by multipath and diffraction.
    """
    b, q = tracks.behind, street.hidden_return if by_radar else 0.0
    found = b * q / np.maximum(b * q + 1.0 - b, TINY)
    missed = b / np.maximum(b + (1.0 - b) * (1.0 - detected), TINY)
    return np.where(tracks.detected, chances * found + (1.0 - chances) * missed, b)


def _searched(tracks: Tracks, scan: Scan) -> FloatArray:
    """Return P(a look covers a track) for every track, from the sector and the range of the sensor."""
    if scan.sector is None or scan.miss_rate is None:
        return np.zeros(len(tracks))
    from_centre_rad = np.abs(wrap_angle(tracks.mean[:, AZIMUTH] - scan.sector.centre_rad))
    covers = from_centre_rad <= scan.sector.half_width_rad
    if math.isinf(scan.range_m):
        return covers.astype(float)
    stds = np.sqrt(tracks.covariance[:, LOG_RANGE, LOG_RANGE])
    deviations = (math.log(scan.range_m) - tracks.mean[:, LOG_RANGE]) / stds
    return np.where(covers, normal_shares(deviations), 0.0)


def _told(tracks: Tracks, found: _Found, source: str, most: float) -> FloatArray:
    # Messages of one sender are fully dependent: only the first one updates existence.
    news = np.array([source not in tracks.sources[i] for i in found.rows.tolist()], bool)
    rows, told = found.rows[news], found.detections.existence[found.by[news]]
    odds, before = told / (1.0 - told), np.minimum(tracks.existence[rows], most)
    after = tracks.existence.copy()
    after[rows] = np.minimum(before * odds / (before * odds + 1.0 - before), most)
    return after


def _move(tracks: Tracks, found: _Found, street: StreetModel) -> None:
    rows, by, chances, detections = found
    placed = tracks.placed[rows] | bool(detections.positions)
    usual = ~placed & tracks.seen[rows] & (detections.moving[by] == tracks.moving[rows])
    for i, j, has_place in zip(*(column[~usual].tolist() for column in (rows, by, placed)), strict=True):
        tracks.put(i, (_placed if has_place else _motion_at)(tracks, i, detections, j, street))
    if usual.any():
        rows, by, chances = rows[usual], by[usual], chances[usual]
        before = MotionBelief(tracks.mean[rows], tracks.covariance[rows])
        after = update(before, AZIMUTH, detections.azimuth_rad[by], detections.std_rad[by], chances)
        tracks.mean[rows], tracks.covariance[rows] = after.mean, after.covariance


def _placed(
    tracks: Tracks, row: int, detections: Detections, by: int, street: StreetModel
) -> CartesianBelief:
    """Return the position of a track after a measured position, or after a bearing if it had a position."""
    place = tracks.place(row)
    if place is None:
        place = CartesianBelief(*full_measurement(detections.positions[by], street.speed_mps))
        own = tracks.mean[row, AZIMUTH], tracks.azimuth_std_rad[row]
        return update_bearing(place, *own) if tracks.seen[row] else place
    if detections.positions:
        return update_position(place, detections.positions[by])
    return update_bearing(place, float(detections.azimuth_rad[by]), float(detections.std_rad[by]))


def _motion_at(tracks: Tracks, row: int, boxes: Detections, by: int, street: StreetModel) -> MotionBelief:
    """Return the motion belief at a box; a moving one keeps its earlier approach rate and range."""
    moving = boxes.moving[by] > 0.0
    rate_std = _NEW_RATE_STD if moving else _PARKED_RATE_STD
    expected = [boxes.azimuth_rad[by], 0.0, 0.0, math.log(street.range_m)]
    std = [boxes.std_rad[by], rate_std, rate_std, street.range_spread]
    if moving:
        expected[2:] = tracks.mean[row, RADIAL_RATE:].tolist()
        std[2:] = np.sqrt(tracks.covariance[row].diagonal()[RADIAL_RATE:]).tolist()
    return MotionBelief.around(expected, std)


def _see(tracks: Tracks, found: _Found, scans: Sequence[Scan], stamp_ns: int, site: SiteGeometry) -> None:
    """Update the found tracks; those that were not in view take side and class from the detection."""
    rows, by, chances, detections = found
    azimuth_rad, moving = detections.azimuth_rad[by], detections.moving[by]
    gains = site.street.label_gain, site.street.doubt
    columns = rows, by, chances, tracks.seen[rows], azimuth_rad
    for i, j, chance, was_seen, at_rad in zip(*(one.tolist() for one in columns), strict=True):
        tracks.sources[i] = merged(tracks.sources[i], scans[0].source)
        if classes := detections.classes[j]:
            tracks.labels[i] = relabelled(tracks.labels[i], classes, *gains) if was_seen else classes
        if detections.in_sight and not was_seen:
            tracks.side[i] = site.nearest_side(at_rad)
            tracks.came_from[i] *= chance
    tracks.updated_ns[rows] = stamp_ns
    tracks.moving[rows] = np.where(np.isnan(moving), tracks.moving[rows], moving > 0.0)
    if detections.positions:
        tracks.approach_heard[rows] = True  # The velocity of its position gives an approach rate
    else:
        tracks.width_rad[rows] = detections.width_rad[by]
    if detections.in_sight:
        tracks.seen[rows], tracks.last_seen_ns[rows], tracks.answer[rows] = True, stamp_ns, "visible"
        tracks.miss_rate[rows] = miss_rates(scans, azimuth_rad)


def _hide(tracks: Tracks, site: SiteGeometry) -> None:
    """Assign tracks behind a corner to the corner's side; those with a position are no longer in view."""
    rows = (tracks.detected & (tracks.behind >= HIDDEN)).nonzero()[0]
    if len(rows):
        chances = occluded(tracks, site)[rows]
        by = chances.argmax(axis=1)
        # If no occluder covers a track any more, it keeps its side.
        covered = (by < len(site.sides)) & chances.any(axis=1)
        rows, by = rows[covered], by[covered]
        tracks.side[rows], tracks.came_from[rows] = by, 1.0
        tracks.seen[rows] &= ~tracks.placed[rows]


def _miss(memory: Memory, rows: IndexArray, scans: Sequence[Scan], asked: CoEvidence | None) -> None:
    """Update the last answer about the tracks that no look of an instant has found."""
    tracks, views = memory.tracks, _other_views(memory, scans)
    azimuth_rad, detected = tracks.mean[rows, AZIMUTH], tracks.detected[rows]
    # If only other cameras, or a radar elsewhere, have looked, the last answer holds. Sound-only entities
    # were searched for in the sector of their sound.
    rates, holds = miss_rates(scans, azimuth_rad), np.full(len(rows), asked is None)
    rates[~detected] = asked.miss_rate if isinstance(asked, Absent) else math.nan
    if asked is not None:
        within = [any(one.touches(at) for one in views) for at in azimuth_rad.tolist()]
        left = detected & (tracks.behind[rows] >= HIDDEN)
        holds = detected & within & ~left
        rates[left] = math.nan
    absent = ~np.isnan(rates)
    rows, rates, absent = (one[absent | ~holds] for one in (rows, rates, absent))
    tracks.answer[rows], tracks.miss_rate[rows] = np.where(absent, "absent", "unqueried"), rates


def _other_views(memory: Memory, scans: Sequence[Scan]) -> list[Sector]:
    """Return the sectors that cameras with their own sector searched in the last second."""
    looks = memory.looks.values() if any(one.names_sector for one in scans) else ()
    recent = (one for one in looks if memory.stamp_ns - one.stamp_ns <= NEWS_HOLDS_NS)
    asked = (one for one in recent if not isinstance(one.answer, Unqueried))
    return [Sector.between(*one.sector_rad) for one in asked if one.sector_rad is not None]
