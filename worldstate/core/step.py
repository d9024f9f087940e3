"""One step of the filter: the memory at a later time, and after what was measured then."""

from collections.abc import Sequence

import numpy as np

from worldstate.belief.association import HANDOVER_RESIDUAL
from worldstate.belief.hidden_bearing import hidden_motion
from worldstate.belief.kinematics.cartesian import corrected, driven
from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import Tracks, hidden_shares, predict_tracks, turn
from worldstate.ground.values import NotUsable, seconds
from worldstate.measurement import Measurement, Odometry, PositionScan

from .acoustic_update import acoustic_update
from .birth_death import (
    HIDDEN,
    birth_death,
    events_between,
    hidden_on,
    hidden_rows,
    merge_tracks,
    past_edges,
    published,
    surviving,
)
from .cues import SideAdvisory, advisories, update_advisories
from .detection_update import new_looks, update_looks, update_positions
from .fixed_lag import Timed
from .memory import CountedLook, Memory
from .relations import relations_at
from .sequence_memory import SequenceMemory, carried
from .side_update import update_sequence, update_windows
from .site_model import FilterModel, from_here, without_open_sides

# All that two cameras and a radio find at a crowded crossing; a step costs with their square.
MOST_TRACKS = 128


def advanced(memory: Memory, stamp_ns: int, model: FilterModel) -> Memory:
    """Return a draft of the memory, predicted to a later time."""
    before, memory, step_ns = memory, memory.draft(), stamp_ns - memory.stamp_ns
    model = from_here(model, memory.ego)
    predict_tracks(memory.tracks, memory.sides, seconds(step_ns), model.site)
    memory.tracks = surviving(memory.tracks, model.site.settings)
    memory.stamp_ns = stamp_ns
    memory.forget()
    if isinstance(memory.belief, SequenceMemory):
        memory.belief = carried(memory.belief, stamp_ns, step_ns, model.context)
    else:
        memory.belief = memory.belief.predict(model.context.rates.values_hz, step_ns)
    memory.ego = memory.ego and driven(memory.ego, seconds(step_ns))
    if (before.tracks.placed & ~before.tracks.seen).any():
        _pass_places(before.tracks, memory, model)
    return memory


def _pass_places(before: Tracks, memory: Memory, model: FilterModel) -> None:
    """Update the memory after announced entities have come past their edge, or their place was lost."""
    tracks, emerged, gone = memory.tracks, list[int](), list[int]()
    now = {name: row for row, name in enumerate(tracks.id)}
    # Without a place it would be a hidden entity by its sound: of a side where nothing is heard it is gone.
    heard = [chance >= model.site.settings.birth_probability for chance in memory.sides.hidden]
    for old in np.flatnonzero(before.placed & ~before.seen).tolist():
        row, side = now[before.id[old]], int(before.side[old])
        if before.behind[old] >= 0.5 > tracks.behind[row]:
            emerged.append(side)
        only_heard = np.flatnonzero(~tracks.detected & (tracks.side == side)).tolist()
        others = [one for one in only_heard if one not in gone]
        if row in others and (len(others) > 1 or not heard[side]):
            gone.append(row)
    memory.tracks = tracks.without(gone)
    past_edges(memory, dict.fromkeys(emerged, HANDOVER_RESIDUAL), (), memory.stamp_ns)


def take_in(before: Memory, memory: Memory, measurement: Timed, start_ns: int, model: FilterModel) -> None:
    """Update a draft with a measurement of its time; `before` is what it was drafted from.

    An advisory that had ended when the draft was carried to its time begins anew.
    """
    model = from_here(model, memory.ego)
    was_advised = any(one.advised_ns is not None for one in before.history)
    held = advisories(memory, model) if was_advised else (None,) * len(before.history)
    memory.counts.measurements += 1
    if isinstance(measurement, Odometry):
        _take_odometry(memory, measurement)
    elif isinstance(measurement, PositionScan):
        update_positions(memory, measurement, model)
    else:
        measurement = without_open_sides(measurement, model.context)
        _perceive(memory, measurement, start_ns, model)
    gone = _announced_in_view(before, memory)
    if gone and isinstance(memory.belief, SequenceMemory):
        memory.belief = memory.belief.not_held(gone)
    named = advisories(memory, model)
    if isinstance(measurement, Measurement):
        birth_death(memory, [one is not None for one in named], measurement, model.site)
        _place_hidden(memory, model.site)
    _keep_likeliest(memory)
    _note_advisories(memory, [None if k in gone else one for k, one in enumerate(held)], named)
    into = merge_tracks(memory, model.site)
    known, now = (published(one.tracks, model.site.settings) for one in (before, memory))
    memory.last.events = events_between(known, now, memory.stamp_ns, into)
    memory.relations = relations_at(memory, now, model.context, model.site)


