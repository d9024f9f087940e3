"""The entities after a step: births, deaths, events, relations, and since when advisories have been out."""

from dataclasses import replace

from worldstate.belief.hidden_bearing import hidden_motion
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import Track, hidden_share
from worldstate.ground.values import NotUsable
from worldstate.measurement import Measurement

from .advisories import advisories
from .birth_death import HIDDEN, birth_death, events_between, merged_tracks, published
from .memory import Memory
from .relations import relations_at
from .site_model import FilterModel


def update_entities(memory: Memory, measurement: Measurement, model: FilterModel) -> Memory:
    """Return the memory after births and deaths of hidden entities."""
    alarmed = [one is not None for one in advisories(memory, model)]
    memory = birth_death(memory, alarmed, measurement, model.site)
    return replace(
        memory,
        tracks=_on_their_way(memory, model.site),
        seq=memory.seq + 1,
        bearing=None if isinstance(measurement.bearing, NotUsable) else measurement.bearing,
        domain=measurement.domain,
    )


def _on_their_way(memory: Memory, site: SiteGeometry) -> tuple[Track, ...]:
    """Return the tracks, those that are only heard and hidden where the sequence has them."""
    kept, sides, tracks = memory.sequence, memory.sides, memory.tracks
    if kept is None:
        return tracks
    coming, shares = kept.coming, [hidden_share(one, sides) for one in tracks]
    return tuple(
        replace(one, motion=hidden_motion(coming[one.side], share, site.sides[one.side], one.motion))
        if not one.seen and one.place is None and share >= HIDDEN
        else one
        for one, share in zip(tracks, shares, strict=True)
    )


def chronicled(before: Memory, carried: Memory, after: Memory, model: FilterModel) -> Memory:
    """Return the memory after a step with its events, and since when advisories have been out.

    An advisory that had ended in the memory that was carried to the time of the step begins anew.
    """
    told = (advisories(one, model) for one in (carried, after))
    advised_ns = tuple(
        (since_ns if since_ns is not None and held is not None else after.stamp_ns) if named else None
        for since_ns, held, named in zip(before.advised_ns, *told, strict=True)
    )
    tracks, into = merged_tracks(after, model.site)
    known, now = (published(one, model.site.settings) for one in (before.tracks, tracks))
    events = events_between(known, now, after.stamp_ns, into)
    relations = relations_at(after, now, before.relations, model.context)
    return replace(after, tracks=tracks, advised_ns=advised_ns, events=events, relations=relations)
