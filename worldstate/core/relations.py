"""Relations of entities to occluders, to the ego vehicle and to one another, with their intervals."""

import math
from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np

from worldstate.abduction.sequence.sequence_model import LONGEST_S, STATED
from worldstate.belief.hidden_bearing import time_to_visible
from worldstate.belief.kinematics.motion import LEAST_STD
from worldstate.belief.site_geometry import normal_share
from worldstate.belief.track import Track, Tracks, occluded, side_weights
from worldstate.ground import TINY, FloatArray, nanoseconds, replaced
from worldstate.state import Context, Relation
from worldstate.state.entity import EGO

from .memory import Memory
from .site_model import FilterModel
from .street_belief import StreetBelief

_HOLDS = 0.5  # A relation holds from this probability
_KEPT_NS = nanoseconds(LONGEST_S)  # Time for which an ended relation is kept
# Half the width of a lane in town; below walking pace the heading does not indicate the lane.
_HALF_LANE_M, _LEAST_SPEED_MPS = 1.6, 1.5
_ALIKE = 0.5  # Smallest cosine between two headings in one lane: 60 degrees
_LEAST = 0.05  # Less likely relations are left out
Edge: TypeAlias = tuple[str, str, str, float]  # Source, target, kind and P(it holds)


def relations_at(memory: Memory, tracks: Tracks, model: FilterModel) -> tuple[Relation, ...]:
    """Return the relations of some tracks, with the interval in which each has held."""
    # An entity that only a camera has found, and that was first in view, has none.
    related = ~tracks.seen | (tracks.came_from >= _LEAST) | tracks.approach_heard | tracks.placed
    related |= tracks.behind >= _LEAST
    if not memory.relations and True not in related:
        return ()
    before = {(one.src, one.dst, one.kind): one for one in memory.relations}
    some = tracks.taken(related).rows()
    edges = [one for track in some for one in _edges(track, memory.belief, model)]
    known_m = model.site.street.known_m
    placed = [one for one in some if one.place and one.place.position_std_m < known_m]
    if placed:
        edges += [edge for edge in _between(placed, model.context) if edge[-1] >= _LEAST]
    edges += _hiding(tracks, model)
    now = {edge[:-1]: edge[-1] for edge in edges}
    names = {*tracks.id, *[one.id for one in model.context.occluders], EGO}
    now |= {key: 0.0 for key in before if key not in now and names.issuperset(key[:2])}
    held = [_held(Relation(*key, chance, memory.stamp_ns), before.get(key)) for key, chance in now.items()]
    return tuple([edge for edge in held if edge.probability or edge.until_ns is not None])


def _held(edge: Relation, before: Relation | None) -> Relation:
    """Return a relation with the interval in which it has held; an ended one is kept for five seconds."""
    before = before or edge
    if edge.probability >= _HOLDS:
        begins = before.since_ns is None or before.until_ns is not None
        return replaced(edge, since_ns=edge.stamp_ns if begins else before.since_ns)
    until_ns = edge.stamp_ns if before.until_ns is None else before.until_ns
    is_kept = before.since_ns is not None and edge.stamp_ns - until_ns <= _KEPT_NS
    return replaced(edge, since_ns=before.since_ns, until_ns=until_ns) if is_kept else edge


def _edges(track: Track, belief: StreetBelief, model: FilterModel) -> Iterator[Edge]:
    occluders = model.context.occluders
    if not track.seen:
        for k, weight in enumerate(side_weights(track, len(occluders))):
            if weight > 0.0:
                hidden = track.behind * weight
                yield track.id, occluders[k].id, "occluded_by", hidden
                yield track.id, occluders[k].id, "approaching_from", hidden * _comes(track, k, belief, model)
    elif track.came_from >= _LEAST and track.behind < _HOLDS:
        yield track.id, occluders[track.side].id, "emerged_from", track.came_from
    if track.approach_heard:
        deviations = track.motion.inverse_tta_hz / track.motion.inverse_tta_std_hz
        yield track.id, EGO, "approaching", normal_share(deviations)


def _hiding(tracks: Tracks, model: FilterModel) -> Iterator[Edge]:
    """Yield the corners and entities that now hide an entity which was in view before."""
    rows = (tracks.seen & (tracks.behind >= _LEAST)).nonzero()[0]
    if len(rows):
        names = [*(one.id for one in model.context.occluders), *tracks.id]
        by = occluded(tracks, model.site)[rows]
        chances = tracks.behind[rows, None] * by / np.maximum(by.sum(axis=1, keepdims=True), _LEAST)
        for i, k in zip(*np.nonzero(chances >= _LEAST), strict=True):
            yield tracks.id[rows[i]], names[k], "occluded_by", min(float(chances[i, k]), 1.0)


