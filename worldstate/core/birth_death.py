"""Births, hand-overs and deaths of entities, those that have become one, and the events of all this."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter, itemgetter

from worldstate.abduction.road_users import UNKNOWN
from worldstate.belief.association import EDGE_STD_RAD, GATE_RAD, HANDOVER_RESIDUAL, Association
from worldstate.belief.kinematics.motion import AZIMUTH, LOG_RANGE
from worldstate.belief.settings import FilterSettings
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import Track, born, heard_as
from worldstate.belief.window_belief import ExplanationBelief
from worldstate.ground.values import nanoseconds, wrap_angle
from worldstate.measurement.measurement import Measurement
from worldstate.state import Event
from worldstate.state.entity import EventKind

from .memory import Memory

# After a hand-over no birth on its side: the window still holds the sound from before it.
_REARM_NS = nanoseconds(1.0)
# A moving entity out of sight for so long may be the one now heard hidden nearby: more than one image at
# 10 Hz, since a single miss is no occlusion, and less than a following vehicle takes, which would get its id.
REOCCLUSION_NS, _REOCCLUSION_END_NS = nanoseconds(0.15), nanoseconds(3.0)
# From the edge that it was last seen near: less than the 64 degrees between the edges of a default junction.
_REOCCLUSION_RAD = 0.8
HIDDEN = 0.5  # P(hidden | exists) from which on an entity is said to be
_LOST_RAD = 0.8  # Standard deviation; beyond, the azimuth is known to no more than half of the view
# Of two at one place; an entity that is found by itself within it is another one.
_ALONE_NS = nanoseconds(1.0)
_AGE = attrgetter("created_ns", "id")


def birth_death(
    memory: Memory, alarmed: Sequence[bool], measurement: Measurement, site: SiteGeometry
) -> Memory:
    """Return the memory with hidden entities born, updated and removed.

    Shapes: alarmed (K,).
    """
    current = {
        None if one is None else one.id for one in map(partial(hidden_on, memory.tracks), _sides(site))
    }
    updated = (
        _heard_on(one, alarmed, measurement, memory.sides, site) if one.id in current else one
        for one in memory.tracks
    )
    # Before births: another one is born on the side that it leaves.
    tracks = (_on_its_side(one, memory.sides, site) for one in updated if one is not None)
    memory = replace(memory, tracks=tuple(tracks))
    for k in _sides_of_births(memory, alarmed, site):
        memory = _with_birth(memory, k, measurement, site)
    if len(_hidden(memory.tracks)) == 1 and memory.sides.hidden_share(None) >= HIDDEN:
        return memory
    return replace(memory, tracks=tuple(_of_known_side(one, memory.sides) for one in memory.tracks))


def _heard_on(
    track: Track, alarmed: Sequence[bool], measurement: Measurement, sides: SideBelief, site: SiteGeometry
) -> Track | None:
    """Return a hidden entity after one more hop; None where it is no longer believed."""
    track = replace(track, labels=heard_as(track, measurement.kinds))
    if track.place is not None:
        return track  # It was announced, and is there until its place is lost
    existence = sides.existence(track.of_side)
    named = any(alarmed[k] for k in _sides(site) if track.of_side in (k, None))
    return (
        replace(track, existence=existence) if existence >= site.settings.death_probability or named else None
    )


def _sides_of_births(memory: Memory, alarmed: Sequence[bool], site: SiteGeometry) -> list[int]:
    """Return the sides on which a hidden entity is born: of one vehicle the likelier one."""
    sides, least, hidden = memory.sides, site.settings.birth_probability, _hidden(memory.tracks)
    rearmed = _rearmed(memory)
    if sides.both is not None and not hidden and all(rearmed):
        some = sides.hidden_on(None) >= least or any(alarmed)
        return [max(_sides(site), key=sides.hidden_on)] if some else []
    if sides.both is not None and sides.both < least and any(one.of_side is None for one in hidden):
        return []
    likely = (sides.hidden[k] >= least or alarmed[k] for k in _sides(site))
    taken = {one.side for one in hidden}
    return [
        k
        for k, (one, free) in enumerate(zip(likely, rearmed, strict=True))
        if one and free and k not in taken
    ]


def _with_birth(memory: Memory, k: int, measurement: Measurement, site: SiteGeometry) -> Memory:
    """Return the memory with one more hidden entity on a side, of unknown side where it is the only one."""
    kept, counts, sides = list(memory.tracks), list(memory.births), memory.sides
    # After a hand-over it is another one, of the other side.
    first = sides.both is not None and not _hidden(kept) and all(_rearmed(memory))
    shares = sides.side_shares(site.settings.death_probability) if first else ()
    # What came into view from here before was another vehicle: the new one starts without its mass.
    forget = partial(ExplanationBelief.forget_origin, direction=k)
    memory = replace(memory, windows=memory.windows and memory.windows.map(forget))
    one = _returning(kept, k, measurement.stamp_ns, site)
    if one is None:
        one = born(site.sides[k].label, counts[k], 0.0, measurement.stamp_ns, site)
        # A detector adds to the kinds at the hand-over.
        one = replace(one, labels=measurement.kinds or one.labels, sources=(measurement.source,))
        counts[k] += 1
    else:
        kept.remove(one)
        shares = ()
    stamp_ns, motion = measurement.stamp_ns, site.sides[k].prior()
    one = replace(one, side=k, seen=False, came_from=1.0, existence=min(sides.hidden[k], 1.0))
    one = replace(one, motion=motion, updated_ns=stamp_ns, place=None, behind=1.0, side_shares=shares)
    kept.append(_on_its_side(one, sides, site))
    return replace(memory, tracks=tuple(kept), births=tuple(counts))


def _on_its_side(track: Track, sides: SideBelief, site: SiteGeometry) -> Track:
    """Return an entity of unknown side on its likelier one."""
    if track.of_side is not None:
        return _of_known_side(track, sides)
    shares = sides.side_shares(site.settings.death_probability)
    side = shares.index(max(shares))
    motion = track.motion if side == track.side else site.sides[side].prior()
    return replace(track, side=side, side_shares=shares, motion=motion, existence=sides.existence(None))


def _of_known_side(track: Track, sides: SideBelief) -> Track:
    if not track.side_shares:
        return track
    existence = track.existence if track.of_side is not None else sides.existence(track.side)
    return replace(track, side_shares=(), existence=existence)


def _rearmed(memory: Memory) -> list[bool]:
    return [ns is None or memory.stamp_ns - ns > _REARM_NS for ns in memory.handover_ns]


def _sides(site: SiteGeometry) -> range:
    return range(len(site.sides))


def _hidden(tracks: Iterable[Track]) -> list[Track]:
    return [one for one in tracks if not one.seen and one.behind >= HIDDEN]


def merged_tracks(memory: Memory, site: SiteGeometry) -> tuple[tuple[Track, ...], dict[str, str]]:
    """Return the tracks with those that have become one as one, and by the ids that end those that go on.

    Of two at one place, of the same class, one has just been found and the other not for a second. They go
    on where the first is, under the id that was known earlier; so do the halves of one of unknown side.
    """
    left, stamp_ns, into = list(memory.tracks), memory.stamp_ns, dict[str, str]()
    tracks = memory.tracks
    if _are_halves(_hidden(tracks), memory.sides, site):
        first, second = sorted(_hidden(tracks), key=_AGE)
        shares = memory.sides.side_shares(site.settings.death_probability)
        left.remove(second)
        left[left.index(first)] = _on_its_side(replace(first, side_shares=shares), memory.sides, site)
        into[second.id] = first.id
    found = [one for one in tracks if one.seen and one.last_seen_ns == stamp_ns]
    lost = [one for one in tracks if one.seen and stamp_ns - (one.last_seen_ns or 0) >= _ALONE_NS]
    for other in lost:
        same = next((one for one in found if _at_one_place(one, other)), None)
        if same is not None:
            first, second = sorted((same, other), key=_AGE)
            known = max(same.existence, other.existence)
            one = replace(
                same, id=first.id, created_ns=first.created_ns, came_from=first.came_from, existence=known
            )
            left.remove(other)
            left[left.index(same)] = found[found.index(same)] = one
            into[second.id] = first.id
    return tuple(left), into


def _are_halves(hidden: list[Track], sides: SideBelief, site: SiteGeometry) -> bool:
    r"""Tell whether two entities that are only heard are one, by the joint of both sides.

    .. math:: P(C_k, C_j) < p_{birth}^2

    which is less than two vehicles have that are each believed just enough to be born.
    """
    told_apart = any(one.detected or one.last_seen_ns is not None for one in hidden)
    if len(hidden) != 2 or told_apart or hidden[0].side == hidden[1].side:
        return False
    behind = all(sides.hidden_share(one.side) >= HIDDEN for one in hidden)
    return behind and sides.both is not None and sides.both < site.settings.birth_probability**2


def _at_one_place(one: Track, other: Track) -> bool:
    """Tell whether two tracks of one class stand within each other's deviations of azimuth and range.

    One that has left the view is soon anywhere in it: beyond the gate no sighting would have been its own.
    """
    gap = one.motion.mean - other.motion.mean
    gap[AZIMUTH] = wrap_angle(gap[AZIMUTH])
    variance = (one.motion.covariance + other.motion.covariance).diagonal()
    near = abs(gap[AZIMUTH]) <= GATE_RAD and all(gap[k] ** 2 <= variance[k] for k in (AZIMUTH, LOG_RANGE))
    alike = _likeliest(one) == _likeliest(other)
    return near and alike and one.moving == other.moving


def _likeliest(track: Track) -> str:
    return max(track.labels, key=itemgetter(1), default=(UNKNOWN, 1.0))[0]


def hidden_on(tracks: Iterable[Track], k: int) -> Track | None:
    """Return the likeliest hidden entity of a side, or one that may be there; None where there is none."""
    there = (one for one in _hidden(tracks) if one.may_be_on(k))
    return max(there, key=lambda one: (one.side == k, one.existence), default=None)


def _returning(tracks: list[Track], k: int, stamp_ns: int, site: SiteGeometry) -> Track | None:
    """Return the moving entity last seen near this side's edge within the reocclusion time, if any."""
    side = site.sides[k]
    candidates = [
        track
        for track in tracks
        if track.seen and track.moving and track.last_seen_ns is not None
        if REOCCLUSION_NS <= stamp_ns - track.last_seen_ns <= _REOCCLUSION_END_NS
        if side.distance_rad(track.motion.azimuth_rad) <= _REOCCLUSION_RAD
    ]
    return min(candidates, key=lambda track: side.distance_rad(track.motion.azimuth_rad), default=None)


