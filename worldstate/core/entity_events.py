"""What became of entities between two steps, as events."""

from collections.abc import Mapping

from worldstate.belief.settings import FilterSettings
from worldstate.belief.track import Track, hidden_share
from worldstate.ground.values import nanoseconds
from worldstate.state import Event
from worldstate.state.entity import EventKind

from .memory import Memory

# Of one step. The deaths and births of a whole street are fewer; a snapshot stays of bounded size.
MOST_EVENTS = 64
# A window of sound, and the second for which an advisory holds an entity that is no longer heard.
_HALF_NS = nanoseconds(2.0)
HIDDEN = 0.5  # P(hidden | exists) from which on an entity is said to be


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
