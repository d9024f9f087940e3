"""Births, hand-overs and deaths of entities, those that have become one, and the events of all this."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from operator import attrgetter, itemgetter

from worldstate.abduction.road_users import UNKNOWN
from worldstate.belief.association import EDGE_STD_RAD, GATE_RAD, HANDOVER_RESIDUAL
from worldstate.belief.kinematics.motion import AZIMUTH, LOG_RANGE
from worldstate.belief.settings import FilterSettings
from worldstate.belief.side_belief import TIE, SideBelief
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import Track, born, heard_as
from worldstate.belief.window_belief import ExplanationBelief, WindowBelief
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
) -> None:
    """Let hidden entities be born, go on or end.

    Shapes: alarmed (K,).
    """
    heard = [hidden_on(memory.tracks, k) for k in _sides(site)]
    memory.tracks = tuple(
        one
        for one in memory.tracks
        if one not in heard or _goes_on(one, alarmed, measurement, memory.sides, site)
    )
    # Before births: another one is born on the side that it leaves.
    for one in memory.tracks:
        if one.side_shares:
            _put_on_its_side(one, memory.sides, site)
    for k in _sides_of_births(memory, alarmed, site):
        _give_birth(memory, k, measurement, site)
    if len(_hidden(memory.tracks)) != 1 or memory.sides.hidden_share(None) < HIDDEN:
        for one in memory.tracks:
            if one.of_side is None:
                one.side_shares, one.existence = (), memory.sides.existence(one.side)


def _goes_on(
    track: Track, alarmed: Sequence[bool], measurement: Measurement, sides: SideBelief, site: SiteGeometry
) -> bool:
    """Update a hidden entity by one more hop; tell whether it is still believed."""
    track.labels = heard_as(track, measurement.kinds)
    if track.place is not None:
        return True  # It was announced, and is there until its place is lost
    track.existence = sides.existence(track.of_side)
    named = any(alarmed[k] for k in _sides(site) if track.of_side in (k, None))
    return track.existence >= site.settings.death_probability or named


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


def _give_birth(memory: Memory, k: int, measurement: Measurement, site: SiteGeometry) -> None:
    """Add one more hidden entity on a side, of unknown side where it is the only one."""
    sides, shares = memory.sides, tuple[float, ...]()
    one = _returning(memory.tracks, k, measurement.stamp_ns, site)
    if one is None:
        # After a hand-over it is another one, of the other side.
        if sides.both is not None and not _hidden(memory.tracks) and all(_rearmed(memory)):
            shares = sides.side_shares(site.settings.death_probability)
        one = born(site.sides[k].label, memory.history[k].births, 0.0, measurement.stamp_ns, site)
        memory.history[k].births += 1
        # A detector adds to the kinds at the hand-over.
        one.labels, one.sources = measurement.kinds or one.labels, (measurement.source,)
    # What came into view from here before was another vehicle: the new one starts without its mass.
    if isinstance(memory.belief, WindowBelief):
        memory.belief = memory.belief.map(partial(ExplanationBelief.forget_origin, direction=k))
    one.side, one.seen, one.came_from, one.existence = k, False, 1.0, min(sides.hidden[k], 1.0)
    one.motion, one.updated_ns = site.sides[k].prior(), measurement.stamp_ns
    one.place, one.behind, one.side_shares = None, 1.0, shares
    _put_on_its_side(one, sides, site)
    memory.tracks = (*(other for other in memory.tracks if other is not one), one)


def _put_on_its_side(track: Track, sides: SideBelief, site: SiteGeometry) -> None:
    """Put an entity of unknown side on its likelier one; in a tie it stays, which rounding must not undo."""
    if track.of_side is not None:
        track.side_shares = ()
        return
    shares = sides.side_shares(site.settings.death_probability)
    if shares[track.side] < max(shares) * (1.0 - TIE):
        side = shares.index(max(shares))
        track.side, track.motion = side, site.sides[side].prior()
    track.side_shares, track.existence = shares, sides.existence(None)


def _rearmed(memory: Memory) -> list[bool]:
    stamps_ns = (one.handover_ns for one in memory.history)
    return [ns is None or memory.stamp_ns - ns > _REARM_NS for ns in stamps_ns]


def _sides(site: SiteGeometry) -> range:
    return range(len(site.sides))


def _hidden(tracks: Iterable[Track]) -> list[Track]:
    return [one for one in tracks if not one.seen and one.behind >= HIDDEN]


def merge_tracks(memory: Memory, site: SiteGeometry) -> dict[str, str]:
    """Merge tracks that have become one; return by the ids that end those that go on.

    Of two at one place, of the same class, one has just been found and the other not for a second. They go
    on where the first is, under the id that was known earlier; so do the halves of one of unknown side.
    """
    tracks, stamp_ns, into = memory.tracks, memory.stamp_ns, dict[str, str]()
    ended = list[Track]()
    if _are_halves(_hidden(tracks), memory.sides, site):
        first, second = sorted(_hidden(tracks), key=_AGE)
        first.side_shares = memory.sides.side_shares(site.settings.death_probability)
        _put_on_its_side(first, memory.sides, site)
        ended.append(second)
        into[second.id] = first.id
    found = [one for one in tracks if one.seen and one.last_seen_ns == stamp_ns]
    lost = [one for one in tracks if one.seen and one.unseen_ns(stamp_ns) >= _ALONE_NS]
    for other in lost:
        same = next((one for one in found if _at_one_place(one, other)), None)
        if same is not None:
            first, second = sorted((same, other), key=_AGE)
            into[second.id] = first.id
            same.existence = max(same.existence, other.existence)
            same.id, same.created_ns, same.came_from = first.id, first.created_ns, first.came_from
            ended.append(other)
    memory.tracks = tuple(one for one in tracks if one not in ended)
    return into


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


def _returning(tracks: Iterable[Track], k: int, stamp_ns: int, site: SiteGeometry) -> Track | None:
    """Return the moving entity last seen near this side's edge within the reocclusion time, if any."""
    side = site.sides[k]
    candidates = [
        track
        for track in tracks
        if track.seen and track.moving
        if REOCCLUSION_NS <= track.unseen_ns(stamp_ns) <= _REOCCLUSION_END_NS
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
    memory: Memory, emerged: Mapping[int, float], fresh: Iterable[Track], stamp_ns: int, site: SiteGeometry
) -> None:
    """Update the memory after a look that has found new tracks, and some that were not seen before.

    `emerged` is the chance that a detection was theirs, by their places in the memory.
    """
    # Of the side where it is: what was heard may have been believed on the other one.
    handed_over = {
        memory.tracks[i].side: max(HANDOVER_RESIDUAL, 1.0 - chance) for i, chance in emerged.items()
    }
    # First seen near an edge, it came past it unheard.
    unheard = {
        track.side
        for track in fresh
        if track.seen and track.moving
        if site.sides[track.side].distance_rad(track.motion.azimuth_rad, track.width_rad)
        <= 2.0 * EDGE_STD_RAD
    }
    memory.tracks = surviving(memory.tracks, site.settings)
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
        hidden = [one for one in memory.tracks if not one.seen]
        # One that is still believed hidden where another came from was not what came.
        left = {k: float(any(one.side == k for one in hidden)) for k in unheard}
        # Vehicles of another side that were told apart before: by a message, or since they were seen.
        apart = {one.side for one in hidden if one.detected or one.last_seen_ns is not None}
        memory.belief = memory.belief.handed_over(left | dict(handed_over), apart, stamp_ns)
    for side in handed_over:
        memory.history[side].handover_ns = stamp_ns


def surviving(tracks: Sequence[Track], settings: FilterSettings) -> tuple[Track, ...]:
    """Return the tracks without seen entities of too little existence or too uncertain azimuth."""
    least = settings.delete_existence
    return tuple(
        track
        for track in tracks
        if not track.seen or (track.existence >= least and track.motion.azimuth_std_rad <= _LOST_RAD)
    )
