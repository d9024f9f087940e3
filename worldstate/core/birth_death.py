"""Births, hand-overs and deaths of entities, those that have become one, and the events of all this."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter

import numpy as np

from worldstate.abduction.co_evidence import MOSTLY_MISSED
from worldstate.abduction.road_users import UNKNOWN, ClassShares
from worldstate.belief.association import EDGE_STD_RAD, GATE_RAD, HANDOVER_RESIDUAL
from worldstate.belief.kinematics.motion import AZIMUTH, LOG_RANGE
from worldstate.belief.settings import FilterSettings
from worldstate.belief.side_belief import TIE, SideBelief
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import NEVER_NS, Tracks, born, heard_as
from worldstate.belief.window_belief import ExplanationBelief, WindowBelief
from worldstate.ground import BoolArray
from worldstate.ground.values import nanoseconds, wrap_angle
from worldstate.measurement import Measurement
from worldstate.state import Event
from worldstate.state.entity import EventKind

from .memory import Memory

# After a hand-over no birth on its side: the window still holds the sound from before it.
_REARM_NS = nanoseconds(1.0)
_MASKED = 0.5  # Of the existence below which a hidden entity ends, beside a vehicle just come into view
HIDDEN = 0.5  # P(hidden | exists) from which on an entity is said to be
_LOST_RAD = 0.8  # Standard deviation; beyond, the azimuth is known to no more than half of the view
# Of two at one place; an entity that is found by itself within it is another one.
_ALONE_NS = nanoseconds(1.0)


def birth_death(
    memory: Memory, alarmed: Sequence[bool], measurement: Measurement, site: SiteGeometry
) -> None:
    """Let hidden entities be born, go on or end.

    Shapes: alarmed (K,).
    """
    tracks = memory.tracks
    heard = {hidden_on(tracks, k) for k in _sides(site)} - {None} if hidden_rows(tracks) else set()
    gone = [i for i in heard if i is not None and not _goes_on(memory, i, alarmed, measurement, site)]
    memory.tracks = tracks = tracks.without(gone)
    # Before births: another one is born on the side that it leaves.
    for i in _of_unknown_side(tracks):
        _put_on_its_side(tracks, i, memory.sides, site)
    for k in _sides_of_births(memory, alarmed, site) if measurement.heard.usable else ():
        _give_birth(memory, k, measurement, site)
    tracks = memory.tracks
    if len(hidden_rows(tracks)) != 1 or memory.sides.hidden_share(None) < HIDDEN:
        for i in _of_unknown_side(tracks):
            if tracks.of_side(i) is None:
                tracks.side_shares[i], tracks.existence[i] = (), memory.sides.existence(tracks.side[i])


def hidden_rows(tracks: Tracks) -> list[int]:
    """Return the rows of the hidden entities."""
    if tracks.seen.all():
        return []
    rows: list[int] = np.flatnonzero(~tracks.seen & (tracks.behind >= HIDDEN)).tolist()
    return rows


def _of_unknown_side(tracks: Tracks) -> list[int]:
    return [i for i, shares in enumerate(tracks.side_shares) if shares]


def _goes_on(
    memory: Memory, row: int, alarmed: Sequence[bool], measurement: Measurement, site: SiteGeometry
) -> bool:
    """Update a hidden entity by one more hop; tell whether it is still believed."""
    tracks = memory.tracks
    tracks.labels[row] = heard_as(tracks, row, measurement.kinds)
    if tracks.placed[row]:
        return True  # It was announced, and is there until its place is lost
    of_side = tracks.of_side(row)
    tracks.existence[row] = existence = memory.sides.existence(of_side)
    named = any(alarmed[k] for k in _sides(site) if of_side in (k, None))
    least = site.settings.death_probability
    # One that has just come into view on the other side masks it: that its chance is low by then is less
    # evidence against it.
    if of_side is not None and memory.sequence is not None and memory.sequence.just_emerged(but=of_side):
        least *= _MASKED
    return existence >= least or named


def _sides_of_births(memory: Memory, alarmed: Sequence[bool], site: SiteGeometry) -> list[int]:
    """Return the sides on which a hidden entity is born: of one vehicle the likelier one."""
    tracks, sides, least = memory.tracks, memory.sides, site.settings.birth_probability
    hidden, rearmed = hidden_rows(tracks), _rearmed(memory)
    if sides.both is not None and not hidden and all(rearmed):
        some = sides.hidden_on(None) >= least or any(alarmed)
        return [max(_sides(site), key=sides.hidden_on)] if some else []
    if sides.both is not None and sides.both < least and any(tracks.of_side(i) is None for i in hidden):
        return []
    taken = set(tracks.side[hidden].tolist())
    likely = [sides.hidden[k] >= least or alarmed[k] for k in _sides(site)]
    return [k for k in _sides(site) if likely[k] and rearmed[k] and k not in taken]


def _give_birth(memory: Memory, k: int, measurement: Measurement, site: SiteGeometry) -> None:
    """Add one more hidden entity on a side, of unknown side where it is the only one."""
    tracks, sides, shares = memory.tracks, memory.sides, tuple[float, ...]()
    # After a hand-over it is another one, of the other side.
    if sides.both is not None and not hidden_rows(tracks) and all(_rearmed(memory)):
        shares = sides.side_shares(site.settings.death_probability)
    one = born(site.sides[k].label, memory.history[k].births, 0.0, measurement.stamp_ns, site)
    memory.history[k].births += 1
    # What came into view from here before was another vehicle: the new one starts without its mass.
    if isinstance(memory.belief, WindowBelief):
        memory.belief = memory.belief.map(partial(ExplanationBelief.forget_origin, direction=k))
    one = replace(
        one,
        side=k,
        came_from=1.0,
        existence=min(sides.hidden[k], 1.0),
        motion=site.sides[k].prior(),
        # A detector adds to the kinds at the hand-over.
        labels=measurement.kinds or one.labels,
        sources=(measurement.source,),
        side_shares=shares,
    )
    memory.tracks = tracks.joined([one])
    _put_on_its_side(memory.tracks, len(tracks), sides, site)


def _put_on_its_side(tracks: Tracks, row: int, sides: SideBelief, site: SiteGeometry) -> None:
    """Put an entity of unknown side on its likelier one; in a tie it stays, which rounding must not undo."""
    if tracks.of_side(row) is not None:
        tracks.side_shares[row] = ()
        return
    shares = sides.side_shares(site.settings.death_probability)
    if shares[tracks.side[row]] < max(shares) * (1.0 - TIE):
        side = shares.index(max(shares))
        tracks.side[row] = side
        tracks.put(row, site.sides[side].prior())
    tracks.side_shares[row], tracks.existence[row] = shares, sides.existence(None)


def _rearmed(memory: Memory) -> list[bool]:
    stamps_ns = (one.handover_ns for one in memory.history)
    return [ns is None or memory.stamp_ns - ns > _REARM_NS for ns in stamps_ns]


def _sides(site: SiteGeometry) -> range:
    return range(len(site.sides))


def merge_tracks(memory: Memory, site: SiteGeometry) -> dict[str, str]:
    """Merge tracks that have become one; return by the ids that end those that go on.

    Of two at one place, of the same class, one has just been found and the other not for a second. They go
    on where the first is, under the id that was known earlier; so do the halves of one of unknown side.
    """
    tracks, stamp_ns, into, ended = memory.tracks, memory.stamp_ns, dict[str, str](), list[int]()
    hidden = hidden_rows(tracks)
    if _are_halves(tracks, hidden, memory.sides, site):
        first, second = sorted(hidden, key=partial(_age, tracks))
        tracks.side_shares[first] = memory.sides.side_shares(site.settings.death_probability)
        _put_on_its_side(tracks, first, memory.sides, site)
        ended.append(second)
        into[tracks.id[second]] = tracks.id[first]
    lost = tracks.seen & (tracks.last_seen_ns <= stamp_ns - _ALONE_NS) & (tracks.behind < HIDDEN)
    for other in np.flatnonzero(lost).tolist():
        found = np.flatnonzero(tracks.seen & (tracks.last_seen_ns == stamp_ns)).tolist()
        apart = np.abs(wrap_angle(tracks.mean[:, AZIMUTH] - tracks.mean[other, AZIMUTH]))
        # The nearest: the first of several would be another one in a mirror.
        there = [i for i in found if _at_one_place(tracks, i, other)]
        same = min(there, key=apart.__getitem__, default=None)
        if same is not None:
            first, second = sorted((same, other), key=partial(_age, tracks))
            into[tracks.id[second]] = tracks.id[first]
            tracks.existence[same] = max(tracks.existence[same], tracks.existence[other])
            for column in (tracks.id, tracks.created_ns, tracks.came_from):
                column[same] = column[first]
            ended.append(other)
    memory.tracks = tracks.without(ended)
    return into


def _age(tracks: Tracks, row: int) -> tuple[int, str]:
    return tracks.created_ns[row], tracks.id[row]


def _are_halves(tracks: Tracks, hidden: list[int], sides: SideBelief, site: SiteGeometry) -> bool:
    r"""Tell whether two entities that are only heard are one, by the joint of both sides.

    .. math:: P(C_k, C_j) < p_{birth}^2

    which is less than two vehicles have that are each believed just enough to be born.
    """
    if len(hidden) != 2 or told_apart(tracks)[hidden].any() or len(set(tracks.side[hidden])) != 2:
        return False
    behind = all(sides.hidden_share(tracks.side[i]) >= HIDDEN for i in hidden)
    return behind and sides.both is not None and sides.both < site.settings.birth_probability**2


def told_apart(tracks: Tracks) -> BoolArray:
    """Return which were told apart from others: by a message, or since they were seen."""
    return np.asarray(tracks.detected | (tracks.last_seen_ns != NEVER_NS))


def _at_one_place(tracks: Tracks, one: int, other: int) -> bool:
    """Tell whether two tracks of one class stand within each other's deviations of azimuth and range.

    One that has left the view is soon anywhere in it: beyond the gate no sighting would have been its own.
    """
    gap = tracks.mean[one] - tracks.mean[other]
    gap[AZIMUTH] = wrap_angle(gap[AZIMUTH])
    variance = (tracks.covariance[one] + tracks.covariance[other]).diagonal()
    near = abs(gap[AZIMUTH]) <= GATE_RAD and all(gap[k] ** 2 <= variance[k] for k in (AZIMUTH, LOG_RANGE))
    alike = _likeliest(tracks.labels[one]) == _likeliest(tracks.labels[other])
    return near and alike and bool(tracks.moving[one] == tracks.moving[other])


def _likeliest(labels: ClassShares) -> str:
    return max(labels, key=itemgetter(1), default=(UNKNOWN, 1.0))[0]


def hidden_on(tracks: Tracks, k: int) -> int | None:
    """Return the row of the likeliest hidden entity of a side, or of one that may be there, if any is."""
    there = [i for i in hidden_rows(tracks) if _may_be_on(tracks, i, k)]
    return max(there, key=lambda i: (tracks.side[i] == k, tracks.existence[i]), default=None)


def _may_be_on(tracks: Tracks, row: int, side: int) -> bool:
    of_side = tracks.of_side(row)
    return bool(tracks.side_shares[row][side] > 0.0) if of_side is None else of_side == side


# Of one step. The deaths and births of a whole street are fewer; a snapshot stays of bounded size.
MOST_EVENTS = 64


def published(tracks: Tracks, settings: FilterSettings) -> Tracks:
    """Return the tracks that a snapshot names."""
    # A refuted claim is remembered while it is repeated: forgotten, it would be believed anew.
    refuted = tracks.placed & (tracks.existence < settings.delete_existence)
    return tracks.taken(~refuted) if refuted.any() else tracks


def events_between(before: Tracks, after: Tracks, steps: Sequence[Memory]) -> tuple[Event, ...]:
    """Return what became of every entity, those that were there before first; `steps` hold their merges."""
    stamp_ns = steps[-1].stamp_ns
    into = {one.entity_id: one.into for step in steps for one in step.last.events if one.into}
    was_in_view, in_view = ((one.seen & (one.behind < HIDDEN)).tolist() for one in (before, after))
    left = dict(zip(after.id, zip(in_view, after.answer, strict=True), strict=True))
    events = list[Event]()
    for name, was_seen, answer in zip(before.id, was_in_view, before.answer, strict=True):
        seen, said = left.pop(name, (None, None))
        kind: EventKind | None = None
        if seen is None:
            kind = "merged" if name in into else "died"
        elif seen != was_seen:
            kind = "handed_over" if seen else "hidden_again"
        elif seen and answer == "visible" != said:
            kind = "coasting"
        if kind is not None:
            events.append(Event(stamp_ns, kind, name, into.get(name)))
    events += (Event(stamp_ns, "born", name) for name in left)
    return tuple(events[:MOST_EVENTS])


def after_look(
    memory: Memory, emerged: Mapping[int, float], known: int, stamp_ns: int, site: SiteGeometry
) -> None:
    """Update the memory after a look; entities beyond the first so many, which were known, are new.

    `emerged` is the chance that a detection was theirs, by the rows of those that were not seen before.
    """
    tracks = memory.tracks
    # Of the side where it is: what was heard may have been believed on the other one. Of two the likelier.
    residuals = [(max(HANDOVER_RESIDUAL, 1.0 - chance), int(tracks.side[i])) for i, chance in emerged.items()]
    handed_over = {side: residual for residual, side in sorted(residuals, reverse=True)}
    # First seen near an edge, it came past it unheard.
    unheard = set[int]()
    for i in range(known, len(tracks)):
        side = int(tracks.side[i])
        apart_rad = site.sides[side].distance_rad(float(tracks.mean[i, AZIMUTH]), float(tracks.width_rad[i]))
        if tracks.seen[i] and tracks.moving[i] and apart_rad <= 2.0 * EDGE_STD_RAD:
            unheard.add(side)
    memory.tracks = surviving(tracks, site.settings)
    past_edges(memory, handed_over, unheard, stamp_ns)


def past_edges(
    memory: Memory, handed_over: Mapping[int, float], unheard: Collection[int], stamp_ns: int
) -> None:
    """Update the memory after vehicles came past the edges of some sides: the one place that tells of it.

    `handed_over` is P(it was another vehicle than the one believed hidden there), by side; `unheard` are
    sides from which one came that was not believed.
    """
    if not handed_over and not unheard:
        return
    if isinstance(memory.belief, WindowBelief):
        for side, residual in handed_over.items():
            emerge = partial(ExplanationBelief.emerge, direction=side, residual=residual)
            memory.belief = memory.belief.map(emerge)
    else:
        tracks, hidden = memory.tracks, ~memory.tracks.seen
        # One that is still believed hidden where another came from was not what came.
        left = {k: float(k in tracks.side[hidden]) for k in unheard}
        apart = set(tracks.side[hidden & told_apart(tracks)].tolist())
        memory.belief = memory.belief.handed_over(left | dict(handed_over), apart, stamp_ns)
    for side in handed_over:
        memory.history[side].handover_ns = stamp_ns


def surviving(tracks: Tracks, settings: FilterSettings) -> Tracks:
    """Return the tracks without seen entities of too little existence or too uncertain azimuth.

    What a camera would mostly miss is not lost for being missed: its existence says how long it is believed.
    """
    known = tracks.covariance[:, AZIMUTH, AZIMUTH] <= _LOST_RAD**2
    known |= tracks.miss_rate > MOSTLY_MISSED
    kept = known & (tracks.existence >= settings.delete_existence) | ~tracks.seen
    return tracks if kept.all() else tracks.taken(kept)
