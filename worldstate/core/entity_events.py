"""What became of entities between two steps, as events."""

from worldstate.belief.settings import FilterSettings
from worldstate.belief.track import Track
from worldstate.state import Event
from worldstate.state.event import EventKind

# Of one step. The deaths and births of a whole street are fewer; a snapshot stays of bounded size.
MOST_EVENTS = 64


def published(tracks: tuple[Track, ...], settings: FilterSettings) -> tuple[Track, ...]:
    """Return the tracks that a snapshot names."""
    # A refuted claim is remembered while it is repeated: forgotten, it would be believed anew.
    return tuple(one for one in tracks if not one.place or one.existence >= settings.delete_existence)


def events_between(before: tuple[Track, ...], after: tuple[Track, ...], stamp_ns: int) -> tuple[Event, ...]:
    """Return what became of every entity, those that were there before first."""
    known, left = {track.id: track for track in before}, {track.id: track for track in after}
    kinds = {name: _became(track, left.get(name)) for name, track in known.items()}
    kinds |= {name: "born" for name in left if name not in known}
    events = (Event(stamp_ns, kind, name) for name, kind in kinds.items() if kind is not None)
    return tuple(events)[:MOST_EVENTS]


def _became(before: Track, after: Track | None) -> EventKind | None:
    if after is None:
        return "died"
    if before.seen != after.seen:
        return "handed_over" if after.seen else "hidden_again"
    lost = after.seen and before.answer == "visible" != after.answer
    return "coasting" if lost else None
