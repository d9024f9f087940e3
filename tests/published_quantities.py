"""Quantities of a snapshot, and snapshots with one of them held at its first value."""

import copy
from dataclasses import fields, is_dataclass
from types import UnionType
from typing import Any, get_args, get_type_hints

from worldstate import WorldState

# Names that a reader may assume; no filter sets another value.
CONSTANT = {"WorldState.frame_id", "WorldState.clock"}


def published(kind: Any = WorldState) -> dict[type, list[str]]:
    """Return the fields of every dataclass of a snapshot, by class."""
    found: dict[type, list[str]] = {}
    waiting = [kind]
    while waiting:
        one = waiting.pop()
        if is_dataclass(one) and isinstance(one, type) and one not in found:
            found[one] = [field.name for field in fields(one)]
            waiting += get_type_hints(one).values()
        elif isinstance(one, UnionType) or get_args(one):
            waiting += get_args(one)
    return found


def quantities() -> list[str]:
    """Return the names of all quantities of a snapshot."""
    every = [f"{kind.__name__}.{name}" for kind, names in published().items() for name in names]
    return sorted(set(every) - CONSTANT)


def held(value: Any, name: str, first: dict[str, Any]) -> Any:
    """Return a value with the quantity of this name as in the first snapshot."""
    if isinstance(value, tuple):
        return tuple(held(one, name, first) for one in value)
    if not is_dataclass(value):
        return value
    value = copy.copy(value)
    for field in fields(value):
        now = held(getattr(value, field.name), name, first)
        if f"{type(value).__name__}.{field.name}" == name:
            now = first.setdefault(name, now)
        # Without the checks of the constructor: tests of published values must detect it.
        object.__setattr__(value, field.name, now)
    return value
