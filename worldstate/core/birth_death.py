"""Births, hand-overs, merges and deaths of entities, and the events that report them."""

from collections.abc import Mapping, Sequence, Set

from worldstate.abduction.co_evidence import MOSTLY_MISSED
from worldstate.belief.hidden_bearing import hidden_motion, motion_in_view
from worldstate.belief.kinematics.motion import AZIMUTH, MotionBelief
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.street_model import StreetModel
from worldstate.belief.track import NEVER_NS, Track, Tracks, born, heard_as
from worldstate.ground import TINY, replaced
from worldstate.measurement import Measurement
from worldstate.state import Event
from worldstate.state.entity import EventKind

from .memory import MOST_BOXES, Memory

HIDDEN = 0.5  # P(hidden | exists) from which an entity is published as hidden


def birth_death(
    memory: Memory, alarmed: Sequence[bool], measurement: Measurement, site: SiteGeometry
) -> None:
    """Create and remove sound-only entities.

    Shapes: alarmed (K,).
    """
    tracks = memory.tracks
    for i in _heard_rows(tracks):
        tracks.labels[i] = heard_as(tracks, i, measurement.kinds, site.street)
    memory.tracks = tracks.without([i for i in _heard_rows(tracks) if _ends(memory, i, alarmed, site)])
    side = _side_of_birth(memory, alarmed, site) if measurement.heard.usable else None
    if side is not None:
        one = born_hidden(memory, side, 0.0, measurement.stamp_ns, measurement.source, site)
        # At the hand-over a detector refines the classes.
        labels, motion = measurement.kinds or one.labels, site.sides[side].prior()
        memory.tracks = memory.tracks.joined([replaced(one, labels=labels, motion=motion)])
    view_heard(memory, site)


def born_hidden(
    memory: Memory, side: int, existence: float, stamp_ns: int, source: str, site: SiteGeometry
) -> Track:
    """Return a new hidden entity on a side."""
    one = born(site.sides[side].label, memory.history[side].births, existence, stamp_ns, site)
    memory.history[side].births += 1
    return replaced(one, side=side, came_from=1.0, sources=(source,))


def view_heard(memory: Memory, site: SiteGeometry) -> None:
    """Set the sound-only entities from the belief over the sides.

    Existence, P(hidden), side and azimuth are marginals of the belief. The entity itself keeps only its
    identity, classes and approach rate. A single entity may be on any side; two are on one side each.
    """
    tracks, belief, rows = memory.tracks, memory.belief, _heard_rows(memory.tracks)
    if not rows:
        return
    sides = _unseen(memory, site)
    for i in rows:
        shares = sides.side_shares(site.street.death) if len(rows) == 1 else ()
        is_open = sum([share > 0.0 for share in shares]) > 1
        # In a tie the side is kept; the tolerance prevents a change by rounding.
        if shares and shares[tracks.side[i]] < max(shares) * (1.0 - TINY):
            tracks.side[i] = shares.index(max(shares))
            if tracks.behind[i] >= HIDDEN:
                tracks.put(i, site.sides[tracks.side[i]].prior())
        of_side, was_hidden = None if is_open else int(tracks.side[i]), bool(tracks.behind[i] >= HIDDEN)
        tracks.side_shares[i] = shares if is_open else ()
        tracks.existence[i], tracks.behind[i] = sides.existence(of_side), sides.hidden_share(of_side)
        side, before = int(tracks.side[i]), MotionBelief(tracks.mean[i], tracks.covariance[i])
        if belief.has_times and was_hidden and tracks.behind[i] < HIDDEN:
            own = shares or tuple(float(k == side) for k in range(len(site.sides)))
            tracks.put(i, motion_in_view(belief.coming, own, site, before))
        elif belief.has_times and was_hidden:
            motion = hidden_motion(belief.coming[side], float(tracks.behind[i]), site.sides[side], before)
            tracks.put(i, motion)


def _unseen(memory: Memory, site: SiteGeometry) -> SideBelief:
    """Return the belief over the sides without vehicles that have just come into view and have tracks."""
    sides, found = memory.belief.sides, memory.belief.emerged_since(memory.stamp_ns, site.street.beside_s)
    emerged = tuple([0.0 if own else one for own, one in zip(found, sides.emerged, strict=True)])
    return replaced(sides, emerged=emerged)


def _heard_rows(tracks: Tracks) -> list[int]:
    rows: list[int] = (~tracks.detected).nonzero()[0].tolist()
    return rows


def hidden_rows(tracks: Tracks) -> list[int]:
    """Return the rows of the hidden entities."""
    if False not in tracks.seen:
        return []
    rows: list[int] = (~tracks.seen & (~tracks.detected | (tracks.behind >= HIDDEN))).nonzero()[0].tolist()
    return rows


def _ends(memory: Memory, row: int, alarmed: Sequence[bool], site: SiteGeometry) -> bool:
    """Return whether a sound-only entity has become too unlikely."""
    least, of_side = site.street.death, int(memory.tracks.side[row])
    several = len(_heard_rows(memory.tracks)) > 1
    existence = _unseen(memory, site).existence(of_side if several else None)
    return existence < least and not (alarmed[of_side] if several else any(alarmed))


