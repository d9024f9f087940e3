"""Joint association of detections with entities in view and with hidden ones at the edge of an occluder."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from worldstate.abduction.evidence import MOST_NATS
from worldstate.abduction.road_users import SEEN_AS, ClassShares
from worldstate.belief.kinematics.cartesian import full_measurement
from worldstate.belief.kinematics.motion import AZIMUTH, LARGEST_STD, LOG_RANGE
from worldstate.ground import CERTAIN_NATS, TINY, BoolArray, FloatArray, wrap_angle

from .detection import Detections
from .site_geometry import SiteGeometry, normal_share
from .street_model import StreetModel
from .track import Track, Tracks, side_weights

# Score of a pair outside the gate; below any sum of scores within it.
FORBIDDEN = -MOST_NATS
# Size limit of a table of events and pairs: five tracks and five measurements fit, or three and twelve.
_MOST_ENTRIES = 100_000
_ROUNDS = 30  # After these rounds, messages among twenty tracks side by side change by less than 1e-3
# Gate on the squared Mahalanobis distance of a bearing or a position: 0.9997 of chi-square with four degrees
# of freedom.
GATE = 21.0
# Detector labels. An audible entity is a vehicle; any other label is an error of detector or sound
# classifier.
_VEHICLES = frozenset().union(*SEEN_AS.values())
_ON_FOOT = frozenset({"person", "pedestrian"})


@dataclass(frozen=True, slots=True)
class Association:
    """The likeliest assignment of detections to tracks, and the probability of every pair."""

    found: dict[int, int]  # Detection by track
    pairs: FloatArray  # P(a detection belongs to a track) over all joint events, shape (detections, tracks)
    new: list[int]  # Detections without a track

    @property
    def unclaimed(self) -> FloatArray:
        """P(it belongs to no track) for every detection."""
        return np.asarray(np.maximum(1.0 - self.pairs.sum(axis=1), 0.0))

    @property
    def chances(self) -> list[float]:
        """P(it has been detected) for every track."""
        chances: list[float] = np.minimum(self.pairs.sum(axis=0), 1.0).tolist()
        return chances


def associated(tracks: Tracks, detections: Detections, site: SiteGeometry) -> Association:
    r"""Return the association of the detections of an instant, all boxes or all positions.

    A detection belongs to an entity that was detected before, to a hidden one that comes past an edge, or to
    a new object. The log ratios of the first two to the third, nats, are

    .. math:: \log \frac{r\, p_D\, N(z; H m, H P H^T + R)}{(1 - r p_D)\, u}, \qquad
              \log \frac{r}{u} [(1 - c)\, N(z; a_k, \sigma^2) + c \max_j N(z; a_j, \sigma^2)]

    with the existence r, for a hidden entity times the chance that it has reached its edge; the edge a of its
    side, which the signature may have confused with probability c; and the density u of new objects. Entities
    in view compete with hidden ones, because an entity that has left the view would otherwise take the first
    detection of the next one.
    """
    detected = tracks.detected
    # A radar also detects some hidden entities.
    unseen = 1.0 - (site.street.hidden_return if detections.positions else 0.0)
    in_sight = detected * (1.0 - tracks.behind * (unseen if detections.in_sight else 0.0))
    if not len(tracks) or not len(detections):
        return joint_association(np.empty((len(detections), len(tracks))), in_sight)
    return joint_association(_log_ratios(tracks, detected, in_sight, detections, site), in_sight)


def joint_association(log_ratios: FloatArray, in_sight: FloatArray | BoolArray) -> Association:
    """Return the association, given the log ratio of every pair to a new object.

    Shapes: log_ratios (detections, tracks), FORBIDDEN outside the gate; in_sight (tracks,), P(in line of
    sight) of entities that were detected before, 0 for others.
    """
    # Within its gate an entity in view has precedence over a new object. With a maximum of the two scores all
    # poor pairs would be equal, and the order of measurements would have an effect.
    gated = log_ratios > FORBIDDEN
    scores = np.where(gated, np.logaddexp(log_ratios, np.log(np.maximum(in_sight, TINY))), log_ratios)
    found = _likeliest(scores)
    taken = set(found.values())
    new = [j for j in range(len(log_ratios)) if j not in taken]
    return Association(found, association_probabilities(log_ratios), new)


def association_probabilities(log_ratios: FloatArray) -> FloatArray:
    r"""Return P(measurement j belongs to track i), shape (measurements, tracks), over all joint events.

    .. math:: p_{ij} = \sum_{a:\, a(i) = j} p(a), \qquad p(a) \propto \prod_i e^{l_{i a(i)}}

    In an event every track has at most one measurement, and every measurement at most one track. For groups
    of tracks with more than about 2,000 events the sum is approximated by belief propagation.

    Examples
    --------
    >>> association_probabilities(np.log([[3.0, 1.0]])).round(3)
    array([[0.6, 0.2]])
    """
    gated, chances = log_ratios > FORBIDDEN, np.zeros_like(log_ratios)
    # Pairs without competitors, which are the majority, all at once.
    alone = gated & (gated.sum(axis=0) == 1) & (gated.sum(axis=1) == 1)[:, None]
    chances[alone] = np.exp(-np.logaddexp(0.0, -log_ratios[alone]))
    crowd = gated & ~alone
    for rows, columns in _groups(crowd) if crowd.any() else ():
        events = _joint_events(len(rows), len(columns))
        if events is not None:
            pairs = np.array(rows)[:, None], columns
            logs = log_ratios[pairs].ravel() @ events
            weights = np.exp(logs - logs.max())
            total = weights.sum()
            chances[pairs] = (events @ weights / total).reshape(len(rows), len(columns))
            crowd[pairs] = False
    if crowd.any():
        chances[crowd] = propagated(np.where(crowd, log_ratios, FORBIDDEN))[crowd]
    return chances


def propagated(log_ratios: FloatArray) -> FloatArray:
    r"""Return P(measurement j belongs to track i) by belief propagation, shape (measurements, tracks).

    .. math:: \mu_{ij} = \frac{e^{l_{ij}}}{1 + \sum_{j' \ne j} e^{l_{ij'}} \nu_{j'i}}, \qquad
              \nu_{ji} = \frac{1}{1 + \sum_{i' \ne i} \mu_{i'j}}

    Source: J. Williams, R. Lau, "Approximate evaluation of marginal association probabilities with belief
    propagation", IEEE Trans. Aerosp. Electron. Syst. 50, 2014, with a proof of convergence.

    Examples
    --------
    >>> propagated(np.log([[3.0, 1.0]])).round(3)
    array([[0.6, 0.2]])
    """
    weight = np.exp(np.minimum(log_ratios, CERTAIN_NATS))
    free = np.ones_like(weight)
    for _ in range(_ROUNDS):
        given = weight * free
        wanted = weight / (1.0 + given.sum(axis=0) - given)
        before, free = free, 1.0 / (1.0 + wanted.sum(axis=1, keepdims=True) - wanted)
        # Four rounds are enough for tracks that are far apart.
        if np.abs(free - before).max() < TINY:
            break
    given = weight * free
    return np.asarray(given / (1.0 + given.sum(axis=0)))


def _groups(gated: BoolArray) -> list[tuple[list[int], list[int]]]:
    """Return rows and columns of all groups; no pair belongs to two groups."""
    groups: list[tuple[int, list[int]]] = []
    # Rows as the bits of a number: two columns share a row if their numbers have a common bit.
    for column, bits in enumerate(np.packbits(gated, axis=0, bitorder="little").T):
        rows, columns = int.from_bytes(bits.tobytes(), "little"), [column]
        for group in [one for one in groups if rows & one[0]]:
            groups.remove(group)
            rows, columns = rows | group[0], columns + group[1]
        groups.append((rows, columns))
    every = range(len(gated))
    return [([row for row in every if rows >> row & 1], columns) for rows, columns in groups if rows]


@lru_cache
def _joint_events(rows: int, columns: int) -> FloatArray | None:
    """Return whether each joint event contains a pair, shape (rows * columns, events); None if too many."""
    events: list[tuple[int, ...]] = [()]
    for _ in range(columns):
        events = [(*one, row) for one in events for row in range(rows + 1) if row == rows or row not in one]
        if len(events) * rows * columns > _MOST_ENTRIES:
            return None
    return np.array([np.eye(rows, rows + 1)[:, one].ravel() for one in map(list, events)]).T.copy()


def _likeliest(scores: FloatArray) -> dict[int, int]:
    """Return {column: row} with the largest sum of scores; a row without a column is a new entity, score 0.

    Examples
    --------
    >>> _likeliest(np.array([[4.0, 3.0], [3.5, FORBIDDEN]]))
    {1: 0, 0: 1}
    """
    # Imported here: scipy.optimize takes longer than everything else that the core imports.
    from scipy.optimize import linear_sum_assignment

    # A row without a useful partner gets one with a score of zero.
    rows, columns = linear_sum_assignment(np.maximum(scores, 0.0), maximize=True)
    worth = scores[rows, columns] > 0.0
    return dict(zip(columns[worth].tolist(), rows[worth].tolist(), strict=True))


def _log_ratios(
    tracks: Tracks, detected: BoolArray, in_sight: FloatArray, detections: Detections, site: SiteGeometry
) -> FloatArray:
    """Return the log ratio of every pair to a new object, nats, shape (detections, tracks)."""
    boxes, found = not detections.positions, detections.found[:, None]
    existence = np.minimum(np.maximum(tracks.existence, site.street.doubt), 1.0 - site.street.doubt)
    if detections.in_sight:
        found = np.maximum(found * np.where(detected, in_sight, 1.0), TINY)
    likely = np.log(existence * np.where(found > 0.0, found, 1.0)) - np.log1p(-existence * found)
    density = _azimuth_density(tracks, detected, detections, site)
    if detections.in_sight and not detected.all():
        # Sound-only entities are detected at the edge where they come into view.
        heard = (~detected).nonzero()[0]
        hidden = tracks.taken(heard).rows()
        density[:, heard] = np.log(np.maximum(emergence_density(hidden, detections, site), TINY))
        reached = np.array([reached_edge(one, site) for one in hidden])
        likely[:, heard] = np.log(existence[heard] * reached)
        density[:, heard] += np.log(np.maximum(detections.line_of_sight(site), TINY))[:, None]
    if boxes:
        density += _alike(tracks, detected, detections, site)
    else:
        density = _density_m2(tracks, detections, density, site.street)
    return np.where(density > 0.5 * FORBIDDEN, density + likely - detections.log_new[:, None], FORBIDDEN)


def _azimuth_density(
    tracks: Tracks, detected: BoolArray, detections: Detections, site: SiteGeometry
) -> FloatArray:
    """Return the log density of every detection's azimuth, 1/rad, FORBIDDEN outside the gate."""
    residual = wrap_angle(detections.azimuth_rad[:, None] - tracks.mean[:, AZIMUTH])
    # The sound of a hidden entity may come from the edge instead.
    biases_rad = np.array([side.bias_std_rad for side in site.sides])
    own = tracks.covariance[:, AZIMUTH, AZIMUTH] + ~detected * biases_rad[tracks.side] ** 2
    variance = own + detections.std_rad[:, None] ** 2
    squares = residual**2 / variance
    density = -0.5 * (squares + np.log(2.0 * math.pi * variance))
    farthest_rad = math.pi if detections.positions else site.street.past_std_rad
    return np.where((squares > GATE) | (np.abs(residual) > farthest_rad), FORBIDDEN, density)


def _alike(tracks: Tracks, detected: BoolArray, detections: Detections, site: SiteGeometry) -> FloatArray:
    """Return the log ratio of motion, width and class for every pair of a box and a track, nats."""
    moving = detections.moving[:, None] > 0.0
    # A parked car that drives off keeps its identity, unless a moving object is equally near.
    alike = np.where(moving == tracks.moving, 0.0, math.log(site.street.doubt))
    known = (detections.width_rad[:, None] > 0.0) & (tracks.width_rad > 0.0) & detected
    logs = [np.log(np.where(one > 0.0, one, 1.0)) for one in (detections.width_rad, tracks.width_rad)]
    own = site.street.width_change**2
    others = own + 2.0 * site.street.size_spread**2
    squares = (logs[0][:, None] - logs[1]) ** 2
    alike += np.where(known, 0.5 * (math.log(others / own) - squares * (1.0 / own - 1.0 / others)), 0.0)
    for i in (~detected).nonzero()[0].tolist():
        labels, seen_as = tracks.labels[i], (shares[0][0] for shares in detections.classes)
        classes = [math.log(_shared_class(labels, label, site.street.misread)) for label in seen_as]
        alike[:, i] = np.where(moving[:, 0], classes, FORBIDDEN)
    return alike


def _density_m2(
    tracks: Tracks, detections: Detections, azimuth: FloatArray, street: StreetModel
) -> FloatArray:
    """Return the log density of every position, 1/m^2, FORBIDDEN outside the gate.

    The velocity enters as a ratio to the density of an unknown velocity. An entity without a position then
    has a score in the same unit, from its azimuth and log range.
    """
    measured = [full_measurement(one, LARGEST_STD) for one in detections.positions]
    z, noise = np.array([one[0] for one in measured]), np.array([one[1] for one in measured])
    range_m = np.maximum(np.hypot(z[:, 0], z[:, 1]), 1.0)
    along = z[:, :2] / range_m[:, None]
    farther = np.log(range_m)[:, None] - tracks.mean[:, LOG_RANGE]
    nearness = np.einsum("ij,ijk,ik->i", along, noise[:, :2, :2], along) / range_m**2
    variance = tracks.covariance[:, LOG_RANGE, LOG_RANGE] + nearness[:, None]
    squares = farther**2 / variance
    # From 1 / (rad log m) to 1 / m^2.
    log_range = -0.5 * (squares + np.log(2.0 * math.pi * variance)) - 2.0 * np.log(range_m)[:, None]
    density = np.where(squares > GATE, FORBIDDEN, azimuth + log_range)
    placed = tracks.placed
    if placed.any():
        mean, covariance = tracks.place_mean[placed], tracks.place_covariance[placed]
        distance, log_density = _log_normal(z[:, None] - mean, noise[:, None] + covariance)
        _, usual = _log_normal(z[:, 2:], noise[:, 2:, 2:] + street.speed_mps**2 * np.eye(2))
        density[:, placed] = np.where(distance > GATE, FORBIDDEN, log_density - usual[:, None])
    return density


def _log_normal(residual: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return squared Mahalanobis distance and log density of residuals, without their last axis."""
    distance = np.einsum("...k,...k->...", residual, np.linalg.solve(spread, residual[..., None])[..., 0])
    return distance, -0.5 * (distance + np.linalg.slogdet(2.0 * math.pi * spread)[1])


def _shared_class(labels: ClassShares, label: str, misread: float) -> float:
    """Return P(a detector uses this label | the sound classes of the entity)."""
    if label not in _VEHICLES:
        return misread if label in _ON_FOOT else 1.0
    kinds = ((kind == label or label in SEEN_AS.get(kind, _VEHICLES), share) for kind, share in labels)
    return max(sum(share for matches, share in kinds if matches), misread)


def reached_edge(track: Track, site: SiteGeometry) -> float:
    """Return the chance that a hidden entity has reached its edge, relative to one of unknown time.

    A vehicle that is believed seconds away from the edge is not the one that appears now.
    """
    side, near_rad = site.sides[track.side], site.street.edge_std_rad

    def near(azimuth_rad: float, std_rad: float) -> float:
        far_rad = side.outwards * wrap_angle(azimuth_rad - side.edge_azimuth_rad)
        return normal_share((2.0 * near_rad - far_rad) / math.hypot(std_rad, near_rad))

    by_time = near(track.motion.azimuth_rad, track.motion.azimuth_std_rad)
    return min(max(by_time / near(side.azimuth_rad, side.std_rad), site.street.unheard), 1.0)


def emergence_density(tracks: Sequence[Track], detections: Detections, site: SiteGeometry) -> FloatArray:
    """Return the density of first sightings of hidden entities, 1/rad, shape (sightings, tracks)."""
    azimuth_rad, widths_rad = detections.azimuth_rad, np.nan_to_num(detections.width_rad)
    from_edge_rad = np.stack([side.distance_rad(azimuth_rad, widths_rad) for side in site.sides], axis=1)
    spread_rad, confused = site.street.edge_std_rad, site.street.side_confusion
    # Density of first sightings around each edge, 1/rad.
    near = np.exp(-0.5 * (from_edge_rad / spread_rad) ** 2) / (spread_rad * math.sqrt(2.0 * math.pi))
    heard = np.empty_like(near)
    for side in range(len(site.sides)):
        others = np.delete(near, side, axis=1).max(axis=1) if len(site.sides) > 1 else near[:, side]
        heard[:, side] = (1.0 - confused) * near[:, side] + confused * others
    return np.asarray(heard @ np.array([side_weights(track, len(site.sides)) for track in tracks]).T)
