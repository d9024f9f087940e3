"""Association of sightings with entities, in view and at the edge of an occluder, all at once."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from worldstate.abduction.road_users import SEEN_AS
from worldstate.ground import BoolArray, FloatArray, IntArray, wrap_angle
from worldstate.measurement import Sector, Sighting

from .site_geometry import SiteGeometry, normal_share
from .track import Track

# Of a pair outside the gate; below any sum of scores within it.
FORBIDDEN = -1e6
# Of pairing a parked with a moving object, nats: below the gate's 4 deviations, so that any free partner is
# preferred, and finite, so that a parked car that drives off keeps its id.
_PARKED_MISMATCH = -10.0
_UNFORESEEN = 0.05  # Of a vehicle that comes into view, whatever the sound had said of the time
_FOUND = 0.95  # Of the looks at an entity in view
_LEAST = 1e-300  # Keeps logarithms finite
# All of five tracks and five measurements, or of three and twelve; their tables take .2 ms to read.
_MOST_EVENTS = 2000
_ROUNDS = 30  # After these messages of twenty tracks that stand abreast change by less than 1e-3
_MOST_NATS = 25.0  # Sums that leave one term out keep their digits
# Deviations and radians of a sighting of an entity in view. The second bounds the first: four deviations of
# an entity unseen for a second are most of the view.
_GATE_SIGMA, _GATE_RAD = 4.0, 0.35
# Of first sightings about the edge that they come past: corners of real junctions stand within 6 degrees of
# the default; missed once or twice, a vehicle moves on by 3 to 6 degrees an image.
EDGE_STD_RAD = 0.15
# P(the signature names the wrong side): rarely on junctions that its model was trained on, often on others.
_SIDE_CONFUSION = 0.2
# P(a new sighting was not heard before): most vehicles from a side street are.
UNHEARD = 0.05
# Of P(hidden), left by a hand-over: at zero, a second vehicle behind the corner would have to be found anew.
HANDOVER_RESIDUAL = 0.02
# As detectors call them. What was heard drives: a detector has misread its label, or the ear the kind.
_VEHICLES = frozenset().union(*SEEN_AS.values())
_ON_FOOT, _MISREAD = frozenset({"person", "pedestrian"}), 0.1


@dataclass(frozen=True, slots=True)
class Association:
    """Whose a look's measurements are: the likeliest assignment, and P(one of them is its) of every track."""

    found: dict[int, int]  # Measurement of a track
    chances: list[float]  # Over all joint events, shape (tracks,)
    new: list[int]  # Measurements of no track


def associated(
    tracks: tuple[Track, ...], sightings: tuple[Sighting, ...], view: Sector, site: SiteGeometry
) -> Association:
    r"""Return whose the sightings are.

    Every sighting is one of an entity in view, a hidden one that comes past an edge, or a vehicle that was
    not heard; how much likelier than that, nats, they are one of

    .. math:: \log \frac{r p_D N(z; \theta, S)}{1 - r p_D} \frac{V}{u}, \qquad
              \log r\, [(1 - c)\, N(z; a_k, \sigma^2) + c \max_j N(z; a_j, \sigma^2)] \frac{V}{u}

    with existence r, of a hidden one times the chance that it stands near its edge by now, the edge a of its
    side, which the signature may have confused with probability c, and u vehicles that were not heard
    anywhere in the view V. Entities in view and hidden ones compete: an entity that has left the view would
    else take the first sighting of the next one.
    """
    if not tracks or not sightings:
        return Association({}, [0.0] * len(tracks), list(range(len(sightings))))
    unheard = math.log(UNHEARD / (2.0 * view.half_width_rad))
    detected = np.array([track.detected for track in tracks])
    scores = _scores(tracks, sightings, detected, site)
    return joint_association(np.where(scores > FORBIDDEN, scores - unheard, FORBIDDEN), detected)


def joint_association(log_ratios: FloatArray, detected: BoolArray) -> Association:
    """Return the association of measurements and tracks by how much likelier than new each pair is.

    Shapes: log_ratios (measurements, tracks), FORBIDDEN outside the gate; detected (tracks,).
    """
    # Within its gate a detected entity takes a measurement before that counts as a new one; a maximum of
    # the two would be a tie of all poor pairs, which the order of measurements would settle.
    gated = log_ratios > FORBIDDEN
    scores = np.where(gated & detected, np.logaddexp(log_ratios, 0.0), log_ratios)
    found = _likeliest(scores)
    chances = association_probabilities(log_ratios).sum(axis=0)
    new = [j for j in range(len(log_ratios)) if j not in found.values()]
    return Association(found, np.minimum(chances, 1.0).tolist(), new)


