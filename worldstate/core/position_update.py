"""Update the entities with the positions of a radar, a lidar or a radio: found, missed, announced."""

import math
from dataclasses import replace
from operator import attrgetter

import numpy as np

from worldstate.belief.association import (
    EDGE_STD_RAD,
    FORBIDDEN,
    UNHEARD,
    emergence_density,
    joint_association,
)
from worldstate.belief.kinematics.cartesian import (
    CartesianBelief,
    at_position,
    full_measurement,
    update_bearing,
    update_position,
)
from worldstate.belief.kinematics.motion import AZIMUTH, LOG_RANGE
from worldstate.belief.site_geometry import HIDDEN_BIAS_STD, SiteGeometry, normal_share
from worldstate.belief.track import (
    Track,
    after_empty_look,
    after_sighting,
    born,
    follow_places,
    merged,
    relabelled,
)
from worldstate.ground import FloatArray, wrap_angle
from worldstate.measurement.position import Position, PositionScan, SearchedSector

from .birth_death import REOCCLUSION_NS, after_look
from .memory import Memory

# m/s, of a velocity that was not measured: wide, so that it decides nothing.
_ANY_SPEED_STD = 100.0
# m/s, of vehicles in a street: twice the speed limit in town covers nearly all.
_SPEED_STD = 15.0
# Of the squared Mahalanobis distance: .9997 of chi-square with four degrees of freedom, as four deviations of
# a bearing are.
_GATE = 21.0
# m^2: messages tell of half a disc of 100 m.
_RADIO_AREA_M2 = 0.5 * math.pi * 100.0**2
# m/s: slower is parked, as far as a radar or a positioning receiver can tell.
_PARKED_MPS = 0.5
# No statement is certain, and a refuted claim that is repeated can still turn out to be true: what was taken
# to be in view stood behind something that the context does not name.
_MOST_EXISTENCE, _LEAST_EXISTENCE = 0.999, 1e-3
_BY_ALL = attrgetter("position_m", "covariance", "velocity_mps", "existence_probability", "classes")


def position_update(memory: Memory, scan: PositionScan, weight: float, site: SiteGeometry) -> Memory:
    """Return the memory after one scan; misses count by `weight`."""
    # Sorted, so that the state does not depend on the order in which a sensor lists what it found.
    positions, tracks = tuple(sorted(scan.positions, key=_BY_ALL)), memory.tracks
    whose = joint_association(
        _log_ratios(tracks, positions, scan, site), np.array([track.detected for track in tracks], bool)
    )
    births, sighted = list(memory.births), memory.sighted
    for j in whose.new:
        track = _born(positions[j], scan, births, sighted, site)
        births[track.side] += track.was_hidden
        sighted += not track.was_hidden
        tracks = (*tracks, track)
    found = whose.found | dict(enumerate(whose.new, start=len(memory.tracks)))
    after, chances = list[Track](), (*whose.chances, *[1.0] * len(whose.new))
    for i, (track, chance) in enumerate(zip(tracks, chances, strict=True)):
        existence = track.existence
        if scan.searched is not None:
            existence = _existence(track, chance, scan.searched, weight)
        if i in found:
            after.append(_found(track, positions[found[i]], existence, scan, site))
        else:
            after.append(_missed(track, existence, scan.searched))
    memory = replace(memory, births=tuple(births), sighted=sighted)
    return after_look(memory, follow_places(after, site), whose, scan.stamp_ns, site)