# Of one step. The deaths and births of a whole street are fewer; a snapshot stays of bounded size.
MOST_EVENTS = 64


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


def _became(before: Track, after: Track | None) -> EventKind | None:
    if after is None:
        return "died"
    if before.seen != after.seen:
        return "handed_over" if after.seen else "hidden_again"
    return "coasting" if after.seen and before.answer == "visible" != after.answer else None


def after_look(
    memory: Memory, tracks: Sequence[Track], whose: Association, stamp_ns: int, site: SiteGeometry
) -> Memory:
    """Return the memory with the tracks after a look: those of before in their order, then the new ones."""
    before = memory.tracks
    emerged = (i for i in whose.found if tracks[i].seen and not before[i].seen)
    # Of the side where it is: what was heard may have been believed on the other one.
    handed_over = {tracks[i].side: max(HANDOVER_RESIDUAL, 1.0 - whose.chances[i]) for i in emerged}
    # First seen near an edge, it came past it unheard.
    unheard = {
        track.side
        for track in tracks[len(before) :]
        if track.seen and track.moving
        if site.sides[track.side].distance_rad(track.motion.azimuth_rad, track.width_rad)
        <= 2.0 * EDGE_STD_RAD
    }
    memory = replace(memory, tracks=surviving(tracks, site.settings))
    return past_edges(memory, handed_over, unheard, stamp_ns)