def association_probabilities(log_ratios: FloatArray) -> FloatArray:
    r"""Return P(measurement j is track i's), shape (measurements, tracks), over all joint events.

    .. math:: p_{ij} = \sum_{a:\, a(i) = j} p(a), \qquad p(a) \propto \prod_i e^{l_{i a(i)}}

    An event gives every track one measurement or none, and no measurement to two. For a group of tracks that
    share measurements with more than 2,000 events the sum is approximated by belief propagation.

    Examples
    --------
    >>> association_probabilities(np.log([[3.0, 1.0]])).round(3)
    array([[0.6, 0.2]])
    """
    gated, chances = log_ratios > FORBIDDEN, np.zeros_like(log_ratios)
    # Pairs that compete with no other, which most are, all at once.
    alone = gated & (gated.sum(axis=0) == 1) & (gated.sum(axis=1) == 1)[:, None]
    chances[alone] = np.exp(-np.logaddexp(0.0, -log_ratios[alone]))
    for rows, columns in _groups(gated & ~alone):
        events = _joint_events(len(rows), len(columns))
        if events is None:
            chances[np.ix_(rows, columns)] = propagated(log_ratios[np.ix_(rows, columns)])
            continue
        # The last row is that of no measurement.
        ratios = np.vstack([log_ratios[np.ix_(rows, columns)], np.zeros(len(columns))])
        logs = ratios[events, np.arange(len(columns))].sum(axis=1)
        weights = np.exp(logs - logs.max())
        for column, given in zip(columns, events.T, strict=True):
            chances[rows, column] = np.bincount(given, weights, len(rows) + 1)[:-1] / weights.sum()
    return chances


def propagated(log_ratios: FloatArray) -> FloatArray:
    r"""Return P(measurement j is track i's) by belief propagation, shape (measurements, tracks).

    .. math:: \mu_{ij} = \frac{e^{l_{ij}}}{1 + \sum_{j' \ne j} e^{l_{ij'}} \nu_{j'i}}, \qquad
              \nu_{ji} = \frac{1}{1 + \sum_{i' \ne i} \mu_{i'j}}

    Source: J. Williams, R. Lau, "Approximate evaluation of marginal association probabilities with belief
    propagation", IEEE Trans. Aerosp. Electron. Syst. 50, 2014, where it is proved to converge.

    Examples
    --------
    >>> propagated(np.log([[3.0, 1.0]])).round(3)
    array([[0.6, 0.2]])
    """
    weight = np.where(log_ratios > FORBIDDEN, np.exp(np.clip(log_ratios, -_MOST_NATS, _MOST_NATS)), 0.0)
    free = np.ones_like(weight)
    for _ in range(_ROUNDS):
        given = weight * free
        wanted = weight / (1.0 + given.sum(axis=0) - given)
        free = 1.0 / (1.0 + wanted.sum(axis=1, keepdims=True) - wanted)
    given = weight * free
    return np.asarray(given / (1.0 + given.sum(axis=0)))


def _groups(gated: BoolArray) -> Iterator[tuple[list[int], list[int]]]:
    """Yield rows and columns of every group that shares no pair with another one."""
    groups: list[tuple[set[int], list[int]]] = []
    for column, gate in enumerate(gated.T.tolist()):
        rows, columns = {row for row, inside in enumerate(gate) if inside}, [column]
        for group in [one for one in groups if rows & one[0]]:
            groups.remove(group)
            rows, columns = rows | group[0], columns + group[1]
        groups.append((rows, columns))
    return ((sorted(rows), columns) for rows, columns in groups if rows)


@lru_cache(maxsize=256)
def _joint_events(rows: int, columns: int) -> IntArray | None:
    """Return the row of every column in all joint events, `rows` for none, shape (events, columns)."""
    events: list[tuple[int, ...]] = [()]
    for _ in range(columns):
        events = [(*one, row) for one in events for row in range(rows + 1) if row == rows or row not in one]
        if len(events) > _MOST_EVENTS:
            return None
    return np.array(events)