def _perceive(memory: Memory, measurement: Measurement, start_ns: int, model: FilterModel) -> None:
    """Update a draft with a measurement's signature, its looks and its sequence."""
    spoke = memory.rules.get(measurement.source)
    since_ns = measurement.stamp_ns - (start_ns if spoke is None else spoke.stamp_ns)
    measurement, looks = new_looks(memory, measurement, start_ns, model.site.settings)
    # Evidence first: association and births need the explanations of this very window.
    update_windows(memory, measurement, model)
    # Of windows that overlap, what is new counts.
    weight = min(max(seconds(since_ns), 0.0) / model.site.settings.window_s, 1.0)
    acoustic_update(memory, measurement, weight)
    update_looks(memory, measurement, looks, model)
    update_advisories(memory, measurement, model)
    update_sequence(memory, measurement, [seen for seen, _ in looks], model)
    bearing = measurement.bearing
    memory.last.bearing = None if isinstance(bearing, NotUsable) else bearing
    memory.last.domain = measurement.domain


def _take_odometry(memory: Memory, told: Odometry) -> None:
    """Update a draft with odometry: azimuth rates are those of axes that turn with the ego vehicle."""
    before, memory.ego = memory.ego, corrected(memory.ego, told)
    faster = memory.ego.yaw_rate_rad_s - (0.0 if before is None else before.yaw_rate_rad_s)
    if faster:
        turn(memory.tracks, faster)
    memory.looks[told.source] = CountedLook(told.stamp_ns, told.source)


def _place_hidden(memory: Memory, site: SiteGeometry) -> None:
    """Put the entities that are only heard and hidden where the sequence has them."""
    if memory.sequence is None:
        return
    tracks, coming = memory.tracks, memory.sequence.own_coming
    shares = hidden_shares(tracks, memory.sides)
    for i in np.flatnonzero(~tracks.detected & (shares >= HIDDEN)).tolist():
        side, before = tracks.side[i], MotionBelief(tracks.mean[i], tracks.covariance[i])
        tracks.put(i, hidden_motion(coming[side], float(shares[i]), site.sides[side], before))


def _keep_likeliest(memory: Memory) -> None:
    """Keep the likeliest tracks; boxes and claims do not push out what is only heard."""
    tracks = memory.tracks
    if len(tracks) > MOST_TRACKS:
        order = np.lexsort((-tracks.existence, tracks.detected))
        memory.tracks = tracks.taken(np.sort(order[:MOST_TRACKS]))
        memory.counts.left_out += len(tracks) - MOST_TRACKS


def _announced_in_view(before: Memory, memory: Memory) -> list[int]:
    """Return the sides whose vehicle of before is in view now, from whichever side it came."""
    if not hidden_rows(before.tracks):
        return []
    seen = set(memory.tracks.id[memory.tracks.seen])
    told = (hidden_on(before.tracks, k) for k in range(len(before.history)))
    return [k for k, row in enumerate(told) if row is not None and before.tracks.id[row] in seen]


def _note_advisories(
    memory: Memory, held: Sequence[SideAdvisory | None], named: Sequence[SideAdvisory | None]
) -> None:
    """Note since when an advisory has been out on each side."""
    for side, old, new in zip(memory.history, held, named, strict=True):
        if new is None:
            side.advised_ns = None
        elif old is None or side.advised_ns is None:
            side.advised_ns = memory.stamp_ns
