"""Events: what became of an entity in a step."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

EventKind: TypeAlias = Literal["born", "handed_over", "coasting", "hidden_again", "died", "merged"]


@dataclass(frozen=True, slots=True)
class Event:
    """A change in the life of an entity.

    Parameters
    ----------
    stamp_ns : int
        Of the measurement that brought it, ns.
    kind : {"born", "handed_over", "coasting", "hidden_again", "died", "merged"}
        Begun; come into view of a sensor that had not seen it; in view before and not found by the last look;
        seen before and now behind an occluder; dropped; gone on as another one.
    entity_id : str
        Whose.
    into : str or None
        As whom a merged one goes on; None of all other kinds.

    Examples
    --------
    >>> Event(0, "born", "a").kind
    'born'
    """

    stamp_ns: int
    kind: EventKind
    entity_id: str
    into: str | None = None