def _likeliest(scores: FloatArray) -> dict[int, int]:
    """Return {column: row} of the largest sum of scores, where every row may be a new entity instead, at 0.

    Examples
    --------
    >>> _likeliest(np.array([[4.0, 3.0], [3.5, FORBIDDEN]]))
    {1: 0, 0: 1}
    """
    n, known = scores.shape
    if not n or not known:
        return {}
    every = np.full((n, known + n), FORBIDDEN)
    every[:, :known] = scores
    np.fill_diagonal(every[:, known:], 0.0)
    # Imported where it is needed: scipy.optimize takes longer than all else that the core imports.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-every)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {column: row for row, column in pairs if column < known and every[row, column] > FORBIDDEN}


def _scores(
    tracks: tuple[Track, ...], sightings: tuple[Sighting, ...], detected: BoolArray, site: SiteGeometry
) -> FloatArray:
    """Return the score of every sighting and track, shape (sightings, tracks)."""
    azimuth_rad = np.array([one.azimuth_rad for one in sightings])[:, None]
    std_rad = np.array([one.std_rad for one in sightings])[:, None]
    moving = np.array([one.moving for one in sightings])[:, None]
    in_view = _in_view(tracks, azimuth_rad, std_rad, moving)
    if detected.all():
        return in_view
    classes = np.log([[_shared_class(track, one.label) for track in tracks] for one in sightings])
    comes = np.array([track.existence * reached_edge(track, site) for track in tracks])
    heard = np.maximum(comes * emergence_density(tracks, azimuth_rad, site), _LEAST)
    return np.where(detected, in_view, np.where(moving, np.log(heard) + classes, FORBIDDEN))


def _in_view(
    tracks: tuple[Track, ...], azimuth_rad: FloatArray, std_rad: FloatArray, moving: BoolArray
) -> FloatArray:
    existence = np.array([track.existence for track in tracks])
    residual = wrap_angle(azimuth_rad - np.array([track.motion.azimuth_rad for track in tracks]))
    variance = np.array([track.motion.azimuth_std_rad for track in tracks]) ** 2 + std_rad**2
    density = -0.5 * (residual**2 / variance + np.log(2.0 * math.pi * variance))
    expected = np.log(np.maximum(_FOUND * existence, _LEAST)) - np.log1p(-existence * _FOUND)
    mismatch = np.where(moving == np.array([track.moving for track in tracks]), 0.0, _PARKED_MISMATCH)
    outside = (np.abs(residual) > _GATE_RAD) | (residual**2 > _GATE_SIGMA**2 * variance)
    return np.where(outside, FORBIDDEN, density + expected + mismatch)


def _shared_class(track: Track, label: str) -> float:
    """Return P(a detector calls what a track sounds like by this label)."""
    if label not in _VEHICLES:
        return _MISREAD if label in _ON_FOOT else 1.0
    kinds = ((kind == label or label in SEEN_AS.get(kind, _VEHICLES), share) for kind, share in track.labels)
    return max(sum(share for matches, share in kinds if matches), _MISREAD)


def reached_edge(track: Track, site: SiteGeometry) -> float:
    """Return how likely a hidden entity is near enough to its edge, against one of unknown time.

    A vehicle believed seconds away from the edge is not the one that appears now.
    """
    side, near_rad = site.sides[track.side], EDGE_STD_RAD
    outwards = math.copysign(1.0, side.edge_azimuth_rad)

    def near(azimuth_rad: float, std_rad: float) -> float:
        far_rad = outwards * wrap_angle(azimuth_rad - side.edge_azimuth_rad)
        return normal_share((2.0 * near_rad - far_rad) / math.hypot(std_rad, near_rad))

    by_time = near(track.motion.azimuth_rad, track.motion.azimuth_std_rad)
    return min(max(by_time / near(side.azimuth_rad, side.std_rad), _UNFORESEEN), 1.0)


def emergence_density(tracks: Sequence[Track], azimuth_rad: FloatArray, site: SiteGeometry) -> FloatArray:
    """Return the density of first sightings of hidden entities, 1/rad, shape (sightings, tracks)."""
    edges_rad = np.array([side.edge_azimuth_rad for side in site.sides])
    deviations = wrap_angle(azimuth_rad - edges_rad) / EDGE_STD_RAD
    # Of first sightings about the edge that they come past, 1/rad.
    near = np.exp(-0.5 * deviations**2) / (EDGE_STD_RAD * math.sqrt(2.0 * math.pi))
    heard = np.empty_like(near)
    for side in range(len(edges_rad)):
        others = np.delete(near, side, axis=1).max(axis=1) if len(edges_rad) > 1 else near[:, side]
        heard[:, side] = (1.0 - _SIDE_CONFUSION) * near[:, side] + _SIDE_CONFUSION * others
    return np.asarray(heard[:, [track.side for track in tracks]])