def _log_ratios(
    tracks: tuple[Track, ...], positions: tuple[Position, ...], scan: PositionScan, site: SiteGeometry
) -> FloatArray:
    r"""Return how much likelier than a new object every pair is, nats, shape (positions, tracks).

    .. math:: \log \frac{r\, p_D\, N(z; H m, H P H^T + R)}{(1 - r p_D)\, N(z_v; 0, V + R_v)} \frac{A}{u}

    The velocity enters by how much likelier it is than that of another, so that an entity without a place is
    scored in the same units, by its azimuth and range.
    """
    if not tracks or not positions:
        return np.empty((len(positions), len(tracks)))
    measured = [full_measurement(one, _ANY_SPEED_STD) for one in positions]
    z, noise = np.array([one[0] for one in measured]), np.array([one[1] for one in measured])
    scores = np.full((len(positions), len(tracks)), FORBIDDEN)
    placed = [i for i, track in enumerate(tracks) if track.place is not None]
    others = [i for i, track in enumerate(tracks) if track.place is None]
    if placed:
        scores[:, placed] = _cartesian([tracks[i] for i in placed], z, noise)
    if others:
        scores[:, others] = _polar([tracks[i] for i in others], z, noise, scan.searched is not None, site)
    found = 0.0 if scan.searched is None else scan.searched.detection_probability
    existence = np.array([track.existence for track in tracks]).clip(_LEAST_EXISTENCE, _MOST_EXISTENCE)
    area_m2 = _RADIO_AREA_M2
    if scan.searched is not None:
        area_m2 = max(scan.searched.sector.half_width_rad * scan.searched.range_m**2, 1.0)
    log_new = math.log(UNHEARD / area_m2)
    ratios = scores + np.log(existence * (found or 1.0)) - np.log1p(-existence * found) - log_new
    return np.where(scores > FORBIDDEN, ratios, FORBIDDEN)


def _cartesian(tracks: list[Track], z: FloatArray, noise: FloatArray) -> FloatArray:
    places = [track.place for track in tracks if track.place is not None]
    residual = z[:, None] - np.array([place.mean for place in places])
    spread = noise[:, None] + np.array([place.covariance for place in places])
    distance, density = _log_normal(residual, spread)
    _, usual = _log_normal(z[:, 2:], noise[:, 2:, 2:] + _SPEED_STD**2 * np.eye(2))
    return np.where(distance > _GATE, FORBIDDEN, density - usual[:, None])


