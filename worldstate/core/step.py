"""One step of the filter: predict the memory to a later time, and update it with a measurement."""

from collections.abc import Iterable, Sequence

import numpy as np

from worldstate.belief.kinematics.cartesian import corrected, driven
from worldstate.belief.sound_tracks import faded, followed
from worldstate.belief.track import Tracks, predict_tracks, turn
from worldstate.ground.values import NotUsable, seconds
from worldstate.measurement import CameraLook, Measurement, Odometry, PositionScan

from .acoustic_update import acoustic_update
from .birth_death import (
    birth_death,
    hidden_on,
    hidden_rows,
    merge_tracks,
    past_edges,
    published,
    surviving,
    view_heard,
)
from .cues import SideAlarms, note_source
from .detection_update import new_looks, update_looks, update_positions
from .fixed_lag import Timed
from .memory import CountedLook, Memory
from .relations import relations_at
from .site_model import FilterModel, from_here, without_open_sides
from .street_belief import carried, informed

# Two cameras and a radio find fewer at a crowded crossing; the time of a step grows with the square.
MOST_TRACKS = 128


def advanced(memory: Memory, stamp_ns: int, model: FilterModel) -> Memory:
    """Return a draft of the memory, predicted to a later time."""
    before, memory, step_ns = memory, memory.draft(), stamp_ns - memory.stamp_ns
    # First, because the edges move with the ego vehicle, and they determine which vehicles have come into
    # view.
    memory.ego = memory.ego and driven(memory.ego, seconds(step_ns))
    model = from_here(model, memory.ego)
    predict_tracks(memory.tracks, seconds(step_ns), model.site)
    memory.tracks = surviving(memory.tracks, model.site.street)
    memory.stamp_ns = stamp_ns
    memory.forget()
    memory.belief = carried(memory.belief, stamp_ns, step_ns, model.context, model.site.street)
    view_heard(memory, model.site)
    memory.sounds = faded(memory.sounds, seconds(step_ns), model.site.street)
    if True in before.tracks.placed & ~before.tracks.seen:
        _pass_places(before.tracks, memory, model)
    return memory


def _pass_places(before: Tracks, memory: Memory, model: FilterModel) -> None:
    """Update the memory after announced entities have passed their edge or have lost their position."""
    tracks, street, emerged, gone = memory.tracks, model.site.street, list[int](), list[int]()
    now = {name: row for row, name in enumerate(tracks.id)}
    # Without a position it would become a sound-only entity; on a side without sound it is removed.
    heard = [chance >= street.birth for chance in memory.belief.sides.hidden]
    for old in (before.placed & ~before.seen).nonzero()[0].tolist():
        row, side = now[before.id[old]], int(before.side[old])
        if before.behind[old] >= 0.5 > tracks.behind[row]:
            emerged.append(side)
        only_heard = (~tracks.detected & (tracks.side == side)).nonzero()[0].tolist()
        others = set(only_heard).difference(gone)
        if row in others and (len(others) > 1 or not heard[side]):
            gone.append(row)
    memory.tracks = tracks.without(gone)
    past_edges(memory, dict.fromkeys(emerged, street.unheard), set(), memory.stamp_ns, street)


def take_in(before: Memory, memory: Memory, measurement: Timed, start_ns: int, model: FilterModel) -> None:
    """Update a draft with a measurement of its time; `before` is the memory before the draft."""
    model = from_here(model, memory.ego)
    stood = _standing(before, memory, model)
    _perceive(memory, measurement, start_ns, model)
    emerged = _announced_in_view(before, memory)
    if emerged:
        memory.belief = memory.belief.not_held(emerged, model.policy, model.site.street)
    alarms = SideAlarms(memory, model)
    alarms.note_announced()
    stands = [one is not None for one in alarms.advisories]
    if isinstance(measurement, Measurement) and model.reads_sound:
        birth_death(memory, stands, measurement, model.site)
    _keep_likeliest(memory)
    _note_advisories(memory, [one and k not in emerged for k, one in enumerate(stood)], stands)
    memory.last.events = merge_tracks(memory, model.site)
    memory.relations = relations_at(memory, published(memory.tracks, model.site.street), model)


