"""Hand-overs: a hidden vehicle comes into view, and what a look has left of the entities."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

from worldstate.belief.association import Association
from worldstate.belief.explanation import ExplanationBelief
from worldstate.belief.settings import FilterSettings
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import Track

from .memory import Memory


def after_look(
    memory: Memory, tracks: Sequence[Track], whose: Association, stamp_ns: int, site: SiteGeometry
) -> Memory:
    """Return the memory with the tracks after a look: those of before in their order, then the new ones."""
    before, settings = memory.tracks, site.settings
    handed_over = whose.handed_over(before, tracks[: len(before)], settings)
    explanation = memory.explanation
    for side, residual in handed_over.items():
        explanation = explanation.emerge(side, residual)
    # First seen near an edge, it came past it unheard.
    unheard = {
        track.side
        for track in tracks[len(before) :]
        if track.seen and track.moving
        if site.sides[track.side].distance_rad(track.motion.azimuth_rad) <= 2.0 * settings.edge_std_rad
    }
    memory = replace(memory, tracks=surviving(tracks, settings), explanation=explanation)
    return past_edges(memory, handed_over, {*handed_over, *unheard}, stamp_ns)


def past_edges(
    memory: Memory, handed_over: Mapping[int, float], emerged: Collection[int], stamp_ns: int
) -> Memory:
    """Return the memory after vehicles came past the edges of some sides.

    `handed_over` is the share of P(hidden) that is left on the sides on which a vehicle was believed hidden.
    """
    # The lagged beliefs are what the next windows build on: they have to know of the hand-over, too.
    lag = memory.lag
    for side, residual in handed_over.items():
        lag = lag.map(partial(ExplanationBelief.emerge, direction=side, residual=residual))
    before = enumerate(memory.handover_ns)
    return replace(
        memory,
        lag=lag,
        handover_ns=tuple(stamp_ns if k in handed_over else before_ns for k, before_ns in before),
        sequence=memory.sequence and memory.sequence.emerged(emerged, stamp_ns),
    )


def surviving(tracks: Sequence[Track], settings: FilterSettings) -> tuple[Track, ...]:
    """Return the tracks without seen entities of too little existence or too uncertain azimuth."""
    least, widest_rad = settings.delete_existence, settings.lost_std_rad
    return tuple(
        track
        for track in tracks
        if not track.seen or (track.existence >= least and track.motion.azimuth_std_rad <= widest_rad)
    )
