"""Views of a state: a text of at most three lines, a headline, and the rows of a table."""

import math
from collections.abc import Iterable, Iterator
from textwrap import shorten
from typing import TYPE_CHECKING

from worldstate.ground.extras import optional

if TYPE_CHECKING:
    import pandas

    from .cue import RiskCue
    from .entity import Entity
    from .world_state import WorldState

MOST_LINES, MOST_CHARACTERS = 3, 240
# A vehicle in view is printed if it more likely exists than not.
_LIKELY = 0.5
COLUMNS = (
    "time_s", "side", "risk", "advisory", "began", "usable", "why_not", "in_view_within_3_s",
    "time_to_visible_s", "azimuth_deg", "entity_id",
)  # fmt: skip


def text(state: "WorldState") -> str:
    """Return a state as `print` shows it: at most three lines and 240 characters.

    Examples
    --------
    >>> from worldstate.state import WorldState
    >>> text(WorldState(1_500_000_000, 0))
    '1.5 s  no measurement yet'
    """
    lines = _lines(state)[:MOST_LINES]
    at = f"{state.time_s:.1f} s  "
    whole = at + f"\n{' ' * len(at)}".join(lines)
    return whole if len(whole) <= MOST_CHARACTERS else whole[: MOST_CHARACTERS - 3] + "..."


def headline(state: "WorldState") -> str:
    """Return the first sentence of a page: the advisories, or the highest risk.

    Examples
    --------
    >>> from worldstate.state import WorldState
    >>> headline(WorldState(0, 0))
    'There is no measurement yet.'
    """
    sides = [cue for cue in state.cues if cue.direction and cue.risk is not None]
    if advised := [cue for cue in sides if cue.advisory]:
        said = "; ".join(f"{_plain(cue.direction)}: a vehicle is hidden, {_chance(cue)}" for cue in advised)
        return f"{said[:1].upper()}{said[1:]}."
    if sides:
        highest = max(sides, key=lambda cue: cue.risk or 0.0)
        return f"No advisory. The highest risk is {highest.risk:.2f}, on the {_plain(highest.direction)}."
    if state.bearing is not None:
        return f"A sound comes from {_towards(state.bearing.azimuth_rad)}; its risk cannot be stated."
    return "No risk can be stated." if state.seq else "There is no measurement yet."


def to_dataframe(states: "Iterable[WorldState]") -> "pandas.DataFrame":
    """Return states as a table of pandas: one row per state and approach side.

    A state without a side, such as one of an array without a model, has one row. Unknown values are None or
    NaN.

    Parameters
    ----------
    states : iterable of WorldState
        As `worldstate.run`, `read` and `listen` return them.

    Returns
    -------
    pandas.DataFrame
        Columns ``time_s`` (s, on the clock of the state), ``side``, ``risk``, ``advisory`` (true during one),
        ``began`` (true in its first state), ``usable``, ``why_not`` (reasons joined by commas),
        ``in_view_within_3_s`` (probability), ``time_to_visible_s`` (best estimate, s), ``azimuth_deg``
        (degrees, left positive) and ``entity_id``.

    Raises
    ------
    MissingExtraError
        If pandas is not installed.

    Examples
    --------
    >>> from worldstate.ground import MissingExtraError
    >>> from worldstate.state import WorldState
    >>> try:
    ...     print(list(to_dataframe([WorldState(0, 0)]).time_s))
    ... except MissingExtraError:
    ...     print([0.0])
    [0.0]
    """
    pandas = optional("pandas")
    return pandas.DataFrame([row for state in states for row in _rows(state)], columns=list(COLUMNS))


def _rows(state: "WorldState") -> Iterator[tuple[object, ...]]:
    for cue in [one for one in state.cues if one.direction]:
        within = (cue.within or {}).get("3")
        best_s = cue.time_to_visible_s and cue.time_to_visible_s[1]
        advised = cue.advisory is not None, cue.began, cue.usable, ", ".join(cue.why_not)
        yield state.time_s, cue.direction, cue.risk, *advised, within, best_s, cue.azimuth_deg, cue.entity_id
    if not any(one.direction for one in state.cues):
        yield state.time_s, *[None] * (len(COLUMNS) - 1)


def _lines(state: "WorldState") -> list[str]:
    sides = [cue for cue in state.cues if cue.direction]
    if state.no_model is not None:
        sound = "no sound with a direction"
        if state.bearing is not None:
            sound = f"sound from {_towards(state.bearing.azimuth_rad)}"
        lines = [f"{sound}; no risk: {shorten(_plain(state.no_model.reason), 100)}"]
    elif not sides:
        lines = ["no risk can be stated" if state.seq else "no measurement yet"]
    else:
        lines = [_advised(state, cue) for cue in sides if cue.advisory] or [_quiet(sides)]
    in_view = [one for one in state.entities if one.moving and one.status in ("visible", "emerged")]
    likeliest = max(in_view, key=lambda one: one.existence_probability, default=None)
    if likeliest is not None and likeliest.existence_probability >= _LIKELY:
        lines.append(f"in view: {_kind(likeliest)} at {_towards(likeliest.azimuth_rad)}")
    return lines


def _advised(state: "WorldState", cue: "RiskCue") -> str:
    hidden = (one for one in state.entities if one.id == cue.entity_id and one.status == "hidden")
    entity = next(hidden, None)
    place = f"hidden {_kind(entity)} at {_towards((entity or cue).azimuth_rad)}"
    risk = "unknown" if cue.risk is None else f"{cue.risk:.2f}"
    times = cue.time_to_visible_s and "{1:.1f} s ({0:.1f} to {2:.1f})".format(*cue.time_to_visible_s)
    parts = f"ADVISORY{_unless_usable([cue])}", f"risk {risk}", place, f"in view in {times}" if times else ""
    return f"{_plain(cue.direction)}: {', '.join(filter(None, parts))}"


def _quiet(sides: "list[RiskCue]") -> str:
    risks = ", ".join(f"{cue.risk:.2f} {_plain(cue.direction)}" for cue in sides if cue.risk is not None)
    return f"no advisory{_unless_usable(sides)}, risk {risks or 'unknown'}"


def _unless_usable(cues: "list[RiskCue]") -> str:
    reasons = dict.fromkeys(reason for cue in cues for reason in cue.why_not)
    return f" (not usable: {', '.join(reasons)})" if reasons else ""


def _chance(cue: "RiskCue") -> str:
    within = (cue.within or {}).get("3")
    return f"risk {cue.risk:.2f}" if within is None else f"{100.0 * within:.0f} % to appear within 3 s"


def _kind(entity: "Entity | None") -> str:
    known = () if entity is None else entity.classification or ()
    likeliest = max(known, key=lambda one: one.probability, default=None)
    return "vehicle" if likeliest is None or likeliest.label == "unknown" else _plain(likeliest.label)


def _towards(azimuth_rad: float) -> str:
    degrees = round(math.degrees(azimuth_rad))
    return f"{abs(degrees)} degrees {'left' if degrees >= 0 else 'right'}" if degrees else "straight ahead"


def _plain(name: str | None) -> str:
    """Return a name without characters that break a line or control a terminal."""
    return " ".join("".join(one if one.isprintable() else " " for one in name or "").split())
