"""Since when those who came into view were heard, by the snapshots that a filter wrote of the recording."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from operator import attrgetter

from worldstate.ground.values import seconds
from worldstate.smoothing.learned_street import ARMS
from worldstate.state import Entity

from .pass_labels import PassLabel

_EXISTS = 0.5  # Likelier than not: a birth is no more than that
# Boxes and smoothing set T0 later or earlier than the filter has its first sighting, by .2 s at most in nine
# of ten passes (docs/smoothing.md); by then the entity is no longer hidden.
_BEFORE_S = 0.2


def with_hidden_times(
    passes: Sequence[PassLabel], snapshots: Iterable[tuple[float, Sequence[Entity]]]
) -> list[PassLabel]:
    """Return the passes with the time since which an entity that existed at T0 was believed on their arm.

    Snapshots are times in order, each with its entities. Whoever came unheard, or after the last one, keeps
    None.
    """
    found = list(passes)
    last: dict[str, float | None] = dict.fromkeys(ARMS)
    waiting = sorted(range(len(found)), key=lambda at: -found[at].t0.time_s)
    for time_s, entities in snapshots:
        while waiting and time_s > found[waiting[-1]].t0.time_s - _BEFORE_S:
            at = waiting.pop()
            found[at] = replace(found[at], heard_s=last[found[at].arm])
        last = {arm: _hidden_since_s(entities, arm) for arm in ARMS}
    return found


def _hidden_since_s(entities: Sequence[Entity], arm: str) -> float | None:
    """Return since when the likeliest entity hidden on an arm has been there, None without one."""
    hidden = (one for one in entities if one.status == "hidden" and one.direction == arm)
    likeliest = max(hidden, key=attrgetter("existence_probability"), default=None)
    if likeliest is None or likeliest.existence_probability < _EXISTS:
        return None
    return seconds(likeliest.created_ns)
