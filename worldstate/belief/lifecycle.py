"""Birth and death of hidden entities."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from worldstate.values import NANOSECONDS_PER_SECOND

from .explanation import ExplanationBelief
from .settings import FilterSettings
from .side import Side
from .track import Track, entity_id

HIDDEN_LABEL = "vehicle"


@dataclass(frozen=True, slots=True)
class Hidden:
    """Outcome: the tracks, the explanations, and how many entities each side has brought forth."""

    tracks: tuple[Track, ...]
    explanation: ExplanationBelief
    births: tuple[int, ...]


def renew_hidden(
    tracks: tuple[Track, ...],
    explanation: ExplanationBelief,
    births: tuple[int, ...],
    alarmed: Sequence[bool],
    rearmed: Sequence[bool],
    sides: tuple[Side, ...],
    stamp_ns: int,
    source: str,
    settings: FilterSettings,
) -> Hidden:
    """Return the world with hidden entities born, refreshed and dropped, one at most per side.

    Parameters
    ----------
    tracks, explanation, births
        The world before; `births` counts per side.
    alarmed : sequence of bool, shape (K,)
        Whether an advisory names the side: a cue without an entity to point at would be of no use.
    rearmed : sequence of bool, shape (K,)
        Whether the side may bring forth an entity again after a hand-over.
    """
    kept, counts = list(tracks), list(births)
    for k, side in enumerate(sides):
        current = next((track for track in kept if not track.seen and track.side == k), None)
        if current is None:
            heard = explanation.hidden[k] >= settings.birth_probability or alarmed[k]
            if heard and rearmed[k]:
                explanation = explanation.disown(k)
                returning = _returning(kept, side, stamp_ns, settings)
                kept = [track for track in kept if track is not returning]
                kept.append(_born(returning, k, side, counts[k], explanation, stamp_ns, source, settings))
                counts[k] += returning is None
        else:
            kept.remove(current)
            existence = explanation.hidden[k] + explanation.emerged[k]
            if existence >= settings.death_probability or alarmed[k]:
                kept.append(replace(current, existence=existence))
    return Hidden(tuple(kept), explanation, tuple(counts))


def _returning(
    tracks: list[Track], side: Side, stamp_ns: int, settings: FilterSettings
) -> Track | None:
    """Return the entity that left view near this side a moment ago, if there is one."""
    candidates = [
        track
        for track in tracks
        if track.seen
        and track.moving
        and track.last_seen_ns is not None
        and settings.reocclusion_after_s * NANOSECONDS_PER_SECOND
        <= stamp_ns - track.last_seen_ns
        <= settings.reocclusion_s * NANOSECONDS_PER_SECOND
        and side.distance_rad(track.motion.azimuth_rad) <= settings.handover_gate_rad
    ]
    return min(candidates, key=lambda track: side.distance_rad(track.motion.azimuth_rad), default=None)


def _born(
    returning: Track | None,
    k: int,
    side: Side,
    number: int,
    explanation: ExplanationBelief,
    stamp_ns: int,
    source: str,
    settings: FilterSettings,
) -> Track:
    prior, existence = side.prior(settings), explanation.hidden[k]
    if returning is not None:
        hidden = replace(returning, side=k, seen=False, was_hidden=True)
        return replace(hidden, existence=existence, motion=prior, updated_ns=stamp_ns)
    return Track(
        id=entity_id(settings.stream, side.label, number),
        side=k,
        seen=False,
        existence=existence,
        motion=prior,
        labels=((HIDDEN_LABEL, 1.0),),
        moving=True,
        sources=(source,),
        created_ns=stamp_ns,
        updated_ns=stamp_ns,
        was_hidden=True,
    )