def _side_of_birth(memory: Memory, alarmed: Sequence[bool], site: SiteGeometry) -> int | None:
    """Return the side on which a hidden entity is born, or None; a single vehicle gets the likelier side."""
    tracks, belief, least = memory.tracks, memory.belief, site.street.birth
    heard, sides, every = _heard_rows(tracks), belief.sides, range(len(site.sides))
    # After a vehicle has come into view, the window still contains its earlier sound.
    masked = belief.emerged_since(memory.stamp_ns, site.street.masked_s)
    taken = {int(tracks.side[i]) for i in hidden_rows(tracks)}
    if heard and (len(heard) > 1 or sides.both < least):
        return None
    if not taken and not any(masked) and (sides.hidden_on(None) >= least or any(alarmed)):
        return max(every, key=sides.hidden_on)
    # If no sensor looks, a vehicle may be in view by its sound alone.
    if not heard and not any(masked) and max(belief.shown) >= least:
        return max(every, key=belief.shown.__getitem__)
    free = [k for k in every if not masked[k] and k not in taken and (sides.hidden[k] >= least or alarmed[k])]
    return max(free, key=sides.hidden_on, default=None)


def merge_tracks(memory: Memory, site: SiteGeometry) -> tuple[Event, ...]:
    """Merge two sound-only entities if two vehicles are unlikely; return the events."""
    tracks, heard = memory.tracks, _heard_rows(memory.tracks)
    least = site.street.birth * min((tracks.existence[i] for i in heard), default=0.0)
    # If P(both) is lower, the second vehicle would be too unlikely to be born, given the less likely of the
    # two.
    if len(heard) < 2 or memory.belief.sides.both >= least:
        return ()
    age = [(-tracks.existence[i], tracks.created_ns[i], tracks.id[i]) for i in heard]
    first, second, *_ = (heard[k] for k in sorted(range(len(heard)), key=age.__getitem__))
    memory.tracks = tracks.without([second])
    view_heard(memory, site)
    return (Event(memory.stamp_ns, "merged", tracks.id[second], tracks.id[first]),)


def hidden_on(tracks: Tracks, k: int) -> int | None:
    """Return the row of the likeliest hidden entity that is, or may be, on a side; None if there is none."""
    there = [
        i
        for i in hidden_rows(tracks)
        if (tracks.side[i] == k if tracks.detected[i] or not (of := tracks.side_shares[i]) else of[k] > 0.0)
    ]
    return max(there, key=lambda i: (tracks.side[i] == k, tracks.existence[i]), default=None)


# Per step, to limit the size of a snapshot; a whole street has fewer deaths and births.
MOST_EVENTS = MOST_BOXES


def published(tracks: Tracks, street: StreetModel) -> Tracks:
    """Return the tracks that a snapshot lists."""
    # A refuted message is kept while it is repeated; otherwise its next repetition would count as new
    # evidence.
    refuted = tracks.placed & (tracks.existence < street.death)
    return tracks.taken(~refuted) if True in refuted else tracks


def events_between(before: Tracks, after: Tracks, steps: Sequence[Memory]) -> tuple[Event, ...]:
    """Return the events of all entities, old ones first; `steps` contain the merges."""
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
    """Update the memory after a look; entities from row `known` on are new.

    `emerged` maps rows that come into view to the chance that the detection belongs to them.
    """
    tracks, sides, least = memory.tracks, memory.tracks.side.tolist(), site.street.unheard
    # The detection determines the side, since the belief may have been on another one. Of two entities, the
    # likelier one is used.
    residuals = [(max(least, 1.0 - chance), sides[i]) for i, chance in emerged.items()]
    handed_over = {side: residual for residual, side in sorted(residuals, reverse=True)}
    # A moving vehicle that is first seen near an edge came past this edge unnoticed.
    unheard = set[int]()
    for i in range(known, len(tracks)):
        side = site.sides[sides[i]]
        apart_rad = side.distance_rad(float(tracks.mean[i, AZIMUTH]), float(tracks.width_rad[i]))
        if side.hides and tracks.seen[i] and tracks.moving[i] and apart_rad <= 2.0 * site.street.edge_std_rad:
            unheard.add(sides[i])
    memory.tracks = surviving(tracks, site.street)
    past_edges(memory, handed_over, unheard, stamp_ns, site.street)


def past_edges(
    memory: Memory, handed_over: Mapping[int, float], unheard: Set[int], stamp_ns: int, street: StreetModel
) -> None:
    """Update the memory after vehicles came past the edges of some sides.

    `handed_over` is P(it was another vehicle than the one believed hidden there), by side. `unheard` contains
    the sides from which an unexpected vehicle came.
    """
    if not handed_over and not unheard:
        return
    tracks, hidden = memory.tracks, ~memory.tracks.seen
    # If an entity is still believed hidden on the side, another vehicle came.
    came = {k: float(k in tracks.side[hidden]) for k in unheard} | dict(handed_over)
    # Entities that are distinct from others: announced by a message, or seen before.
    apart = hidden & (tracks.detected | (tracks.last_seen_ns != NEVER_NS))
    memory.belief = memory.belief.handed_over(came, set(tracks.side[apart].tolist()), stamp_ns, street)


def surviving(tracks: Tracks, street: StreetModel) -> Tracks:
    """Return the tracks without seen entities of low existence or uncertain azimuth.

    An entity that a camera would mostly miss is kept for as long as its existence is high enough.
    """
    known = tracks.covariance[:, AZIMUTH, AZIMUTH] <= (2.0 * street.past_std_rad) ** 2
    known |= tracks.miss_rate > MOSTLY_MISSED
    kept = known & (tracks.existence >= street.death) | ~tracks.seen
    return tracks.taken(kept) if False in kept else tracks