def _comes(track: Track, side: int, belief: StreetBelief, model: FilterModel) -> float:
    """Return P(it comes into view there within five seconds | hidden), from its position or the sound."""
    if track.place is not None:
        return float(time_to_visible(track.place, model.site.sides[side], model.site, LONGEST_S)[0])
    coming = belief.coming[side]
    total = np.add.reduce
    return float(total(coming[:STATED]) / max(total(coming), TINY)) if belief.has_times else 1.0


def _between(tracks: Sequence[Track], context: Context) -> Iterator[Edge]:
    r"""Yield which entity is next ahead of another one in a lane, and which will cross the ego's path.

    With the heading u of b, its normal n and the offset d from b to a,

    .. math:: P(\text{one lane}) = P(|n \cdot d| \le w / 2), \qquad
              P(\text{in front}) = P(\text{one lane})\, P(u \cdot d > 0)
    """
    ids, places = [*(one.id for one in tracks), EGO], [one.place for one in tracks if one.place]
    mean = np.array([*(one.mean for one in places), np.zeros_like(places[0].mean)])
    covariance = np.array([*(one.covariance for one in places), np.zeros_like(places[0].covariance)])
    speed = np.hypot(*mean[:, 2:].T)
    heading = mean[:, 2:] / np.maximum(speed, _LEAST_SPEED_MPS)[:, None]
    heading[-1] = 1.0, 0.0
    moves = np.append(speed[:-1] >= _LEAST_SPEED_MPS, True)
    normal = heading @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    offset = mean[:, None, :2] - mean[None, :, :2]
    spread = covariance[:, None, :2, :2] + covariance[None, :, :2, :2]
    along, across = (np.einsum("abi,bi->ab", offset, axis) for axis in (heading, normal))
    along_var, across_var = (np.einsum("bi,abij,bj->ab", axis, spread, axis) for axis in (heading, normal))
    alike = moves[None] & ((heading @ heading.T >= _ALIKE) | ~moves[:, None])
    beside = np.maximum(np.abs(across) - _HALF_LANE_M, 0.0)
    near = alike & (beside <= 2.0 * np.sqrt(across_var)) & (along > 0.0)
    # Only the next entity ahead, because twenty entities have 380 pairs.
    farness = np.where(near, along, np.inf)[:-1]
    for b in np.flatnonzero(np.isfinite(farness).any(axis=0)).tolist():
        a = int(np.argmin(farness[:, b]))
        aside, std_m = float(across[a, b]), math.sqrt(across_var[a, b])
        left, right = (normal_share((end_m - aside) / std_m) for end_m in (_HALF_LANE_M, -_HALF_LANE_M))
        lane = left - right
        ahead = lane * normal_share(float(along[a, b]) / math.sqrt(along_var[a, b]))
        yield ids[a], ids[b], "same_lane", lane
        yield ids[a], ids[b], "in_front_of", ahead
    for track in tracks:
        yield track.id, EGO, "conflicts_with_ego_path", _crosses(track, context.ego_speed_mps or 0.0)


def _crosses(track: Track, ego_speed_mps: float) -> float:
    r"""Return the probability that an entity is on the path ahead of the ego vehicle within five seconds.

    It crosses y = 0 after :math:`t = -y / v_y` at :math:`x + (v_x - u) t`; both are normal to first order.
    """
    assert track.place is not None
    (x, y, vx, vy), covariance = track.place.mean.tolist(), track.place.covariance
    if y * vy >= 0.0 or abs(vy) < LEAST_STD:
        return 0.0
    time_s, closing = -y / vy, vx - ego_speed_mps
    slopes: FloatArray = np.array(
        [[0.0, -1.0 / vy, 0.0, y / vy**2], [1.0, -closing / vy, time_s, closing * y / vy**2]]
    )
    (time_var, _), (_, ahead_var) = (slopes @ covariance @ slopes.T).tolist()
    soon = normal_share((LONGEST_S - time_s) / math.sqrt(time_var))
    # The speed of an entity that may also stand still or turn away has a deviation as large as itself.
    comes = normal_share(abs(vy) / math.sqrt(covariance[-1, -1]))
    return soon * comes * normal_share((x + closing * time_s) / math.sqrt(ahead_var))
