"""What became of entities between two steps, as events, and since when their relations hold."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from worldstate.belief.acoustic_update import hidden_share
from worldstate.belief.settings import FilterSettings
from worldstate.belief.site_geometry import normal_share
from worldstate.belief.track import Track
from worldstate.ground.values import nanoseconds
from worldstate.state import Context, Event, Relation
from worldstate.state.event import EventKind
from worldstate.state.relation import EGO

from .memory import Memory

# Of one step. The deaths and births of a whole street are fewer; a snapshot stays of bounded size.
MOST_EVENTS = 64
# A window of sound, and the second for which an advisory holds an entity that is no longer heard.
_HALF_NS = nanoseconds(2.0)
HIDDEN = _HOLDS = 0.5  # P(hidden | exists) from which on an entity is said to be; as relations hold
_KEPT_NS = nanoseconds(5.0)  # Of a relation that has ended


def published(tracks: tuple[Track, ...], settings: FilterSettings) -> tuple[Track, ...]:
    """Return the tracks that a snapshot names."""
    # A refuted claim is remembered while it is repeated: forgotten, it would be believed anew.
    return tuple(one for one in tracks if not one.place or one.existence >= settings.delete_existence)


def events_between(
    before: tuple[Track, ...], after: tuple[Track, ...], stamp_ns: int, into: Mapping[str, str]
) -> tuple[Event, ...]:
    """Return what became of every entity, those that were there before first; `into` by merged ids."""
    known, left = {track.id: track for track in before}, {track.id: track for track in after}
    kinds = {name: "merged" if name in into else _became(one, left.get(name)) for name, one in known.items()}
    kinds |= {name: "born" for name in left if name not in known}
    events = (Event(stamp_ns, kind, name, into.get(name)) for name, kind in kinds.items() if kind is not None)
    return tuple(events)[:MOST_EVENTS]


def halves_of_one(before: Memory, after: Memory) -> dict[str, str]:
    """Return as whom those go on who were heard on the other side of one that has just come into view.

    Within two seconds of that they have ended, or sound as if they were in view.
    """
    still = {one.id for one in after.tracks if one.detected or hidden_share(one, after.sides) >= HIDDEN}
    halves = [one for one in before.tracks if not one.detected and one.id not in still]
    sides = {k for k, ns in enumerate(after.handover_ns) if ns and after.stamp_ns - ns <= _HALF_NS}
    seen = [one for one in after.tracks if one.seen and one.was_hidden]
    latest = max(seen, key=lambda one: one.last_seen_ns or 0, default=None)
    return {} if latest is None else {one.id: latest.id for one in halves if sides - {one.side}}


def _became(before: Track, after: Track | None) -> EventKind | None:
    if after is None:
        return "died"
    if before.seen != after.seen:
        return "handed_over" if after.seen else "hidden_again"
    return "coasting" if after.seen and before.answer == "visible" != after.answer else None


def relations_at(memory: Memory, tracks: Sequence[Track], context: Context) -> tuple[Relation, ...]:
    """Return the relations of some tracks, with the interval in which each has held."""
    before = {(one.src, one.dst, one.kind): one for one in memory.relations}
    now = {(one.src, one.dst, one.kind): one for track in tracks for one in _edges(track, memory, context)}
    names = {track.id for track in tracks}
    for key, edge in before.items():
        if key not in now and edge.src in names:
            now[key] = Relation(*key, 0.0, memory.stamp_ns)
    held = (_held(edge, before.get(key)) for key, edge in now.items())
    return tuple(edge for edge in held if edge.probability or edge.until_ns is not None)


def _held(edge: Relation, before: Relation | None) -> Relation:
    """Return a relation with the interval in which it has held; the last one is kept for five seconds."""
    since_ns, until_ns = (None, None) if before is None else (before.since_ns, before.until_ns)
    if edge.probability >= _HOLDS:
        begins = since_ns is None or until_ns is not None
        return replace(edge, since_ns=edge.stamp_ns if begins else since_ns)
    until_ns = edge.stamp_ns if until_ns is None else until_ns
    if since_ns is None or edge.stamp_ns - until_ns > _KEPT_NS:
        return edge
    return replace(edge, since_ns=since_ns, until_ns=until_ns)


def _edges(track: Track, memory: Memory, context: Context) -> Iterator[Relation]:
    """Yield the relations of one entity to its occluder and to the ego vehicle."""
    occluder, stamp_ns = context.occluders[track.side].id, memory.stamp_ns
    if not track.seen:
        yield Relation(track.id, occluder, "occluded_by", hidden_share(track, memory.sides), stamp_ns)
    elif track.was_hidden:
        yield Relation(track.id, occluder, "emerged_from", 1.0, stamp_ns)
    if track.approach_heard:
        deviations = track.motion.inverse_tta_hz / track.motion.inverse_tta_std_hz
        yield Relation(track.id, EGO, "approaching", normal_share(deviations), stamp_ns)