def _standing(before: Memory, memory: Memory, model: FilterModel) -> list[bool]:
    """Return which sides have an advisory before a measurement is applied.

    An advisory that ended by the time of the draft starts anew.
    """
    stood = [one.advised_ns is not None for one in before.history]
    return [one is not None for one in SideAlarms(memory, model).advisories] if any(stood) else stood


def _perceive(memory: Memory, measurement: Timed, start_ns: int, model: FilterModel) -> None:
    memory.counts.measurements += 1
    if isinstance(measurement, Odometry):
        _take_odometry(memory, measurement)
    elif isinstance(measurement, PositionScan):
        update_positions(memory, measurement, model)
    else:
        _hear_and_look(memory, without_open_sides(measurement, model.context), start_ns, model)


def _hear_and_look(memory: Memory, measurement: Measurement, start_ns: int, model: FilterModel) -> None:
    last, site = memory.sources.get(measurement.source), model.site
    since_ns = measurement.stamp_ns - (start_ns if last is None else last.stamp_ns)
    # Windows overlap, so only the new part has weight.
    new_s = max(seconds(since_ns), 0.0)
    weight = min(new_s / site.settings.window_s, 1.0)
    measurement, looks = new_looks(memory, measurement, start_ns, site.street)
    acoustic_update(memory, measurement, weight, site)
    if not model.reads_sound:
        memory.sounds = followed(memory.sounds, measurement, new_s, site.street)
    update_looks(memory, measurement, looks, model)
    note_source(memory, measurement, model)
    _update_belief(memory, measurement, [seen for seen, _ in looks], model)
    bearing = measurement.bearing
    memory.last.bearing = None if isinstance(bearing, NotUsable) else bearing
    memory.last.domain, memory.last.named = measurement.domain, measurement.signature.directions


def _update_belief(
    memory: Memory, measurement: Measurement, looks: Iterable[CameraLook], model: FilterModel
) -> None:
    """Update the belief over the sides with the evidence and the looks of a measurement."""
    said, site, memory.last.predicted = measurement.sequence, model.site, memory.belief.joint.explanations
    seen = map(site.in_sight, looks)
    memory.belief = informed(memory.belief, measurement, seen, model.context, model.policy, site.settings)
    if said is not None:  # Other sources leave it unchanged
        memory.last.no_sequence = said if isinstance(said, NotUsable) else None


def _take_odometry(memory: Memory, told: Odometry) -> None:
    """Update a draft with odometry; azimuth rates refer to axes that turn with the ego vehicle."""
    before, memory.ego = memory.ego, corrected(memory.ego, told)
    faster = memory.ego.yaw_rate_rad_s - (0.0 if before is None else before.yaw_rate_rad_s)
    if faster:
        turn(memory.tracks, faster)
    memory.looks[told.source] = CountedLook(told.stamp_ns, told.source)


def _keep_likeliest(memory: Memory) -> None:
    """Keep the likeliest tracks; boxes and messages do not displace sound-only entities."""
    tracks = memory.tracks
    if len(tracks) > MOST_TRACKS:
        order = np.lexsort((-tracks.existence, tracks.detected))
        memory.tracks = tracks.taken(np.sort(order[:MOST_TRACKS]))
        memory.counts.left_out += len(tracks) - MOST_TRACKS


def _announced_in_view(before: Memory, memory: Memory) -> list[int]:
    """Return the sides whose earlier hidden vehicle is in view now, from whichever side it came."""
    if not hidden_rows(before.tracks):
        return []
    seen = set(memory.tracks.id[memory.tracks.seen])
    told = [hidden_on(before.tracks, k) for k in range(len(before.history))]
    return [k for k, row in enumerate(told) if row is not None and before.tracks.id[row] in seen]


def _note_advisories(memory: Memory, stood: Sequence[bool], stands: Sequence[bool]) -> None:
    for side, was_out, is_out in zip(memory.history, stood, stands, strict=True):
        if not is_out:
            side.advised_ns = None
        elif not was_out or side.advised_ns is None:
            side.advised_ns = memory.stamp_ns