def _log_normal(residual: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return squared Mahalanobis distance and log density of residuals, shape (..., n) both without n."""
    distance = np.einsum("...k,...k->...", residual, np.linalg.solve(spread, residual[..., None])[..., 0])
    return distance, -0.5 * (distance + np.linalg.slogdet(2.0 * math.pi * spread)[1])


def _polar(
    tracks: list[Track], z: FloatArray, noise: FloatArray, line_of_sight: bool, site: SiteGeometry
) -> FloatArray:
    """Return the scores of entities of which only azimuth and log range are believed."""
    range_m = np.maximum(np.hypot(z[:, 0], z[:, 1]), 1.0)
    azimuth = np.arctan2(z[:, 1], z[:, 0])
    along = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    noises = [np.einsum("ij,ijk,ik->i", axis, noise[:, :2, :2], axis) for axis in (across, along)]
    means = np.array([track.motion.mean for track in tracks])
    variances = np.array([np.diag(track.motion.covariance) for track in tracks])
    turned = wrap_angle(azimuth[:, None] - means[:, AZIMUTH])
    # The sound of a hidden one may come from the edge instead.
    hidden = np.array([not track.seen for track in tracks])
    bias = np.where(hidden, HIDDEN_BIAS_STD, 0.0)
    variance = variances[:, AZIMUTH] + bias**2 + (noises[0] / range_m**2)[:, None]
    farther = np.log(range_m)[:, None] - means[:, LOG_RANGE]
    range_variance = variances[:, LOG_RANGE] + (noises[1] / range_m**2)[:, None]
    distance, log_azimuth = turned**2 / variance, -0.5 * np.log(2.0 * math.pi * variance)
    if line_of_sight:
        # An entity that was only heard is found where it comes into view.
        peak = 1.0 / (EDGE_STD_RAD * math.sqrt(2.0 * math.pi))
        near = np.maximum(emergence_density(tracks, azimuth[:, None], site) / peak, 1e-300)
        distance = np.where(hidden, -2.0 * np.log(near), distance)
        log_azimuth = np.where(hidden, math.log(peak), log_azimuth)
    distance = distance + farther**2 / range_variance
    # From 1 / (rad log m) to 1 / m^2.
    log_range = -0.5 * np.log(2.0 * math.pi * range_variance) - 2.0 * np.log(range_m)[:, None]
    return np.where(distance > _GATE, FORBIDDEN, log_azimuth + log_range - 0.5 * distance)


def _found(
    track: Track, position: Position, existence: float, scan: PositionScan, site: SiteGeometry
) -> Track:
    """Return a track after a position of its own."""
    labels = track.labels
    if position.classes:
        labels = relabelled(labels, position.classes) if track.detected else position.classes
    changed = replace(
        track,
        existence=existence if scan.searched is not None else _told(track, position, scan),
        labels=labels,
        moving=_moving(position, track.moving),
        sources=merged(track.sources, scan.source),
        updated_ns=scan.stamp_ns,
        approach_heard=True,
        place=_placed(track, position),
    )
    if scan.searched is None:
        return _at_side(changed, site)
    miss_rate = 1.0 - scan.searched.detection_probability
    return replace(changed, seen=True, last_seen_ns=scan.stamp_ns, answer="visible", miss_rate=miss_rate)


def _placed(track: Track, position: Position) -> CartesianBelief:
    if track.place is not None:
        return update_position(track.place, position)
    place = at_position(position)
    if not track.seen:
        return place
    return update_bearing(place, track.motion.azimuth_rad, track.motion.azimuth_std_rad)


def _at_side(track: Track, site: SiteGeometry) -> Track:
    """Return a track that a message has placed on the side whose occluder hides it there, if one does."""
    assert track.place is not None
    x, y = track.place.mean[:2].tolist()
    side = site.hiding_side(math.atan2(y, x))
    unseen_ns = track.updated_ns - (track.last_seen_ns or 0)
    if side is None or (track.seen and unseen_ns <= REOCCLUSION_NS):
        return track
    return replace(track, side=side, seen=False, was_hidden=True)


def _told(track: Track, position: Position, scan: PositionScan) -> float:
    """Return the existence after a message."""
    # A sender that lies in one message lies in the next: what a source repeats counts once.
    if scan.source in track.sources:
        return track.existence
    odds = position.existence_probability / (1.0 - position.existence_probability)
    before = min(track.existence, _MOST_EXISTENCE)
    return min(before * odds / (before * odds + 1.0 - before), _MOST_EXISTENCE)


def _moving(position: Position, before: bool) -> bool:
    velocity = position.velocity_mps
    return before if velocity is None else math.hypot(*velocity) > _PARKED_MPS


def _existence(track: Track, chance: float, searched: SearchedSector, weight: float) -> float:
    r"""Return the existence after a scan, with the chance c that one of its positions is of the track.

    .. math:: r \leftarrow c\, r_+ + (1 - c)\, \frac{r (1 - p)}{1 - r p}, \qquad
              p = p_D\, P_{range}\, (1 - P_{hidden})
    """
    miss_rate, missed = 1.0 - searched.detection_probability, track.existence
    found = after_sighting(track.existence, miss_rate, searched.clutter_rate)
    if not track.detected:
        return found
    if searched.sector.touches(track.motion.azimuth_rad):
        mean, variance = track.motion.mean[LOG_RANGE], track.motion.covariance[LOG_RANGE, LOG_RANGE]
        in_range = normal_share((math.log(searched.range_m) - mean) / math.sqrt(variance))
        in_sight = 1.0 if track.seen else 1.0 - track.behind
        miss = 1.0 - in_range * in_sight * (1.0 - miss_rate**weight)
        missed = after_empty_look(missed, miss)
        if not track.seen:
            missed = max(missed, _LEAST_EXISTENCE)
    return missed + chance * (found - missed)


def _missed(track: Track, existence: float, searched: SearchedSector | None) -> Track:
    """Return a track that a scan has not found."""
    if searched is None or not track.detected or not searched.sector.touches(track.motion.azimuth_rad):
        return track
    return replace(
        track, existence=existence, answer="absent", miss_rate=1.0 - searched.detection_probability
    )


def _born(
    position: Position, scan: PositionScan, births: list[int], sighted: int, site: SiteGeometry
) -> Track:
    """Return a new entity before its position counts, hidden where a message places it behind an occluder."""
    azimuth_rad = math.atan2(position.position_m[1], position.position_m[0])
    side = site.hiding_side(azimuth_rad) if scan.searched is None else None
    existence = min(position.existence_probability, _MOST_EXISTENCE)
    kind, number = ("visible", sighted) if side is None else (site.sides[side].label, births[side])
    one = replace(born(kind, number, existence, scan.stamp_ns, site), sources=(scan.source,))
    if side is None:
        return replace(one, side=site.nearest_side(azimuth_rad))
    return replace(one, side=side, was_hidden=True)