def past_edges(
    memory: Memory, handed_over: Mapping[int, float], unheard: Collection[int], stamp_ns: int
) -> Memory:
    """Return the memory after vehicles came past the edges of some sides: the one place that tells of it.

    `handed_over` is P(it was another vehicle than the one believed hidden there), by side; `unheard` are
    sides from which one came that was not believed.
    """
    if not handed_over and not unheard:
        return memory
    windows, sequence = memory.windows, memory.sequence
    for side, residual in handed_over.items():
        emerge = partial(ExplanationBelief.emerge, direction=side, residual=residual)
        windows = windows and windows.map(emerge)
    if sequence is not None:
        hidden = [one for one in memory.tracks if not one.seen]
        # One that is still believed hidden where another came from was not what came.
        left = {k: float(any(one.side == k for one in hidden)) for k in unheard}
        # Vehicles of another side that were told apart before: by a message, or since they were seen.
        apart = {one.side for one in hidden if one.detected or one.last_seen_ns is not None}
        sequence = sequence.handed_over(left | dict(handed_over), apart, stamp_ns)
    before = enumerate(memory.handover_ns)
    return replace(
        memory,
        windows=windows,
        handover_ns=tuple(stamp_ns if k in handed_over else before_ns for k, before_ns in before),
        sequence=sequence,
    )


def surviving(tracks: Sequence[Track], settings: FilterSettings) -> tuple[Track, ...]:
    """Return the tracks without seen entities of too little existence or too uncertain azimuth."""
    least = settings.delete_existence
    return tuple(
        track
        for track in tracks
        if not track.seen or (track.existence >= least and track.motion.azimuth_std_rad <= _LOST_RAD)
    )
