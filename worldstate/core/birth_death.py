"""Birth and death of hidden entities, one at most on each side; entities that have become one."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter

from worldstate.abduction.road_users import UNKNOWN
from worldstate.belief.explanation import ExplanationBelief
from worldstate.belief.kinematics.polar import AZIMUTH, LOG_RANGE
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import Track, entity_id, heard_as
from worldstate.ground.values import NANOSECONDS_PER_SECOND, nanoseconds, wrap_angle
from worldstate.measurement.measurement import Measurement

from .memory import Memory

# Of two at one place; whoever is found by himself within it is somebody else.
_ALONE_NS = nanoseconds(1.0)


def birth_death(
    memory: Memory, alarmed: Sequence[bool], measurement: Measurement, site: SiteGeometry
) -> Memory:
    """Return the memory with hidden entities born, updated and removed.

    Shapes: alarmed (K,).
    """
    settings, sides, kept, counts = site.settings, memory.sides, list(memory.tracks), list(memory.births)
    rearm_ns = settings.rearm_s * NANOSECONDS_PER_SECOND
    for k, before_ns in enumerate(memory.handover_ns):
        current, existence = hidden_on(kept, k), sides.existence(k)
        if current is not None:
            kept.remove(current)
            current = replace(current, labels=heard_as(current, measurement.kinds))
            if current.place is not None:
                # It was announced, and is there until its place is lost.
                kept.append(current)
            elif existence >= settings.death_probability or alarmed[k]:
                kept.append(replace(current, existence=existence))
            continue
        rearmed = before_ns is None or memory.stamp_ns - before_ns > rearm_ns
        if rearmed and (sides.hidden[k] >= settings.birth_probability or alarmed[k]):
            # What came into view from here before was another vehicle: the new one starts without its mass.
            memory = memory.explained(partial(ExplanationBelief.forget_origin, direction=k))
            returning = _returning(kept, k, measurement.stamp_ns, site)
            if returning is None:
                kept.append(_born(k, counts[k], min(sides.hidden[k], 1.0), measurement, site))
                counts[k] += 1
            else:
                kept.remove(returning)
                kept.append(_hidden_again(returning, k, min(sides.hidden[k], 1.0), measurement, site))
    return replace(memory, tracks=tuple(kept), births=tuple(counts))


def merged_tracks(tracks: tuple[Track, ...], stamp_ns: int) -> tuple[tuple[Track, ...], dict[str, str]]:
    """Return the tracks with those that have become one as one, and by the ids that end those that go on.

    Of two at one place, of the same class, one has just been found and the other not for a second. They go
    on where the first is, as whoever was known earlier.
    """
    left, into = list(tracks), dict[str, str]()
    found = [one for one in tracks if one.seen and one.last_seen_ns == stamp_ns]
    lost = [one for one in tracks if one.seen and stamp_ns - (one.last_seen_ns or 0) >= _ALONE_NS]
    for other in lost:
        same = next((one for one in found if _at_one_place(one, other)), None)
        if same is not None:
            first, second = sorted((same, other), key=lambda one: (one.created_ns, one.id))
            known = max(same.existence, other.existence)
            one = replace(
                same, id=first.id, created_ns=first.created_ns, was_hidden=first.was_hidden, existence=known
            )
            left.remove(other)
            left[left.index(same)] = found[found.index(same)] = one
            into[second.id] = first.id
    return tuple(left), into


def _at_one_place(one: Track, other: Track) -> bool:
    """Tell whether two tracks of one class stand within each other's deviations of azimuth and range."""
    gap = one.motion.mean - other.motion.mean
    gap[AZIMUTH] = wrap_angle(gap[AZIMUTH])
    variance = (one.motion.covariance + other.motion.covariance).diagonal()
    near = all(gap[k] ** 2 <= variance[k] for k in (AZIMUTH, LOG_RANGE))
    alike = _likeliest(one) == _likeliest(other)
    return near and alike and one.moving == other.moving


def _likeliest(track: Track) -> str:
    return max(track.labels, key=itemgetter(1), default=(UNKNOWN, 1.0))[0]


def hidden_on(tracks: Iterable[Track], k: int) -> Track | None:
    """Return the likeliest hidden entity of a side; None where there is none."""
    hidden = [one for one in tracks if not one.seen and one.side == k and one.behind >= 0.5]
    return max(hidden, key=lambda one: one.existence, default=None)


def _returning(tracks: list[Track], k: int, stamp_ns: int, site: SiteGeometry) -> Track | None:
    """Return the moving entity last seen near this side's edge within the reocclusion time, if any."""
    side, settings = site.sides[k], site.settings
    earliest_ns = stamp_ns - settings.reocclusion_s * NANOSECONDS_PER_SECOND
    latest_ns = stamp_ns - settings.reocclusion_after_s * NANOSECONDS_PER_SECOND
    candidates = [
        track
        for track in tracks
        if track.seen and track.moving and track.last_seen_ns is not None
        if earliest_ns <= track.last_seen_ns <= latest_ns
        if side.distance_rad(track.motion.azimuth_rad) <= settings.reocclusion_gate_rad
    ]
    return min(candidates, key=lambda track: side.distance_rad(track.motion.azimuth_rad), default=None)


def _hidden_again(
    track: Track, k: int, existence: float, measurement: Measurement, site: SiteGeometry
) -> Track:
    return replace(
        track,
        side=k,
        seen=False,
        was_hidden=True,
        existence=existence,
        motion=site.prior(k),
        updated_ns=measurement.stamp_ns,
        place=None,
        behind=1.0,
    )


def _born(k: int, number: int, existence: float, measurement: Measurement, site: SiteGeometry) -> Track:
    return Track(
        id=entity_id(site.settings.stream, site.sides[k].label, number),
        side=k,
        seen=False,
        existence=existence,
        motion=site.prior(k),
        # A detector adds to it at the hand-over.
        labels=measurement.kinds or ((UNKNOWN, 1.0),),
        moving=True,
        sources=(measurement.source,),
        created_ns=measurement.stamp_ns,
        updated_ns=measurement.stamp_ns,
        was_hidden=True,
    )
